"""A session under arbitrary packets and motions, and sessions with a check taken away."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test
from session_machine import SessionMachine

import drivers.machine
from drivers import Guard, State
from drivers.machine import Machine
from drivers.states import TRANSITIONS, Input

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
        pytest.param(Machine, "require_axes", skip, RATES, id="modes of the axes"),
        pytest.param(
            drivers.machine, "TRANSITIONS", OPEN_AT_ONCE, "closed axes", id="closed after a fault"
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
