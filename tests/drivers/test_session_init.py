"""Init packets that are answered although nothing can be moved with them, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers import DriveTrain, InitPacket, InitReceived, Mode, RequestError, State
from drivers.init_check import AnnouncedLimits, InitCheck, compare, narrower, shown
from drivers.packets import NO_SLOT
from tests.drivers.rig import (
    PERIOD,
    START,
    N,
    Rig,
    drive_train,
    init_packet,
    smooth_move,
    started,
    still,
)


class TestInitOfAnotherArm:
    def other(self, name, axis, value):
        init = init_packet()
        init.record[name][0, 0, axis] = value
        return Rig(init=init)

    @pytest.mark.parametrize("value", [np.nan, 0.0, 110.0, -110.01, -110.0 * (1 + 4e-6), np.inf])
    def test_another_gear_ratio(self, value):
        self.refused(self.other("gear_ratio", 2, value), "gear ratio of axis 3")

    @pytest.mark.parametrize("value", [np.nan, 0.0, 2.00001, -2.0])
    def test_another_calibration(self, value):
        self.refused(self.other("calibration", 2, value), "calibration of axis 3")

    @pytest.mark.parametrize(
        ("entry", "name"), [(3, "k54 of axis 5"), (4, "k64 of axis 6"), (5, "k65 of axis 6")]
    )
    @pytest.mark.parametrize("value", [np.nan, 0.0, 0.0101])
    def test_another_coupling(self, entry, name, value):
        self.refused(self.other("kinematic_influence", entry, value), name)

    def refused(self, rig, name):
        rig.session.request(still(3))
        rig.start()
        unusable = rig.seen(InitReceived)[0].unusable
        assert unusable.startswith(f"{name} is ")
        assert ";" not in unusable
        assert rig.cycle() is not None
        assert (rig.cycle(mode=Mode.POSITION).axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        rig.cycle(mode=Mode.CLOSED)
        with pytest.raises(RequestError, match=name):
            rig.session.request(still(3))

    def test_every_axis_that_differs_is_named_with_both_values(self):
        rig = self.other("gear_ratio", 0, 119.5)
        rig.init.record["calibration"][0, 0, 5] = 3.25
        rig.start()
        assert rig.seen(InitReceived)[0].unusable == (
            "gear ratio of axis 1 is 119.5 in the controller, -120 in the cell; "
            "calibration of axis 6 is 3.25 in the controller, -0.75 in the cell"
        )

    def test_what_float32_rounds_away_is_no_difference(self):
        rig = Rig(
            init=init_packet(arm_1={"calibration": np.array([0.5, -1.25, 2, 1e-8, 0.25, -0.75])})
        )
        up = np.float32(np.inf)
        for name in ("gear_ratio", "calibration", "kinematic_influence"):
            row = rig.init.record[name][0, 0]
            row[:N] = np.where(row[:N] != 0, np.nextafter(row[:N], up), row[:N])
        rig.start()
        assert rig.seen(InitReceived)[0].unusable is None

    def test_axes_beyond_the_arm_do_not_matter(self):
        rig = self.other("gear_ratio", 6, np.nan)
        rig.start()
        assert rig.seen(InitReceived)[0].unusable is None


class TestInitThatDoesNotFit:
    @pytest.mark.parametrize(
        "init",
        [
            init_packet(sample_time=1),
            init_packet(sample_time=1500),
            init_packet(n_axes=5),
            init_packet(open_axes_map=np.full((4, 10), 1)),
        ],
        ids=["cycle", "cycle in microseconds", "axis missing", "no map"],
    )
    def test_it_is_answered_but_nothing_can_be_moved(self, init):
        rig = started(init=init)
        assert rig.seen(InitReceived)[0].unusable
        assert rig.cycle(mode=Mode.CLOSED) is not None
        with pytest.raises(RequestError):
            rig.session.request(still(3))
        assert (rig.cycle(mode=Mode.POSITION).axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert (rig.cycle().axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert np.isnan(rig.records["position"]).all()


class TestDifferences:
    """Each is named with the axis and both values, whether or not anything can be done."""

    def told(self, init, **options) -> InitReceived:
        rig = started(init=init, **options)
        return rig.seen(InitReceived)[0]

    def test_none(self):
        event = self.told(init_packet())
        assert (event.differences, event.unusable, event.adopted) == ((), None, False)

    def test_of_the_cycle(self):
        event = self.told(init_packet(sample_time=1))
        assert event.differences == ("cycle is 1 ms in the controller, 2 ms in the cell",)

    def test_of_axes_that_are_not_open(self):
        axes_map = np.full((4, 10), NO_SLOT)
        axes_map[0, :N] = [0, NO_SLOT, 1, 2, NO_SLOT, 3]
        event = self.told(init_packet(n_axes=4, open_axes_map=axes_map))
        assert event.differences == (
            "axis 2 of arm 1 is not open in the controller, joint 2 in the cell",
            "axis 5 of arm 1 is not open in the controller, joint 5 in the cell",
        )

    def test_of_an_arm_that_is_not_there(self):
        event = self.told(init_packet(), arm=3)
        assert "axis 1 of arm 3 is not open" in event.differences[0]

    def test_of_everything_at_once(self):
        init = init_packet(sample_time=4, open_axes_map=np.full((4, 10), 1))
        init.record["gear_ratio"][0, 0, 0] = 119.5
        init.record["kinematic_influence"][0, 0, 5] = 0.04
        event = self.told(init)
        assert [difference.split(" is ")[0] for difference in event.differences] == [
            "cycle",
            "packet open_axes_map",
            "gear ratio of axis 1",
            "k65 of axis 6",
        ]
        assert event.unusable == "; ".join(event.differences)


class TestAcceptedInit:
    def other(self, **changes) -> Rig:
        init = init_packet()
        for name, (axis, value) in changes.items():
            init.record[name][0, 0, axis] = value
        return Rig(init=init, accept_init=True)

    def test_the_controllers_values_are_in_force(self):
        rig = self.other(
            gear_ratio=(2, -111.5), calibration=(4, 0.75), kinematic_influence=(4, 0.004)
        )
        assert rig.session.drive_train is rig.train
        rig.start()
        event = rig.seen(InitReceived)[0]
        assert (event.unusable, event.adopted) == (None, True)
        assert [text.split(" is ")[0] for text in event.differences] == [
            "gear ratio of axis 3",
            "calibration of axis 5",
            "k64 of axis 6",
        ]
        train = rig.session.drive_train
        np.testing.assert_array_equal(train.gear_ratio, [-120, 150, -111.5, 90, 80, -60])
        np.testing.assert_array_equal(train.calibration, [0.5, -1.25, 2, 0, 0.75, -0.75])
        np.testing.assert_allclose([train.k54, train.k64, train.k65], [0.01, 0.004, 0.03], 1e-6)
        np.testing.assert_array_equal(train.joint_sign, rig.train.joint_sign)
        np.testing.assert_array_equal(train.torque_constant, rig.train.torque_constant)

    def test_records_and_set_points_use_them(self):
        rig = self.other(gear_ratio=(2, -111.5), calibration=(4, 0.75))
        rig.start()
        rig.train = rig.session.drive_train
        rig.put_arm_at(START)
        move = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])
        rig.session.request(smooth_move(move, 300))
        rig.open()
        np.testing.assert_allclose(rig.records[-1]["position"], START, atol=1e-6)
        rig.run_to("completed")
        end = rig.axes["d"][:, 0]
        np.testing.assert_allclose(rig.train.joint_position(end), START + move, atol=1e-6)
        motor = drive_train().motor_revolutions(START + move)
        assert abs(end[2] - motor[2]) > 0.01
        np.testing.assert_allclose(end[4] - motor[4], 0.5, atol=1e-5)

    def test_the_guard_stays_with_the_joints(self):
        rig = self.other(gear_ratio=(2, -111.5))
        rig.start()
        rig.train = rig.session.drive_train
        rig.put_arm_at(START)
        rig.session.request(smooth_move(np.array([0, 0, 2.0, 0, 0, 0]), 3000))
        rig.open()
        rig.cycle(3000)
        assert (rig.refusal.joint, rig.refusal.bound) == (2, pytest.approx(2.0, rel=1e-5))
        assert 2.0 < rig.refusal.value < 2.01

    @pytest.mark.parametrize(
        ("field", "axis", "value"),
        [
            ("gear_ratio", 2, np.nan),
            ("gear_ratio", 2, 0.0),
            ("gear_ratio", 2, np.inf),
            ("calibration", 1, np.nan),
            ("calibration", 1, -np.inf),
            ("kinematic_influence", 3, np.nan),
            ("kinematic_influence", 5, np.inf),
        ],
    )
    def test_what_is_no_value_cannot_be_accepted(self, field, axis, value):
        rig = self.other(**{field: (axis, value)})
        rig.start()
        event = rig.seen(InitReceived)[0]
        assert len(event.differences) == 1
        assert "cannot be accepted" in event.unusable
        assert not event.adopted
        assert rig.session.drive_train is rig.train
        with pytest.raises(RequestError, match="cannot be accepted"):
            rig.session.request(still(3))

    def test_another_cycle_and_an_axis_that_is_closed_are_not_accepted(self):
        init = init_packet(sample_time=1)
        init.record["gear_ratio"][0, 0, 2] = -111.5
        rig = started(init=init, accept_init=True)
        event = rig.seen(InitReceived)[0]
        assert event.unusable == "cycle is 1 ms in the controller, 2 ms in the cell"
        assert len(event.differences) == 2
        assert not event.adopted
        rig = started(init=init_packet(n_axes=5), accept_init=True)
        assert "axis 6 of arm 1 is not open" in rig.seen(InitReceived)[0].unusable

    def test_without_a_difference_the_cells_values_stay(self):
        rig = started(accept_init=True)
        assert not rig.seen(InitReceived)[0].adopted
        assert rig.session.drive_train is rig.train

    def test_a_later_init_packet_is_judged_by_itself(self):
        rig = self.other(gear_ratio=(2, -111.5))
        rig.start()
        assert rig.session.drive_train is not rig.train
        rig.init = init_packet()
        rig.start()
        assert rig.session.drive_train is rig.train
        assert rig.state is State.INIT

    def test_nothing_is_adopted_unless_it_was_asked_for(self):
        init = init_packet()
        init.record["calibration"][0, 0, 0] = 0.75
        rig = started(init=init)
        event = rig.seen(InitReceived)[0]
        assert not event.adopted
        assert event.unusable == event.differences[0]


class TestOtherAxes:
    """Open in the controller, but no joint of the cell: they would be held, and nobody watches."""

    def extra(self, arm: int, axis: int, **options) -> Rig:
        table = np.full((4, 10), 0xFF)
        table[0, :N] = range(N)
        table[arm - 1, axis - 1] = N
        return Rig(init=init_packet(n_axes=N + 1, open_axes_map=table), **options)

    @pytest.mark.parametrize(("arm", "axis"), [(1, 7), (2, 1), (4, 10)])
    def test_one_nobody_named_refuses_the_session(self, arm, axis):
        rig = self.extra(arm, axis)
        rig.start()
        event = rig.seen(InitReceived)[0]
        told = f"axis {axis} of arm {arm} is open in the controller; the cell does not know it"
        assert event.differences == (told,)
        assert event.unusable == told
        with pytest.raises(RequestError, match="does not know"):
            rig.session.request(still(3))

    @pytest.mark.parametrize(("arm", "axis"), [(1, 7), (2, 1)])
    @pytest.mark.parametrize("accept", [False, True])
    def test_named_or_accepted_it_is_held_beside_the_motion(self, arm, axis, accept):
        options = {"accept_init": True} if accept else {"other_axes": {(arm, axis)}}
        rig = self.extra(arm, axis, **options)
        rig.session.request(still(3))
        rig.open()
        event = rig.seen(InitReceived)[0]
        assert (event.unusable, len(event.differences)) == (None, int(accept))
        assert rig.session.drive_train is rig.train
        rig.run_to("completed")

    def test_another_one_named_does_not_help(self):
        rig = self.extra(1, 7, other_axes={(1, 8), (2, 7)})
        rig.start()
        assert "axis 7 of arm 1" in rig.seen(InitReceived)[0].unusable


@pytest.mark.parametrize(
    ("theirs", "ours", "below"),
    [
        (np.float32(1.23456514), 1.23457, False),  # six digits, as a person types what he was told
        (np.float32(1.2345), 1.2346, True),
        (np.float32(0.1), 0.1, False),
        (np.float32(np.nan), 1.0, False),
    ],
)
def test_a_limit_is_narrower_only_by_more_than_six_digits_round(theirs, ours, below):
    assert narrower(np.array([theirs], dtype=np.float64), np.array([ours])).tolist() == [below]


def test_a_limit_is_shown_in_digits_that_are_that_limit_again():
    for value in np.random.default_rng(1).uniform(0.1, 50.0, 200).astype(np.float32):
        assert np.float32(shown(value)) == value


COUPLING = (0.02, 0.003, 0.04)


def arm(n: int) -> DriveTrain:
    """The first joints of the rig's arm, without a wrist where it ends before it."""
    whole = drive_train()
    names = ("gear_ratio", "calibration", "joint_sign", "joint_offset")
    names += ("torque_constant", "current_limit")
    coupling = COUPLING if n == 6 else (0.0, 0.0, 0.0)
    return replace(
        whole,
        **{name: getattr(whole, name)[:n] for name in names},
        **dict(zip(("k54", "k64", "k65"), coupling, strict=True)),
    )


