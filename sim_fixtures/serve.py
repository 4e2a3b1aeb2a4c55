"""A simulated controller in real time: it paces a link as the cabinet would.

Each cycle begins at its own moment, one period after the one before, however long the work took.
The controller's packet goes out; the first answer with the right number within a period is the
reply, whatever else arrives is counted and dropped; then controller and arm compute their cycle.

The server may itself run late. That is never laid at the PC's door: an answer has a whole period
from the moment the packet really left, and before an answer is called missing the server looks
into the link once more, for it may have slept while the answer lay there. A server that is late by
a period or more goes on from where it is; it does not send the packets it owes in a burst. What
happened is a `ServeCounts`: counts and times, in memory that does not grow.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum, auto
from heapq import heappop, heappush
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
from drivers.transports.faults import FaultyLink
from drivers.transports.simulated import Peer
from sim_fixtures.errors import SimulationError

LARGEST_DATAGRAM: Final = 65536
_SO_TIMESTAMPNS: Final = 35  # of asm-generic/socket.h, which the socket module does not name
_TIMESPEC: Final = struct.Struct("@ll")
_CONTROL_SPACE: Final = socket.CMSG_SPACE(_TIMESPEC.size)


class ControllerLink(Protocol):
    """The controller's end of a real link: moves whole packets; knows no cycle, state or mode."""

    def send(self, packet: bytes) -> None:
        """Send towards the PC. What the network refuses to carry is lost, not an error."""

    def receive(self, timeout: float) -> bytes | None:
        """The next packet of the PC; None if none came within `timeout` seconds (0: look)."""

    def close(self) -> None:
        """Give the link up."""


class ControllerLinkError(SimulationError):
    """The controller's end of a link cannot be opened.

    Attributes:
        place: what was to be opened.
        problem: why it cannot be.
    """

    def __init__(self, place: str, problem: str) -> None:
        self.place = place
        self.problem = problem
        super().__init__(f"{place}: {problem}")

    def __reduce__(self) -> tuple[type[ControllerLinkError], tuple[str, str]]:
        return type(self), (self.place, self.problem)


class UdpControllerLink:
    """One datagram, one packet, to a PC program that listens at `host`:`port` (IPv4).

    The socket is not connected: a PC that does not listen yet is a PC that does not answer, not a
    broken connection. Datagrams of any other address or port are dropped.

    Attributes:
        foreign: datagrams that came from elsewhere.
        last_foreign: where the last of them came from, "host:port"; "" if there was none.
        waited: s that the packet received last lay in the kernel's queue; 0 where that is unknown.
        unsent: packets that the network refused to carry.
        trouble: why it refused the last one, in words; "" if it never did.

    Raises:
        ControllerLinkError: no such host, or the local port is in use.
    """

    def __init__(self, host: str, port: int, *, source_port: int | None = None) -> None:
        self.foreign = 0
        self.last_foreign = ""
        self.waited = 0.0
        self.unsent = 0
        self.trouble = ""
        try:
            self._pc = (socket.gethostbyname(host), port)
        except (OSError, UnicodeError) as error:
            raise ControllerLinkError(f"{host}:{port}", f"no such IPv4 host ({error})") from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with suppress(OSError):  # not every system has it; nothing needs it
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
        """The local port that packets leave from."""
        port: int = self._socket.getsockname()[1]
        return port

    def send(self, packet: bytes) -> None:
        """Send one datagram; a network that is down or full loses it."""
        try:
            self._socket.sendto(packet, self._pc)
        except OSError as error:
            self.unsent += 1
            self.trouble = error.strerror or str(error)

    def receive(self, timeout: float) -> bytes | None:
        """The next datagram of the PC, or None."""
        until = time.monotonic() + timeout
        while True:
            # select() waits to the microsecond; the time-out of a socket rounds up to the next ms.
            if not select([self._socket], [], [], max(0.0, until - time.monotonic()))[0]:
                return None
            try:
                packet, control, _, sender = self._socket.recvmsg(LARGEST_DATAGRAM, _CONTROL_SPACE)
            except OSError:  # reported ready, then dropped for a bad checksum; or an ICMP notice
                continue
            if sender == self._pc:
                self.waited = _waited(control)
                return packet
            self.foreign += 1
            self.last_foreign = f"{sender[0]}:{sender[1]}"
            if time.monotonic() > until:
                return None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _waited(control: list[tuple[int, int, bytes]]) -> float:
    """How long ago the kernel had a datagram [s], by its time stamp."""
    for _, kind, data in control:
        if kind == _SO_TIMESTAMPNS and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return max(0.0, time.time() - float(seconds) - 1e-9 * float(nanoseconds))
    return 0.0


