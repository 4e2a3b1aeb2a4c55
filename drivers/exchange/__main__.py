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
from types import FrameType
from typing import Final

from drivers.exchange import realtime
from drivers.exchange.control import ControlBlock
from drivers.exchange.event_log import EventWriter
from drivers.exchange.loop import exchange
from drivers.exchange.notices import ExchangeEnded, ExchangeFailed, ExchangeStarted
from drivers.exchange.rehearsal import rehearse
from drivers.exchange.serving import Serving, portable
from drivers.exchange.settings import ExchangeSettings
from drivers.exchange.shared_ring import SharedCycleRing, SharedPacketRing
from drivers.guard import Guard
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport
from drivers.transports.tapped import TappedTransport

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
    terminated = _Flag()
    signal.signal(signal.SIGTERM, terminated.set)
    channel = socket.socket(fileno=channel_fd)
    try:
        with os.fdopen(settings_fd, "rb") as file:
            settings: ExchangeSettings = pickle.load(file)
        for module in settings.preload:
            importlib.import_module(module)
        ring = SharedCycleRing.attach(ring_fd, settings.drive_train.n_joints)
        guard = Guard(settings.guard_limits, settings.period)
        session = Session(settings.drive_train, guard, ring, **settings.session)
        max_late = settings.late_allowed
        transport = settings.transport.open()
        for fd in packets_fd:
            transport = TappedTransport(transport, SharedPacketRing(fd), lambda: session.cycle)
        control = ControlBlock(control_fd)
        serving = Serving(
            session,
            transport,
            ring,
            EventWriter(event_fd),
            control,
            channel,
            terminated=terminated,
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


class _Flag:
    """Set by a signal, which comes between two instructions of the loop."""

    def __init__(self) -> None:
        self._set = False

    def set(self, _number: int, _frame: FrameType | None) -> None:
        self._set = True

    def __bool__(self) -> bool:
        return self._set


def _serve(transport: Transport, session: Session, serving: Serving, max_late: int) -> int:
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