def adopted(ours: DriveTrain, **changes) -> InitCheck:
    """The controller's values, accepted."""
    n = ours.n_joints
    described = {
        "gear_ratio": ours.gear_ratio,
        "calibration": ours.calibration,
        "kinematic_influence": [0.0, 0.0, 0.0, *COUPLING],
    }
    init = InitPacket.build(n, round(1000 * PERIOD), described | changes)
    return compare(ours, PERIOD, init, 1, True)


@pytest.mark.parametrize("n", [3, 4, 6])
def test_a_coupling_is_taken_only_of_axes_that_the_arm_has(n):
    ours = arm(n)
    theirs = adopted(ours, calibration=ours.calibration + 0.5)
    assert theirs.adopted
    train = theirs.drive_train
    assert train.n_joints == n
    expected = COUPLING if n == 6 else (0.0, 0.0, 0.0)
    assert (train.k54, train.k64, train.k65) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(train.calibration, ours.calibration + 0.5)
    np.testing.assert_array_equal(train.torque_constant, ours.torque_constant)
    assert train.gear_ratio.dtype == train.calibration.dtype == np.float64


@pytest.mark.parametrize(("k54", "fits"), [(0.0, True), (0.02, False)])
def test_an_arm_of_five_joints_has_no_wrist_to_couple(k54, fits):
    ours = arm(5)
    told = [0.0, 0.0, 0.0, k54, 0.003, 0.04]
    theirs = adopted(ours, calibration=ours.calibration + 0.5, kinematic_influence=told)
    assert theirs.adopted == fits
    assert fits or "values cannot be accepted: drive train k54" in theirs.unusable


