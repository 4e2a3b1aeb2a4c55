"""Server of a simulated controller on a real link, in real time.

Cycles begin one period after another. The packet is sent; the first reply with the right number
within a period is the reply; other packets are counted and dropped; then controller and arm are
simulated for a cycle.

Delays of the server are not counted as the PC's: the period for a reply begins when the packet
was sent, and the link is polled once more before a reply counts as missing. If the server is late
by a period or more, later cycles are shifted; packets are not sent in a burst. `ServeCounts` has
counts and times, in memory of fixed size.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum, auto
from math import inf
from select import select
from typing import Final, Protocol

from drivers.c4g_packets import (
    AXIS_LENGTH,
    HEADER_LENGTH,
    Mode,
    is_init,
    next_number,
    packet_number,
)
from drivers.errors import PacketError
from drivers.exchange.control import LATENCY_BINS, bin_of, quantile
from drivers.transports.base import TransportError
from drivers.transports.simulated import Peer
from drivers.transports.udp import UdpSpec

MAX_DATAGRAM_BYTES: Final = 65536


class ControllerLink(Protocol):
    """The controller's end of a real link, for complete packets."""

    def send(self, packet: bytes) -> None:
        """Send to the PC; what the network refuses is lost without an error."""

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet of the PC, or None after `timeout` seconds (0: poll)."""

    def close(self) -> None:
        """Close the link."""


class UdpControllerLink:
    """Link to a PC program that listens at `host`:`port` (IPv4), one datagram per packet.

    The socket is not connected, so that a PC that does not listen yet is not an error. Datagrams
    from any other address or port are dropped.

    Attributes:
        foreign: number of datagrams from other addresses.

    Raises:
        TransportError: no such host.
    """

    def __init__(self, host: str, port: int) -> None:
        self.foreign = 0
        try:
            self._pc = (socket.gethostbyname(host), port)
        except (OSError, UnicodeError) as error:
            reason = f"there is no such IPv4 host ({error})"
            raise TransportError(f"UDP to {host}:{port}", reason, "check the address") from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(("", 0))

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
                packet, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
            except OSError:  # dropped for a bad checksum, or an ICMP error
                continue
            if sender == self._pc:
                return packet
            self.foreign += 1
            if time.monotonic() > until:
                return None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def open_controller_link(spec: UdpSpec, mode: int | None = None) -> UdpControllerLink:
    """Open the controller's end of UDP to a PC program at the host and port of `spec`."""
    del mode
    return UdpControllerLink(spec.peer_host, spec.port)


REMEMBERED_PACKETS: Final = 1000


@dataclass(eq=False)
class Latencies:
    """Durations in the bins of `drivers.exchange.control`, and the largest one, s."""

    largest: float = 0.0
    counts: list[int] = field(default_factory=lambda: [0] * LATENCY_BINS)

    def add(self, seconds: float) -> None:
        """Count one duration."""
        self.largest = max(self.largest, seconds)
        self.counts[bin_of(seconds)] += 1

    def quantile(self, share: float) -> float:
        """Return a quantile, s, at most 19 % too long; 0 without durations."""
        return min(self.largest, quantile(self.counts, share) or 0.0)


