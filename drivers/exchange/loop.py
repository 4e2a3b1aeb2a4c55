"""The one loop between a link and a session."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.packets import LAST_NUMBER
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

POLL: Final = 0.1
"""s, longest time between two looks at `until` on a silent link."""
COUNT_EVERY: Final = 100
"""Packets between two looks at what the link discarded."""
HELD_UP: Final = 1.5
"""Cycles between two packets from which on more of them may be waiting than one."""
_MOST_WAITING: Final = 64
_Arrival = tuple[bytes, NDArray[np.uint16] | None]


def exchange(transport: Transport, session: Session, *, until: Callable[[], bool]) -> None:
    """Answer packets until `until()`, the controller ends the session, or the link is closed.

    `until` is asked once per packet, after its answer was sent, and at least each 0.1 s. What
    can wait until then is done there.

    If this process was held up in open mode, packets have piled up. An answer to any but the
    newest of them would come too late, and the motion would run ahead of the arm by one step for
    each; so these are left unanswered, as if the link had lost them, and counted as "late".

    A closed link is silence for good: the session is told so, and ends what was going on.
    """
    heard = math.inf  # when the last packet came
    answered = 0
    receive, send, reply = transport.receive, transport.send, session.reply
    while session.state is not State.ENDED and not until():
        try:
            packet = receive(min(POLL, max(0.0, session.deadline - transport.now)))
            now = transport.now
            if packet is None:
                _idle(transport, session, now)
                continue
            if session.state is State.OPEN and now - heard > HELD_UP * session.period:
                arrivals = _newest(transport, session, packet)
            else:
                arrivals = ((packet, transport.ages),)
            for arrived, ages in arrivals:
                answer = reply(arrived, now, ages)
                if answer is not None:
                    send(answer)
            heard = now
            answered += 1
            if answered % COUNT_EVERY == 0:
                _count_rejected(transport, session)
        except TransportClosed:
            if math.isfinite(session.deadline):
                session.tick(max(transport.now, session.deadline))
            return


def _idle(transport: Transport, session: Session, now: float) -> None:
    """Nothing came: tell the session what time it is."""
    waiting = math.isfinite(session.deadline)
    session.tick(now)
    lost = waiting and not math.isfinite(session.deadline)
    # Before the init packet there is nothing that a change of port could break.
    if lost or session.state is State.SYNC:
        transport.forget_peer()
    _count_rejected(transport, session)


def _count_rejected(transport: Transport, session: Session) -> None:
    for kind, count in transport.rejected().items():
        session.discarded(kind, count)


def _newest(transport: Transport, session: Session, packet: bytes) -> tuple[_Arrival, ...]:
    """Of the packets that wait, those that no later one of the same kind makes obsolete."""
    waiting: list[_Arrival] = [(packet, _kept_ages(transport))]
    while len(waiting) < _MOST_WAITING:
        following = transport.receive(0.0)
        if following is None:
            break
        waiting.append((following, _kept_ages(transport)))
    kept = [arrival for arrival, later in pairwise(waiting) if not _follows(later[0], arrival[0])]
    if late := len(waiting) - 1 - len(kept):
        session.discarded("late", late)
    return (*kept, waiting[-1])


def _kept_ages(transport: Transport) -> NDArray[np.uint16] | None:
    """Ages of the packet received last; the link may reuse its array for the next."""
    return None if transport.ages is None else transport.ages.copy()


def _follows(later: bytes, earlier: bytes) -> bool:
    """Whether one is a later cyclic packet than the other: same length, number a little ahead."""
    if len(later) != len(earlier):
        return False
    first, second = (int.from_bytes(packet[:4], "little") for packet in (earlier, later))
    return 1 <= (second - first) % LAST_NUMBER <= _MOST_WAITING
