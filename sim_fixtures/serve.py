"""Server of a simulated controller on a real link, in real time.

Cycles begin one period after another. The packet is sent; the first answer with the right number
within a period is the reply; other packets are counted and dropped; then controller and arm are
simulated for a cycle.

Delays of the server are not counted as the PC's: the period for an answer begins when the packet
was sent, and the link is polled once more before an answer counts as missing. If the server is late
by a period or more, later cycles are shifted; packets are not sent in a burst. `ServeCounts` has
counts and times, in memory of fixed size.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum, auto
from math import inf
from select import select
from typing import Final, Protocol

from drivers.errors import PacketError
from drivers.packets import (
    AXIS_LENGTH,
    HEADER_LENGTH,
    Mode,
    is_init,
    next_number,
    packet_number,
)
from drivers.transports.simulated import Peer
from sim_fixtures.settings import SimulationError

LARGEST_DATAGRAM: Final = 65536
_SO_TIMESTAMPNS: Final = 35  # of asm-generic/socket.h, which the socket module does not name
_TIMESPEC: Final = struct.Struct("@ll")
_CONTROL_SPACE: Final = socket.CMSG_SPACE(_TIMESPEC.size)


class ControllerLink(Protocol):
    """The controller's end of a real link, for complete packets."""

    def send(self, packet: bytes) -> None:
        """Send to the PC; what the network refuses is lost without an error."""

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet of the PC, or None after `timeout` seconds (0: poll)."""

    def close(self) -> None:
        """Close the link."""


class ControllerLinkError(SimulationError):
    """The controller's end of a link, at an address or device, cannot be opened."""

    def __init__(self, place: str, problem: str) -> None:
        self.place = place
        self.problem = problem
        super().__init__(f"{place}: {problem}")

    def __reduce__(self) -> tuple[type[ControllerLinkError], tuple[str, str]]:
        return type(self), (self.place, self.problem)


class UdpControllerLink:
    """Link to a PC program that listens at `host`:`port` (IPv4), one datagram per packet.

    The socket is not connected, so that a PC that does not listen yet is not an error. Datagrams
    from any other address or port are dropped.

    Attributes:
        foreign: number of datagrams from other addresses.
        waited: time of the last packet in the kernel's queue [s].

    Raises:
        ControllerLinkError: no such host, or the local port is in use.
    """

    def __init__(self, host: str, port: int, *, source_port: int | None = None) -> None:
        self.foreign = 0
        self.waited = 0.0
        try:
            self._pc = (socket.gethostbyname(host), port)
        except (OSError, UnicodeError) as error:
            raise ControllerLinkError(f"{host}:{port}", f"no such IPv4 host ({error})") from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            self._socket.setblocking(False)
            self._socket.bind(("", source_port or 0))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise ControllerLinkError(
                f"local UDP port {source_port}", f"cannot be used ({error})"
            ) from error

    @property
    def source_port(self) -> int:
        """Local port of sent packets."""
        port: int = self._socket.getsockname()[1]
        return port

    def send(self, packet: bytes) -> None:
        """Send one datagram; it is lost if the network is down or full."""
        with suppress(OSError):
            self._socket.sendto(packet, self._pc)

    def receive(self, timeout: float) -> bytes | None:
        """Return the next datagram of the PC, or None."""
        until = time.monotonic() + timeout
        while True:
            # select() waits to the microsecond; the timeout of a socket is rounded up to ms.
            if not select([self._socket], [], [], max(0.0, until - time.monotonic()))[0]:
                return None
            try:
                packet, control, _, sender = self._socket.recvmsg(LARGEST_DATAGRAM, _CONTROL_SPACE)
            except OSError:  # dropped for a bad checksum, or an ICMP error
                continue
            if sender == self._pc:
                self.waited = _waited(control)
                return packet
            self.foreign += 1
            if time.monotonic() > until:
                return None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _waited(control: list[tuple[int, int, bytes]]) -> float:
    """Return the age of a datagram by the kernel's time stamp [s]."""
    for _, kind, data in control:
        if kind == _SO_TIMESTAMPNS and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return max(0.0, time.time() - float(seconds) - 1e-9 * float(nanoseconds))
    return 0.0


REMEMBERED: Final = 1000


class Histogram:
    """Durations in bins of 5 µs up to 50 ms, and the largest one."""

    BIN: Final = 5e-6
    BINS: Final = 10_000

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0.0
        self._bins = [0] * (self.BINS + 1)

    def add(self, seconds: float) -> None:
        """Count one duration."""
        self.count += 1
        self.largest = max(self.largest, seconds)
        self._bins[min(self.BINS, int(max(0.0, seconds) / self.BIN))] += 1

    def quantile(self, fraction: float) -> float:
        """Return the upper edge of the bin of a quantile [s]; 0 without durations."""
        wanted, seen = fraction * self.count, 0
        for index, entries in enumerate(self._bins):
            seen += entries
            if entries and seen >= wanted:
                return min(self.largest, (index + 1) * self.BIN)
        return 0.0