@dataclass(eq=False)
class ServeCounts:
    """Counts and times of a served session.

    `own_late` are cycles that began late by a tenth of the period or more although the reply
    before was in time, `slips` those of them that were late by a period or more.
    """

    cycles: int = 0  # packets of the controller, the repeated first one counted once
    first_packets: int = 0  # transmissions of the first packet
    replies: int = 0  # accepted replies, at most one per cycle
    missed: int = 0  # cycles without a valid reply
    late: int = 0  # replies after their cycle, not accepted
    surplus: int = 0  # further replies in a cycle that had one
    rejected: int = 0  # replies of wrong length, number or content
    extended: int = 0  # cycles extended to wait for their reply
    read_late: int = 0  # replies read after their cycle only because the server itself was late
    own_late: int = 0
    slips: int = 0
    ended: bool = False  # whether the controller has ended its session (504)
    longest_extension: float = 0.0  # longest extension of a cycle, s
    reply: Latencies = field(default_factory=Latencies)  # times from the packet to its reply
    cost: Latencies = field(default_factory=Latencies)  # computing times of a cycle
    _without_reply: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_PACKETS))
    _replied: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_PACKETS))

    def count_reply(self, number: int, *, valid: bool) -> None:
        """Count a reply with the right number, valid for the controller or not."""
        if valid:
            self.replies += 1
        else:
            self.rejected += 1
            self.missed += 1
        self._replied.append(number)

    def count_missing(self, number: int) -> None:
        """Count a cycle without the reply `number`."""
        self.missed += 1
        self._without_reply.append(number)

    def count_discarded(self, number: int | None) -> None:
        """Count a reply to another than the present cycle; None if it has no number."""
        if number is not None and number in self._without_reply:
            self.late += 1
            self._without_reply.remove(number)
            self._replied.append(number)
        elif number is not None and number in self._replied:
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
"""Seconds between two first packets while no PC replies."""
STOP_TIMEOUT: Final = 3.0
"""Time for the arm to stop when the session is to end [s]."""
_MAX_STRAY_PACKETS: Final = 100
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
    patience: float = STOP_TIMEOUT,
    cycle_extension: float = 0.0,
) -> ServeCounts:
    """Run a controller on a real link until its session has ended; the link stays open.

    The first packet is repeated once a second until a PC replies, so that either program may be
    started first.

    Args:
        peer: the controller.
        link: to the PC.
        request: called every cycle. At `END` the controller ends its session, at `ABORT` it stops
            at once.
        watch: called once per cycle with the counts so far.
        clock: of the cycles.
        patience: in which the arm must have stopped after `END`, else its drive is switched off
            [s].
        cycle_extension: by which a cycle without a reply is extended at most [s]; for PCs with
            occasional delays, as real controllers do not extend cycles. A PC from which nothing
            came within an extension is not waited for again before something comes from it. After
            `END`, only a valid reply counts.
    """
    server = _Server(peer, link, request, watch, clock, patience, cycle_extension)
    if server.await_pc():
        server.run()
    return server.counts


