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
from contextlib import suppress
from typing import Final

from drivers.cycle_records import CycleRing
from drivers.exchange import realtime
from drivers.exchange.control import SharedState
from drivers.exchange.event_log import (
    SESSION_ENDED,
    EventWriter,
    ExchangeEnded,
    ExchangeFailed,
    ExchangeStarted,
)
from drivers.exchange.loop import MAX_LATE_REPLIES, exchange
from drivers.exchange.process_handle import ExchangeSettings
from drivers.exchange.serving import CommandHandler, portable
from drivers.exchange.warm_up import WarmUp, may_poll
from drivers.guard import Guard
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import PollingTransport, Transport, TransportError

EXIT_LINK_FAILED: Final = 1
EXIT_NOT_STARTED: Final = 2
EXIT_CRASHED: Final = 70


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
        processors = os.sched_getaffinity(0)
        report = realtime.enter(settings.realtime)
        warm_up = WarmUp(
            settings.drive_train,
            settings.guard_limits,
            settings.period,
            _loopback(transport),
            settings.session.get("protocol"),
        )
        warm_up.polls = may_poll(report.scheduling, processors)
    except Exception as error:
        traceback.print_exc()
        channel.send(portable(error))
        return EXIT_NOT_STARTED
    notes = tuple(getattr(transport, "notes", ()))
    server.log(ExchangeStarted(os.getpid(), report, notes))
    channel.send(pickle.dumps((report, notes)))
    max_late = settings.max_late
    if max_late is None:
        max_late = settings.session.get("max_gap", MAX_LATE_REPLIES)
    status = _serve(transport, session, server, max_late, warm_up)
    control.finished = int(status == 0)
    return status


def _loopback(transport: Transport) -> Transport | None:
    """Return a link like this one that receives what it sends, or None."""
    if isinstance(transport, PollingTransport):
        with suppress(TransportError):  # the loopback device is off: the link may work all the same
            return transport.loopback()
    return None


def _serve(
    transport: Transport,
    session: Session,
    server: CommandHandler,
    max_late: int,
    warm_up: WarmUp,
) -> int:
    try:
        exchange(
            transport,
            session,
            ends_when=server,
            max_late=max_late,
            before_packet=warm_up.before_packet,
        )
        server.conclude()
    except Exception:
        traceback.print_exc()
        server.log(ExchangeFailed(traceback.format_exc()))
        return EXIT_CRASHED
    finally:
        transport.close()
    if session.state is State.ENDED:
        server.log(ExchangeEnded(SESSION_ENDED))
    elif server.reason:
        server.log(ExchangeEnded(server.reason))
    else:
        server.log(ExchangeEnded("the link was closed"))
        return EXIT_LINK_FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