@dataclass(eq=False)
class ServeCounts:
    """Counts and times of a served session.

    `own_late` are cycles that began late by a tenth of the period or more although the answer
    before was in time, `slips` those of them that were late by a period or more.
    """

    cycles: int = 0  # packets of the controller, the repeated first one counted once
    knocks: int = 0  # transmissions of the first packet
    replies: int = 0  # accepted answers, at most one per cycle
    missed: int = 0  # cycles without a valid answer
    late: int = 0  # answers after their cycle, not accepted
    surplus: int = 0  # further answers in an answered cycle
    rejected: int = 0  # answers of wrong length, number or content
    stretched: int = 0  # cycles extended to wait for their answer
    own_late: int = 0
    slips: int = 0
    ended: bool = False  # whether the controller has ended its session (504)
    stretch_max: float = 0.0  # longest extension of a cycle, s
    answer: Histogram = field(default_factory=Histogram)  # times from the packet to its answer
    cost: Histogram = field(default_factory=Histogram)  # computing times of a cycle
    _unanswered: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _answered: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    def count_reply(self, number: int, *, valid: bool) -> None:
        """Count a reply with the right number, valid for the controller or not."""
        if valid:
            self.replies += 1
        else:
            self.rejected += 1
            self.missed += 1
        self._answered.append(number)

    def count_missing(self, number: int) -> None:
        """Count a cycle without the answer `number`."""
        self.missed += 1
        self._unanswered.append(number)

    def count_stretched(self, seconds: float) -> None:
        """Count an extended cycle."""
        self.stretched += 1
        self.stretch_max = max(self.stretch_max, seconds)

    def count_discarded(self, number: int | None) -> None:
        """Count an answer that is not that of the present cycle; None if it has no number."""
        if number is not None and number in self._unanswered:
            self.late += 1
            self._unanswered.remove(number)
            self._answered.append(number)
        elif number is not None and number in self._answered:
            self.surplus += 1
        else:
            self.rejected += 1


class Clock(Protocol):
    """Clock and sleep functions, as of the module `time`."""

    def monotonic(self) -> float:
        """Return a monotonic time [s]."""

    def sleep(self, seconds: float, /) -> None:
        """Wait."""


KNOCK_INTERVAL: Final = 1.0
"""Seconds between two first packets while no PC answers."""
PATIENCE: Final = 3.0
"""Time for the arm to stop when the session is to end [s]."""
_MOST_STRAY: Final = 100
"""Stray packets read after the end of a cycle, so that a flood cannot delay the next one."""


class Request(IntEnum):
    """Request of the operator at the controller."""

    CONTINUE = auto()
    END = auto()
    ABORT = auto()


class ServedPeer(Peer, Protocol):
    """A controller that can be served, such as `SimulatedController`."""

    rejected_replies: int

    def finish(self) -> None:
        """End the session when the arm is at rest."""

    def lose_drive(self, reason: str) -> None:
        """Switch the drive off for a reason."""


def serve(
    peer: ServedPeer,
    link: ControllerLink,
    *,
    request: Callable[[], Request] = lambda: Request.CONTINUE,
    watch: Callable[[ServeCounts], None] = lambda _: None,
    clock: Clock = time,
    patience: float = PATIENCE,
    stretch: float = 0.0,
) -> ServeCounts:
    """Run a controller on a real link until its session has ended; the link stays open.

    The first packet is repeated once a second until a PC answers, so that either program may be
    started first.

    `request` is called every cycle. At `END` the controller ends its session; if the arm does not
    stop within `patience` s, its drive is switched off. At `ABORT` it stops at once. `watch` is
    called once per cycle with the counts so far.

    A cycle without an answer is extended by up to `stretch` s. Real controllers do not extend
    cycles; this is for PCs with occasional delays. After `END`, a PC that did not answer within an
    extension is not waited for until it answers again.
    """
    server = _Server(peer, link, clock, watch, stretch)
    if server.await_pc(request):
        server.run(request, patience)
    return server.counts


