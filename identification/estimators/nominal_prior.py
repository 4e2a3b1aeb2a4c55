"""Prior on the parameters from the inertia that a URDF gives (CAD)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.prior import GaussianPrior
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

# CAD leaves out cables, grease and fasteners, and castings differ from their drawings. Ten per
# cent is an assumption, to be replaced by what is known of an arm.
NOMINAL_SHARE: Final = 0.1
_INERTIA, _MOMENT, _MASS = slice(0, 6), slice(6, 9), 9


def nominal_prior(
    model: RobotModel,
    share: float = NOMINAL_SHARE,
    known: Mapping[str, tuple[float, float]] | None = None,
) -> GaussianPrior:
    """Prior from the inertia in the URDF.

    The mass of a link is believed to `share` of itself, its first moments and its inertia to
    `share` of the largest among them, so that a zero in the CAD is no certainty. A link whose
    first moments are all zero gets those of its radius of gyration, one without inertia the
    largest on the arm. A URDF says nothing about rotor inertia, friction and springs: of these
    nothing is believed unless they are known. The belief is in the standard parameters; that in
    their base groups, and how they correlate, follows.

    Args:
        model: the robot.
        share: of the nominal value.
        known: mean and standard deviation by name, of standard parameters (replacing the
            nominal) and of all others: `{"I3m": (1.2, 0.2), "f0_1": (40.0, 40.0)}`.

    Raises:
        IdentificationError: the URDF has no inertia, a name is unknown, the share not positive.
    """
    if not share > 0.0:
        raise IdentificationError(f"the nominal parameters' uncertainty is {share}, not positive")
    others = model.parameter_names[model.base.rank :]  # friction, springs and balancers
    names = model.standard_names + others
    mean = np.concatenate([model.nominal, np.zeros(len(others))])
    std = np.concatenate([_nominal_std(model, share), np.full(len(others), np.inf)])
    for name, (value, deviation) in (known or {}).items():
        if name not in names:
            raise IdentificationError(f"the model has no parameter {name!r} to be known")
        mean[names.index(name)], std[names.index(name)] = value, deviation
    combinations = np.zeros((model.n_parameters, len(names)))
    combinations[: model.base.rank, : len(model.standard_names)] = model.base.grouping
    combinations[model.base.rank :, len(model.standard_names) :] = np.eye(len(others))
    extra = f", {len(known)} given" if known else ""
    return GaussianPrior.of_combinations(
        combinations, mean, std, f"nominal parameters to {100.0 * share:g} %{extra}"
    )


def _nominal_std(model: RobotModel, share: float) -> Array:
    """Standard deviations of the standard parameters (s,), infinite for what turns on motors."""
    values = np.abs(model.nominal[model.layout.links])
    inertia, mass = values[:, _INERTIA].max(axis=1), values[:, _MASS].copy()
    if not (inertia.any() and mass.any()):
        raise IdentificationError("the URDF gives no inertia to make a prior from")
    inertia[inertia == 0.0], mass[mass == 0.0] = inertia.max(), mass.max()
    moment = values[:, _MOMENT].max(axis=1)
    moment = np.where(moment > 0.0, moment, np.sqrt(mass * inertia))
    links = np.empty(values.shape)
    links[:, _INERTIA] = share * inertia[:, None]
    links[:, _MOMENT] = share * moment[:, None]
    links[:, _MASS] = share * mass
    std = np.full(model.layout.size, np.inf)
    std[model.layout.links] = links
    return std
