from __future__ import annotations

import numpy as np
import pytest

from planner import InvalidSetting, plan, to_csv
from tests.motion_table import MotionTable

NAMES = ("axis 1", "wrist, long", "j3", "j4", "j5", "j6")


class TestMotionAsCsv:
    """A motion as a table that spreadsheets and other programs read."""

    @pytest.mark.parametrize("rate", [7.0, 100.0, 1000.0 / 3.0])
    def test_holds_every_bit_of_the_samples(self, six_axis_limits, random_points, rate):
        motion = plan(random_points(1), six_axis_limits)
        table = MotionTable.of(to_csv(motion, rate, NAMES))
        assert table.joint_names == NAMES
        assert table.duration == motion.duration
        np.testing.assert_array_equal(table.time[:-1], np.arange(len(table.time) - 1) / rate)
        assert 0.0 < table.time[-1] - table.time[-2] <= 1.0 / rate + 1e-9
        rows = (table.position, table.velocity, table.acceleration)
        for ours, theirs in zip(rows, motion.sample(table.time), strict=True):
            assert ours.tobytes() == np.ascontiguousarray(theirs).tobytes()

    def test_headings_name_joint_quantity_and_unit(self, six_axis_limits, random_points):
        motion = plan(random_points(1), six_axis_limits)
        heading = to_csv(motion, 10.0, [f"j{i}" for i in range(6)]).splitlines()[0]
        assert heading.startswith(
            "time [s],j0.position [rad],j0.velocity [rad/s],j0.acceleration [rad/s^2],j1.position"
        )

    def test_refuses_a_rate_or_names_that_do_not_fit(self, six_axis_limits, random_points):
        motion = plan(random_points(1), six_axis_limits)
        for rate in (0.0, -1.0, np.nan, np.inf, 1.01e5):
            with pytest.raises(InvalidSetting):
                to_csv(motion, rate, NAMES)
        with pytest.raises(InvalidSetting):
            to_csv(motion, 10.0, NAMES[:5])
        with pytest.raises(InvalidSetting, match="different"):
            to_csv(motion, 10.0, NAMES[:5] + NAMES[:1])

    def test_a_motion_of_no_duration_is_refused_for_no_table_can_tell_it(self, six_axis_limits):
        standing = plan(np.zeros((2, 6)), six_axis_limits)
        assert standing.duration == 0.0
        with pytest.raises(InvalidSetting, match="duration"):
            to_csv(standing, 100.0, NAMES)

    def test_a_motion_shorter_than_rounding_has_its_two_ends_in_the_table(self, six_axis_limits):
        points = np.zeros((2, 6))
        points[1] = 1e-30
        motion = plan(points, six_axis_limits)
        assert 0.0 < motion.duration < 1e-9
        np.testing.assert_array_equal(
            MotionTable.of(to_csv(motion, 1.0, NAMES)).time, [0.0, motion.duration]
        )
