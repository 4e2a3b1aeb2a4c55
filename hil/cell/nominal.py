"""Nominal model of the arm of a cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.base.arrays import Array
from identification.model.nominal_masses import mass_fault

from .cell import Cell


class Nominal(NamedTuple):
    """Nominal model of an arm."""

    values: Array  #: parameters (p,)
    label: str  #: description
    rotors_known: bool
    share: float | None = None  #: relative uncertainty of its torque, None: of its bodies


def nominal_of(cell: Cell) -> Nominal | None:
    """Return the model of `[nominal]`, else of the URDF's inertias; None without masses."""
    table = cell.file.nominal
    model = cell.model
    if table is not None:
        has_rotors = bool(np.any(table.rotor_inertia))
        return Nominal(cell.nominal_values(), "the nominal values", has_rotors, table.uncertainty)
    standard = model.nominal
    if mass_fault(model) is not None:
        return None
    values = np.zeros(model.n_parameters)
    values[: model.base.rank] = model.base.grouping @ standard
    values[model.element_part] = model.elements.nominal
    label = "the URDF's inertias, without friction and rotors"
    return Nominal(values, label, False)