REMEMBERED: Final = 1000


class Histogram:
    """Durations in bins of 5 µs up to 50 ms; the largest is left as it is."""

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
        """Upper edge (s) of the bin that this fraction of all durations ends in; 0 for none."""
        wanted, seen = fraction * self.count, 0
        for index, entries in enumerate(self._bins):
            seen += entries
            if entries and seen >= wanted:
                return min(self.largest, (index + 1) * self.BIN)
        return 0.0


@dataclass(eq=False)
class ServeCounts:
    """What a served session came to so far.

    Attributes:
        cycles: packets the controller sent, the repeated first one counted once.
        knocks: how often the first packet was sent until somebody answered.
        replies: answers the controller took, at most one a cycle.
        missed: cycles that no valid answer came in.
        late: answers that came after their cycle; not accepted.
        surplus: further answers to a cycle that had been answered.
        rejected: answers of wrong length, number or content.
        stretched: cycles made longer than a period to wait for their answer.
        own_late: cycles that began late by a tenth of the period or more though the answer before
            had come in time: the server's fault, not the PC's.
        slips: how many of these were late by a whole period or more; the cycle goes on from there.
        ended: whether the controller has ended its session (504); otherwise it was given up.
        stretch_max: by how much the longest stretched cycle was longer, s.
        answer: times from the packet to its answer, as seen here.
        cost: times of computing a cycle of controller and arm.
    """

    cycles: int = 0
    knocks: int = 0
    replies: int = 0
    missed: int = 0
    late: int = 0
    surplus: int = 0
    rejected: int = 0
    stretched: int = 0
    own_late: int = 0
    slips: int = 0
    ended: bool = False
    stretch_max: float = 0.0
    answer: Histogram = field(default_factory=Histogram)
    cost: Histogram = field(default_factory=Histogram)
    _unanswered: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _answered: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    def take(self, number: int, *, valid: bool) -> None:
        """A reply with the right number was handed over; the controller found it valid or not."""
        if valid:
            self.replies += 1
        else:
            self.rejected += 1
            self.missed += 1
        self._answered.append(number)

    def miss(self, number: int) -> None:
        """The cycle whose answer should have carried `number` had none."""
        self.missed += 1
        self._unanswered.append(number)

    def stretch(self, seconds: float) -> None:
        """A cycle was made longer by that much."""
        self.stretched += 1
        self.stretch_max = max(self.stretch_max, seconds)

    def discard(self, number: int | None) -> None:
        """An answer that is not that of the running cycle; `number` is None if it has none."""
        if number is not None and number in self._unanswered:
            self.late += 1
            self._unanswered.remove(number)
            self._answered.append(number)
        elif number is not None and number in self._answered:
            self.surplus += 1
        else:
            self.rejected += 1


Delayed = tuple[float, int, bytes]


class Clock(Protocol):
    """What time it is, and waiting; the module `time` is one."""

    def monotonic(self) -> float:
        """Seconds since whenever, never falling."""

    def sleep(self, seconds: float, /) -> None:
        """Let that much time pass."""