class _Server:
    """One session of one controller."""

    def __init__(
        self,
        peer: ServedPeer,
        link: ControllerLink,
        clock: Clock,
        watch: Callable[[ServeCounts], None],
        stretch: float,
    ) -> None:
        self.counts = ServeCounts()
        self._peer = peer
        self._link = link
        self._clock = clock
        self._watch = watch
        self._period = peer.period
        self._stretch = stretch
        self._due = 0.0
        self._finish_by: float | None = None
        self._patience = 0.0
        self._unanswered = False

    def await_pc(self, request: Callable[[], Request]) -> bool:
        """Repeat the first packet until it is answered; False if the end is requested before."""
        packet = self._peer.next_packet()
        if packet is None:
            self.counts.ended = True
            return False
        while request() is Request.CONTINUE:
            sent = self._clock.monotonic()
            self._link.send(packet)
            self.counts.knocks += 1
            reply = self._first_reply(packet, sent + KNOCK_INTERVAL, request)
            if reply is not None:
                self.counts.cycles += 1
                self._due = max(sent + self._period, self._clock.monotonic())
                self._hand_over(packet, reply)
                return True
        return False

    def _first_reply(
        self, packet: bytes, until: float, request: Callable[[], Request]
    ) -> bytes | None:
        """Return the answer to the first packet, checking for requests every 0.1 s."""
        while request() is Request.CONTINUE and (now := self._clock.monotonic()) < until:
            reply = self._reply(packet, min(until, now + 0.1))
            self._watch(self.counts)
            if reply is not None:
                return reply
        return None

    def run(self, request: Callable[[], Request], patience: float) -> None:
        """Run cycle by cycle to the end."""
        late_by_missing = False
        while True:
            if not self._apply(request(), patience):
                return
            self._sleep_until(self._due)
            self._count_lateness(excused=late_by_missing)
            packet = self._peer.next_packet()
            if packet is None:
                self.counts.ended = True
                return
            stretched = self.counts.stretched
            answered = self._exchange(packet) if packet else self._stay_silent()
            late_by_missing = not answered or self.counts.stretched > stretched
            self._due += self._period
            self._watch(self.counts)

    def _exchange(self, packet: bytes) -> bool:
        """Run one cycle with a packet; return whether it was answered."""
        sent = self._clock.monotonic()
        self.counts.cycles += 1
        self._link.send(packet)
        reply = self._reply(packet, sent + self._period)
        ending = self._finish_by is not None
        if reply is None and self._stretch and not (self._unanswered and ending):
            until = sent + self._period
            reply = self._reply(packet, until + self._stretch)
            self.counts.count_stretched(self._clock.monotonic() - until)
        self._unanswered = reply is None
        if reply is not None:
            # By the kernel's time stamp: the time in the queue is not the PC's.
            waited = getattr(self._link, "waited", 0.0)
            self.counts.answer.add(max(0.0, self._clock.monotonic() - sent - waited))
        self._hand_over(packet, reply)
        return reply is not None

    def _sleep_until(self, moment: float) -> None:
        while (now := self._clock.monotonic()) < moment:
            self._clock.sleep(moment - now)

    def _stay_silent(self) -> bool:
        """Run one cycle of a booting controller, without a packet."""
        self.counts.cycles += 1
        self._peer.accept(None)
        return True

    def _apply(self, request: Request, patience: float) -> bool:
        """Apply a request of the operator; return False to stop at once."""
        if request is Request.END:
            now = self._clock.monotonic()
            if self._finish_by is None:
                self._finish_by = now + patience
                self._patience = patience
                self._peer.finish()
            elif now > self._finish_by:
                self._finish_by = inf
                self._peer.lose_drive(
                    f"the arm did not stand within {self._patience:g} s of the end"
                )
        return request is not Request.ABORT

    def _count_lateness(self, *, excused: bool) -> None:
        """Count a cycle that begins late; shift later ones after a delay of a period or more."""
        late = self._clock.monotonic() - self._due
        if late >= 0.1 * self._period and not excused:
            self.counts.own_late += 1
        if late >= self._period:
            self.counts.slips += not excused
            self._due += late

    def _reply(self, packet: bytes, until: float) -> bytes | None:
        """Return the first answer with the next number; count others."""
        wanted = next_number(packet_number(packet))
        stray = 0
        while stray < _MOST_STRAY:
            answer = self._link.receive(max(0.0, until - self._clock.monotonic()))
            if answer is None:
                return None
            number = _number(answer)
            if number == wanted:
                return answer
            self.counts.count_discarded(number)
            if self._clock.monotonic() > until:
                stray += 1
        return None

    def _hand_over(self, packet: bytes, reply: bytes | None) -> None:
        """Simulate a cycle of controller and arm."""
        begun = self._clock.monotonic()
        rejected = self._peer.rejected_replies
        self._peer.accept(reply)
        self.counts.cost.add(self._clock.monotonic() - begun)
        number = next_number(packet_number(packet))
        if reply is None:
            if not _ends_the_session(packet):
                self.counts.count_missing(number)
        else:
            self.counts.count_reply(number, valid=self._peer.rejected_replies == rejected)


def _ends_the_session(packet: bytes) -> bool:
    """Whether a packet has mode 504, which needs no answer."""
    if len(packet) < HEADER_LENGTH + AXIS_LENGTH or is_init(packet):
        return False
    mode = packet[HEADER_LENGTH : HEADER_LENGTH + 4]
    return int.from_bytes(mode, "little") == Mode.END_OF_SESSION


def _number(packet: bytes) -> int | None:
    try:
        return packet_number(packet)
    except PacketError:
        return None
