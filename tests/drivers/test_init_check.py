"""What of an init packet is in force for arms of few joints, and how far off it may be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers import DriveTrain, InitPacket
from drivers.init_check import AnnouncedLimits, InitCheck, compare, shown
from tests.drivers.rig import PERIOD, drive_train

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
    told = {
        "gear_ratio": ours.gear_ratio,
        "calibration": ours.calibration,
        "kinematic_influence": [0.0, 0.0, 0.0, *COUPLING],
    }
    init = InitPacket.build(n, round(1000 * PERIOD), told | changes)
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
