"""The loop between a link and a session."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from drivers.errors import TransportClosed
from drivers.punctuality import BUNCHED, CAME_LATE, LEFT_OUT, REPLIED_TO_LATE
from drivers.session import Session
from drivers.states import STATES_WITH_SET_POINTS, State
from drivers.transports.base import Transport
from drivers.wire import Wire

POLL_PERIOD: Final = 0.1
"""Longest wait for a packet, s."""
PEER_TIMEOUT: Final = 1.0
"""Silence of a sender before the init packet after which another may start the session, s."""
MAX_LATE_REPLIES: Final = 2
"""Consecutive late replies that do not stop a motion in open mode."""
MAX_REPLIED_PACKETS: Final = 64
"""Most packets of one backlog that get a reply."""
_MAX_BACKLOG: Final = 100_000
"""Most packets read in search of the newest, more than any kernel queue holds."""
_COUNT_EVERY: Final = 100
"""Packets between two readings of the link's counters."""
_LATE_READ_PERIODS: Final = 1.5
"""Cycles between two packets read above which more than one may be queued."""
_LONG_QUEUED_PERIODS: Final = 0.5
"""Cycles that a packet was queued above which the next may be queued too."""
_BUNCHED_PERIODS: Final = 0.5
"""Cycles between two arrivals below which these and others were delayed on their way."""
_IMMEDIATE_PERIODS: Final = 0.1
"""Cycles that the reception of a queued packet takes at most."""
_OLD_BACKLOG_PERIODS: Final = 3.0
_OLD_BACKLOG_SECONDS: Final = 0.005
"""Age of the newest packet of a backlog, in cycles and at least in s, above which the queue must
have been full when newer ones arrived."""
_NUMBER_WINDOW: Final = 1000
"""Largest difference of two packet numbers of one session; beyond it neither is the newer."""

_Kind = tuple[int, bytes]
"""Session within the backlog, and kind of packet."""


def _accepts_any_peer(session: Session) -> bool:
    """Whether there is no session, or a lost one, which the first packet with a reply resumes."""
    return session.state is State.SYNC or session.deadline == math.inf


class _PeerSelection:
    """Makes the link forget a peer whose packets do not lead to a session.

    Before the init packet, a peer whose packets get replies is retained until one gets none or
    none comes for `PEER_TIMEOUT`: another host cannot take over a start in progress, and an
    abandoned start does not exclude the controller.
    """

    def __init__(self, transport: Transport, session: Session) -> None:
        self._transport = transport
        self._session = session
        self._replied_at = -math.inf

    def after_packet(self, replied: bool) -> None:
        if not _accepts_any_peer(self._session):
            return
        if replied:
            self._replied_at = self._transport.now
        else:
            self._transport.forget_peer()

    def after_silence(self) -> None:
        session = self._session
        transport = self._transport
        if _accepts_any_peer(session) and (
            session.state is not State.SYNC or transport.now - self._replied_at >= PEER_TIMEOUT
        ):
            transport.forget_peer()


class Arrival(NamedTuple):
    """A packet received at time `arrived` on the link's clock, of reception if not `stamped`."""

    packet: bytes
    arrived: float
    stamped: bool


