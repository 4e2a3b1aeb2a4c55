"""The one loop between a link and a session."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from drivers.errors import TransportClosed
from drivers.exchange.listening import Listening
from drivers.exchange.punctuality import MAX_LATE, Punctuality
from drivers.exchange.receive_queue import Intake
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

COUNT_EVERY: Final = 100
"""Packets between two looks at what the link discarded."""


def exchange(
    transport: Transport,
    session: Session,
    *,
    until: Callable[[], bool],
    max_late: int = MAX_LATE,
) -> None:
    """Answer packets until `until()`, the controller ends the session, or the link is closed.

    `until` is asked once per packet, after its answer was sent, and at least each 0.1 s. What
    can wait until then is done there.

    Where packets have piled up, only the newest are answered, see `Intake`. Answers that leave
    later than the controller's next packet are counted, and end a motion, see `Punctuality`. Before
    the init packet and after a loss, anybody at the controller's address may begin, see
    `Listening`.

    A closed link is silence for good: the session is informed, and ends what was going on.
    """
    intake = Intake(transport, session)
    listening = Listening(transport, session)
    punctuality = Punctuality(session, max_late)
    handled = 0
    send, reply = transport.send, session.reply
    while session.state is not State.ENDED and not until():
        try:
            arrivals = intake.take()
            if not arrivals:
                session.tick(transport.now)
                listening.heard_nothing()
                _count_rejected(transport, session)
                continue
            for packet, arrived, ages, stamped in arrivals:
                punctuality.heard(arrived if stamped else math.inf)
                deadline = session.deadline
                answer = reply(packet, arrived, ages)
                if answer is not None:
                    now = transport.now
                    # Silence is counted from the answer: the packet may have waited long for it.
                    if session.deadline != deadline:
                        session.sent(now)
                    # Before it leaves: a controller that waits for it may be faster than we are.
                    punctuality.answered(arrived, now)
                    send(answer)
                listening.heard(answer is not None)
            handled += 1
            if handled % COUNT_EVERY == 0:
                _count_rejected(transport, session)
        except TransportClosed:
            if math.isfinite(session.deadline):
                session.tick(max(transport.now, session.deadline))
            break
    _count_rejected(transport, session)


def _count_rejected(transport: Transport, session: Session) -> None:
    for kind, count in transport.rejected().items():
        session.discarded(kind, count)
