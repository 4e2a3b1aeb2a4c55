"""Simulated controller and arm of a cell file, linked in virtual time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from drivers.transports.simulated import SimulatedTransport
from hil.base.arrays import Array
from hil.cell import AngleFrame, Cell, CellError
from hil.control.motion_checks import collision_checker
from hil.control.own_moves import InterpolatedMoves
from hil.control.planted_arm import carried, planted_truth, unmodelled_effects
from hil.control.ur_simulation import ur_link
from hil.control.virtual_link import VirtualLink
from identification.text import percentage
from sim_fixtures import (
    ControllerSettings,
    PlantTruth,
    SimulatedController,
    SimulatedDrive,
    UnmodelledEffects,
)
from sim_fixtures.faults import InjectedFault
from sim_fixtures.servo import loops_per_cycle

NOISE_SHARE: Final = 0.005  # Noise of the current, rms, as a share of the weakest motor's limit
RESOLUTION_SHARE: Final = 0.001  # Resolution of the target current, as a share of the same limit
SUBSTEP_SECONDS = 0.0005
"""Step of a simulated arm with effects that the model leaves out, s."""
OWN_SPEED_SHARE = 0.3
"""Speed of the controller's own motion, as a share of the velocity limits."""
_CHECKED_POSTURES = 100
"""Postures checked on each path of the controller's own motion."""
_OWN_MOTION_POSTURES = 12
"""Postures of that motion before home."""


def simulated_link(
    cell: Cell,
    *,
    effects: bool = False,
    drive: SimulatedDrive | None = None,
    truth: PlantTruth | None = None,
    instead_of_hardware: bool = False,
    only_axis: int | None = None,
    session: int = 0,
) -> VirtualLink:
    """Return a link in virtual time to a simulated controller; runs are reproducible by seed.

    Args:
        cell: with the true parameters in `[simulation]`.
        effects: whether to simulate unmodelled effects, with the sizes of the cell.
        drive: true drive train; default: the cell's.
        truth: true parameters, by default of the cell.
        instead_of_hardware: also simulate a cell with a real link.
        only_axis: number, from 1, of the only axis that is opened; None for all.
        session: number of earlier sessions of the controller; each has noise of its own.

    Raises:
        CellError: the cell is one of real hardware.
    """
    if cell.controller.transport != "simulated" and not instead_of_hardware:
        raise CellError(
            cell.path,
            "controller.transport",
            cell.controller.transport,
            "a cell of real hardware is not simulated",
            'set it to "simulated" to run without hardware',
        )
    if cell.is_ur:
        return ur_link(cell, session=session, effects=effects)
    settings = replace(controller_settings(cell, effects=effects), only_axis=only_axis)
    controller = simulated_controller(
        cell, effects=effects, drive=drive, truth=truth, settings=settings, session=session
    )
    transport = SimulatedTransport(controller)
    return VirtualLink.over(transport, cell, finish=controller.finish, only_axis=only_axis)


def assumed_simulation(cell: Cell) -> dict[str, Any]:
    """Return initial posture and noise of `[simulation]` for a cell without it.

    The posture is home, or the middle of the ranges without `[campaign]`.
    """
    weakest = min(cell.drive_table.current_limit)
    table = cell.file.campaign
    limits = cell.joint_limits
    middle = AngleFrame.of(cell).shown((limits.lower + limits.upper) / 2.0)
    return {
        "initial_deg": middle.tolist() if table is None else table.home_deg,
        "current_noise": NOISE_SHARE * weakest,
        "current_resolution": RESOLUTION_SHARE * weakest,
    }


def with_simulation(cell: Cell) -> Cell:
    """Return the cell with `[simulation]`: where it has none, with the values of `[nominal]`."""
    if cell.file.simulation is not None:
        return cell
    nominal = cell.nominal
    table = {
        "rotor_inertia": nominal.rotor_inertia,
        "coulomb": nominal.coulomb,
        "viscous": nominal.viscous,
        "third": nominal.third or [0.0] * len(cell.joint_names),
        **assumed_simulation(cell),
    }
    return cell.with_values({f"simulation.{key}": value for key, value in table.items()})