class ReceiveQueue:
    """Receives packets; of a backlog that formed while this process did not run, the newest.

    A reply to any other comes too late, and a motion would run ahead of the arm by one step for
    each. Of each kind (length, status, modes) only the newest packet gets a reply, so that
    the session sees axes open and close; packets before and after an init packet are of different
    kinds. The others are counted as left out or as bunched (`drivers.punctuality`).

    A full queue contains the oldest packets. If the newest packet found is so old that later ones
    were dropped, it gets no reply either while axes are open: the next one comes within a cycle.

    Where the link has no time stamps, a packet received at once may have others behind it.
    """

    def __init__(self, transport: Transport, session: Session) -> None:
        self._transport = transport
        self._session = session
        self._read_at = math.inf
        self._earliest_next = -math.inf

    def receive(self) -> tuple[Arrival, ...]:
        """Return the packets to reply to, in order; none if none came before the deadline.

        Raises:
            TransportClosed: the link is closed.
        """
        transport = self._transport
        session = self._session
        before = transport.now
        packet = transport.receive(min(POLL_PERIOD, max(0.0, session.deadline - before)))
        if packet is None:
            return ()
        now = transport.now
        period = session.period
        stamp = self._stamp()
        arrived = now if stamp is None else stamp
        read_at = self._read_at
        self._read_at = now
        earliest = self._earliest_next
        self._earliest_next = arrived + _BUNCHED_PERIODS * period
        if stamp is None:
            queued = now - before <= _IMMEDIATE_PERIODS * period
        else:
            queued = now - arrived > _LONG_QUEUED_PERIODS * period
        delayed = queued or now - read_at > _LATE_READ_PERIODS * period or arrived < earliest
        # While any peer is accepted, the queue may hold packets of several.
        if delayed and not _accepts_any_peer(session):
            return self._newest(self._arrival(packet, stamp, now), period)
        return (self._arrival(packet, stamp, now),)

    def _stamp(self) -> float | None:
        arrived: float | None = getattr(self._transport, "arrived", None)
        return arrived

    @staticmethod
    def _arrival(packet: bytes, stamp: float | None, now: float) -> Arrival:
        return Arrival(packet, now if stamp is None else stamp, stamp is not None)

    def _newest(self, first: Arrival, period: float) -> tuple[Arrival, ...]:
        """Return the newest of each kind among a packet and the packets queued behind it."""
        transport = self._transport
        backlog = _Backlog(self._session.wire, _BUNCHED_PERIODS * period)
        backlog.add(first)
        for _ in range(_MAX_BACKLOG):
            packet = transport.receive(0.0)
            if packet is None:
                break
            backlog.add(self._arrival(packet, self._stamp(), transport.now))
        arrivals = tuple(queued.arrival for queued in backlog.newest)
        left_out = backlog.left_out
        if left_out + backlog.bunched and self._too_old(arrivals, period):
            arrivals = ()
            left_out += 1
        self._session.discarded(LEFT_OUT, left_out)
        self._session.discarded(BUNCHED, backlog.bunched)
        return arrivals

    def _too_old(self, arrivals: tuple[Arrival, ...], period: float) -> bool:
        """Whether newer packets than these, all of one kind, must have been dropped.

        Packets of several kinds carry changes that the session needs, however old they are.
        """
        if (
            len(arrivals) != 1
            or not arrivals[0].stamped
            or self._session.state not in STATES_WITH_SET_POINTS
        ):
            return False
        age = self._transport.now - arrivals[0].arrived
        return age > max(_OLD_BACKLOG_PERIODS * period, _OLD_BACKLOG_SECONDS)


@dataclass(eq=False)
class _Queued:
    """A packet of a backlog; `bunched` if another came closely after it."""

    kind: _Kind
    number: int
    arrival: Arrival
    bunched: bool = False


class _Backlog:
    """The newest packet of each kind, in the order of arrival.

    Two packets whose numbers are far apart are both retained: one is of another session, or its
    number is corrupt, which the session can decide.

    Args:
        wire: of the session.
        bunch: time between two arrivals below which the earlier packet was delayed on its way, s.

    Attributes:
        newest: packets, one of each kind.
        left_out, bunched: packets not retained, without repetitions of one that was, by
            `drivers.punctuality`.
    """

    def __init__(self, wire: Wire, bunch: float) -> None:
        self.left_out = 0
        self.bunched = 0
        self.newest: list[_Queued] = []
        self._wire = wire
        self._bunch = bunch
        self._last: _Queued | None = None
        self._sessions = 0

    def add(self, arrival: Arrival) -> None:
        """Add a packet that came after the others."""
        starts, sort, number = self._wire.sort(arrival.packet)
        self._sessions += starts
        last, queued = self._last, _Queued((self._sessions, sort), number, arrival)
        self._last = queued
        if last is not None:
            last.bunched = self._follows_closely(last.arrival, arrival)
        ahead = self._wire.ahead
        for other in self.newest:
            if other.kind != queued.kind:
                continue
            if arrival.packet == other.arrival.packet:
                return
            if ahead(other.number, number) <= _NUMBER_WINDOW:
                queued.bunched = last is not None and last.bunched  # it was overtaken on its way
                self._count(queued)
                return
            if ahead(number, other.number) <= _NUMBER_WINDOW:
                self._drop(other)
                break
        if len(self.newest) >= MAX_REPLIED_PACKETS:
            self._drop(self.newest[0])
        self.newest.append(queued)

    def _follows_closely(self, earlier: Arrival, later: Arrival) -> bool:
        """Whether the link delayed the earlier packet: it is known when both came."""
        known = earlier.stamped and later.stamped
        return known and later.arrived - earlier.arrived < self._bunch

    def _drop(self, queued: _Queued) -> None:
        self.newest.remove(queued)
        self._count(queued)

    def _count(self, queued: _Queued) -> None:
        if queued.bunched:
            self.bunched += 1
        else:
            self.left_out += 1