class Wire:
    """A far end whose packets go through `faults`.

    What is held back leaves or arrives when its time has come, as long as somebody waits here
    (`receive` or `sleep_until`), which the server of a controller always does.
    """

    def __init__(self, far_end: ControllerLink, faults: FaultyLink | None, clock: Clock) -> None:
        self._far_end = far_end
        self._faults: Final = faults
        self._clock = clock
        self._leaving: list[Delayed] = []
        self._arriving: list[Delayed] = []
        self._order = 0

    def send(self, cycle: int, packet: bytes) -> None:
        """Send the packet of a cycle."""
        if self._faults is None:
            self._far_end.send(packet)
            return
        self._hold(self._leaving, self._faults.carry(cycle, "to_pc", packet))
        self._release()

    def receive(self, cycle: int, until: float) -> bytes | None:
        """What arrives by the time `until`, None if nothing does.

        Looks into the link at least once, even if `until` has passed: what lies there already
        arrived while this program was not running.
        """
        if self._faults is None:
            return self._far_end.receive(max(0.0, until - self._clock.monotonic()))
        while True:
            now = self._release()
            if self._arriving and self._arriving[0][0] <= now:
                return heappop(self._arriving)[2]
            next_event = min(until, _due(self._leaving), _due(self._arriving))
            packet = self._far_end.receive(max(0.0, next_event - now))
            if packet is not None:
                self._hold(self._arriving, self._faults.carry(cycle, "to_controller", packet))
            elif now >= until:
                return None

    @property
    def waited(self) -> float:
        """S that the packet received last lay in the kernel's queue, as far as is known."""
        # What is held back by a fault arrives when its time has come.
        return 0.0 if self._faults is not None else float(getattr(self._far_end, "waited", 0.0))

    def sleep_until(self, moment: float) -> None:
        """Wait; what is due meanwhile leaves."""
        while True:
            now = self._release()
            if now >= moment:
                return
            self._clock.sleep(min(moment, _due(self._leaving)) - now)

    def _hold(self, queue: list[Delayed], deliveries: Sequence[tuple[float, bytes]]) -> None:
        now = self._clock.monotonic()
        for delay, packet in deliveries:
            heappush(queue, (now + delay, self._order, packet))
            self._order += 1

    def _release(self) -> float:
        """Send what is due; the time."""
        now = self._clock.monotonic()
        while self._leaving and self._leaving[0][0] <= now:
            self._far_end.send(heappop(self._leaving)[2])
        return now


def _due(queue: list[Delayed]) -> float:
    return queue[0][0] if queue else inf


KNOCK_INTERVAL: Final = 1.0
"""Seconds between two first packets while nobody answers."""
PATIENCE: Final = 3.0
"""Seconds that the arm may take to come to rest once the session is to end."""
_NO_CYCLE: Final = -1
"""Of the repeated first packet: a fault scripted for cycle 0 strikes once."""
_LOOKS: Final = 100
"""Stray packets looked at after a cycle is over, so that a flood cannot hold the cycle up."""


class Request(IntEnum):
    """What the person in front of the cabinet wants."""

    CONTINUE = auto()
    END = auto()
    ABORT = auto()


class ServedPeer(Peer, Protocol):
    """A controller that can be served: `SimulatedController` is one."""

    rejected_replies: int

    def finish(self) -> None:
        """End the session when the arm stands."""

    def lose_drive(self, reason: str) -> None:
        """Switch the drive off, for this reason."""


def serve(
    peer: ServedPeer,
    far_end: ControllerLink,
    *,
    faults: FaultyLink | None = None,
    request: Callable[[], Request] = lambda: Request.CONTINUE,
    watch: Callable[[ServeCounts], None] = lambda _: None,
    clock: Clock = time,
    patience: float = PATIENCE,
    stretch: float = 0.0,
) -> ServeCounts:
    """Run a controller on a real link until its session has ended.

    The first packet is repeated once a second until a PC answers it, so that the order of starting
    does not matter and the PC still sees each packet of the start once.

    Args:
        peer: the controller.
        far_end: its link, left open.
        faults: what the link does to packets; cycle 0 is that of the first one.
        request: asked every cycle. At `END` the controller ends its session, with the drive
            switched off under a moving arm if it does not stand within `patience` s; at `ABORT`
            it falls silent at once.
        watch: called once a cycle, in the time that is left over, with the counts so far.
        clock: of the machine, if left out.
        patience: see `request`, s.
        stretch: a cycle without an answer is made longer by up to so many s until one comes. No
            real controller does that; it is for PCs that are held up now and then. Once the end is
            requested, a PC that let such a wait pass counts as gone until it answers again.
    """
    server = _Server(peer, Wire(far_end, faults, clock), clock, watch, stretch)
    if server.knock(request):
        server.run(request, patience)
    return server.tally


