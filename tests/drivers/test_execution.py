"""Duration of stops and holds, allowed bounds, and results of motions."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import SourceFailed
from drivers.execution import Execution, execution_of
from tests.messages import DID_NOT_COME_TO_REST, MOTION_BEING_STOPPED

pytestmark = pytest.mark.safety

N = 2
SETTLE = 3
STOP = 5
HERE = np.array([0.5, -0.25])


class Motion:
    """Steps of `step` rad in joint 1, at a velocity of its own; records the calls of the rest."""

    def __init__(self, step=0.01, speed=5.0):
        self.finished = False
        self.calls = []
        for name in ("stop", "hold", "resume"):
            setattr(self, name, lambda name=name: self.calls.append(name))
        self.step = step
        self.speed = speed
        self.bounds = "plan"

    def begin(self, position):
        self.position = position

    def advance(self):
        self.position = self.position + np.array([self.step, 0.0])
        return self.position, np.array([self.speed, 0.0])

    def override(self, fraction):
        self.calls.append(fraction)


def requested(source) -> Execution:
    execution = execution_of(source, N, SETTLE, STOP)
    assert isinstance(execution, Execution)
    return execution


def begun(source) -> Execution:
    execution = requested(source)
    execution.begin(HERE, 0)
    return execution


def run(execution: Execution, cycles: int, first: int = 1) -> None:
    for cycle in range(first, first + cycles):
        execution.advance(cycle)


def fails(execution: Execution, message: str, cycle: int = 7) -> None:
    with pytest.raises(SourceFailed, match=message) as caught:
        execution.advance(cycle)
    assert caught.value.cycle == cycle


class TestEnd:
    def test_end_is_held_for_the_settling_time(self):
        source = Motion()
        execution = begun(source)
        execution.advance(1)
        source.finished = True
        last = execution.advance(2)
        for cycle in range(SETTLE):
            assert not execution.settled
            position, velocity, bounds = execution.advance(3 + cycle)
            np.testing.assert_array_equal(position, last[0])
            np.testing.assert_array_equal(velocity, np.zeros(N))
            assert bounds == "plan"
        assert execution.settled
        assert not execution.leaving
        execution.stop("late", 2)
        assert (execution.outcome, source.calls) == ("completed", [])
        assert execution.hold(0) is None
        assert not execution.held

    @pytest.mark.parametrize(("cycles", "late"), [(STOP, STOP + 1), (1, STOP + 7)])
    def test_longest_duration_of_a_stop(self, cycles, late):
        """Missed packets included; the first reason stays, and the source is called once."""
        execution = begun(source := Motion())
        execution.stop("first", 1)
        execution.stop("second", 2)
        run(execution, cycles)
        fails(execution, f"not come to rest in the {STOP} cycles after a stop was requested", late)
        assert (execution.outcome, execution.reason) == ("stopped", "first")
        assert source.calls == ["stop"]
        assert execution.hold(0) is None
        assert not execution.held
        assert execution.resume() == MOTION_BEING_STOPPED

    def test_values_of_another_shape_are_named(self):
        names = ("position", "velocity")
        for place, name in enumerate(names):
            rows = [np.zeros(1 if k == place else N) for k in range(2)]
            source = Motion()
            source.advance = lambda rows=rows: rows
            fails(begun(source), rf"source failed: ValueError: a {name} of shape \(1,\), not \(2,")

    @pytest.mark.parametrize("values", [["east", "west"], [0.5j, 0.0]])
    def test_values_that_are_no_numbers_are_refused(self, values):
        source = Motion()
        source.advance = lambda: (values, np.zeros(N))
        fails(begun(source), "source failed: ")

    def test_end_of_a_stop_is_held_without_limit(self):
        execution = begun(source := Motion())
        execution.hold(0)
        execution.stop("enough", 1)
        assert not execution.held
        source.finished = True
        run(execution, 3 * STOP)
        assert execution.outcome == "stopped"

    def test_motion_that_does_not_come_to_rest_in_a_hold_is_stopped(self):
        execution = begun(Motion())
        execution.hold(0)
        for cycle in range(STOP):
            execution.advance(1 + cycle)
            assert execution.outcome == "completed"
            execution.hold(1 + cycle)  # a second request does not extend the time
        execution.advance(9)
        assert execution.outcome == "stopped"
        assert execution.reason == f"{DID_NOT_COME_TO_REST} {STOP} cycles of a hold"


class Careless(Motion):
    """Returns one array again and again, and changes those it is given."""

    def begin(self, position):
        super().begin(position.copy())
        position += 1.0

    def advance(self):
        position, velocity = super().advance()
        self.returned = getattr(self, "returned", np.zeros(N))
        self.returned[:] = position
        return self.returned, velocity

    def resume_from(self, position, velocity, cycles):
        position += 1.0
        velocity += 1.0


def test_arrays_of_the_session_are_not_those_of_the_source():
    execution = requested(Careless())
    here = HERE.copy()
    speed = np.zeros(N)
    execution.begin(here, 0)
    first, _, _ = execution.advance(1)
    before = first.copy()
    execution.advance(2)
    execution.resume_from(here, speed, 1, 3)
    with pytest.raises(SourceFailed, match="the motion source cannot continue: AttributeError"):
        execution.resume_from(here, None, 1, 3)
    np.testing.assert_array_equal([first, here, speed], [before, HERE, np.zeros(N)])


class TestHold:
    @pytest.mark.parametrize("what", ["step", "speed"])
    def test_rest_has_neither_step_nor_velocity_and_no_limit(self, what):
        """Over one cycle, except for rounding."""
        source = Motion(step=0.0, speed=0.0)
        execution = begun(source)
        execution.hold(0)
        setattr(source, what, 1.1e-9)
        run(execution, STOP)
        source.step = source.speed = 0.9e-9
        execution.advance(8)
        setattr(source, what, 1.1e-9)
        run(execution, 2 * STOP, 9)
        assert (execution.outcome, execution.held) == ("completed", True)
        execution = begun(source := Motion(step=0.0, speed=0.0))
        execution.hold(0)
        setattr(source, what, 1.1e-9)
        run(execution, STOP + 1)
        assert execution.outcome == "stopped", "it did not rest"

    def test_hold_before_the_begin(self):
        execution = requested(source := Motion())
        assert execution.hold(0) is None
        assert (execution.held, source.calls, execution._allowed[-1]) == (True, [], "plan")
        assert execution.resume() is None
        assert (execution.held, source.calls) == (False, [])
        execution.hold(0)
        execution.begin(HERE, 0)
        assert (source.calls, execution._allowed[-1]) == (["hold"], "stop")
        run(execution, STOP + 1)
        assert execution.outcome == "stopped"

    def test_resume_ends_the_time_limit(self):
        execution = begun(Motion())
        execution.hold(0)
        execution.advance(1)
        assert execution.resume() is None
        assert not execution.held
        run(execution, 3 * STOP, 2)
        assert execution.outcome == "completed"


class TestBounds:
    def test_bounds_are_allowed_from_the_first_call(self):
        source = Motion()
        execution = begun(source)
        for needs, call in (
            ("override", lambda: execution.override(0.5)),
            ("stop", lambda: execution.hold(1)),
        ):
            source.bounds = needs
            fails(execution, f"bounds '{needs}', not")
            assert call() is None
            assert execution._allowed[-1] == needs
            assert execution.advance(2)[2] == needs
        source.bounds = "override"
        assert (execution.advance(3)[2], execution._allowed[-1]) == ("override", "stop")
        execution = begun(source)
        execution.stop("enough", 1)
        fails(execution, "not plan or stop")

    @pytest.mark.parametrize("fraction", [-0.01, 1.01, float("nan")])
    def test_override_is_between_0_and_1(self, fraction):
        execution = begun(Motion())
        assert "is not one of 0..1" in execution.override(fraction)
        assert execution._allowed[-1] == "plan"
        for share in (0.0, 1.0, 1):
            assert execution.override(share) is None
            assert execution.fraction == share
