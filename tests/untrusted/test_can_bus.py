"""Others on the CAN bus: a node with identifiers of its own, and one with the controller's.

No frame tells who sent it, so what the second says is taken for the controller's. It can end the
run; it cannot have a set-point sent that is not of the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import count

import can
import numpy as np
import pytest

from drivers import MotionEnded, PacketRejected, TransportClosed
from drivers.transports.can.layout import BusRates
from drivers.transports.can.transport import CanTransport
from sim_fixtures import Phase
from sim_fixtures.can_link import CanControllerLink
from tests.drivers.can_bench import HOME, MOVE, PERIOD, PROFILES, Cycles, Run, UnstampedBus

ANSWERS = {0x100, 0x120, 0x121, 0x122, 0x180}  # Identifiers of what the PC says (`docs/can.md`)
_channels = count()

LAST_CYCLE = 600  # A session takes 484

Frames = list[can.Message]
Meddle = Callable[["Overheard", int], None]


class Overheard:
    """The controller's end of a bus with a third node, which acts after each of its packets."""

    def __init__(self, profile: str, meddle: Meddle) -> None:
        self._clock, channel = Cycles(), f"strangers-{next(_channels)}"
        rates, clock = BusRates(profile), self._clock
        self.near = CanTransport(UnstampedBus(channel), rates, clock=clock)
        self._far = CanControllerLink(UnstampedBus(channel), rates, clock=clock, start_patience=0.0)
        self.third = UnstampedBus(channel)
        self.said: list[Frames] = []
        self._meddle = meddle

    def send(self, packet: bytes) -> None:
        if len(self.said) == LAST_CYCLE:
            raise TransportClosed("the bus is taken away")
        self._heard()
        self._clock.time += PERIOD
        self._far.send(packet)
        self.said.append(self._heard())
        self._meddle(self, len(self.said))

    def receive(self, timeout: float) -> bytes | None:
        return self._far.receive(0.0)  # whatever was sent is there

    def close(self) -> None:
        self._far.close()
        self.third.shutdown()

    def say(self, frames: Frames) -> None:
        for frame in frames:
            self.third.send(frame)

    def _heard(self) -> Frames:
        frames = []
        while (frame := self.third.recv(0.0)) is not None:
            frames.append(frame)
        return frames


def nothing(bus: Overheard, cycle: int) -> None:
    """Only listen."""


@cache
def heard(profile: str) -> list[Frames]:
    """Frames of the controller in a session with nobody else, by cycle."""
    _, bus = played(profile, nothing)
    return bus.said


def played(profile: str, meddle: Meddle) -> tuple[Run, Overheard]:
    far = Overheard(profile, meddle)
    return Run(profile, ends=(far.near, far)), far


@pytest.mark.parametrize("profile", PROFILES)
def test_frames_of_another_node_are_counted_and_the_arm_goes_on(profile: str) -> None:
    rng = np.random.default_rng(1)
    own = {frame.arbitration_id for frames in heard(profile) for frame in frames}
    others = [number for number in range(0x800) if number not in own | ANSWERS]

    def chat(bus: Overheard, _: int) -> None:
        for number in rng.choice(others, 3):
            bus.say([can.Message(arbitration_id=number, data=rng.bytes(8), is_extended_id=False)])

    run, bus = played(profile, chat)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed"
    counted = [one.count for one in run.seen(PacketRejected) if one.kind == "foreign"]
    assert sum(counted) == 3 * (len(bus.said) - 1), "what follows the last packet is not heard"


@pytest.mark.parametrize(
    ("at", "first", "outcome"),
    [
        (5, 0, "completed"),  # a start beside the controller's own: the same, and answered as that
        (5, 100, "lost"),  # packets of a session in which axes are open
        (250, 0, "lost"),  # a start while the arm moves
        (250, 4, "lost"),
        (250, 100, "completed"),  # numbers that were answered long ago
        (150, 200, "refused"),  # numbers to come, in which the arm is elsewhere
    ],
)
def test_a_recorded_session_under_the_controllers_identifiers_moves_nothing(
    at: int, first: int, outcome: str
) -> None:
    recorded = heard("fd")

    def replay(bus: Overheard, cycle: int) -> None:
        if at <= cycle < at + len(recorded) - first:
            bus.say(recorded[cycle - at + first])

    run, _ = played("fd", replay)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == outcome, ended.reason
    sent = run.records["commanded_position"]
    gone = sent[np.isfinite(sent).all(axis=1)] - HOME
    share = (gone @ MOVE) / (MOVE @ MOVE)
    np.testing.assert_allclose(gone, np.outer(share, MOVE), atol=1e-6, err_msg="off the path")
    assert not run.controller.plant.velocity.any()
    assert run.controller.phase in (Phase.CLOSED, Phase.DRIVE_OFF, Phase.ENDED)


@pytest.mark.parametrize("profile", PROFILES)
def test_frames_of_this_session_said_again_later_get_no_answer(profile: str) -> None:
    said_again = []

    def again(bus: Overheard, cycle: int) -> None:
        if cycle > 200 and cycle % 40 == 0:
            said_again.append(cycle)
            bus.say(bus.said[-25])

    run, _ = played(profile, again)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert None not in run.link.replies
    rejected = {(one.kind, one.count) for one in run.seen(PacketRejected)}
    assert rejected == {("stale", 1)}
    assert run.session.counters.stale == len(said_again)
