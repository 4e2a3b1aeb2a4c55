"""A motion that is held on its path and goes on, and what a source may do wrong with it."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    AccelerationLimit,
    HoldChanged,
    OverrideChanged,
    RequestError,
    State,
)
from planner import JointLimits, TrajectoryPlayer, plan
from tests.drivers.rig import (
    PERIOD,
    START,
    Cruise,
    GoesOn,
    N,
    Rig,
    Unspeakable,
    all_drive_off,
    assert_refused,
    closed,
    limits,
    moving,
    opened,
    running,
    smooth_move,
)

WAY = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


def player(start=START) -> TrajectoryPlayer:
    bounds = limits()
    of_joints = JointLimits(
        bounds.lower, bounds.upper, bounds.velocity, bounds.acceleration, bounds.jerk
    )
    path = plan(np.vstack((start, start + WAY)), of_joints, fly=0.0)
    return TrajectoryPlayer(path, PERIOD, of_joints)


def playing(cycles: int = 60) -> Rig:
    rig = running(player())
    rig.cycle(cycles)
    assert rig.state is State.OPEN
    return rig


def nothing(self):
    pass


def held_before_it_began() -> Rig:
    rig = closed()
    rig.session.request(player())
    rig.session.hold()
    rig.cycle()
    rig.open()
    rig.cycle(10)
    return rig


def at_rest(rig: Rig) -> bool:
    return not rig.records[-1]["commanded_velocity"].any()


class TestHold:
    def test_the_arm_rests_for_as_long_as_it_takes_and_goes_on_to_the_end(self):
        rig = playing()
        assert not at_rest(rig)
        rig.session.hold()
        rig.cycle(300)
        assert at_rest(rig)
        # Longer than a stop may take, which is 10 s.
        rig.cycle(6000)
        assert (rig.state, rig.exits_asked) == (State.OPEN, 0)
        assert at_rest(rig)
        rig.session.resume()
        rig.cycle(20)
        assert not at_rest(rig)
        rig.run_to("completed")
        end = rig.train.joint_position(rig.axes["d"][:, 0])
        np.testing.assert_allclose(end, START + WAY, atol=1e-6)

    @pytest.mark.parametrize("cycles", [3, 300])
    def test_a_stop_ends_a_hold(self, cycles):
        rig = playing()
        rig.session.hold()
        rig.cycle(cycles)
        rig.session.stop()
        rig.run_to("stopped")

    def test_one_that_cannot_hold_is_stopped_on_its_path(self):
        rig, source = moving()
        rig.session.hold()
        rig.run()
        assert source.stops == 1
        assert rig.ended.outcome == "stopped"
        assert "cannot" in rig.ended.reason

    def test_one_that_fails_to_hold_is_stopped(self):
        def fails(self):
            raise SystemExit("no")

        source = type("Odd", (Cruise,), {"hold": fails, "resume": fails})()
        rig = running(source, 300)
        with pytest.raises(RequestError, match="SystemExit: no"):
            rig.session.resume()
        rig.session.hold()
        rig.run()
        assert (rig.ended.outcome, source.stops) == ("stopped", 1)
        assert "failed to hold: SystemExit: no" in rig.ended.reason

    def test_a_stop_ends_one_that_was_held_before_it_began(self):
        rig = held_before_it_began()
        rig.session.stop()
        rig.run_to("stopped")
        assert not np.nan_to_num(rig.records["commanded_velocity"]).any()

    def test_one_that_cannot_hold_and_has_not_begun_is_dropped(self):
        rig = closed()
        rig.session.request(Cruise())
        rig.session.hold()
        rig.cycle()
        assert (rig.ended.outcome, rig.ended.interval) == ("stopped", -1)

    def test_one_that_fails_to_hold_as_it_begins_is_refused(self):
        def fails(self):
            raise ValueError("no")

        rig = Rig()
        rig.session.request(type("Odd", (Cruise,), {"hold": fails, "resume": nothing})())
        rig.session.hold()
        rig.open()
        rig.cycle()
        assert rig.ended.outcome == "refused"
        assert "failed to hold: ValueError: no" in rig.ended.reason

    def test_each_change_is_told_once(self):
        rig = playing()
        for _ in range(2):
            rig.session.override(0.5)
            rig.session.hold()
        rig.cycle(20)
        for _ in range(2):
            rig.session.resume()
        cycle = rig.session.cycle
        rig.run()
        assert rig.seen(OverrideChanged) == [OverrideChanged(0.5, cycle - 20)]
        assert rig.seen(HoldChanged) == [HoldChanged(True, cycle - 20), HoldChanged(False, cycle)]

    def test_needs_a_motion_and_keeps_nothing_for_one_to_come(self):
        rig = opened()
        with pytest.raises(RequestError, match="no hold can be requested in state 'open'"):
            rig.session.hold()
        rig.session.request(player())
        rig.cycle(60)
        assert (rig.state, rig.exits_asked) == (State.OPEN, 0)
        assert not at_rest(rig)


class TestResume:
    def test_needs_a_motion(self):
        rig = Rig()
        with pytest.raises(RequestError, match="no motion was requested"):
            rig.session.resume()

    def test_needs_a_motion_that_can_be_held(self):
        rig, _ = moving()
        with pytest.raises(RequestError, match="cannot be held"):
            rig.session.resume()

    def test_needs_a_motion_that_is_not_being_stopped(self):
        rig = playing()
        rig.session.hold()
        rig.cycle(5)
        rig.session.stop()
        rig.cycle(1)
        with pytest.raises(RequestError, match="is being stopped"):
            rig.session.resume()


class TestSourcesThatRaiseAnything:
    def test_so_does_a_property_where_a_method_should_be(self):
        def fails(self):
            raise SystemExit("no")

        for name in ("override", "hold", "resume"):
            parts = {"hold": nothing, "resume": nothing, name: property(fails)}
            rig = running(source := type("Odd", (Cruise,), parts)(), 50)
            if name == "hold":
                rig.session.hold()
                rig.cycle()
                assert source.stops == 1
                continue
            call = {"override": lambda rig=rig: rig.session.override(0.5)}
            with pytest.raises(RequestError, match="SystemExit: no"):
                call.get(name, rig.session.resume)()
            assert rig.state is State.OPEN
        with pytest.raises(RequestError, match="SystemExit: no"):
            Rig().session.request(type("Odd", (Cruise,), {"feed_forward": property(fails)})())

    def test_an_override_that_raises_anything_is_a_request_refused(self):
        def fails(self, fraction):
            raise Unspeakable

        rig = running(type("Odd", (Cruise,), {"override": fails})(), 5)
        with pytest.raises(RequestError, match="Unspeakable, whose message"):
            rig.session.override(0.5)
        rig.cycle(5)
        assert rig.state is State.OPEN


def test_a_defect_of_our_own_asks_for_drive_off_too(monkeypatch):
    rig, _ = moving()

    def fails(*_, **__):
        raise MemoryError("no room")

    monkeypatch.setattr(rig.guard, "check_set_point", fails)
    assert all_drive_off(rig.cycle())
    assert "the session failed: MemoryError: no room" in str(rig.refusal)
    assert rig.ended.outcome == "refused"
    assert all_drive_off(rig.cycle())


class TestRequestAfterAStop:
    def test_none_is_taken_before_open_mode_was_left(self):
        rig = opened()
        rig.session.stop()
        with pytest.raises(RequestError, match="being left"):
            rig.session.request(smooth_move(WAY, 300))
        rig.cycle()
        assert (rig.state, rig.exits_asked) == (State.EXITING, 1)
        rig.close()
        rig.exits_asked = 0
        rig.session.request(smooth_move(WAY, 300))
        rig.open()
        rig.run_to("completed")

    def test_none_is_taken_while_axes_open(self):
        rig = closed()
        rig.axes["mode"][: N - 1] = 4
        rig.cycle()
        rig.session.stop()
        with pytest.raises(RequestError, match="being left"):
            rig.session.request(smooth_move(WAY, 300))


WIDE = {"jerk": np.full(N, 1e9)}


class Overridable(GoesOn):
    """Has the bounds that it was given from the first override on."""

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
        rig.run_to("completed")
