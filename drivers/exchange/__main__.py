"""The exchange process. Started by `ExchangeProcess`, which passes the descriptors it needs."""

from __future__ import annotations

import importlib
import os
import pickle
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.drive_train import DriveTrain
from drivers.exchange import realtime
from drivers.exchange.control import ControlBlock
from drivers.exchange.event_log import EventWriter, ExchangeEnded, ExchangeFailed, ExchangeStarted
from drivers.exchange.loop import exchange
from drivers.exchange.process import ExchangeSettings
from drivers.exchange.serving import ControlServer, portable
from drivers.guard import Guard, GuardLimits
from drivers.motion_source import BoundsName
from drivers.packets import DRIVE_ON, INIT_NUMBER, CyclicPacket, InitPacket, Mode, next_number
from drivers.record import CycleRing, PacketRing
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport
from drivers.transports.tapped import TappedTransport

Array = NDArray[np.float64]

CYCLES: Final = 200
_HEADER: Final = struct.Struct("<i4B4x")


class _Rest:
    """A motion that stays where it begins."""

    finished = False
    bounds: BoundsName = "plan"

    def __init__(self, position: Array) -> None:
        self.start = position
        self._velocity = np.zeros_like(position)

    def begin(self, position: Array) -> None:
        self.start = position

    def advance(self) -> tuple[Array, Array]:
        return self.start, self._velocity

    def stop(self) -> None:
        self.finished = True


class Rehearsal:
    """A session of an arm and the controller it assumes; `cycle` runs one packet.

    Attributes:
        state: of the session; `State.OPEN` from the second cycle on.
    """

    def __init__(self, drive_train: DriveTrain, limits: GuardLimits, period: float) -> None:
        n = drive_train.n_joints
        position = 0.5 * (limits.lower + limits.upper)
        self._session = Session(drive_train, Guard(limits, period), CycleRing(n, 16))
        self._axes = CyclicPacket.zeros(1, n).axes
        self._axes["d"][:, 0] = self._axes["d"][:, 2] = drive_train.motor_revolutions(position)
        self._number = INIT_NUMBER
        init = InitPacket.build(n, round(1000.0 * period), _init_values(drive_train, limits))
        self._session.reply(init.encode(), 0.0)
        self._session.request(_Rest(position))

    @property
    def state(self) -> State:
        """Where the session stands."""
        return self._session.state

    def cycle(self) -> bytes | None:
        """The answer to one more packet."""
        first = self._number == INIT_NUMBER and self._session.state is State.INIT
        self._axes["mode"] = Mode.CLOSED if first else Mode.POSITION
        self._number = next_number(self._number)
        packet = _HEADER.pack(self._number, DRIVE_ON, 0, 0, 0) + self._axes.tobytes()
        return self._session.reply(packet, 0.0)


def _init_values(drives: DriveTrain, limits: GuardLimits) -> Mapping[str, ArrayLike]:
    """What the controller of this arm would say of it."""
    return {
        "gear_ratio": drives.gear_ratio,
        "calibration": drives.calibration,
        "kinematic_influence": [0.0, 0.0, 0.0, drives.k54, drives.k64, drives.k65],
        "current_limit": limits.current,
        "following_error": limits.following_error,
    }


def rehearse(drive_train: DriveTrain, limits: GuardLimits, period: float) -> State:
    """Run a motion at rest for some cycles; returns the state it came to, open if all is well."""
    rehearsal = Rehearsal(drive_train, limits, period)
    for _ in range(CYCLES):
        rehearsal.cycle()
    return rehearsal.state


LINK_FAILED: Final = 1
NOT_STARTED: Final = 2
CRASHED: Final = 70


def main(arguments: Sequence[str]) -> int:
    """Run the exchange over descriptors: channel, settings, ring, events, control block, packets.

    The last one is there only if raw packets are to be stored.
    """
    channel_fd, settings_fd, ring_fd, event_fd, control_fd, *packets_fd = map(int, arguments)
    # Whoever started this may be interrupted or hung up on while an arm moves.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    # Between two instructions of the loop, and maybe of itself: no lock is safe in there.
    terminated: list[bool] = []
    signal.signal(signal.SIGTERM, lambda *_: terminated.append(True))
    channel = socket.socket(fileno=channel_fd)
    try:
        with os.fdopen(settings_fd, "rb") as file:
            settings: ExchangeSettings = pickle.load(file)
        for module in settings.preload:
            importlib.import_module(module)
        ring = CycleRing(settings.drive_train.n_joints, fd=ring_fd)
        guard = Guard(settings.guard_limits, settings.period)
        session = Session(settings.drive_train, guard, ring, **settings.session)
        max_late = settings.late_allowed
        transport = settings.transport.open()
        for fd in packets_fd:
            transport = TappedTransport(transport, PacketRing(fd=fd), lambda: session.cycle)
        control = ControlBlock(control_fd)
        serving = ControlServer(
            session,
            transport,
            ring,
            EventWriter(event_fd),
            control,
            channel,
            terminated=lambda: bool(terminated),
            needs_archive=settings.needs_archive,
        )
        report = realtime.enter(settings.realtime)
        rehearse(settings.drive_train, settings.guard_limits, settings.period)
    except Exception as error:
        traceback.print_exc()
        channel.send(portable(error))
        return NOT_STARTED
    notes = tuple(getattr(transport, "notes", ()))
    serving.say(ExchangeStarted(os.getpid(), report, notes))
    channel.send(pickle.dumps((report, notes)))
    status = _serve(transport, session, serving, max_late)
    control.finished = int(status == 0)
    return status


def _serve(transport: Transport, session: Session, serving: ControlServer, max_late: int) -> int:
    try:
        exchange(transport, session, until=serving, max_late=max_late)
        serving.conclude()
    except Exception:
        traceback.print_exc()
        serving.say(ExchangeFailed(traceback.format_exc()))
        return CRASHED
    finally:
        transport.close()
    if session.state is State.ENDED:
        serving.say(ExchangeEnded("the controller ended the session"))
    elif serving.reason:
        serving.say(ExchangeEnded(serving.reason))
    else:
        serving.say(ExchangeEnded("the link was closed"))
        return LINK_FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
