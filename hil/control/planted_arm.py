"""The true parameters of a simulated arm, by the cell file."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hil.base.arrays import Array
from hil.cell import Cell, CellError
from identification.model.known_payload import Payload
from identification.model.pseudo_inertia import body
from sim_fixtures import PlantTruth, UnmodelledEffects
from sim_fixtures.plant import Carried


def planted_truth(cell: Cell) -> PlantTruth:
    """Return the true rotor inertias, friction and link inertias, or raise CellError.

    The simulated arm carries `[robot.payload]`, and its controller knows it.
    """
    settings = cell.simulation
    return PlantTruth(
        rotor_inertia=np.array(settings.rotor_inertia),
        coulomb=np.array(settings.coulomb),
        viscous=np.array(settings.viscous),
        third=np.array(settings.third),
        third_law=_third_law(cell),
        inertia_scale=np.array(settings.inertia_scale or [1.0]),
        carried=carried(cell, cell.model.payload),
    )


def carried(cell: Cell, payload: Payload | None) -> Carried | None:
    """Return a payload as the body on the simulated arm (ModelError: not on a moving link)."""
    if payload is None or payload.mass == 0.0:
        return None
    joint, inertial = payload.carried_by(cell.model.chain)
    return Carried(joint, *body(inertial))


def _third_law(cell: Cell) -> Literal["quadratic", "cubic"]:
    """Return the third friction term of the simulated arm."""
    joints = zip(cell.joint_names, cell.model.friction.laws, cell.simulation.third, strict=True)
    planted = {name: law.third for name, law, third in joints if third}
    laws = set(planted.values()) - {None}
    if len(laws) > 1:
        raise CellError(
            cell.path,
            "robot.friction.joints",
            None,
            f"quadratic and cubic terms in {', '.join(planted)}; a simulated arm has only one",
            "give all joints of the simulated arm the same third term",
        )
    return "cubic" if laws == {"cubic"} else "quadratic"


def planted_values(cell: Cell) -> Array:
    """Return the true parameters (p,) in the order of the cell's model."""
    truth = planted_truth(cell)
    return cell.parameter_values(
        rotor_inertia=truth.rotor_inertia,
        coulomb=truth.coulomb,
        viscous=truth.viscous,
        third=truth.third,
        inertia_scale=truth.inertia_scale,
    )


def unmodelled_effects(cell: Cell) -> UnmodelledEffects:
    """Return the unmodelled effects with the sizes of the cell."""
    settings = cell.simulation
    return UnmodelledEffects(
        torque_ripple=settings.torque_ripple,
        friction_drift=settings.friction_drift,
        elasticity=tuple(settings.elasticity),
        delay=settings.delay,
    )
