"""The one loop between a link and a session."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.packets import (
    AXIS_LENGTH,
    HEADER_LENGTH,
    LAST_NUMBER,
    MAX_AXES,
    N_ARMS,
    cyclic_length,
    is_init,
)
from drivers.session import Session
from drivers.states import HAS_SET_POINTS, State
from drivers.transports.base import Transport

FALLEN_SILENT: Final = 1.0
"""s without a packet that gets an answer, after which another sender may begin the session."""


def listens_to_all(session: Session) -> bool:
    """Whether there is no session that a change of port could break.

    Before the init packet there is none, and a lost one goes on with the first packet that gets
    an answer: a stray datagram must not decide who is listened to.
    """
    return session.state is State.SYNC or session.deadline == math.inf


class Listening:
    """Lets the link forget its peer where that one does not lead to a session.

    Before the init packet, whoever gets answers is listened to alone until it sends something
    that gets none, or falls silent: another host cannot take over a start that is going on, and one
    that does not go on cannot keep the controller out.
    """

    def __init__(self, transport: Transport, session: Session) -> None:
        self._transport = transport
        self._session = session
        self._answered_at = -math.inf

    def heard(self, answered: bool) -> None:
        """A packet came and was answered, or was not."""
        if not listens_to_all(self._session):
            return
        if answered:
            self._answered_at = self._transport.now
        else:
            self._transport.forget_peer()

    def heard_nothing(self) -> None:
        """Nothing came for a while."""
        session, transport = self._session, self._transport
        if not listens_to_all(session):
            return
        starting = session.state is State.SYNC
        if not starting or transport.now - self._answered_at >= FALLEN_SILENT:
            transport.forget_peer()


POLL: Final = 0.1
"""s, longest wait for a packet."""
HELD_UP: Final = 1.5
"""Cycles between two packets from which on more of them may be waiting than one."""
WAITED_HERE: Final = 0.5
"""Cycles a packet has waited from which on the next may be there too."""
TOO_SOON: Final = 0.5
"""Cycles between two arrivals below which they, and others, were held up on their way."""
MOST_WAITING: Final = 100_000
"""Packets looked at for the newest, more than any queue of a kernel holds."""
MOST_KINDS: Final = 64
"""Packets left of a pile at most."""
TOO_OLD: Final = 3.0
"""Cycles since the newest of a pile came, from which on newer ones must have found no room."""
_TOO_OLD_AT_LEAST: Final = 0.005
"""s; the same, where cycles are short against what the system may be busy for."""
_A_LITTLE: Final = 1000
"""Packet numbers within which one is a little later than another, or a little earlier."""
_SLEPT: Final = 0.1
"""Cycles that receiving a packet takes at most if it was there already."""

Ages = NDArray[np.uint16]
_Kind = tuple[int, int, bytes]
"""Session within the pile, length, status and modes."""


class Arrival(NamedTuple):
    """A packet taken from the link.

    Attributes:
        packet: its bytes.
        arrived: when, on the link's clock; where the link cannot say, when it was received.
        ages: of its values, see `Transport.ages`.
        stamped: whether the link could say.
    """

    packet: bytes
    arrived: float
    ages: Ages | None
    stamped: bool


class ReceiveQueue:
    """Takes packets from a link that may have queued some while this process was held up.

    The answer to any but the newest comes too late, and a motion would run ahead of the arm by a
    step for each. So of each kind (length, status, modes) only the newest stays. The others are
    left unanswered as if the link had lost them, and counted as "late". Where axes opened or
    closed meanwhile the session sees it, and packets before an init packet are not mixed with
    those after it.

    A queue that was full holds the oldest packets. Where the newest one found is so old that
    others must have been turned away since, it is left unanswered too while axes are open: the
    controller's next packet comes within a cycle.

    On a link that cannot say when a packet arrived, that is guessed for finding piles, and for
    nothing else.
    """

    def __init__(self, transport: Transport, session: Session) -> None:
        self._transport = transport
        self._session = session
        self._heard = self._arrived = math.inf
        self._due = -math.inf
        self._number = 0

    def take(self) -> tuple[Arrival, ...]:
        """What is to be answered, in order; nothing if nothing came before the deadline.

        Raises:
            TransportClosed: the link is gone.
        """
        transport, session = self._transport, self._session
        before = transport.now
        packet = transport.receive(min(POLL, max(0.0, session.deadline - before)))
        if packet is None:
            return ()
        now = transport.now
        period = session.period
        stamp = self._stamp()
        arrived = self._guess(packet, before, now, period) if stamp is None else stamp
        heard, self._heard = self._heard, now
        due, self._due = self._due, arrived + TOO_SOON * period
        late = now - arrived > WAITED_HERE * period
        held_up = late or now - heard > HELD_UP * period or arrived < due
        # Where nobody in particular is listened to, packets of several may wait.
        if held_up and not listens_to_all(session):
            return self._newest(self._arrival(packet, stamp, now, self._copied_ages()), period)
        return (self._arrival(packet, stamp, now, transport.ages),)

    def _stamp(self) -> float | None:
        arrived: float | None = getattr(self._transport, "arrived", None)
        return arrived

    def _arrival(
        self, packet: bytes, stamp: float | None, now: float, ages: Ages | None
    ) -> Arrival:
        if stamp is None:
            return Arrival(packet, now, ages, False)
        return Arrival(packet, stamp, ages, True)

    def _guess(self, packet: bytes, before: float, now: float, period: float) -> float:
        """When a packet presumably arrived that was received between `before` and `now`."""
        # If there was no wait for it, it came earlier: when it was due.
        number = _number(packet)
        cycles, self._number = _ahead(number, self._number), number
        if now - before > _SLEPT * period:
            self._arrived = now
        else:
            steps = cycles if cycles <= _A_LITTLE else 1
            self._arrived = min(now, self._arrived + steps * period)
        return self._arrived

    def _newest(self, first: Arrival, period: float) -> tuple[Arrival, ...]:
        """Of a packet and those that wait behind it, the newest of each kind."""
        transport = self._transport
        init = self._session.init
        pile = _Pile(MAX_AXES if init is None else init.n_axes)
        pile.add(first)
        for _ in range(MOST_WAITING):
            before = transport.now
            following = transport.receive(0.0)
            if following is None:
                break
            stamp, now = self._stamp(), transport.now
            if stamp is None:
                self._guess(following, before, now, period)
            pile.add(self._arrival(following, stamp, now, self._copied_ages()))
        arrivals, left_out = pile.arrivals, pile.left_out
        if left_out and self._too_old(arrivals, period):
            arrivals, left_out = (), left_out + 1
        self._session.discarded("late", left_out)
        return arrivals

    def _too_old(self, arrivals: tuple[Arrival, ...], period: float) -> bool:
        """Whether a pile, of one kind, is that of a queue that had no room for the newest.

        One packet alone is none: its controller may be waiting for the answer. Packets of several
        kinds tell the session something, however old they are.
        """
        if (
            len(arrivals) != 1
            or not arrivals[0].stamped
            or self._session.state not in HAS_SET_POINTS
        ):
            return False
        age = self._transport.now - arrivals[0].arrived
        return age > max(TOO_OLD * period, _TOO_OLD_AT_LEAST)

    def _copied_ages(self) -> Ages | None:
        """Ages of the packet received last; the link may reuse its array for the next."""
        ages = self._transport.ages
        return None if ages is None else ages.copy()


class _Pile:
    """The newest packet of each kind, in the order of their arrival.

    Numbers that are far apart are no matter of age: one of two such packets is of another session,
    or its number was garbled, and which one the session knows.

    Args:
        n_axes: slots of a packet that mean something. Some controllers send more bytes, and what
            stands in those makes no kind.

    Attributes:
        left_out: packets that were not stored; repetitions of one that was do not count.
    """

    def __init__(self, n_axes: int) -> None:
        self.left_out = 0
        self._modes = slice(HEADER_LENGTH, cyclic_length(n_axes), AXIS_LENGTH)
        self._newest: list[tuple[_Kind, Arrival]] = []
        self._sessions = 0

    @property
    def arrivals(self) -> tuple[Arrival, ...]:
        """In order."""
        return tuple(arrival for _, arrival in self._newest)

    def add(self, arrival: Arrival) -> None:
        """Take one that came after the others."""
        packet = arrival.packet
        if is_init(packet):
            self._sessions += 1
        status = packet[4 : 4 + N_ARMS]
        # The lowest byte tells the modes there are from each other.
        kind = (self._sessions, len(packet), status + packet[self._modes])
        for place, (other, earlier) in enumerate(self._newest):
            if other != kind:
                continue
            if packet == earlier.packet:
                return
            if _ahead(_number(earlier.packet), _number(packet)) <= _A_LITTLE:
                self.left_out += 1  # overtaken on the way
                return
            if _ahead(_number(packet), _number(earlier.packet)) <= _A_LITTLE:
                self._leave_out(place)
                break
        if len(self._newest) >= MOST_KINDS:
            self._leave_out(0)
        self._newest.append((kind, arrival))

    def _leave_out(self, place: int) -> None:
        del self._newest[place]
        self.left_out += 1


def _number(packet: bytes) -> int:
    return int.from_bytes(packet[:4], "little")


def _ahead(later: int, earlier: int) -> int:
    """How far one packet number is ahead of another, modulo their range."""
    return (later - earlier) % LAST_NUMBER


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

    Where packets have piled up, only the newest are answered, see `ReceiveQueue`. Answers that
    leave later than the controller's next packet are counted, and end a motion, see
    `Punctuality`. Before the init packet and after a loss, any port of the controller's host may
    begin, see `Listening`.

    A closed link is silence for good: the session is informed, and ends what was going on.
    """
    intake = ReceiveQueue(transport, session)
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
