"""A simulated Universal Robots controller and arm: the controller's end of RTDE.

It shares no code with the PC's end (`drivers.ur`), not even the packing of frames, so that an error
of one side cannot cancel on the other; programs of others read it in the tests.
"""

from __future__ import annotations

from sim_fixtures.ur.arm import CELL_PATH, UR5E_URDF, SimulatedUrArm, UrArmTruth
from sim_fixtures.ur.controller import SimulatedUr, UrFault, UrProgram, UrSettings
from sim_fixtures.ur.server import UrServer

__all__ = [
    "CELL_PATH",
    "SimulatedUr",
    "SimulatedUrArm",
    "UR5E_URDF",
    "UrArmTruth",
    "UrFault",
    "UrProgram",
    "UrServer",
    "UrSettings",
]
