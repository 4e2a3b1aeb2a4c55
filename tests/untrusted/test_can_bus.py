"""Other nodes on the CAN bus: one with identifiers of its own, one with the controller's.

Frames have no sender, so the second is accepted as the controller. It can end the run; it cannot
cause a set-point that is not of the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import count

import can
import numpy as np
import pytest

from drivers import MotionEnded, PacketRejected, TransportClosed
from drivers.transports.can.frames import PACKED_IDS, BusRates
from drivers.transports.can.transport import CanTransport
from sim_fixtures import Phase
from sim_fixtures.can_link import CanControllerLink
from tests.drivers.can_bench import HOME, MOVE, PERIOD, Cycles, Run, UnstampedBus

pytestmark = pytest.mark.safety

REPLY_IDS = {0x100}  # Identifier of the PC (`docs/connect.md`)
_channels = count()

LAST_CYCLE = 600  # a session has 484

Frames = list[can.Message]
Meddle = Callable[["SharedBus", int], None]


class SharedBus:
    """The controller's end of a bus with a third node, which acts after each of its packets."""

    def __init__(self, meddle: Meddle) -> None:
        self._clock = Cycles()
        channel = f"untrusted-{next(_channels)}"
        rates = BusRates()
        clock = self._clock
        self.pc = CanTransport(UnstampedBus(channel), rates, clock=clock)
        self._controller = CanControllerLink(
            UnstampedBus(channel), rates, clock=clock, start_patience=0.0
        )
        self.third = UnstampedBus(channel)
        self.frames: list[Frames] = []
        self._meddle = meddle

    def send(self, packet: bytes) -> None:
        if len(self.frames) == LAST_CYCLE:
            raise TransportClosed("the bus is removed")
        self._received()
        self._clock.time += PERIOD
        self._controller.send(packet)
        self.frames.append(self._received())
        self._meddle(self, len(self.frames))

    def receive(self, timeout: float) -> bytes | None:
        return self._controller.receive(0.0)  # sent frames have arrived

    def close(self) -> None:
        self._controller.close()
        self.third.shutdown()

    def send_frames(self, frames: Frames) -> None:
        for frame in frames:
            self.third.send(frame)

    def _received(self) -> Frames:
        frames = []
        while (frame := self.third.recv(0.0)) is not None:
            frames.append(frame)
        return frames


def nothing(bus: SharedBus, cycle: int) -> None:
    """Send nothing."""


@cache
def frames_of() -> list[Frames]:
    """Return the frames of the controller in an undisturbed session, by cycle."""
    _, bus = run_with(nothing)
    return bus.frames


def run_with(meddle: Meddle) -> tuple[Run, SharedBus]:
    bus = SharedBus(meddle)
    return Run(ends=(bus.pc, bus)), bus


def test_frames_of_another_node_are_ignored() -> None:
    rng = np.random.default_rng(1)
    session_ids = {frame.arbitration_id for frames in frames_of() for frame in frames}
    others = [
        number for number in range(0x800) if number not in session_ids | REPLY_IDS | PACKED_IDS
    ]

    def chat(bus: SharedBus, _: int) -> None:
        for number in rng.choice(others, 3):
            bus.send_frames(
                [can.Message(arbitration_id=number, data=rng.bytes(8), is_extended_id=False)]
            )

    run, bus = run_with(chat)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed"
    foreign = [
        rejection.count for rejection in run.seen(PacketRejected) if rejection.kind == "foreign"
    ]
    assert sum(foreign) == 3 * (len(bus.frames) - 1), "frames behind the last packet are not read"


def test_repeated_frames_get_no_reply() -> None:
    repeated = []

    def again(bus: SharedBus, cycle: int) -> None:
        if cycle > 200 and cycle % 40 == 0:
            bus.send_frames(bus.frames[-25])  # not a packet again: the transfer has just ended
        if cycle > 200 and cycle % 40 == 20:
            repeated.append(cycle)
            bus.send_frames(bus.frames[-75])

    run, _ = run_with(again)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert {(rejection.kind, rejection.count) for rejection in run.seen(PacketRejected)} == {
        ("stale", 1)
    }
    assert run.session.counters.stale == len(repeated)


@pytest.mark.parametrize(
    ("at", "first", "outcome"),
    [
        (5, 0, "completed"),  # a start beside the controller's own, with the same reply
        (5, 100, "lost"),  # packets of a session in which axes are open
        (250, 0, "lost"),  # a start while the arm moves
        (250, 4, "lost"),
        (250, 100, "completed"),  # numbers that were answered before
        (150, 200, "refused"),  # later numbers, with the arm elsewhere
    ],
)
def test_replayed_session_moves_nothing(at: int, first: int, outcome: str) -> None:
    recorded = frames_of()

    def replay(bus: SharedBus, cycle: int) -> None:
        if at <= cycle < at + len(recorded) - first:
            bus.send_frames(recorded[cycle - at + first])

    run, _ = run_with(replay)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == outcome, ended.reason
    sent = run.records["commanded_position"]
    gone = sent[np.isfinite(sent).all(axis=1)] - HOME
    share = (gone @ MOVE) / (MOVE @ MOVE)
    np.testing.assert_allclose(gone, np.outer(share, MOVE), atol=1e-6, err_msg="off the path")
    assert not run.controller.plant.velocity.any()
    assert run.controller.phase in (Phase.CLOSED, Phase.DRIVE_OFF, Phase.ENDED)