def simulated_controller(
    cell: Cell,
    *,
    effects: bool = False,
    drive: SimulatedDrive | None = None,
    truth: PlantTruth | None = None,
    settings: ControllerSettings | None = None,
    seed: int | None = None,
    session: int = 0,
    faults: Sequence[InjectedFault] = (),
    own_speed: float = OWN_SPEED_SHARE,
) -> SimulatedController:
    """Return controller and arm of a cell with any link.

    The init packet states the drive train of the cell, not `drive`.

    Args:
        cell: that is simulated.
        effects: as for `simulated_link`.
        drive: likewise.
        truth: likewise.
        settings: by default `controller_settings(cell)`.
        seed: of the noise; default: the cell's.
        session: as for `simulated_link`.
        faults: likewise.
        own_speed: share of the velocity limits at which the moves of an own program run.
    """
    nominal_drive = simulated_drive(cell)
    settings = settings or controller_settings(cell, effects=effects)
    return SimulatedController(
        cell.urdf,
        drive or nominal_drive,
        truth or planted_truth(cell),
        settings,
        seed=cell.simulation.seed if seed is None else seed,
        session=session,
        effects=unmodelled_effects(cell) if effects else UnmodelledEffects(),
        initial_position=cell.initial,
        gravity=cell.file.robot.gravity,
        stated=nominal_drive,
        entered=carried(cell, cell.model.payload),
        faults=faults,
        moves=InterpolatedMoves(cell.joint_limits, settings.period, own_speed),
    )


def controller_settings(cell: Cell, *, effects: bool = False) -> ControllerSettings:
    """Return cycle, mode and noise of the simulated controller."""
    return ControllerSettings(
        period=cell.period,
        open_mode=cell.controller.mode,
        # Elastic gears and a delay of 0.5 ms need steps of 0.5 ms; rigid gears are integrated to
        # second order under a constant current.
        substeps=round(cell.period / loops_per_cycle(cell.period) / SUBSTEP_SECONDS)
        if effects
        else 1,
        current_noise=cell.simulation.current_noise,
        current_resolution=cell.simulation.current_resolution,
    )


def own_postures(cell: Cell) -> tuple[tuple[float, ...], ...]:
    """Return postures (joint angles, rad) of the controller's own program, home at the end.

    Random within half of each joint's range around home, by the cell's seed, with collision-free
    straight motions in between; there may be fewer than 13.
    """
    rng = np.random.default_rng(cell.simulation.seed)
    limits = cell.joint_limits
    home = cell.home
    reach = np.minimum(0.25 * (limits.upper - limits.lower), np.pi)
    checker = collision_checker(cell)

    def clear(start: Array, end: Array) -> bool:
        share = np.linspace(0.0, 1.0, _CHECKED_POSTURES)[:, np.newaxis]
        return bool(checker.clear(start + share * (end - start)).all())

    here = cell.initial
    postures: list[Array] = []
    for _ in range(10 * _OWN_MOTION_POSTURES):
        there = np.clip(
            home + reach * rng.uniform(-1.0, 1.0, len(home)), limits.lower, limits.upper
        )
        if len(postures) < _OWN_MOTION_POSTURES and clear(here, there):
            postures.append(there)
            here = there
    if clear(here, home):
        postures.append(home)
    return tuple(tuple(posture.tolist()) for posture in postures)


def simulated_drive(cell: Cell) -> SimulatedDrive:
    """Return the true drive train: the cell's, overridden by `[simulation.drive_train]`."""
    simulation = cell.file.simulation
    stated = {} if simulation is None else simulation.drive_train.model_dump(exclude_none=True)
    table = cell.drive_table.model_copy(update=stated)
    return SimulatedDrive(
        gear_ratio=tuple(table.gear_ratio),
        calibration=tuple(table.calibration),
        joint_sign=tuple(float(sign) for sign in table.joint_sign),
        joint_offset=tuple(np.radians(table.joint_offset_deg).tolist()),
        torque_constant=tuple(table.torque_constant),
        current_limit=tuple(table.current_limit),
        following_error=tuple(table.following_error),
        encoder_counts=table.encoder_counts_per_revolution,
        k54=table.k54,
        k64=table.k64,
        k65=table.k65,
    )


def simulated_provenance(cell: Cell, effects: bool) -> dict[str, str]:
    """Return the metadata of a simulated archive."""
    sizes = unmodelled_effects(cell) if effects else UnmodelledEffects()
    pairs = zip(cell.joint_names, sizes.elasticity, strict=False)  # none without effects
    elasticity = ", ".join(f"{joint} {compliance:g}" for joint, compliance in pairs)
    ripple = percentage(sizes.torque_ripple)
    drift = percentage(sizes.friction_drift)
    described = {
        f"torque ripple of {ripple} of the Coulomb torque": sizes.torque_ripple,
        f"friction drift of {drift} from cold to hot": sizes.friction_drift,
        f"elasticity of {elasticity} rad/(N·m)": any(sizes.elasticity),
        f"delay of {1e3 * sizes.delay:g} ms": sizes.delay,
    }
    switched_on = [text for text, size in described.items() if size]
    return {
        "simulated": "yes",
        "seed": str(cell.simulation.seed),
        "effects": json.dumps(switched_on),
    }
