"""The exchange process. Started by `ExchangeProcess`, which passes the descriptors it needs."""

from __future__ import annotations

import importlib
import os
import pickle
import signal
import socket
import sys
import traceback
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.drive_train import DriveTrain
from drivers.exchange import realtime
from drivers.exchange.control import SharedState
from drivers.exchange.event_log import EventWriter, ExchangeEnded, ExchangeFailed, ExchangeStarted
from drivers.exchange.loop import MAX_LATE, exchange
from drivers.exchange.process import ExchangeSettings
from drivers.exchange.serving import CommandHandler, portable
from drivers.guard import Guard, GuardLimits
from drivers.motion_source import BoundsName
from drivers.packets import (
    DRIVE_ON,
    INIT_NUMBER,
    N_ARMS,
    CyclicPacket,
    InitPacket,
    Mode,
    next_number,
)
from drivers.record import CycleRing
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

Array = NDArray[np.float64]

LINK_FAILED: Final = 1
NOT_STARTED: Final = 2
CRASHED: Final = 70


class _Rest:
    """A motion source at rest."""

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


def warm_up(
    drives: DriveTrain, limits: GuardLimits, period: float, cycles: int = 200
) -> tuple[State, bytes | None]:
    """Run a motion at rest in a separate session: the first cycles of a process are slow.

    Returns the state of that session, open unless something is wrong, and its last reply.
    """
    n = drives.n_joints
    position = 0.5 * (limits.lower + limits.upper)
    session = Session(drives, Guard(limits, period), CycleRing(n, 16))
    axes = CyclicPacket.zeros(1, n).axes
    axes["d"][:, 0] = axes["d"][:, 2] = drives.motor_revolutions(position)
    values: dict[str, ArrayLike] = {
        "gear_ratio": drives.gear_ratio,
        "calibration": drives.calibration,
        "kinematic_influence": [0.0, 0.0, 0.0, drives.k54, drives.k64, drives.k65],
        "current_limit": limits.current,
        "following_error": limits.following_error,
    }
    session.reply(InitPacket.build(n, round(1000.0 * period), values).encode(), 0.0)
    session.request(_Rest(position))
    status = bytes((DRIVE_ON, 0, 0, 0))
    number = INIT_NUMBER
    reply: bytes | None = None
    for cycle in range(cycles):
        number = next_number(number)
        axes["mode"] = Mode.POSITION if cycle else Mode.CLOSED
        packet = CyclicPacket(number, status, bytes(N_ARMS), axes).encode()
        reply = session.reply(packet, 0.0)
    return session.state, reply


def main(arguments: Sequence[str]) -> int:
    """Run the exchange on descriptors: channel, settings, ring, events, shared state."""
    channel_fd, settings_fd, ring_fd, event_fd, control_fd = map(int, arguments)
    # The terminal of the supervisor may send these while an arm moves.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    # The handler may interrupt any instruction, itself included: no lock is safe there.
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
        transport = settings.transport.open()
        control = SharedState(control_fd)
        server = CommandHandler(
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
        warm_up(settings.drive_train, settings.guard_limits, settings.period)
    except Exception as error:
        traceback.print_exc()
        channel.send(portable(error))
        return NOT_STARTED
    notes = tuple(getattr(transport, "notes", ()))
    server.log(ExchangeStarted(os.getpid(), report, notes))
    channel.send(pickle.dumps((report, notes)))
    max_late = settings.max_late
    if max_late is None:
        max_late = settings.session.get("max_gap", MAX_LATE)
    status = _serve(transport, session, server, max_late)
    control.finished = int(status == 0)
    return status


def _serve(transport: Transport, session: Session, server: CommandHandler, max_late: int) -> int:
    try:
        exchange(transport, session, ends_when=server, max_late=max_late)
        server.conclude()
    except Exception:
        traceback.print_exc()
        server.log(ExchangeFailed(traceback.format_exc()))
        return CRASHED
    finally:
        transport.close()
    if session.state is State.ENDED:
        server.log(ExchangeEnded("the controller ended the session"))
    elif server.reason:
        server.log(ExchangeEnded(server.reason))
    else:
        server.log(ExchangeEnded("the link was closed"))
        return LINK_FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
