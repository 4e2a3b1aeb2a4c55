"""The one loop between a link and a session."""

from __future__ import annotations

import math
from collections.abc import Callable

from drivers.errors import TransportClosed
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

POLL = 0.1
"""s, longest time between two looks at `until` on a silent link."""


def exchange(transport: Transport, session: Session, *, until: Callable[[], bool]) -> None:
    """Answer packets until `until()`, the controller ends the session, or the link is closed.

    A closed link is silence for good: the session is told so, and ends what was going on.
    """
    while session.state is not State.ENDED and not until():
        try:
            packet = transport.receive(min(POLL, max(0.0, session.deadline - transport.now)))
            if packet is None:
                session.tick(transport.now)
                continue
            reply = session.reply(packet, transport.now)
            if reply is not None:
                transport.send(reply)
        except TransportClosed:
            if math.isfinite(session.deadline):
                session.tick(max(transport.now, session.deadline))
            return
