"""Open modes other than 4 and 5, field by field; holds and overrides of a motion in any of them."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import HoldChanged, OverrideChanged, RequestError, SourceFailed, State
from drivers.errors import (
    Check,
)
from drivers.packets import MODE_FIELDS
from drivers.states import CORRECTION_MODES, HOLDABLE, INCREMENTAL, POSITION_MODES
from planner import JointLimits, TrajectoryPlayer, plan
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    Correction,
    Cruise,
    N,
    Rig,
    Table,
    Unspeakable,
    Unstopped,
    accelerating,
    all_drive_off,
    assert_refused,
    bump,
    closed,
    init_packet,
    kind_of,
    limits,
    moving,
    opened,
    running,
    smooth_move,
)

HEIGHT = np.array([0.01, -0.005, 0.02, 0.01, -0.01, 0.005])
AMPERES = np.array([1.0, -2.0, 0.5, 3.0, -1.0, 0.25])
MOVED = (2, 7, 8)
CURRENTS = (2, 9)
AT_ONCE = limits(current_rise=1e-3)
UNBOUNDED = {"jerk": np.full(N, 1e12), "acceleration": np.full(N, 1e9)}


def correction(mode: int, cycles: int = 400) -> Correction:
    """A smooth one with all that the mode has fields for."""
    return Correction(
        bump(HEIGHT * (0.1 if mode == 7 else 1.0), cycles) if mode in MOVED else None,
        bump(AMPERES, cycles) if mode in CURRENTS else None,
    )


def begun(mode: int, source, **options) -> Rig:
    return running(source, mode=mode, **options)


def only_fields_of(mode: int, answer) -> bool:
    others = [d - 1 for d in range(1, 6) if d not in MODE_FIELDS[mode]]
    return not answer.axes["d"][:, others].any() and not answer.axes["extra"].any()


def test_fields_of_the_documented_modes():
    assert {int(mode): fields for mode, fields in MODE_FIELDS.items() if mode < 10} == {
        1: (1, 2, 4, 5), 2: (4, 5), 4: (1, 2), 5: (1, 2), 7: (1,), 8: (4,), 9: (5,),
    }  # fmt: skip
    for mode, fields in MODE_FIELDS.items():
        assert mode < 10 or MODE_FIELDS[mode - 10] == fields
    assert {1, 4, 5, 11, 14, 15} == HOLDABLE
    assert {2, 7, 8, 9, 12, 17} == INCREMENTAL
    assert {1, 4, 5} == POSITION_MODES
    assert {2, 7, 8, 9} == CORRECTION_MODES


class TestEveryMode:
    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES | POSITION_MODES))
    def test_arm_is_held_without_a_motion(self, mode):
        rig = Rig(mode=mode)
        for answer in (rig.open(), rig.cycle(20)):
            assert (answer.axes["mode"] == mode).all()
            assert only_fields_of(mode, answer)
            assert answer.status == bytes(4)
        if mode in CORRECTION_MODES:
            assert not answer.axes["d"].any()
        else:
            motor = rig.train.motor_revolutions(START).astype(np.float32)
            np.testing.assert_array_equal(answer.axes["d"][:, 0], motor)

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES | POSITION_MODES))
    def test_a_source_of_another_kind_is_refused(self, mode):
        other = correction(2) if mode in POSITION_MODES else Cruise()
        for source in (other, None, object(), 3, "begin"):
            words = f"a {type(source).__name__} is not the kind of source mode {mode} needs"
            with pytest.raises(RequestError, match=words):
                Rig(mode=mode).session.request(source)

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES | POSITION_MODES))
    @pytest.mark.parametrize(
        ("begun", "column", "off", "kind"),
        [
            (True, 2, 2.01, Check.FOLLOWING_ERROR),
            (False, 2, 0.21, Check.FIRST_SET_POINT),
            (False, 1, 6e-4, Check.STANDSTILL),
            (False, 4, 20.1, Check.CURRENT),
        ],
    )
    def test_arm_begins_and_rests_at_its_target(self, mode, begun, column, off, kind):
        rig = (opened if begun else closed)(mode=mode)
        rig.axes["d"][3, column] += off
        answer = rig.cycle(mode=mode)
        assert (kind_of(rig.refusal), rig.refusal.joint) == (kind, 3)
        reported = [mode] * 3 + [508] + [mode] * 2 if begun else [505] * N
        assert answer.axes["mode"].tolist() == reported

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES | POSITION_MODES))
    def test_axis_that_opens_is_at_its_target(self, mode):
        rig = closed(mode=mode)
        rig.modes[3] = mode
        rig.axes["d"][3, 2] += 2.01
        assert rig.cycle().axes["mode"].tolist() == [0, 0, 0, 508, 0, 0]
        assert (kind_of(rig.refusal), rig.refusal.joint) == (Check.FOLLOWING_ERROR, 3)

    @pytest.mark.parametrize("mode", [3, 6, 11, 12, 14, 15, 17])
    def test_modes_not_served_are_not_moved(self, mode):
        rig = Rig()
        rig.session.request(Cruise())
        rig.close()
        answer = rig.cycle(mode=mode)
        if mode in (3, 6):
            assert not answer.axes["mode"].any()
            assert not answer.axes["d"].any()
        else:
            assert all_drive_off(answer)
        assert rig.state is State.FAULTED
        assert rig.ended.outcome in ("lost", "refused")


class WithFeedForward(Table):
    """A table that also feeds forward rows (m, n) of velocity and current."""

    def __init__(self, positions, velocity=None, current=None):
        super().__init__(positions)
        rows = len(self.positions)
        self.forward = np.zeros((rows, N)) if velocity is None else velocity
        self.current = np.zeros((rows, N)) if current is None else current

    def feed_forward(self):
        return self.forward[self.index], self.current[self.index]


class TestPositionWithFeedForward:
    def test_without_feed_forward_d4_is_the_step_and_d5_is_zero(self):
        rig = begun(1, smooth_move(MOVE, 300))
        for _ in range(250):
            answer = rig.cycle()
            d = answer.axes["d"]
            np.testing.assert_array_equal(d[:, 3], d[:, 1])
            assert not d[:, 4].any()
            assert not d[:, 2].any()
        assert np.abs(d[:, 3]).max() > 0
        rig.run_to("completed")

    def test_feed_forward_is_sent_in_d4_and_d5(self):
        move = smooth_move(MOVE, 300)
        speed = 1.1 * move.velocities
        speed[-1] = 0.0
        current = bump(AMPERES, 301)
        rig = begun(1, WithFeedForward(move.positions, speed, current))
        for row in range(1, 280):
            d = rig.cycle().axes["d"]
            motor = rig.train.motor_revolutions_per_cycle(speed[row], PERIOD)
            np.testing.assert_allclose(d[:, 3], motor, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(d[:, 4], current[row], rtol=1e-6)
        rig.run_to("completed")

    @pytest.mark.parametrize(
        ("part", "value", "kind"),
        [
            *((part, np.nan, Check.FINITE) for part in ("velocity", "current")),
            ("velocity", 2.1, Check.VELOCITY),
            ("velocity", 0.1, Check.ACCELERATION),
            ("current", 4.01, Check.CURRENT_STEP),
        ],
    )
    def test_velocity_and_current_are_checked(self, part, value, kind):
        rows = np.zeros((10, N))
        rows[4, 2] = value
        rig = begun(1, WithFeedForward(np.tile(START, (10, 1)), **{part: rows}))
        assert assert_refused(rig, rig.cycle(4), kind).joint == 2

    @pytest.mark.parametrize("sign", [-1, 1])
    def test_too_much_current_is_refused_not_clamped(self, sign):
        rows = np.zeros((10, N))
        rows[3, 5] = sign * 7.5
        rows[4, 5] = sign * 7.51
        small = init_packet(arm_1={"current_limit": [20, 20, 20, 20, 20, 7.5]})
        source = WithFeedForward(np.tile(START, (10, 1)), current=rows)
        rig = begun(1, source, init=small, guard_limits=AT_ONCE)
        assert rig.cycle(3).axes["d"][5, 4] == np.float32(sign * 7.5)
        error = assert_refused(rig, rig.cycle(), Check.COMMANDED_CURRENT)
        assert (error.joint, error.bound, error.unit) == (5, pytest.approx(7.5, rel=1e-5), "A")

    @pytest.mark.parametrize("part", ["velocity", "current"])
    def test_feed_forward_left_on_at_the_end_is_refused(self, part):
        rows = np.zeros((10, N))
        rows[9, 2] = 3e-5
        rig = begun(1, WithFeedForward(np.tile(START, (10, 1)), **{part: rows}))
        rig.cycle(8)
        error = assert_refused(rig, rig.cycle(), Check.CORRECTION_END)
        assert error.unit == {"velocity": "rad/s", "current": "A"}[part]

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            (None, "TypeError"),
            (("a", "b"), "ValueError: could not convert"),
            ((1.0, 2.0), "ValueError: a feed-forward velocity of shape"),
            ((np.zeros(5), np.zeros(6)), "ValueError: a feed-forward velocity of shape"),
            ((np.zeros(6), 2.0), "ValueError: a feed-forward current of shape"),
        ],
    )
    def test_invalid_feed_forward(self, given, words):
        source = WithFeedForward(np.tile(START, (10, 1)))
        source.feed_forward = lambda: given
        error = assert_refused((rig := begun(1, source)), rig.cycle(), SourceFailed)
        assert f"the motion source failed to feed forward: {words}" in str(error)


SPOILED = [  # mode; part, row, and what is added to it; what is refused
    *((mode, "motion", 10, np.nan, Check.FINITE) for mode in MOVED),
    *((mode, "current", 10, np.nan, Check.FINITE) for mode in CURRENTS),
    *((mode, "current", 10, value, SourceFailed) for mode in (7, 8) for value in (np.nan, 1e-6)),
    *((9, "motion", 10, value, SourceFailed) for value in (np.nan, 1e-6)),
    *((mode, "motion", 10, 0.1, Check.ACCELERATION) for mode in (2, 8)),
    (7, "motion", 10, 0.1, Check.VELOCITY),
    *((mode, "current", 10, -4.1, Check.CURRENT_STEP) for mode in CURRENTS),
    *((mode, "current", 10, 4.1, Check.CURRENT_STEP) for mode in CURRENTS),
    # What is left on at the end.
    *((mode, "current", 399, 3e-5, Check.CORRECTION_END) for mode in CURRENTS),
    (7, "motion", 399, 5e-9, Check.CORRECTION_END),
    (8, "motion", 399, 3e-6, Check.CORRECTION_END),
]


class TestCorrections:
    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_complete_correction(self, mode):
        source = correction(mode)
        rig = Rig(mode=mode)
        rig.session.request(source)
        first = rig.open()
        assert not first.axes["d"].any()
        for row in range(400):
            answer = rig.cycle()
            assert only_fields_of(mode, answer)
            d = answer.axes["d"].astype(np.float64)
            motion = rig.train.motor_from_joint @ source.motion[row] / (2 * np.pi)
            if mode == 7:
                np.testing.assert_allclose(d[:, 0], motion, rtol=1e-6, atol=1e-9)
            if mode in (2, 8):
                np.testing.assert_allclose(d[:, 3], motion * PERIOD, rtol=1e-6, atol=1e-12)
            if mode in (2, 9):
                np.testing.assert_allclose(d[:, 4], source.current[row], rtol=1e-6)
        assert source.begun == 1
        rig.run_to("completed")
        assert source.index == 400
        rows = rig.records[2:402]
        offset, velocity = rows["commanded_position"], rows["commanded_velocity"]
        expected = START + source.motion if mode == 7 else np.full((400, N), np.nan)
        np.testing.assert_allclose(offset, expected, atol=1e-6)
        expected = source.motion if mode in (2, 8) else np.full((400, N), np.nan)
        np.testing.assert_array_equal(velocity, expected)

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_stop_of_a_correction(self, mode):
        """After a long gap as well if it is zero, else it is refused: was it applied?"""
        rig = begun(mode, source := correction(mode))
        rig.cycle(50)
        rig.session.stop()
        rig.run()
        assert (rig.ended.outcome, source.stops) == ("stopped", 1)
        rig = begun(mode, source := Correction(rows=300))
        rig.cycle(5)
        rig.miss(3)
        rig.run()
        assert (rig.ended.outcome, source.stops) == ("stopped", 1)
        rig = begun(mode, correction(mode))
        rig.cycle(50)
        rig.miss(2)
        rig.cycle()
        assert rig.state is State.OPEN
        rig.miss(3)
        assert_refused(rig, rig.cycle(), Check.GAP_CORRECTION)

    @pytest.mark.parametrize(("mode", "part", "row", "value", "kind"), SPOILED)
    def test_one_spoiled_row_is_refused(self, mode, part, row, value, kind):
        source = correction(mode)
        getattr(source, part)[row, 3] += value
        rig = begun(mode, source)
        rig.cycle(row)
        assert rig.state is State.OPEN
        answer = rig.cycle()
        error = assert_refused(rig, answer, kind)
        assert np.isfinite(answer.axes["d"]).all()
        if kind is SourceFailed:
            assert f"mode {mode} has no field for a {part}: [" in str(error)
        else:
            assert error.joint == 3
        if kind is Check.CORRECTION_END:
            assert error.unit == ("A" if part == "current" else "rad" if mode == 7 else "rad/s")

    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    @pytest.mark.parametrize("missed", [0, 2])
    def test_speed_of_offset_and_target_together(self, sign, missed):
        def after(own: float, offset: float):
            rows = np.zeros((20, N))
            rows[10:, 2] = sign * offset
            rig = begun(7, Correction(rows), guard_limits=limits(**UNBOUNDED))
            for cycle in range(11):
                rig.miss(missed)
                step = sign * own * PERIOD * (missed + 1)
                motor = rig.train.motor_from_joint[:, 2] * step / (2 * np.pi)
                rig.axes["d"][:, 0] += motor
                rig.axes["d"][:, 2] += motor
                answer = rig.cycle()
                assert cycle == 10 or rig.state is State.OPEN, rig.refusal
            return rig, answer

        rig, _ = after(1.0, 0.95 * PERIOD)
        assert rig.state is State.OPEN
        rig, answer = after(1.0, 1.05 * PERIOD)
        error = assert_refused(rig, answer, Check.VELOCITY)
        assert (error.joint, error.value) == (2, pytest.approx(2.05, rel=1e-2))

    @pytest.mark.parametrize(("share", "state"), [(0.95, State.OPEN), (1.05, State.FAULTED)])
    def test_speed_in_the_first_cycle(self, share, state):
        rig = opened(50, mode=7, guard_limits=limits(**UNBOUNDED))
        rig.session.request(Correction(np.zeros((20, N))))
        rig.cycle()
        step = share * limits().velocity[2] * PERIOD
        rig.axes["d"][:, [0, 2]] += (rig.train.motor_from_joint[:, [2]] * step) / (2 * np.pi)
        rig.cycle()
        assert rig.state is state

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    @pytest.mark.parametrize("corrected", [False, True])
    @pytest.mark.parametrize(
        ("column", "off", "kind"),
        [(None, 0.006, Check.POSITION), (2, 2.1, Check.FOLLOWING_ERROR), (4, 20.1, Check.CURRENT)],
    )
    def test_arm_is_checked_beside_its_correction(self, mode, corrected, column, off, kind):
        """Its range begins 0.005 rad from where it stands."""
        options = {"mode": mode, "guard_limits": limits(upper=START + 0.005)}
        rig = running(correction(mode), **options) if corrected else opened(**options)
        if column is None:
            rig.put_arm_at(START + off * (np.arange(N) == 4))
        else:
            rig.axes["d"][4, column] += off
        rig.cycle()
        assert (kind_of(rig.refusal), rig.refusal.joint) == (kind, 4)

    def test_offset_out_of_the_range_is_refused(self):
        """Of an arm that is within it, 5e-4 rad from its end."""
        rig = running(correction(7), mode=7, guard_limits=limits(upper=START + 5e-4))
        rig.cycle(50)
        assert rig.state is State.OPEN
        rig.cycle(150)
        assert (kind_of(rig.refusal), rig.refusal.joint) == (Check.POSITION, 2)

    @pytest.mark.parametrize("sign", [-1, 1])
    def test_sum_with_the_servo_current_is_limited(self, sign):
        rows = np.full((400, N), sign * 5.0)
        rig = begun(9, Correction(current=rows), guard_limits=AT_ONCE)
        rig.axes["d"][:, 4] = sign * 15.0
        rig.cycle()
        assert rig.state is State.OPEN
        rig.axes["d"][4, 4] = sign * 15.01
        error = assert_refused(rig, rig.cycle(), Check.COMMANDED_CURRENT)
        assert (error.joint, error.value) == (4, pytest.approx(20.01))
        rig = begun(9, Correction(current=rows), guard_limits=AT_ONCE)
        rig.axes["d"][:, 4] = -sign * 19.9
        rig.cycle()
        assert rig.state is State.OPEN

    def test_current_fed_forward_is_limited_by_itself(self):
        """It is part of the current that the servo reports, not an addition to that."""
        rig = begun(2, Correction(current=np.full((400, N), 5.0)), guard_limits=AT_ONCE)
        rig.axes["d"][:, 4] = 19.0
        rig.cycle(3)
        assert rig.state is State.OPEN

    @pytest.mark.parametrize(
        ("age", "cycles", "state"),
        [(0, 1.9, State.FAULTED), (1, 1.9, State.OPEN), (1, 2.1, State.FAULTED)],
    )
    def test_an_old_target_had_one_cycle_more(self, age, cycles, state):
        """A target that is new after one that was `age` cycles old moved for `age` + 1 cycles."""
        rig = begun(7, Correction(rows=400), guard_limits=limits(**UNBOUNDED))
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.cycle(5)
        for old, share in ((age, 0.0), (0, cycles)):
            rig.ages[:, 0] = old
            step = share * limits().velocity[2] * PERIOD
            rig.axes["d"][:, [0, 2]] += rig.train.motor_from_joint[:, [2]] * step / (2 * np.pi)
            rig.cycle()
        assert rig.state is state


def player() -> TrajectoryPlayer:
    rates = ("lower", "upper", "velocity", "acceleration", "jerk")
    bounds = JointLimits(**{name: getattr(limits(), name) for name in rates})
    return TrajectoryPlayer(plan([START, START + MOVE], bounds, fly=0.0), PERIOD, bounds)


def playing() -> Rig:
    rig = running(player(), 60)
    assert rig.state is State.OPEN
    return rig


def do_nothing(self):
    pass


def failing(*parts: str, error: BaseException, **others) -> Cruise:
    """A source that can hold and resume, but fails in these parts."""

    def fails(self, *_):
        raise error

    methods = {"hold": do_nothing, "resume": do_nothing} | dict.fromkeys(parts, fails) | others
    return type("Failing", (Cruise,), methods)()


def at_rest(rig: Rig) -> bool:
    return not rig.records[-1]["commanded_velocity"].any()


class Ramp(Correction):
    """A velocity of joint 3, which a hold brings to zero, at first as fast as a stop may be."""

    velocity, target, rate = 0.0, 0.5, 7.0

    def advance(self):
        step = self.rate * PERIOD
        self.velocity += float(np.clip(self.target - self.velocity, -step, step))
        return self.velocity * np.eye(N)[2], np.zeros(N)

    def hold(self):
        self.target, self.rate = 0.0, 15.0

    def resume(self):
        self.target = 0.5


class TestHold:
    def test_hold_without_limit_and_resume(self):
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
        np.testing.assert_allclose(end, START + MOVE, atol=1e-6)

    @pytest.mark.parametrize("cycles", [3, 300])
    def test_a_stop_ends_a_hold(self, cycles):
        rig = playing()
        rig.session.hold()
        rig.cycle(cycles)
        rig.session.stop()
        rig.run_to("stopped")

    @pytest.mark.parametrize(("rate", "state"), [(7.0, State.OPEN), (15.0, State.FAULTED)])
    def test_hold_of_a_correction(self, rate, state, monkeypatch):
        """It has the bounds of a stop until it rests, and is held for longer than a stop takes."""
        monkeypatch.setattr("drivers.session.STOP_TIMEOUT", 0.2)
        source = Ramp(rows=1)
        rig = begun(8, source, cycles=60, guard_limits=limits(jerk=np.full(N, 1e9)))
        rig.session.hold()
        rig.cycle(20)
        assert source.velocity == 0.0
        rig.cycle(200)
        assert (rig.state, rig.ended) == (State.OPEN, None)
        source.rate = rate
        rig.session.resume()
        rig.cycle(40)
        assert rig.state is state

    def test_source_without_hold_is_stopped(self):
        rig, source = moving()
        rig.session.hold()
        rig.run()
        assert source.stops == 1
        assert rig.ended.outcome == "stopped"
        assert rig.ended.reason == "held, which this motion cannot: it was stopped instead"
        rig = closed()  # one that has not begun is dropped
        rig.session.request(Cruise())
        rig.session.hold()
        rig.cycle()
        assert (rig.ended.outcome, rig.ended.interval) == ("stopped", -1)

    def test_one_event_per_change(self):
        rig = playing()
        for _ in range(2):
            rig.session.override(0.5)
            rig.session.hold()
            rig.cycle(10)
        for _ in range(2):
            rig.session.resume()
        cycle = rig.session.cycle
        rig.run()
        assert rig.seen(OverrideChanged) == [OverrideChanged(0.5, cycle - 20)]
        assert rig.seen(HoldChanged) == [HoldChanged(True, cycle - 20), HoldChanged(False, cycle)]


def no(self):
    raise SystemExit("no")


class TestSourcesThatRaise:
    """A method, or a property where a method should be."""

    @pytest.mark.parametrize(
        ("source", "words"),
        [
            (failing(error=SystemExit(), override=property(no)), "SystemExit: no"),
            (failing(error=SystemExit(), resume=property(no)), "SystemExit: no"),
            (failing("override", error=Unspeakable()), "Unspeakable without a message"),
            (failing("override", error=ZeroDivisionError("not now")), "ZeroDivisionError: not now"),
        ],
    )
    def test_request_is_refused_and_the_motion_continues(self, source, words):
        rig = running(source, 50)
        with pytest.raises(RequestError, match=words):
            if isinstance(vars(type(source))["resume"], property):
                rig.session.resume()
            else:
                rig.session.override(0.5)
        rig.cycle(5)
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("name", ["begin", "stop", "feed_forward"])
    def test_property_that_raises(self, name):
        """Only what is needed to choose how to run it is looked up at the request."""
        rig = Rig()
        source = failing(error=SystemExit(), **{name: property(no)})
        if name == "feed_forward":
            with pytest.raises(RequestError, match="cannot be inspected: SystemExit: no"):
                rig.session.request(source)
            return
        rig.session.request(source)
        rig.open()
        if name != "begin":
            rig.cycle(300)
            assert rig.state is State.OPEN
            rig.session.stop()
            rig.cycle()
        what = "cannot begin" if name == "begin" else "failed to stop"
        assert f"the motion source {what}: SystemExit: no" in str(rig.refusal)
        assert type(rig.refusal) is SourceFailed

    def test_source_that_fails_to_hold(self):
        """It is stopped, or refused at its begin."""
        rig = running(source := failing(error=SystemExit(), hold=property(no)), 50)
        rig.session.hold()
        rig.cycle()
        assert source.stops == 1
        rig = Rig()
        rig.session.request(failing("hold", error=ValueError("no")))
        rig.session.hold()
        answer = rig.open()
        assert "failed to hold: ValueError: no" in str(assert_refused(rig, answer, SourceFailed))


@pytest.mark.parametrize("where", ["guard", "record of the packet"])
def test_internal_error_requests_drive_off(where, monkeypatch):
    rig, _ = moving()

    def fails(*_, **__):
        raise MemoryError("no room")

    owner, name = rig.guard, "check_set_point"
    if where != "guard":
        owner, name = rig.session, "_record"
    monkeypatch.setattr(owner, name, fails)
    assert all_drive_off(rig.cycle())
    assert "the session failed: MemoryError: no room" in str(rig.refusal)
    assert rig.ended.outcome == "refused"
    assert all_drive_off(rig.cycle())


WIDE = {"jerk": np.full(N, 1e9)}


class Overridable(Unstopped):
    """Has the bounds of an override from the first on."""

    def __init__(self, positions):
        super().__init__(positions)
        self.fractions = []

    def override(self, fraction):
        self.fractions.append(fraction)
        self.bounds = "override"


def test_override_and_its_bounds():
    rig = Rig()  # requested before the motion begins
    rig.session.request(source := Overridable(np.tile(START, (20, 1))))
    rig.session.override(0.25)
    rig.open()
    rig.run_to("completed")
    assert source.fractions == [0.25]
    for scale, refused in ((0.999, False), (1.001, True)):
        rig = running(Overridable(accelerating(8.0 * 1.3 * scale)), guard_limits=limits(**WIDE))
        rig.session.override(0.5)
        answer = rig.cycle(2)
        if refused:
            assert_refused(rig, answer, Check.ACCELERATION)
        else:
            rig.cycle(30)
            assert rig.state is State.OPEN


STOPPING = "the motion is being stopped"
WHAT = {"override": "change of override", "hold": "hold", "resume": "resumption"}
NOT_FITTING = [
    (lambda: Rig(), "override", "no motion was requested"),
    (lambda: moving(10)[0], "override", "this motion has no override"),
    (lambda: stopping(Overridable(np.tile(START, (20, 1)))), "override", STOPPING),
    (lambda: opened(), "hold", "no motion was requested"),
    (lambda: Rig(), "resume", "no motion was requested"),
    (lambda: moving(10)[0], "resume", "this motion cannot be held"),
    (lambda: stopping(player()), "resume", STOPPING),
]


def stopping(source) -> Rig:
    rig = running(source, 5)
    if hasattr(source, "hold"):
        rig.session.hold()
    rig.session.stop()
    rig.cycle()
    return rig


@pytest.mark.parametrize(("situation", "request_", "words"), NOT_FITTING)
def test_refused_overrides_and_resumptions(situation, request_, words):
    rig = situation()
    state = rig.state
    message = f"no {WHAT[request_]} can be requested in state '{state.name.lower()}': {words}"
    with pytest.raises(RequestError, match=f"^{message}$"):
        getattr(rig.session, request_)(*[0.5] * (request_ == "override"))
    assert rig.state is state
