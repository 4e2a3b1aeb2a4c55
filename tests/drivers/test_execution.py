"""Duration of stops and holds, allowed bounds, and results of motions and corrections."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import Mode, SourceFailed
from drivers.execution import Execution, execution_of

N = 2
SETTLE, STOP = 3, 5
HERE = np.array([0.5, -0.25])


class Motion:
    """Steps of `step` rad in joint 1; records the calls of its other methods."""

    def __init__(self, step=0.01):
        self.step = step
        self.position = HERE
        self.finished = False
        self.bounds = "plan"
        self.calls = []

    def begin(self, position):
        self.position = position

    def advance(self):
        self.position = self.position + np.array([self.step, 0.0])
        return self.position, np.array([self.step / 0.002, 0.0])

    def stop(self):
        self.calls.append("stop")

    def hold(self):
        self.calls.append("hold")

    def resume(self):
        self.calls.append("resume")

    def override(self, fraction):
        self.calls.append(fraction)

    def feed_forward(self):
        return np.full(N, 0.25), np.full(N, 0.5)


class Correction:
    def __init__(self):
        self.finished = False
        self.rows = (np.array([0.1, 0.0]), np.array([0.0, 2.0]))

    def begin(self):
        pass

    def advance(self):
        return self.rows

    def stop(self):
        pass

    def hold(self):
        pass

    def resume(self):
        pass


def begun(source) -> Execution:
    mode = Mode.POSITION if isinstance(source, Motion) else Mode.VELOCITY
    execution = execution_of(source, mode, N, SETTLE, STOP)
    assert isinstance(execution, Execution)
    execution.begin(HERE, 0)
    return execution


def fails(execution: Execution, words: str, cycle: int = 7) -> None:
    with pytest.raises(SourceFailed, match=words) as caught:
        execution.advance(cycle)
    assert caught.value.cycle == cycle


class TestEnd:
    def test_end_is_held_for_the_settling_time(self):
        source = Motion()
        execution = begun(source)
        execution.advance(1)
        source.finished = True
        position, _, _ = execution.advance(2)
        for cycle in range(SETTLE):
            assert not execution.settled
            held, velocity, bounds = execution.advance(3 + cycle)
            np.testing.assert_array_equal(held, position)
            np.testing.assert_array_equal(velocity, np.zeros(N))
            assert bounds == "plan"
        assert execution.settled
        assert not execution.leaving
        source = Correction()
        execution = begun(source)
        source.finished = True
        np.testing.assert_array_equal(execution.advance(1)[:2], source.rows)
        for cycle in range(SETTLE):
            assert not execution.settled
            np.testing.assert_array_equal(execution.advance(2 + cycle)[:2], np.zeros((2, N)))
        assert execution.settled

    def test_feed_forward_is_zero_after_the_end(self):
        source = Motion()
        execution = begun(source)
        execution.advance(1)
        np.testing.assert_array_equal(execution.feed_forward(1), [[0.25] * N, [0.5] * N])
        source.finished = True
        execution.advance(2)
        np.testing.assert_array_equal(execution.feed_forward(2), [[0.25] * N, [0.5] * N])
        execution.advance(3)
        np.testing.assert_array_equal(execution.feed_forward(3), np.zeros((2, N)))


@pytest.mark.parametrize("kind", [Motion, Correction])
class TestStop:
    def test_longest_duration(self, kind):
        execution = begun(kind())
        execution.advance(1)
        execution.stop("enough", 2)
        for cycle in range(STOP):
            execution.advance(2 + cycle)
        fails(execution, f"did not come to rest in the {STOP} cycles")
        execution = begun(kind())
        execution.stop("enough", 1)
        execution.advance(1)
        fails(execution, "did not come to rest", cycle=1 + STOP)  # after missed packets

    def test_end_of_a_stop_is_held_without_limit(self, kind):
        source = kind()
        execution = begun(source)
        execution.stop("enough", 1)
        source.finished = True
        for cycle in range(3 * STOP):
            execution.advance(1 + cycle)
        assert execution.outcome == "stopped"

    def test_first_reason_stays_and_the_source_is_called_once(self, kind):
        source = kind()
        calls = []
        source.stop = lambda: calls.append("stop")
        execution = begun(source)
        execution.stop("first", 1)
        execution.stop("second", 2)
        assert (execution.outcome, execution.reason, calls) == ("stopped", "first", ["stop"])

    def test_finished_motion_is_not_stopped(self, kind):
        source = kind()
        execution = begun(source)
        source.finished = True
        execution.advance(1)
        execution.stop("late", 2)
        assert execution.outcome == "completed"
        assert execution.hold(0) is None
        assert not execution.held

    def test_stopping_motion_is_not_held_or_resumed(self, kind):
        execution = begun(kind())
        assert execution.hold(0) is None
        assert execution.held
        execution.stop("enough", 1)
        assert not execution.held
        assert execution.hold(0) is None
        assert not execution.held
        assert execution.resume() == "the motion is being stopped"


class TestHold:
    @pytest.mark.parametrize("kind", [Motion, Correction])
    def test_motion_that_does_not_come_to_rest_is_stopped(self, kind):
        execution = begun(kind())
        execution.hold(0)
        for cycle in range(STOP):
            execution.advance(1 + cycle)
            assert execution.outcome == "completed"
            execution.hold(1 + cycle)  # a second request does not extend the time
        execution.advance(9)
        assert execution.outcome == "stopped"
        assert execution.reason == f"it did not come to rest in {STOP} cycles of a hold"

    def test_rest_has_no_limit(self):
        source = Motion()
        execution = begun(source)
        execution.hold(0)
        execution.advance(1)
        source.step = 0.0
        for cycle in range(5 * STOP):
            execution.advance(2 + cycle)
        assert execution.outcome == "completed"
        assert execution.held

    @pytest.mark.parametrize("what", ["step", "speed"])
    def test_rest_has_neither_step_nor_velocity(self, what):
        """Over one cycle, except for rounding."""
        source = Motion(step=0.0)
        execution = begun(source)
        execution.hold(0)
        tiny = {"step": 0.9e-9, "speed": 0.9e-9}
        large = {"step": 0.0, "speed": 0.0, what: 1.1e-9}

        def give(sizes):
            def advance():
                source.position = source.position + np.array([sizes["step"], 0.0])
                return source.position, np.array([-sizes["speed"], 0.0])

            source.advance = advance

        give(large)
        for cycle in range(STOP):
            execution.advance(1 + cycle)
        give(tiny)
        execution.advance(8)
        give(large)
        for cycle in range(2 * STOP):
            execution.advance(9 + cycle)
        assert execution.outcome == "completed"

    def test_rest_before_the_hold_does_not_count(self):
        source = Motion(step=0.0)
        execution = begun(source)
        execution.advance(1)
        source.step = 0.01
        execution.hold(1)
        for cycle in range(STOP + 1):
            execution.advance(2 + cycle)
        assert execution.outcome == "stopped"

    def test_hold_before_the_begin(self):
        source = Motion()
        execution = Execution(source, Mode.POSITION, N, SETTLE, STOP)
        assert execution.hold(0) is None
        assert (execution.held, source.calls, execution.widest) == (True, [], "plan")
        assert execution.resume() is None
        assert (execution.held, source.calls) == (False, [])
        execution.hold(0)
        execution.begin(HERE, 0)
        assert (source.calls, execution.widest) == (["hold"], "stop")
        for cycle in range(STOP + 1):
            execution.advance(1 + cycle)
        assert execution.outcome == "stopped"

    def test_resume_ends_the_time_limit(self):
        source = Motion()
        execution = begun(source)
        execution.hold(0)
        execution.advance(1)
        assert execution.resume() is None
        assert not execution.held
        for cycle in range(3 * STOP):
            execution.advance(2 + cycle)
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
            assert execution.widest == needs
            assert execution.advance(2)[2] == needs
        source.bounds = "override"
        assert execution.advance(3)[2] == "override"
        assert execution.widest == "stop"
        execution = begun(source)
        execution.stop("enough", 1)
        fails(execution, "not plan or stop")

    @pytest.mark.parametrize("wrong", ["wide", None, 7, ["plan"]])
    def test_invalid_name_is_refused(self, wrong):
        source = Motion()
        execution = begun(source)
        execution.override(0.5)
        source.bounds = wrong
        fails(execution, "not plan or override")

    def test_bounds_of_a_correction_at_rest(self):
        execution = begun(Correction())
        execution.hold(0)
        assert execution.widest == "stop"
        execution.mark_at_rest()
        assert execution.widest == "plan"
        execution.stop("enough", 3)
        execution.mark_at_rest()
        assert execution.widest == "stop"

    @pytest.mark.parametrize("fraction", [-0.01, 1.01, float("nan")])
    def test_override_is_between_0_and_1(self, fraction):
        execution = begun(Motion())
        assert "is not one of 0..1" in execution.override(fraction)
        assert execution.widest == "plan"
        for share in (0.0, 1.0, 1):
            assert execution.override(share) is None
            assert execution.fraction == share
