"""What is believed of a robot before any data: its URDF and the cell's `[nominal]`."""

from __future__ import annotations

from hil.cell import Cell
from hil.cell.schema import NominalTable
from hil.errors import InputError
from identification import IdentificationError, RobotModel
from identification.estimators.prior import GaussianPrior, nominal_prior

# Friction changes with temperature, lubricant and wear by tens of per cent (Bittencourt and
# Gunnarsson 2012): a data sheet's is no better than to half of itself.
FRICTION_SHARE = 0.5


def cad_prior(cell: Cell) -> GaussianPrior | str:
    """Prior of a cell; in words why it has none.

    The URDF's inertias are believed to `[nominal] uncertainty` (10 % without that table), rotor
    inertias of the table likewise, its friction to `FRICTION_SHARE`. Of what neither gives
    nothing is believed.
    """
    table = cell.file.nominal
    try:
        if table is None or table.uncertainty == 0.0:
            return nominal_prior(cell.model, known=_known(cell.model, table, 0.0))
        known = _known(cell.model, table, table.uncertainty)
        return nominal_prior(cell.model, table.uncertainty, known)
    except IdentificationError as error:
        return str(error)


def required(prior: GaussianPrior | str) -> GaussianPrior:
    """The prior of a cell, for an estimator that needs one.

    Raises:
        InputError: there is none.
    """
    if isinstance(prior, str):
        raise InputError(
            None,
            f"there is no prior to be had: {prior}",
            field="--estimator prior",
            remedy="give inertias in the URDF, or use --estimator wls",
        )
    return prior


def _known(
    model: RobotModel, table: NominalTable | None, share: float
) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation by name of what the table gives and the model has."""
    if table is None:
        return {}
    share = share or FRICTION_SHARE
    known = {f"I{j}m": (value, share * value) for j, value in enumerate(table.rotor_inertia, 1)}
    for name, term, owner, motor, _ in model.friction.terms:
        values = getattr(table, term.option, None)
        if values and not motor:
            known[name] = values[owner], FRICTION_SHARE * abs(values[owner])
    names = {*model.standard_names, *model.friction.names}
    return {name: one for name, one in known.items() if one[0] != 0.0 and name in names}
