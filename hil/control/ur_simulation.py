"""The simulated Universal Robots controller and arm of a cell file, served on its ports."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.ur.identity import MODELS
from drivers.ur.outputs import N_JOINTS
from hil.base.errors import InputError
from hil.cell import Cell
from hil.control.simulated_cell import planted_truth
from sim_fixtures.settings import SettingError, SimulationError
from sim_fixtures.ur import (
    SimulatedUr,
    UrArmTruth,
    UrProgram,
    UrServer,
    UrSettings,
)
from sim_fixtures.ur.controller import parse_ur_fault

_CB3 = (3, 15, 8, 0)
_WITHIN = 0.9
"""Share of the distance to the limits that the program's motion uses."""


def served_arm(
    cell: Cell,
    *,
    own_speed: float | None = None,
    faults: Sequence[str] = (),
    seed: int | None = None,
) -> UrServer:
    """Return a server of the arm of a cell at its address; it listens already.

    Args:
        cell: with the true parameters in `[simulation]`, and transport "rtde".
        own_speed: share of the velocity limits at which its own program moves it; None for rest.
        faults: KIND@CYCLE[xCOUNT], see `UrFault`.
        seed: of the noise, that of the cell by default.

    Raises:
        InputError: another number of joints, an invalid fault, or a port that cannot be opened.
    """
    if len(cell.joint_names) != N_JOINTS:
        problem = f"has {len(cell.joint_names)} joints; an arm on RTDE has {N_JOINTS}"
        raise cell.error("cell.urdf", cell.file.cell.urdf, problem, "name a cell of six joints")
    table = cell.controller
    try:
        robot = SimulatedUr(
            _settings(cell),
            _program(cell, own_speed),
            truth=_truth(cell),
            faults=[parse_ur_fault(text) for text in faults],
            seed=cell.simulation.seed if seed is None else seed,
            repeats=True,
            urdf=cell.urdf,
        )
        return UrServer(
            robot,
            table.host,
            rtde=table.rtde.port,
            primary=table.rtde.primary_port,
            dashboard=table.rtde.dashboard_port,
        )
    except (SettingError, SimulationError) as error:
        raise InputError(None, str(error)) from error


def _settings(cell: Cell) -> UrSettings:
    table = cell.controller.rtde
    base = table.model.removesuffix("e")
    kind = next((number for number, name in MODELS.items() if name == base), 1)
    default = UrSettings()
    return UrSettings(
        version=_CB3 if cell.controller.cycle_ms == round(1e3 / 125) else default.version,
        serial_number=cell.file.cell.serial_number or default.serial_number,
        model=base or default.model,
        kind=kind,
    )


def _truth(cell: Cell) -> UrArmTruth:
    """Return the planted arm: its torque constants differ from those of the cell as a UR5e's do."""
    default = UrArmTruth()
    drives = cell.drive_train
    stated = drives.torque_constant * np.abs(np.diag(drives.motor_from_joint))
    nominal = cell.nominal
    return UrArmTruth(
        plant=planted_truth(cell),
        torque_constant=stated * default.torque_constant / default.stated_constant,
        stated_constant=stated,
        coulomb=np.array(nominal.coulomb),
        viscous=np.array(nominal.viscous),
        quadratic=np.zeros(N_JOINTS),
        current_noise=cell.simulation.current_noise,
    )


def _program(cell: Cell, own_speed: float | None) -> UrProgram | None:
    """Return a motion about the initial posture, within limits and a share of the speeds."""
    if own_speed is None:
        return None
    limits = cell.joint_limits
    pattern = UrProgram()
    order = np.arange(1, pattern.amplitude.shape[1] + 1)
    reach = np.abs(pattern.amplitude).sum(axis=1)
    speed = np.abs(pattern.amplitude) @ (2.0 * np.pi / pattern.period * order)
    room = np.minimum(limits.upper - cell.initial, cell.initial - limits.lower)
    factor = np.minimum(own_speed * limits.velocity / speed, _WITHIN * room / reach)
    return UrProgram(cell.initial, pattern.amplitude * np.clip(factor, 0.0, None)[:, None])
