"""The simulated cell of a cell file: a controller in virtual time at the other end of the link."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from drivers.transports import SimulatedTransport
from hil.campaign import Link
from hil.cell import Cell, CellError
from sim_fixtures import (
    ControllerSettings,
    PlantTruth,
    SimulatedController,
    SimulatedDrive,
    UnmodelledEffects,
)

Array = NDArray[np.float64]


def simulated_link(
    cell: Cell,
    *,
    effects: bool = False,
    drive: SimulatedDrive | None = None,
    truth: PlantTruth | None = None,
) -> Link:
    """A link to a simulated controller of this cell; one seed in the cell is one run.

    Args:
        cell: names the planted truth in `[simulation]`.
        effects: switch on what the model leaves out, at the sizes the cell names.
        drive: what the robot really has, where it shall differ from the cell's drive train.
        truth: rotor inertias and friction of the plant, where they shall differ from the cell's.
    """
    controller = simulated_controller(cell, effects=effects, drive=drive, truth=truth)
    return Link.over(SimulatedTransport(controller), cell, finish=controller.finish)


def simulated_controller(
    cell: Cell,
    *,
    effects: bool = False,
    drive: SimulatedDrive | None = None,
    truth: PlantTruth | None = None,
) -> SimulatedController:
    """The controller and arm that `simulated_link` connects to."""
    settings = cell.simulation
    if cell.controller.transport != "simulated":
        raise CellError(
            cell.path,
            "controller.transport",
            cell.controller.transport,
            "a cell of real hardware is not simulated",
            'write "simulated" to try it without',
        )
    announced = simulated_drive(cell)
    return SimulatedController(
        cell.urdf,
        drive or announced,
        truth or planted_truth(cell),
        ControllerSettings(
            period=cell.period,
            open_mode=cell.controller.mode,
            # Springs and a delay of half a cycle need steps shorter than the cycle; rigid gears,
            # integrated to second order under a current that is constant over it, do not.
            substeps=2 if effects else 1,
            current_noise=settings.current_noise,
            current_resolution=settings.current_resolution,
        ),
        seed=settings.seed,
        effects=unmodelled_effects(cell) if effects else UnmodelledEffects(),
        initial_position=cell.initial,
        gravity=cell.file.robot.gravity,
        announced=announced,
    )


def simulated_drive(cell: Cell) -> SimulatedDrive:
    """The cell's drive train as the simulated robot has it, by its own formulas."""
    table = cell.drive_table
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


def planted_truth(cell: Cell) -> PlantTruth:
    """Rotor inertias and friction planted in the plant."""
    settings = cell.simulation
    third = cell.file.robot.friction.third
    return PlantTruth(
        rotor_inertia=np.array(settings.rotor_inertia),
        coulomb=np.array(settings.coulomb),
        viscous=np.array(settings.viscous),
        third=np.array(settings.third),
        third_law="cubic" if third == "cubic" else "quadratic",
    )


def unmodelled_effects(cell: Cell) -> UnmodelledEffects:
    """What the model leaves out, at the sizes the cell names."""
    settings = cell.simulation
    return UnmodelledEffects(
        torque_ripple=settings.torque_ripple,
        friction_drift=settings.friction_drift,
        elasticity=tuple(settings.elasticity),
        delay=settings.delay,
    )


def simulated_provenance(cell: Cell, effects: bool) -> dict[str, str]:
    """Metadata that marks an archive as simulated, and with what."""
    sizes = unmodelled_effects(cell) if effects else UnmodelledEffects()
    elasticity = ", ".join(f"{compliance:g}" for compliance in sizes.elasticity)
    described = {
        f"torque ripple of {sizes.torque_ripple:.0%} of the Coulomb torque": sizes.torque_ripple,
        f"friction drift of {sizes.friction_drift:.0%} from cold to hot": sizes.friction_drift,
        f"elasticity of {elasticity} rad/(N·m)": any(sizes.elasticity),
        f"delay of {1e3 * sizes.delay:g} ms": sizes.delay,
    }
    switched_on = [text for text, size in described.items() if size]
    return {
        "simulated": "yes",
        "seed": str(cell.simulation.seed),
        "effects": json.dumps(switched_on),
    }


def planted_values(cell: Cell) -> Array:
    """The planted parameter vector (p,) in the order of the cell's model."""
    truth = planted_truth(cell)
    return cell.parameter_values(
        rotor_inertia=truth.rotor_inertia,
        coulomb=truth.coulomb,
        viscous=truth.viscous,
        third=truth.third,
    )


__all__ = [
    "planted_truth",
    "planted_values",
    "simulated_controller",
    "simulated_drive",
    "simulated_link",
    "simulated_provenance",
    "unmodelled_effects",
]