class _Server:
    """One session of one controller."""

    def __init__(
        self,
        peer: ServedPeer,
        wire: Wire,
        clock: Clock,
        watch: Callable[[ServeCounts], None],
        stretch: float,
    ) -> None:
        self.tally = ServeCounts()
        self._peer = peer
        self._wire = wire
        self._clock = clock
        self._watch = watch
        self._period = peer.period
        self._stretch = stretch
        self._due = 0.0
        self._finish_by: float | None = None
        self._patience = 0.0
        self._deserted = False

    def knock(self, request: Callable[[], Request]) -> bool:
        """Repeat the first packet until it is answered; False if asked to end before."""
        packet = self._peer.next_packet()
        if packet is None:
            self.tally.ended = True
            return False
        while request() is Request.CONTINUE:
            sent = self._clock.monotonic()
            self._wire.send(0 if self.tally.knocks == 0 else _NO_CYCLE, packet)
            self.tally.knocks += 1
            reply = self._patient_reply(packet, sent + KNOCK_INTERVAL, request)
            if reply is not None:
                self.tally.cycles += 1
                self._due = max(sent + self._period, self._clock.monotonic())
                self._hand_over(packet, reply)
                return True
        return False

    def _patient_reply(
        self, packet: bytes, until: float, request: Callable[[], Request]
    ) -> bytes | None:
        """An answer to the first packet, in steps short enough to notice a request to end."""
        while request() is Request.CONTINUE and (now := self._clock.monotonic()) < until:
            reply = self._reply(packet, min(until, now + 0.1))
            self._watch(self.tally)
            if reply is not None:
                return reply
        return None

    def run(self, request: Callable[[], Request], patience: float) -> None:
        """Cycle by cycle to the end."""
        late_by_missing = False
        while True:
            if not self._heed(request(), patience):
                return
            self._wire.sleep_until(self._due)
            self._note_lateness(excused=late_by_missing)
            packet = self._peer.next_packet()
            if packet is None:
                self.tally.ended = True
                return
            stretched = self.tally.stretched
            answered = self._exchange(packet) if packet else self._stay_silent()
            late_by_missing = not answered or self.tally.stretched > stretched
            self._due += self._period
            self._watch(self.tally)

    def _exchange(self, packet: bytes) -> bool:
        """One cycle: packet, reply, computation. Whether it was answered."""
        sent = self._clock.monotonic()
        self.tally.cycles += 1
        self._wire.send(self.tally.cycles - 1, packet)
        reply = self._reply(packet, sent + self._period)
        if reply is None and self._stretch and not (self._deserted and self._finish_by is not None):
            until = sent + self._period
            reply = self._reply(packet, until + self._stretch)
            self.tally.stretch(self._clock.monotonic() - until)
        self._deserted = reply is None
        if reply is not None:
            # By the kernel's time: that this program looked late is not the PC's doing.
            self.tally.answer.add(max(0.0, self._clock.monotonic() - sent - self._wire.waited))
        self._hand_over(packet, reply)
        return reply is not None

    def _stay_silent(self) -> bool:
        """A cycle in which the controller sends nothing, for it is booting."""
        self.tally.cycles += 1
        self._peer.accept(None)
        return True

    def _heed(self, request: Request, patience: float) -> bool:
        """Ask the controller to end; take its drive away if the arm does not come to rest."""
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

    def _note_lateness(self, *, excused: bool) -> None:
        """Count a cycle that begins late; go on from here if a whole period is gone."""
        late = self._clock.monotonic() - self._due
        if late >= 0.1 * self._period and not excused:
            self.tally.own_late += 1
        if late >= self._period:
            self.tally.slips += not excused
            self._due += late

    def _reply(self, packet: bytes, until: float) -> bytes | None:
        """The first answer that carries the number after that of `packet`; the rest is counted."""
        wanted = next_number(packet_number(packet))
        looks = _LOOKS
        while looks:
            answer = self._wire.receive(self.tally.cycles - 1, until)
            if answer is None:
                return None
            number = _number(answer)
            if number == wanted:
                return answer
            self.tally.discard(number)
            if self._clock.monotonic() > until:
                looks -= 1
        return None

    def _hand_over(self, packet: bytes, reply: bytes | None) -> None:
        """Let controller and arm compute their cycle."""
        begun = self._clock.monotonic()
        rejected = self._peer.rejected_replies
        self._peer.accept(reply)
        self.tally.cost.add(self._clock.monotonic() - begun)
        number = next_number(packet_number(packet))
        if reply is None:
            if not _ends_the_session(packet):
                self.tally.miss(number)
        else:
            self.tally.take(number, valid=self._peer.rejected_replies == rejected)


def _ends_the_session(packet: bytes) -> bool:
    """Whether a packet says 504, which needs no answer."""
    if len(packet) < HEADER_LENGTH + AXIS_LENGTH or is_init(packet):
        return False
    mode = packet[HEADER_LENGTH : HEADER_LENGTH + 4]
    return int.from_bytes(mode, "little") == Mode.END_OF_SESSION


def _number(packet: bytes) -> int | None:
    try:
        return packet_number(packet)
    except PacketError:
        return None
