"""Packets as they are taken from a link, and what is left of a pile of them."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.packets import AXIS_LENGTH, HEADER_LENGTH, LAST_NUMBER, N_ARMS, is_init
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Stamped, Transport

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
_A_LITTLE: Final = 1000
_SLEPT: Final = 0.1
"""Cycles that receiving a packet takes at most if it was there already."""

Ages = NDArray[np.uint16]


class Arrival(NamedTuple):
    """A packet, when it arrived on the link's clock, and how old its values are."""

    packet: bytes
    arrived: float
    ages: Ages | None


class Intake:
    """Takes packets from a link that may have queued some while this process was held up.

    The answer to any but the newest comes too late, and a motion would run ahead of the arm by a
    step for each. So of each kind (length, status, modes) only the newest is kept. The others are
    left unanswered as if the link had lost them, and counted as "late". Where axes opened or
    closed meanwhile the session sees it, and packets before an init packet are not mixed with
    those after it.
    """

    def __init__(self, transport: Transport, session: Session) -> None:
        self._transport = transport
        self._session = session
        self._stamped = transport if isinstance(transport, Stamped) else None
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
        arrived = self._arrival(packet, before, now, period)
        heard, self._heard = self._heard, now
        due, self._due = self._due, arrived + TOO_SOON * period
        late = now - arrived > WAITED_HERE * period
        held_up = late or now - heard > HELD_UP * period or arrived < due
        # Where nobody in particular is listened to, packets of several may wait.
        if held_up and not listens_to_all(session):
            return self._newest(packet, arrived, period)
        return (Arrival(packet, arrived, transport.ages),)

    def _arrival(self, packet: bytes, before: float, now: float, period: float) -> float:
        """When a packet arrived that was received between `before` and `now`."""
        stamp = None if self._stamped is None else self._stamped.arrived
        if stamp is not None:
            return stamp
        # A link that cannot say. If there was no wait for the packet it came earlier, presumably
        # when it was due.
        number = _number(packet)
        cycles, self._number = _ahead(number, self._number), number
        if now - before > _SLEPT * period:
            self._arrived = now
        else:
            steps = cycles if cycles <= _A_LITTLE else 1
            self._arrived = min(now, self._arrived + steps * period)
        return self._arrived

    def _newest(self, packet: bytes, arrived: float, period: float) -> tuple[Arrival, ...]:
        """Of a packet and those that wait behind it, the newest of each kind."""
        transport = self._transport
        pile = _Pile()
        pile.add(Arrival(packet, arrived, self._kept_ages()))
        for _ in range(MOST_WAITING):
            before = transport.now
            following = transport.receive(0.0)
            if following is None:
                break
            arrived = self._arrival(following, before, transport.now, period)
            pile.add(Arrival(following, arrived, self._kept_ages()))
        self._session.discarded("late", pile.left_out)
        return pile.kept

    def _kept_ages(self) -> Ages | None:
        """Ages of the packet received last; the link may reuse its array for the next."""
        ages = self._transport.ages
        return None if ages is None else ages.copy()


def listens_to_all(session: Session) -> bool:
    """Whether there is no session that a change of port could break.

    Before the init packet there is none, and a lost one goes on with the first packet that gets
    an answer: a stray datagram must not decide who is listened to.
    """
    return session.state is State.SYNC or session.deadline == math.inf


class _Pile:
    """The newest packet of each kind, in the order of their arrival.

    Attributes:
        left_out: packets that were not kept; repetitions of one that was do not count.
    """

    def __init__(self) -> None:
        self.left_out = 0
        self._kinds: dict[tuple[int, int, bytes], Arrival] = {}
        self._sessions = 0

    @property
    def kept(self) -> tuple[Arrival, ...]:
        """In order."""
        return tuple(self._kinds.values())

    def add(self, arrival: Arrival) -> None:
        """Take one that came after the others."""
        packet = arrival.packet
        if is_init(packet):
            self._sessions += 1
        status = packet[4 : 4 + N_ARMS]
        # The lowest byte tells the modes there are from each other.
        modes = packet[HEADER_LENGTH::AXIS_LENGTH]
        kind = (self._sessions, len(packet), status + modes)
        earlier = self._kinds.get(kind)
        if earlier is None:
            if len(self._kinds) >= MOST_KINDS:
                del self._kinds[next(iter(self._kinds))]
                self.left_out += 1
        elif packet == earlier.packet:
            return
        else:
            self.left_out += 1
            if _ahead(_number(earlier.packet), _number(packet)) <= _A_LITTLE:
                return  # overtaken on the way
            del self._kinds[kind]
        self._kinds[kind] = arrival


def _number(packet: bytes) -> int:
    return int.from_bytes(packet[:4], "little")


def _ahead(later: int, earlier: int) -> int:
    """How far one packet number is ahead of another, modulo their range."""
    return (later - earlier) % LAST_NUMBER
