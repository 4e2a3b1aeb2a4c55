"""The one loop between a link and a session."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from drivers.errors import TransportClosed
from drivers.exchange.receive_queue import Intake, Listening
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

MAX_LATE: Final = 2
"""Answers in a row that may come too late in open mode."""


class Punctuality:
    """Counts the answers that leave more than a cycle after their packet arrived.

    Each is counted as "answered late", in every state. More than `max_late` in a row, each of them
    overtaken by the controller's next packet, bring a motion to rest on its path: the controller
    has been taking no answer, or each in a later cycle than it was meant for. A controller that
    was seen to wait for its answer is not overtaken by anything.
    """

    def __init__(self, session: Session, max_late: int) -> None:
        self._session = session
        self._max_late = max_late
        self._left = -math.inf  # when the last answer left, if it was late
        self._in_a_row = 0

    def heard(self, arrived: float) -> None:
        """A packet arrived at that time and is to be answered next.

        Infinite if the time is not known: a guess must not stop a motion.
        """
        if arrived > self._left:
            self._in_a_row = 0
            return
        self._left = -math.inf
        self._in_a_row += 1
        if self._in_a_row > self._max_late and self._session.state is State.OPEN:
            self._session.stop(f"{self._in_a_row} answers in a row left too late")

    def answered(self, arrived: float, left: float) -> None:
        """The answer to that packet left at that time."""
        if left - arrived > self._session.period:
            self._session.discarded("answered late", 1)
            self._left = left
        else:
            self._left = -math.inf


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
