"""Random conversations with a session, checked at each step; sessions without one check."""

from __future__ import annotations

import random
from math import nan

import numpy as np
import pytest

import drivers.states
from drivers import Guard, State
from drivers.c4g_wire import PacketStatus
from drivers.states import TRANSITIONS, Input
from tests.drivers.sources import Breaks, ScriptedMotion, smooth
from tests.fuzz.draw import Draw
from tests.fuzz.targets import session
from tests.fuzz.targets.session import Conversation

pytestmark = pytest.mark.safety


def random_conversation(seed: int) -> bytes:
    """Return bytes of a conversation in which a motion is requested first."""
    chance = random.Random(seed)
    return chance.randbytes(5) + bytes(6) + bytes((1,)) + chance.randbytes(chance.choice((60, 300)))


@pytest.mark.parametrize("part", range(4))
def test_random_conversations(part):
    opened = sum(
        session.run(random_conversation(seed)) for seed in range(100 * part, 100 * part + 60)
    )
    assert opened > 20, "and they do get deep into the session"


@pytest.mark.slow
def test_many_random_conversations():
    for seed in range(1000, 11_000):
        session.run(random_conversation(seed))


def begun(head: bytes = b"", *, obedient: bool = True) -> Conversation:
    """Two joints in mode 4, unless the bytes say otherwise; the controller obeys, or does not."""
    talk = Conversation(Draw(head))
    talk.obedient = obedient
    talk.begin()
    return talk


def in_motion(cycles: int, breaks: Breaks) -> Conversation:
    """So many cycles into a motion of 200."""
    talk = begun()
    rows = smooth(200, np.full(talk.arm.n, 0.004))
    velocity = np.diff(rows, axis=0, prepend=rows[:1]) / talk.arm.period
    talk.ask_for(ScriptedMotion(rows, velocity, breaks))
    talk.open_properly()
    talk.run(cycles - 1)
    return talk


def close_an_axis(talk: Conversation) -> None:
    talk.controller.modes[talk.arm.slots[1]] = 0
    talk.run(2)


def disturb(talk: Conversation, column: int, value: float) -> None:
    """One packet with another number of the first joint."""
    slot = talk.arm.slots[0]
    before = talk.controller.d[slot, column]
    talk.controller.d[slot, column] = value
    talk.run(1)
    talk.controller.d[slot, column] = before


def test_check_of_an_axis_that_closes_during_a_motion(monkeypatch):
    """Without it, the axes that are still open are stopped by a jump."""
    close_an_axis(in_motion(40, Breaks()))
    monkeypatch.setattr(PacketStatus, "misplaced", skip)
    talk = in_motion(40, Breaks())
    with pytest.raises(AssertionError, match=r"velocity|acceleration|jerk"):
        close_an_axis(talk)


@pytest.mark.parametrize(("last", "refused"), [(50, True), (100, True), (200, False)])
def test_source_that_is_finished_while_it_moves_is_refused(last, refused):
    """Though nothing of its end was to be held before open mode is left."""
    talk = in_motion(last, Breaks("finishes early", index=last))
    talk.obedient = False  # it takes its time to leave open mode
    talk.run(30)
    assert talk.conduct.tally["exit asked"]
    assert ("refused" in talk.conduct.tally) == refused


def test_target_lost_after_a_following_error():
    talk = begun(obedient=False)
    talk.open_properly()
    disturb(talk, 2, talk.controller.d[talk.arm.slots[0], 2] + 2.1)
    disturb(talk, 0, nan)
    assert talk.conduct.tally["no target"] == 1


def test_axes_with_their_drive_off_in_a_refusal():
    talk = begun(bytes((0, 0, 0, 2)), obedient=False)  # two axes of others, one of arm 2
    talk.controller.modes = [505] * len(talk.arm.axes)
    talk.run(1)
    talk.open_properly()
    disturb(talk, 2, talk.controller.d[talk.arm.slots[0], 2] + 2.1)
    assert talk.conduct.tally["refused"] == 1


def skip(*_args, **_kwargs) -> None:
    """Replacement of a check that passes everything."""


OPEN_AT_ONCE = {**TRANSITIONS, State.FAULTED: {**TRANSITIONS[State.CLOSED], Input.SYNC: State.SYNC}}


def test_missing_check_of_the_start_is_detected(monkeypatch):
    monkeypatch.setattr(Guard, "check_start", skip)
    talk = begun(obedient=False)
    talk.controller.d[talk.arm.slots[0], 2] += 0.21  # a tenth of the threshold is 0.2
    talk.controller.wanted(talk.mode)
    with pytest.raises(AssertionError, match="first set-point"):
        talk.run(1)


@pytest.mark.parametrize(
    ("owner", "check", "broken", "finding"),
    [
        (Guard, "check_set_point", skip, "velocity|acceleration|jerk|position|finite"),
        (Guard, "check_feedback", skip, "following error|current|not there|finite"),
        (drivers.states, "TRANSITIONS", OPEN_AT_ONCE, "closed axes"),
    ],
)
def test_missing_check_is_detected(monkeypatch, owner, check, broken, finding):
    monkeypatch.setattr(owner, check, broken)
    with pytest.raises(AssertionError, match=finding):
        for seed in range(3000):
            session.run(random_conversation(seed))