@dataclass(eq=False)
class _Server:
    """One session of one controller."""

    peer: ServedPeer
    link: ControllerLink
    request: Callable[[], Request]
    watch: Callable[[ServeCounts], None]
    clock: Clock
    patience: float
    cycle_extension: float
    counts: ServeCounts = field(default_factory=ServeCounts)
    due: float = 0.0
    finish_by: float | None = None
    without_reply: bool = False
    gone: bool = False  # nothing came from the PC within the last extension

    def await_pc(self) -> bool:
        """Repeat the first packet until it gets a reply; False if the end is requested before."""
        packet = self.peer.next_packet()
        if packet is None:
            self.counts.ended = True
            return False
        while self.request() is Request.CONTINUE:
            sent = self.clock.monotonic()
            self.link.send(packet)
            self.counts.first_packets += 1
            reply = self._first_reply(packet, sent + KNOCK_INTERVAL)
            if reply is not None:
                self.counts.cycles += 1
                self.due = max(sent + self.peer.period, self.clock.monotonic())
                self._hand_over(packet, reply)
                return True
        return False

    def _first_reply(self, packet: bytes, until: float) -> bytes | None:
        """Return the reply to the first packet, checking for requests every 0.1 s."""
        while self.request() is Request.CONTINUE and (now := self.clock.monotonic()) < until:
            reply = self._reply(packet, min(until, now + 0.1))
            self.watch(self.counts)
            if reply is not None:
                return reply
        return None

    def run(self) -> None:
        """Run cycle by cycle to the end."""
        late_by_missing = False
        while True:
            if not self._apply(self.request()):
                return
            self._sleep_until(self.due)
            self._count_lateness(excused=late_by_missing)
            packet = self.peer.next_packet()
            if packet is None:
                self.counts.ended = True
                return
            before = self.counts.extended
            replied = self._exchange(packet) if packet else self._stay_silent()
            late_by_missing = not replied or self.counts.extended > before
            self.due += self.peer.period
            self.watch(self.counts)

    def _exchange(self, packet: bytes) -> bool:
        """Run one cycle with a packet; return whether it got a reply."""
        sent = self.clock.monotonic()
        before = self.counts.extended
        self.counts.cycles += 1
        self.link.send(packet)
        reply = self._reply(packet, sent + self.peer.period)
        ending = self.finish_by is not None
        if (
            reply is None
            and self.cycle_extension
            and not self.gone
            and not (self.without_reply and ending)
        ):
            until = sent + self.peer.period
            self.gone = True
            reply = self._reply(packet, until + self.cycle_extension)
            self.counts.extended += 1
            extended = self.clock.monotonic() - until
            self.counts.longest_extension = max(self.counts.longest_extension, extended)
        self.without_reply = reply is None
        if reply is not None:
            took = self.clock.monotonic() - sent
            self.counts.reply.add(took)
            self.counts.read_late += took > self.peer.period and self.counts.extended == before
        self._hand_over(packet, reply)
        return reply is not None

    def _sleep_until(self, moment: float) -> None:
        while (now := self.clock.monotonic()) < moment:
            self.clock.sleep(moment - now)

    def _stay_silent(self) -> bool:
        """Run one cycle of a booting controller, without a packet."""
        self.counts.cycles += 1
        self.peer.accept(None)
        return True

    def _apply(self, request: Request) -> bool:
        """Apply a request of the operator; return False to stop immediately."""
        if request is Request.END:
            now = self.clock.monotonic()
            if self.finish_by is None:
                self.finish_by = now + self.patience
                self.peer.finish()
            elif now > self.finish_by:
                self.finish_by = inf
                self.peer.lose_drive(f"the arm did not stand within {self.patience:g} s of the end")
        return request is not Request.ABORT

    def _count_lateness(self, *, excused: bool) -> None:
        """Count a cycle that begins late; shift later ones after a delay of a period or more."""
        late = self.clock.monotonic() - self.due
        if late >= 0.1 * self.peer.period and not excused:
            self.counts.own_late += 1
        if late >= self.peer.period:
            self.counts.slips += not excused
            self.due += late

    def _reply(self, packet: bytes, until: float) -> bytes | None:
        """Return the first reply with the next number; count others."""
        wanted = next_number(packet_number(packet))
        stray = 0
        while stray < _MAX_STRAY_PACKETS:
            reply = self.link.receive(max(0.0, until - self.clock.monotonic()))
            if reply is None:
                return None
            self.gone = False
            number = _number(reply)
            if number == wanted:
                return reply
            self.counts.count_discarded(number)
            if self.clock.monotonic() > until:
                stray += 1
        return None

    def _hand_over(self, packet: bytes, reply: bytes | None) -> None:
        """Simulate a cycle of controller and arm."""
        begun = self.clock.monotonic()
        rejected = self.peer.rejected_replies
        self.peer.accept(reply)
        self.counts.cost.add(self.clock.monotonic() - begun)
        number = next_number(packet_number(packet))
        if reply is None:
            if not _ends_the_session(packet):
                self.counts.count_missing(number)
        else:
            self.counts.count_reply(number, valid=self.peer.rejected_replies == rejected)


def _ends_the_session(packet: bytes) -> bool:
    """Whether a packet has mode 504, which needs no reply."""
    if len(packet) < HEADER_LENGTH + AXIS_LENGTH or is_init(packet):
        return False
    mode = packet[HEADER_LENGTH : HEADER_LENGTH + 4]
    return int.from_bytes(mode, "little") == Mode.END_OF_SESSION


def _number(packet: bytes) -> int | None:
    try:
        return packet_number(packet)
    except PacketError:
        return None