class TestTooFarOff:
    """Twice or half the gear ratio, a turn of the joint, a coupling of 1: so far and no further."""

    ONE = np.arange(6) == 2

    @pytest.mark.parametrize(
        ("factor", "fits"), [(0.5, True), (0.49, False), (2.0, True), (2.01, False)]
    )
    def test_a_gear_ratio(self, factor, fits):
        ours = arm(6)
        theirs = adopted(ours, gear_ratio=np.where(self.ONE, factor, 1.0) * ours.gear_ratio)
        assert theirs.adopted == fits
        assert fits or f"gear ratio of axis 3 is {factor:g} times the cell's" in theirs.unusable

    @pytest.mark.parametrize(("turns", "fits"), [(1.0, True), (-1.0, True), (1.01, False)])
    def test_a_calibration(self, turns, fits):
        ours = arm(6)
        turned = ours.calibration + np.where(self.ONE, turns * ours.gear_ratio, 0.0)
        theirs = adopted(ours, calibration=turned)
        assert theirs.adopted == fits
        assert fits or "calibration of axis 3 is" in theirs.unusable

    @pytest.mark.parametrize(("value", "fits"), [(1.0, True), (-1.0, True), (1.01, False)])
    @pytest.mark.parametrize(("entry", "name"), [(0, "k54"), (1, "k64"), (2, "k65")])
    def test_a_coupling(self, entry, name, value, fits):
        told = [0.0, 0.0, 0.0, *COUPLING]
        told[3 + entry] = value
        theirs = adopted(arm(6), kinematic_influence=told)
        assert theirs.adopted == fits
        assert fits or f"{name} is {value:g}, and 1 is the most" in theirs.unusable


def test_limits_are_those_of_the_arm_and_of_its_joints():
    tell = {"current_limit": np.arange(1.0, 7.0), "following_error": np.arange(11.0, 17.0)}
    init = InitPacket.build(6, 2, tell)
    found = AnnouncedLimits.of(init, 1, 4)
    np.testing.assert_array_equal(found.current, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(found.following_error, [11.0, 12.0, 13.0, 14.0])
    assert found.current.dtype == found.following_error.dtype == np.float64
    other = AnnouncedLimits.of(init, 2, 4)
    assert not np.array_equal(other.current, found.current)


@pytest.mark.parametrize(
    ("value", "text"), [(5.0, "5"), (-120.0, "-120"), (0.1, "0.1"), (2.5, "2.5")]
)
def test_a_figure_of_the_wire_is_shown_in_as_few_digits_as_are_that_figure(value, text):
    assert shown(np.float32(value)) == text
