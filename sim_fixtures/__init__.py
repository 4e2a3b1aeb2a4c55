"""The simulated cell: a robot with its controller, the peer of the PC in tests.

It shares no conversion, friction or regressor code with what it tests, only the packet codec, which
is also tested against captures of foreign programs.
"""

from __future__ import annotations

from sim_fixtures.arm import UnmodelledEffects
from sim_fixtures.controller import Phase, SimulatedController
from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.plant import ElasticPlant, Plant, PlantTruth
from sim_fixtures.settings import (
    ControllerSettings,
    PlantDiverged,
    ServoSettings,
    SettingError,
    SimulationError,
)

__all__ = [
    "SimulatedController",
    "ControllerSettings",
    "ServoSettings",
    "Phase",
    "SimulatedDrive",
    "Plant",
    "ElasticPlant",
    "PlantTruth",
    "UnmodelledEffects",
    "SimulationError",
    "SettingError",
    "PlantDiverged",
]
