"""cell.toml of the NS 16 agrees with the truth, the geometry and itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from sim_fixtures import ControllerSettings, ns16
from sim_fixtures.ns16 import geometry

Array = NDArray[np.float64]


def test_the_planted_figures_are_those_of_the_truth(cell: dict[str, Any]) -> None:
    planted, truth = cell["simulation"], ns16.load_truth()
    for name in ("rotor_inertia", "coulomb", "viscous", "third"):
        assert tuple(planted[name]) == getattr(truth, name), name


class TestNominal:
    """Law: figures known before the arm moves are 10 to 20 % off the planted ones, both ways."""

    @pytest.mark.parametrize("name", ["rotor_inertia", "coulomb", "viscous"])
    def test_drives(self, cell: dict[str, Any], name: str) -> None:
        self.check(np.divide(cell["nominal"][name], cell["simulation"][name]))

    def test_links(self) -> None:
        """The planted links are those of Table 2, however the URDF of the cell has them."""
        nominal, planted = (
            np.array([body.toDynamicParameters() for body in list(model.inertias)[1:]])
            for model in (
                pin.buildModelFromXML(text)
                for text in (ns16.URDF_PATH.read_text(encoding="utf-8"), ns16.urdf_text())
            )
        )
        scale = nominal[:, 0] / planted[:, 0]
        self.check(scale)
        np.testing.assert_allclose(nominal, scale[:, None] * planted, rtol=1e-12, atol=1e-14)

    def check(self, share: Array) -> None:
        errors = np.abs(share - 1.0)
        assert np.all((errors > 0.0995) & (errors < 0.2005))  # figures of 4 digits
        assert share.min() < 1.0 < share.max()


def test_the_limits_and_signs_are_those_of_the_geometry(cell: dict[str, Any]) -> None:
    limits, train = cell["limits"], cell["drive_train"]
    assert limits["frame"] == "controller"
    assert tuple(limits["lower_deg"]) == geometry.LOWER_DEG
    assert tuple(limits["upper_deg"]) == geometry.UPPER_DEG
    assert tuple(limits["velocity_deg"]) == geometry.VELOCITY_DEG
    assert tuple(train["joint_sign"]) == geometry.JOINT_SIGN
    assert tuple(train["joint_offset_deg"]) == geometry.JOINT_OFFSET_DEG
    assert tuple(cell["campaign"]["home_deg"]) == geometry.HOME_DEG


def test_nothing_of_the_drive_train_is_trivial(cell: dict[str, Any]) -> None:
    """Zeros would hide mistakes in coupling and calibration."""
    train = cell["drive_train"]
    assert all(train[k] for k in ("k54", "k64", "k65"))
    assert all(train["calibration"])
    assert len({np.sign(ratio) for ratio in train["gear_ratio"]}) == 2


def test_every_assumed_field_exists(cell: dict[str, Any]) -> None:
    for path in cell["cell"]["assumed"]:
        section, name = path.split(".")
        assert name in cell[section], path


def test_everything_unpublished_about_the_drives_is_marked_assumed(cell: dict[str, Any]) -> None:
    assumed = set(cell["cell"]["assumed"])
    published = {"joint_sign", "joint_offset_deg"}
    for name in set(cell["drive_train"]) - published:
        assert f"drive_train.{name}" in assumed


def test_the_stated_current_delay_is_that_of_the_default_servo(cell: dict[str, Any]) -> None:
    settings = ControllerSettings()
    assert cell["controller"]["cycle_ms"] == 1000.0 * settings.period
    delay = 0.5 - settings.servo.current_lag / settings.period
    assert cell["controller"]["current_delay_cycles"] == delay
