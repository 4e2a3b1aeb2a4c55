"""Init packets that are answered although nothing can be moved with them, and why."""

from __future__ import annotations

import numpy as np
import pytest
from rig import N, Rig, init_packet, still

from drivers import InitReceived, Mode, RequestError


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
        rig.modes = Mode.POSITION
        assert (rig.cycle().axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        rig.modes = Mode.CLOSED
        rig.cycle()
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
        rig = Rig(init=init)
        rig.start()
        assert rig.seen(InitReceived)[0].unusable
        rig.modes = Mode.CLOSED
        assert rig.cycle() is not None
        with pytest.raises(RequestError):
            rig.session.request(still(3))
        rig.modes = Mode.POSITION
        assert (rig.cycle().axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert (rig.cycle().axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert np.isnan(rig.records["position"]).all()
