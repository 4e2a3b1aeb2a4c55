"""A session under arbitrary packets and motions, and sessions with a check taken away."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

import drivers.state_machine
from drivers import Guard, State
from drivers.state_machine import Machine
from drivers.states import TRANSITIONS, Input
from tests.drivers.model_controller import PERIOD, N
from tests.drivers.session_machine import SessionMachine
from tests.drivers.sources import Breaks, ScriptedMotion, smooth

QUICK = settings(
    max_examples=60,
    stateful_step_count=25,
    suppress_health_check=list(HealthCheck),
    deadline=None,
)


class TestSession(SessionMachine.TestCase):
    settings = QUICK


@pytest.mark.slow
def test_the_same_for_longer():
    run_state_machine_as_test(
        SessionMachine, settings=settings(QUICK, max_examples=3000, stateful_step_count=60)
    )


class Drawn:
    """Values chosen beforehand, where the machine would draw its own."""

    def __init__(self, *values: object) -> None:
        self._values = iter(values)

    def draw(self, _strategy: object) -> object:
        return next(self._values)


def begun(*, obedient: bool = False) -> SessionMachine:
    """A session of an arm that does what it is told, or nothing, with the judge beside it."""
    machine = SessionMachine()
    machine.begin(mode=4, obedient=obedient, cold=False, settle=0)
    return machine


def in_motion(cycles: int, breaks: Breaks) -> SessionMachine:
    """So many cycles into a motion of 200."""
    machine = begun(obedient=True)
    rows = smooth(200, np.full(N, 0.004))
    velocity = np.diff(rows, axis=0, prepend=rows[:1]) / PERIOD
    machine.request(Drawn(1, ScriptedMotion(rows, velocity, breaks)))
    machine.open_properly(source_seed=0, cycles=cycles, stagger=False)
    return machine


def test_an_axis_that_closes_in_mid_motion_is_one_of_the_checks(monkeypatch):
    """Nothing is found with the check; without it, the axes that are left are held by a jump."""
    in_motion(40, Breaks()).one_axis_closes(joint=1)
    monkeypatch.setattr(Machine, "require_axes", skip)
    machine = in_motion(40, Breaks())
    with pytest.raises(AssertionError, match=r"velocity|acceleration|jerk"):
        machine.one_axis_closes(joint=1)


@pytest.mark.parametrize(("last", "refused"), [(50, True), (100, True), (200, False)])
def test_a_source_that_says_it_is_finished_while_it_moves_is_refused(last, refused):
    """Though nothing of its end was to be held before open mode is left."""
    machine = in_motion(last, Breaks("finishes early", index=last))
    machine.obedient = False  # it takes its time to leave open mode
    machine.run(30)
    assert machine.conduct.tally["exit asked"]
    assert ("refused" in machine.conduct.tally) == refused


def test_a_target_that_is_lost_after_a_following_error_is_not_held_at_zero():
    machine = begun()
    machine.open_properly(source_seed=0, cycles=1, stagger=False)
    machine.the_arm_does_not_follow(joint=0, column=2, value=2.1)
    machine.disturb(slot=0, column=0, value=nan, cycles=1)
    assert machine.conduct.tally["no target"] == 1


def test_axes_of_a_drive_that_is_off_are_echoed_in_a_refusal_too():
    machine = begun()
    machine.all_modes(mode=505)
    machine.open_properly(source_seed=0, cycles=1, stagger=False)
    machine.the_arm_does_not_follow(joint=0, column=2, value=2.1)
    assert machine.conduct.tally["refused"] == 1


def skip(*_args, **_kwargs) -> None:
    """A check that was taken away."""


OPEN_AT_ONCE = {**TRANSITIONS, State.FAULTED: {**TRANSITIONS[State.CLOSED], Input.SYNC: State.SYNC}}
RATES = "velocity|acceleration|jerk|position|finite"


@pytest.mark.parametrize(
    ("owner", "check", "broken", "finding"),
    [
        pytest.param(Guard, "check_set_point", skip, RATES, id="set-points"),
        pytest.param(Guard, "check_start", skip, "first set-point", id="first set-point"),
        pytest.param(
            Guard, "check_feedback", skip, "following error|current|not there|finite", id="feedback"
        ),
        pytest.param(
            drivers.state_machine,
            "TRANSITIONS",
            OPEN_AT_ONCE,
            "closed axes",
            id="closed after a fault",
        ),
    ],
)
def test_a_session_with_a_check_taken_away_is_found_out(monkeypatch, owner, check, broken, finding):
    monkeypatch.setattr(owner, check, broken)
    with pytest.raises(AssertionError, match=finding):
        run_state_machine_as_test(
            SessionMachine,
            settings=settings(
                QUICK,
                max_examples=2000,  # it stops at the first finding
                stateful_step_count=40,
                phases=[Phase.generate],
                report_multiple_bugs=False,
                database=None,
            ),
        )
