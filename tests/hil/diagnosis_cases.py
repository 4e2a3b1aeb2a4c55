"""Logs with a known fault, and how far from the truth is what is identified from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pinocchio as pin
import pytest

from hil.identified.identified_arm import IdentifiedArm, arm_from
from hil.importers.recording_import import ImportOptions

CASES: Final = Path(__file__).parents[3] / "shared" / "cases" / "diagnosis"
URDF: Final = CASES / "arm.urdf"
TOO_HEAVY: Final = 1.08  # masses of that URDF over those of the arm

needs_the_cases = pytest.mark.skipif(
    not CASES.is_dir(), reason="the logs with a known fault are not here"
)


def identified(log: Path, **options: Any) -> IdentifiedArm:
    return arm_from(log, URDF, None, (), ImportOptions(**options), None, None)


def rigid_error(arm: IdentifiedArm) -> float:
    """Error of the torque of the identified bodies at random states, by pinocchio."""
    true = pin.buildModelFromUrdf(str(URDF))
    found = arm.model
    random = np.random.default_rng(0)
    torques = []
    for _ in range(200):
        states = [random.uniform(-1.5, 1.5, 6) * factor for factor in (1.0, 1.0, 3.0)]
        expected = pin.rnea(true, true.createData(), *states) / TOO_HEAVY
        torque = pin.rnea(found, found.createData(), *states)
        torques.append((expected, torque - found.armature * states[2]))  # not of the URDF
    true_torque, torque = (np.array(each) for each in zip(*torques, strict=True))
    return float(np.sqrt(np.mean((torque - true_torque) ** 2) / np.mean(true_torque**2)))