class _LatenessMonitor:
    """Counts packets that came late, and replies that left late (`drivers.punctuality`).

    More than `max_late` in a row, each overtaken by the controller's next packet, stop a motion on
    its path: the controller has accepted none of them, or each in a later cycle than intended. A
    controller that waits for its reply is never overtaken.
    """

    def __init__(self, session: Session, max_late: int) -> None:
        self._session = session
        self._max_late = max_late
        self._late_reply_at = -math.inf
        self._consecutive = 0
        self._arrived = math.nan  # arrival of the last packet
        self._cycle = 0

    def before_reply(self, arrived: float) -> None:
        """Record the arrival of a packet; infinite if it is not known."""
        if arrived > self._late_reply_at:
            self._consecutive = 0
            return
        self._late_reply_at = -math.inf
        self._consecutive += 1
        if self._consecutive > self._max_late and self._session.state is State.OPEN:
            self._session.stop(f"{self._consecutive} consecutive replies left too late")

    def after_reply(self, arrived: float, sent: float, *, stamped: bool) -> None:
        """Record the time at which its reply left."""
        session = self._session
        period = session.period
        cycles = session.cycle - self._cycle
        if cycles:  # not the packet before once more
            if cycles > 0 and arrived - self._arrived > (cycles + 1) * period:
                session.discarded(CAME_LATE, 1)
            self._arrived = arrived if stamped else math.nan
            self._cycle = session.cycle
        if sent - arrived > period:
            session.discarded(REPLIED_TO_LATE, 1)
            self._late_reply_at = sent
        else:
            self._late_reply_at = -math.inf


def exchange(
    transport: Transport,
    session: Session,
    *,
    ends_when: Callable[[], bool],
    max_late: int = MAX_LATE_REPLIES,
    before_packet: Callable[[Transport, Session, float], None] | None = None,
) -> None:
    """Reply to packets until the session ends, the link closes, or `ends_when()` is true.

    Of a backlog only the newest packets get a reply (`ReceiveQueue`). A closed link counts as
    permanent silence, which ends a motion.

    Args:
        transport: that packets come from.
        session: that answers them.
        ends_when: called after the replies to what was received at once, and at least every 0.1 s
            and a cycle; the place for work that can wait.
        max_late: consecutive late replies, each overtaken by the next packet, that a motion
            survives.
        before_packet: called with the time at which the last packet arrived, before the next one is
            received.
    """
    queue = ReceiveQueue(transport, session)
    peers = _PeerSelection(transport, session)
    lateness = _LatenessMonitor(session, max_late)
    handled = 0
    send = transport.send
    reply_to = session.reply
    arrivals: tuple[Arrival, ...] = ()
    while session.state is not State.ENDED and not ends_when():
        try:
            if before_packet is not None and arrivals:
                before_packet(transport, session, arrivals[-1].arrived)
            arrivals = queue.receive()
            if not arrivals:
                session.tick(transport.now)
                peers.after_silence()
                _count_rejected(transport, session)
                continue
            for packet, arrived, stamped in arrivals:
                lateness.before_reply(arrived if stamped else math.inf)
                deadline = session.deadline
                reply = reply_to(packet, arrived)
                if reply is not None:
                    now = transport.now
                    send(reply)
                    # Silence is counted from the reply: the packet may have been queued for long.
                    if session.deadline != deadline:
                        session.sent(now)
                    lateness.after_reply(arrived, now, stamped=stamped)
                peers.after_packet(reply is not None)
            handled += 1
            if handled % _COUNT_EVERY == 0:
                _count_rejected(transport, session)
        except TransportClosed:
            if math.isfinite(session.deadline):
                session.tick(max(transport.now, session.deadline))
            break
    _count_rejected(transport, session)


def _count_rejected(transport: Transport, session: Session) -> None:
    for kind, count in transport.rejected().items():
        session.discarded(kind, count)
