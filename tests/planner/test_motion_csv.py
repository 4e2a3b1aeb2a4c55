from __future__ import annotations

import numpy as np
import pytest

from planner import InvalidSetting, InvalidTrajectory, LimitExceeded, check_limits, plan
from planner.motion_csv import from_csv, to_csv

NAMES = ("axis 1", "wrist, long", "j3", "j4", "j5", "j6")


@pytest.mark.parametrize("rate", [7.0, 100.0, 1000.0 / 3.0])
def test_every_bit_of_the_samples_comes_back(six_axis_limits, random_points, rate):
    motion = plan(random_points(1), six_axis_limits)
    table, names = from_csv(to_csv(motion, rate, NAMES))
    assert names == NAMES
    assert table.duration == motion.duration
    np.testing.assert_array_equal(table.time[:-1], np.arange(len(table.time) - 1) / rate)
    assert 0.0 < table.time[-1] - table.time[-2] <= 1.0 / rate + 1e-9
    rows = (table.position, table.velocity, table.acceleration)
    for ours, theirs in zip(rows, motion.sample(table.time), strict=True):
        assert ours.tobytes() == np.ascontiguousarray(theirs).tobytes()


def test_headings_name_joint_quantity_and_unit(six_axis_limits, random_points):
    motion = plan(random_points(1), six_axis_limits)
    heading = to_csv(motion, 10.0, [f"j{i}" for i in range(6)]).splitlines()[0]
    assert heading.startswith(
        "time [s],j0.position [rad],j0.velocity [rad/s],j0.acceleration [rad/s^2],j1.position [rad]"
    )


def test_a_foreign_table_may_count_in_degrees_and_begin_at_any_time():
    table, names = from_csv(
        "a.velocity [deg/s], a.position [deg], time [s], a.acceleration [rad/s^2]\n"
        "0, 90, 5.0, 0\n"
        "18, 180, 5.5, 1\n"
    )
    assert names == ("a",)
    np.testing.assert_array_equal(table.time, [0.0, 0.5])
    np.testing.assert_allclose(table.position[:, 0], [np.pi / 2, np.pi])
    np.testing.assert_allclose(table.velocity[:, 0], [0.0, np.pi / 10])
    np.testing.assert_array_equal(table.acceleration[:, 0], [0.0, 1.0])


def test_limits_of_an_imported_motion_are_checked_between_its_rows_too(
    six_axis_limits, random_points
):
    motion = plan(random_points(1), six_axis_limits, speed=0.5)
    table = from_csv(to_csv(motion, 500.0, NAMES)).trajectory
    # A switch of jerk from limit to limit between rows adds 1.53 times the limit at most, for half
    # a period; three of them fall between the same two rows now and then.
    jerk = 3 * 1.53
    acceleration = jerk * 0.001 * six_axis_limits.jerk / six_axis_limits.acceleration
    check_limits(
        table,
        six_axis_limits.scaled(velocity=0.51, acceleration=1.0 + acceleration, jerk=1.0 + jerk),
    )
    with pytest.raises(LimitExceeded, match="velocity"):
        check_limits(table, six_axis_limits.scaled(velocity=0.45, acceleration=2.0, jerk=3.0))
    # A row that lies beside the motion is an impossible acceleration.
    lines = to_csv(motion, 500.0, NAMES).splitlines()
    cells = lines[200].split(",")
    cells[1] = repr(float(cells[1]) + 0.01)
    lines[200] = ",".join(cells)
    with pytest.raises(LimitExceeded):
        check_limits(from_csv("\n".join(lines)).trajectory, six_axis_limits)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "headings"),
        ("time [s]\n0\n1\n", "no joints"),
        ("a.position [rad]\n0\n1\n", "no column"),
        ("time [s],a.position [rad]\n0,0\n1,1\n", "no velocity"),
        ("time [s],time [s]\n0,0\n1,1\n", "twice"),
        ("time [s],a.torque [N·m]\n0,0\n1,1\n", "unknown"),
        ("time [s],a.velocity [rad]\n0,0\n1,1\n", "unknown"),
        ("time [s],.position [rad]\n0,0\n1,1\n", "unknown"),
        ("time [s],a.position [rad]\n0,0\n1\n", "row 2"),
        ("time [s],a.position [rad]\n0,0\n1,one\n", "row 2"),
        (
            "time [s],a.position [rad],a.velocity [rad/s],a.acceleration [rad/s^2]\n"
            "0,0,0,0\n0,0,0,0\n",
            "rise",
        ),
        (
            "time [s],a.position [rad],a.velocity [rad/s],a.acceleration [rad/s^2]\n"
            "0,0,0,0\n1,nan,0,0\n",
            "finite",
        ),
    ],
)
def test_refuses_a_table_that_is_no_motion(text, problem):
    with pytest.raises(InvalidTrajectory, match=problem):
        from_csv(text)


def test_refuses_a_rate_or_names_that_do_not_fit(six_axis_limits, random_points):
    motion = plan(random_points(1), six_axis_limits)
    for rate in (0.0, -1.0, np.nan, np.inf, 1.01e5):
        with pytest.raises(InvalidSetting):
            to_csv(motion, rate, NAMES)
    with pytest.raises(InvalidSetting):
        to_csv(motion, 10.0, NAMES[:5])
    with pytest.raises(InvalidSetting, match="different"):
        to_csv(motion, 10.0, NAMES[:5] + NAMES[:1])


def test_a_motion_of_no_duration_is_refused_for_no_table_can_tell_it(six_axis_limits):
    standing = plan(np.zeros((2, 6)), six_axis_limits)
    assert standing.duration == 0.0
    with pytest.raises(InvalidSetting, match="duration"):
        to_csv(standing, 100.0, NAMES)


def test_a_motion_shorter_than_rounding_has_its_two_ends_in_the_table(six_axis_limits):
    points = np.zeros((2, 6))
    points[1] = 1e-30
    motion = plan(points, six_axis_limits)
    assert 0.0 < motion.duration < 1e-9
    np.testing.assert_array_equal(
        from_csv(to_csv(motion, 1.0, NAMES)).trajectory.time, [0.0, motion.duration]
    )


HEAD = "time [s],a.position [rad],a.velocity [rad/s],a.acceleration [rad/s^2]\n"


def test_the_mark_that_spreadsheets_begin_a_table_with_is_passed_over():
    assert from_csv("\ufeff" + HEAD + "0,0,0,0\n1,1,0,0\n").joint_names == ("a",)


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "0,0,0," + "9" * 200_000 + "\n1,0,0,0\n",
        HEAD.replace("\n", "\r") + "0,0,0,0\r1,0,0,0\r",
        HEAD + "0,0,0,\x00\n1,0,0,0\n",
        HEAD + '0,0,0,"0\n1,0,0,0\n',
    ],
)
def test_a_damaged_table_is_an_invalid_motion(text):
    with pytest.raises(InvalidTrajectory):
        from_csv(text)
