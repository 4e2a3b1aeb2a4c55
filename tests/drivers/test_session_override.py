"""Live changes of speed, for sources that know them."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import AccelerationLimit, JerkLimit, RequestError, SourceFailed, State
from tests.drivers.rig import (
    PERIOD,
    START,
    Correction,
    Cruise,
    GoesOn,
    N,
    Rig,
    assert_refused,
    limits,
)

WIDE = {"jerk": np.full(N, 1e9)}


class Overridable(GoesOn):
    """Takes the bounds it was told to from the first override on."""

    def __init__(self, positions, then="override"):
        super().__init__(positions)
        self.then = then
        self.fractions = []

    def override(self, fraction):
        self.fractions.append(fraction)
        self.bounds = self.then


def accelerating(acceleration: float, cycles: int = 40) -> np.ndarray:
    t = np.arange(cycles)[:, None] * PERIOD
    return START + 0.5 * acceleration * t**2 * np.array([0, 1, 0, 0, 0, 0])


def running(source, **options) -> Rig:
    rig = Rig(**options)
    rig.session.request(source)
    rig.open()
    return rig


def test_the_source_is_told():
    source = Overridable(np.tile(START, (20, 1)))
    rig = running(source)
    for fraction in (0.5, 0.0, 1.0):
        rig.session.override(fraction)
        rig.cycle()
    assert source.fractions == [0.5, 0.0, 1.0]


def test_it_may_be_told_before_the_motion_begins():
    rig = Rig()
    source = Overridable(np.tile(START, (20, 1)))
    rig.session.request(source)
    rig.session.override(0.25)
    rig.open()
    rig.run()
    assert (source.fractions, rig.ended.outcome) == ([0.25], "completed")


def test_the_bounds_of_an_override_are_granted_from_then_on_and_enforced():
    for scale, refused in ((0.999, False), (1.001, True)):
        rig = running(Overridable(accelerating(8.0 * 1.3 * scale)), guard_limits=limits(**WIDE))
        rig.session.override(0.5)
        answer = rig.cycle(2)
        if refused:
            assert_refused(rig, answer, AccelerationLimit)
        else:
            rig.cycle(30)
            assert rig.state is State.OPEN


def test_a_source_that_keeps_the_bounds_of_a_plan_is_held_to_them():
    rig = running(Overridable(accelerating(8.0 * 1.2), "plan"), guard_limits=limits(**WIDE))
    rig.session.override(0.5)
    assert_refused(rig, rig.cycle(2), AccelerationLimit)


def test_those_of_a_stop_are_not_granted_by_it():
    rig = running(Overridable(np.tile(START, (20, 1)), "stop"))
    rig.session.override(0.5)
    assert_refused(rig, rig.cycle(), SourceFailed)


def test_a_stop_after_an_override_has_the_bounds_of_a_stop():
    rig = running(Overridable(accelerating(15.9)), guard_limits=limits(**WIDE))
    rig.session.override(1.0)
    rig.session.stop()
    rig.cycle(30)
    assert rig.state is State.OPEN


def test_corrections_may_be_overridden_too():
    class Faded(Correction):
        def override(self, fraction):
            self.motion = self.motion * fraction

    t = PERIOD * np.arange(1, 400)[:, None] * np.ones(N)
    for told in (False, True):
        rig = running(Faded(1.6 * 100.0 * t**2 / 2), mode=8)
        if told:
            rig.session.override(1.0)
        answer = rig.cycle(5)
        if told:
            assert rig.state is State.OPEN
        else:
            assert (answer.axes["mode"] == 505).all()
            assert type(rig.refusal) is JerkLimit


class TestRefused:
    def test_without_a_motion(self):
        with pytest.raises(RequestError, match="no change of override can be requested"):
            Rig().session.override(0.5)

    def test_for_a_source_that_knows_none(self):
        rig = running(Cruise())
        with pytest.raises(RequestError, match="knows no override"):
            rig.session.override(0.5)
        rig.cycle(10)
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("fraction", [-0.01, 1.01, np.nan, np.inf])
    def test_outside_its_range(self, fraction):
        source = Overridable(np.tile(START, (20, 1)))
        rig = running(source)
        with pytest.raises(RequestError, match=r"0\.\.1"):
            rig.session.override(fraction)
        assert source.fractions == []

    def test_while_the_motion_is_brought_to_rest(self):
        rig = running(Overridable(np.tile(START, (20, 1))))
        rig.session.stop()
        rig.cycle()
        with pytest.raises(RequestError, match="is being stopped"):
            rig.session.override(0.5)

    def test_by_the_source_itself_and_the_motion_goes_on(self):
        class Stubborn(Overridable):
            def override(self, fraction):
                raise ZeroDivisionError("not now")

        rig = running(Stubborn(np.tile(START, (20, 1))))
        with pytest.raises(RequestError, match="ZeroDivisionError: not now"):
            rig.session.override(0.5)
        rig.run()
        assert rig.ended.outcome == "completed"
