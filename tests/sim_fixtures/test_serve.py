"""A controller served in real time: valid answers, and causes of missing ones."""

from __future__ import annotations

import struct
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.c4g_packets import CyclicPacket, echo, next_number, packet_number
from sim_fixtures.serve import Request, serve

T = 0.001


class VirtualClock:
    """Time that passes only while a caller waits; `stalls` are additional pauses of the machine."""

    def __init__(self, stalls: list[tuple[float, float]]) -> None:
        self.time = 100.0
        self.stalls = stalls

    def monotonic(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.advance_to(self.time + max(0.0, seconds))

    def advance_to(self, moment: float) -> None:
        self.time = max(self.time, moment)
        if self.stalls and self.time >= self.stalls[0][0]:
            self.time += self.stalls.pop(0)[1]


class Cabinet:
    """A controller without a robot: numbered packets, and a list of the replies.

    Of its packets, by index, those in `silent_in` are empty, and `ends_in` has mode 504.
    """

    period = T
    rejected_replies = 0
    finished = stopped = False

    def __init__(
        self, clock: VirtualClock, cycles: int = 50, *, at_rest=True, silent_in=(), ends_in=-1
    ) -> None:  # fmt: skip
        self.sent_at: list[float] = []
        self.accepted: list[bytes | None] = []
        self.at_rest = at_rest
        self.silent_in = silent_in
        self.ends_in = ends_in
        self._clock = clock
        self._cycles = cycles
        self._number = 1

    def next_packet(self) -> bytes | None:
        over = self.finished and (self.at_rest or self.stopped)
        index = len(self.accepted)
        if over or index >= self._cycles:
            return None
        self.sent_at.append(self._clock.time)
        if index in self.silent_in:
            return b""
        packet = CyclicPacket.zeros(self._number, 1)
        packet.axes["mode"] = 504 if index == self.ends_in else 0
        return packet.encode()

    def accept(self, reply: bytes | None) -> None:
        self.accepted.append(reply)
        self._number = next_number(self._number)

    def finish(self) -> None:
        self.finished = True

    def lose_drive(self, reason: str) -> None:
        self.stopped = True
        self.reason = reason


Answer = Callable[[int, bytes], list[tuple[float, bytes]]]


def prompt(index: int, packet: bytes) -> list[tuple[float, bytes]]:
    """Give the right answer soon."""
    del index
    return [(0.1 * T, echo(packet))]


def only(answered: Callable[[int], bool]) -> Answer:
    """Answer the packets of these indices, the others not."""
    return lambda index, packet: prompt(index, packet) if answered(index) else []


def slow(late: dict[int, float]) -> Answer:
    """Answer some packets after so many periods, the others soon."""
    return lambda index, packet: [(late.get(index, 0.1) * T, echo(packet))]


class VirtualLink:
    """The controller's end of a link; `answer` gives the replies to packet `index`, with delays."""

    def __init__(self, clock: VirtualClock, answer: Answer, cost: float) -> None:
        self.cost = cost
        self.sent: list[tuple[float, bytes]] = []
        self._clock = clock
        self._answer = answer
        self._coming: list[tuple[float, int, bytes]] = []
        self._order = 0

    def send(self, packet: bytes) -> None:
        index = len(self.sent)
        self.sent.append((self._clock.time, packet))
        for delay, reply in self._answer(index, packet):
            heappush(self._coming, (self._clock.time + delay, self._order, reply))
            self._order += 1

    def receive(self, timeout: float) -> bytes | None:
        self._clock.time += self.cost
        until = self._clock.time + timeout
        if self._coming and self._coming[0][0] <= until:
            self._clock.advance_to(self._coming[0][0])
            return heappop(self._coming)[2]
        self._clock.advance_to(until)
        arrived = self._coming and self._coming[0][0] <= self._clock.time
        return heappop(self._coming)[2] if arrived else None

    def close(self) -> None: ...


def served(
    answer: Answer = prompt,
    *,
    cycles: int = 50,
    receive_cost: float = 0.0,
    stalls: list[tuple[float, float]] | None = None,
    request: Callable[[Cabinet], Request] = lambda _: Request.CONTINUE,
    options: dict[str, object] | None = None,
    **keywords,
):
    """Serve a `Cabinet` with these options; its counts, the cabinet, its link."""
    clock = VirtualClock(stalls or [])
    cabinet = Cabinet(clock, cycles, **(options or {}))
    wire = VirtualLink(clock, answer, receive_cost)
    counts = serve(cabinet, wire, clock=clock, request=lambda: request(cabinet), **keywords)
    return counts, cabinet, wire


def gaps(cabinet: Cabinet) -> list[float]:
    return [b - a for a, b in pairwise(cabinet.sent_at)]


def test_the_packet_that_ends_the_session_needs_no_answer():
    summary, _, _ = served(only(lambda k: k < 19), cycles=20, options={"ends_in": 19})
    assert (summary.cycles, summary.replies, summary.missed) == (20, 19, 0)


def test_an_answer_after_its_cycle_is_late_and_not_accepted():
    summary, cabinet, _ = served(slow({20: 1.3}))
    assert (summary.missed, summary.late, summary.rejected) == (1, 1, 0)
    assert [k for k, reply in enumerate(cabinet.accepted) if reply is None] == [20]
    assert packet_number(cabinet.accepted[21]) == 23


def test_only_the_first_of_several_answers_is_accepted():
    def answer(index, packet):
        second = bytearray(echo(packet))
        second[4] = 1
        return [*prompt(index, packet), (0.2 * T, bytes(second))]

    summary, cabinet, _ = served(answer)
    # That of the last cycle is never read.
    assert (summary.replies, summary.surplus) == (50, 49)
    assert all(reply[4] == 0 for reply in cabinet.accepted)


def test_an_answer_the_controller_finds_wrong_counts_as_missing(monkeypatch):
    accept = Cabinet.accept

    def picky(self, reply: bytes | None) -> None:
        accept(self, reply)
        self.rejected_replies += len(self.accepted) % 10 == 0

    monkeypatch.setattr(Cabinet, "accept", picky)
    summary, _, _ = served()
    assert (summary.replies, summary.missed, summary.rejected) == (45, 5, 5)


@pytest.mark.parametrize("junk", [b"", b"\0" * 5, struct.pack("<i", 0) * 12, b"\xff" * 48])
def test_junk_before_the_answer_is_rejected(junk: bytes):
    summary, _, _ = served(lambda k, packet: [(0.05 * T, junk), *prompt(k, packet)])
    assert (summary.replies, summary.missed, summary.rejected) == (50, 0, 50)


def test_a_flood_of_junk_ends_with_the_cycle():
    def answer(index, packet):
        return [(0.2 * T, b"junk")] * 5000 if index == 10 else prompt(index, packet)

    summary, cabinet, _ = served(answer, receive_cost=0.001 * T)
    assert summary.cycles == 50
    assert max(gaps(cabinet)) < 1.3 * T


@pytest.mark.parametrize("stall", [0.6, 3.0, 30.0, 200.0])
def test_a_stall_of_the_server_is_not_counted_as_the_pcs(stall: float):
    """And packets are not sent in a burst after it."""
    summary, cabinet, _ = served(stalls=[(100.0 + 20 * T, stall * T)])
    assert (summary.replies, summary.missed) == (50, 0)
    assert summary.own_late >= 1
    assert summary.slips == (stall >= 1.0)
    assert None not in cabinet.accepted
    assert min(gaps(cabinet)[1:]) > (0.5 * T if stall == 30.0 else 0.0)


def test_an_extended_cycle_waits_for_its_reply():
    summary, cabinet, _ = served(slow({20: 30.0}), cycle_extension=0.5)
    assert (summary.replies, summary.missed, summary.late) == (50, 0, 0)
    assert (summary.extended, summary.own_late) == (1, 0)
    assert summary.longest_extension == pytest.approx(29.0 * T)
    waited = gaps(cabinet)
    assert waited[20] >= 30.0 * T - 1e-12
    assert max(waited[:20] + waited[21:]) <= T + 1e-12


def test_the_first_packet_is_repeated_until_it_is_answered():
    summary, _, link = served(only(lambda k: k >= 3))
    assert summary.first_packets == 4
    assert len({packet for _, packet in link.sent[:4]}) == 1
    times = [moment for moment, _ in link.sent[:4]]
    assert [b - a for a, b in pairwise(times)] == pytest.approx([1.0] * 3)
    assert (summary.cycles, summary.missed) == (50, 0)
    assert [packet_number(packet) for _, packet in link.sent[3:]] == list(range(1, 51))


def after(cycles: int, request: Request) -> Callable[[Cabinet], Request]:
    return lambda cabinet: request if len(cabinet.accepted) > cycles else Request.CONTINUE


class TestRequest:
    def test_end_before_the_first_answer_ends_at_once(self):
        polls = iter([Request.CONTINUE] * 10)
        summary, cabinet, _ = served(
            only(lambda k: False), request=lambda _: next(polls, Request.END)
        )
        assert not summary.ended
        assert (summary.cycles, cabinet.accepted) == (0, [])

    def test_end_finishes_the_session_and_abort_stops_at_once(self):
        summary, cabinet, _ = served(request=after(50, Request.END), cycles=10_000)
        assert (summary.ended, cabinet.finished, cabinet.stopped) == (True, True, False)
        summary, _, _ = served(request=after(6, Request.ABORT), cycles=10_000)
        assert (summary.cycles, summary.ended) == (7, False)

    def test_at_the_end_a_silent_pc_is_waited_for_once(self):
        summary, cabinet, _ = served(
            only(lambda k: k < 10), request=after(5, Request.END), cycle_extension=0.5,
            patience=1.0, options={"at_rest": False}, cycles=10_000,
        )  # fmt: skip
        assert (summary.extended, summary.missed) == (1, len(cabinet.accepted) - 10)
        assert len(cabinet.accepted) > 400

    def test_an_arm_not_at_rest_after_the_patience_loses_its_drive(self):
        summary, cabinet, _ = served(
            request=after(5, Request.END), patience=0.5, cycles=10_000, options={"at_rest": False}
        )
        assert summary.ended and cabinet.stopped
        assert cabinet.reason == "the arm did not stand within 0.5 s of the end"
        assert cabinet.sent_at[-1] - cabinet.sent_at[5] == pytest.approx(0.5, abs=0.01)


def test_cycles_of_a_silent_controller_are_not_missed():
    summary, cabinet, link = served(options={"silent_in": {10, 11, 12}})
    assert (summary.cycles, summary.replies, summary.missed) == (50, 47, 0)
    assert len(link.sent) == 47
    assert cabinet.accepted[10:13] == [None] * 3
    assert gaps(cabinet)[1:] == pytest.approx([T] * 48)


@settings(max_examples=50, deadline=None)
@given(
    delays=st.lists(st.floats(0.0, 4.0).filter(lambda d: abs(d - round(d)) > 0.01), min_size=30),
    copies=st.lists(st.integers(0, 3), min_size=30),
    naps=st.lists(st.tuples(st.floats(0.0, 0.03), st.floats(0.0, 0.02)), max_size=4),
)
@pytest.mark.long
def test_each_cycle_accepts_at_most_one_answer_of_its_own(delays, copies, naps):
    def answer(index, packet):
        if index == 0:
            return prompt(index, packet)
        delay = delays[index % len(delays)]
        count = copies[index % len(copies)]
        return [(delay * T, echo(packet))] * count

    stalls = sorted((100.0 + at, nap) for at, nap in naps)
    summary, cabinet, _ = served(answer, cycles=40, stalls=stalls)
    assert summary.cycles == 40 == summary.replies + summary.missed
    for cycle, reply in enumerate(cabinet.accepted):
        assert reply is None or packet_number(reply) == cycle + 2
    assert sum(reply is not None for reply in cabinet.accepted) == summary.replies
    assert summary.rejected == 0, "late or surplus"
