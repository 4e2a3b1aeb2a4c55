"""A load in unseen motion only: a body on the last link."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.errors import IdentificationError
from identification.estimators.payload_estimate import mass_difference
from identification.estimators.payload_problem import Run
from identification.factor.columns import under_gravity
from identification.factor.factor import Factor
from identification.hypotheses.gravity_direction import standard_parameters
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

MIN_LOAD_EXPLAINED: Final = 0.8
"""Share of the additional error on unseen motion that a body on the last link explains. A real
body: at least 0.99; other faults: at most 0.7."""
_MIN_ROWS: Final = 50  # of a joint whose usual error is known
_MIN_POWER_RATIO: Final = 4.0  # power ratio beyond which a joint's error exceeds that of the fit


class CarriedLoad(NamedTuple):
    """Body on the last link that explains errors on unseen motion only."""

    mass: float  # mass difference to the fitted motion [kg]
    explained: float  # share of the additional error on unseen motion that it explains
    axes: int  # number of joints whose error is far above that of the fit
    half_interval: float = np.inf  # of the mass, 95 % [kg]; infinite if unknown
    is_throughout: bool = True  # whether both halves of the unseen motion have this mass


def find_load(
    model: RobotModel,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    fitted: Factor,
    predicted: Factor,
) -> CarriedLoad:
    """Fit the training motion, then ten parameters of the last link to the unseen motion.

    Args:
        model: of the arm.
        training: recordings that are fitted.
        held_out: recordings of unseen motion.
        fitted: factor of the training in standard parameters.
        predicted: likewise of the unseen motion.
    """
    seen, unseen = (under_gravity(factor, model.gravity) for factor in (fitted, predicted))
    values = standard_parameters(seen, fitted.samples / np.maximum(seen.gram[:, -1, -1], 1e-300))
    # Squared error of the fit, scaled to as many rows.
    floor = 1e-12 * unseen.gram[:, -1, -1] + 1e-300
    usual = seen.squared_errors(values) * predicted.samples / np.maximum(fitted.samples, 1.0)
    # What the fitted motion did not move has no usual error.
    fits = fitted.samples >= _MIN_ROWS
    weights = np.where(fits, predicted.samples / np.maximum(usual, floor), 0.0)
    before = unseen.squared_errors(values)
    last = model.layout.links[model.chain.last_joint]
    # Columns [last link | residual].
    change = np.zeros((unseen.n_parameters + 1, len(last) + 1))
    change[last, range(len(last))] = 1.0
    change[:, -1] = np.append(-values, 1.0)
    left = Factor.of_gram(unseen.products(change), unseen.samples, LINK_SYMBOLS)
    body = standard_parameters(left, weights)
    after = left.squared_errors(body)
    beyond = weights @ np.maximum(before - usual, 0.0)
    load = CarriedLoad(
        mass=float(body[LINK_SYMBOLS.index("m")]),
        explained=float(weights @ (before - after) / beyond) if beyond > 0.0 else 0.0,
        axes=int(np.count_nonzero(fits & (before > _MIN_POWER_RATIO * np.maximum(usual, floor)))),
    )
    if load.explained <= MIN_LOAD_EXPLAINED:
        return load
    try:
        mass, half_interval = _mass(model, training, held_out)
    except IdentificationError:
        return load
    if not np.isfinite(half_interval):
        return load
    is_throughout = _is_throughout(model, training, held_out)
    return load._replace(mass=mass, half_interval=half_interval, is_throughout=is_throughout)


def _is_throughout(
    model: RobotModel, training: Sequence[Samples], held_out: Sequence[Samples]
) -> bool:
    """Return whether the masses in both halves of each recording agree, within their intervals."""
    pairs = [(samples, len(samples.torque)) for samples in held_out]
    halves = (
        [samples.between(0, rows // 2) for samples, rows in pairs],
        [samples.between(rows // 2, rows) for samples, rows in pairs],
    )
    try:
        masses, intervals = np.transpose([_mass(model, training, half) for half in halves])
    except IdentificationError:
        return True  # too few rows to tell
    return not abs(masses[0] - masses[1]) > np.hypot(*intervals)


def _mass(
    model: RobotModel, training: Sequence[Samples], loaded: Sequence[Samples]
) -> tuple[float, float]:
    """Return the mass of a body in loaded recordings [kg], and half its 95 % interval."""
    runs = [
        Run.of(str(k), model, samples, None, loaded=is_loaded)
        for is_loaded, some in ((False, training), (True, loaded))
        for k, samples in enumerate(some)
    ]
    mass, _, high = mass_difference(model, runs)
    return mass, high - mass
