"""What else looks at a URDF finds in one with a default namespace what the model has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from hil.campaign.folder import MESH, MISSING, checksums
from hil.cell.text import urdf_limits
from sim_fixtures.plant import build_model
from tests.hil.new_cells import TWO_JOINTS

DRAKES = TWO_JOINTS.replace('"1.0"', '"1.0" encoding="GB2312"').replace(
    "<robot ", '<robot xmlns="http://drake.mit.edu" xmlns:gazebo="x" gazebo:y="z" '
)


def test_limits() -> None:
    np.testing.assert_array_equal(
        urdf_limits(DRAKES, ["hip", "knee"]), urdf_limits(TWO_JOINTS, ["hip", "knee"])
    )
    assert urdf_limits(DRAKES, ["hip"]).upper[0] == 2.0


def test_a_simulated_arm_gets_other_inertias() -> None:
    plain, drakes = (
        build_model(text, (0.0, 0.0, -9.81), np.zeros(2), (1.1, 0.9))
        for text in (TWO_JOINTS, DRAKES)
    )
    masses = [inertia.mass for inertia in drakes.inertias]
    assert masses == [inertia.mass for inertia in plain.inertias]
    assert masses[1] == 1.1 * pin.buildModelFromXML(TWO_JOINTS).inertias[1].mass


def test_a_simulated_joint_that_turns_on_and_on_has_one_angle() -> None:
    assert build_model(DRAKES, (0.0, 0.0, -9.81), np.zeros(2)).nq == 2


def test_meshes_are_sealed(tmp_path: Path) -> None:
    urdf = DRAKES.replace('<box size="0.08 0.08 0.3"/>', '<mesh filename="a.stl"/>')
    assert checksums({"robot.urdf": urdf.encode()}, tmp_path)[f"{MESH}a.stl"] == MISSING
