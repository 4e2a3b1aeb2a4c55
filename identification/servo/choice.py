"""Which terms a servo's model has: all but those without which other windows are predicted better.

A term that neither helps nor harms stays, with the interval that its prior and the motion give it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.servo.fit import ServoEstimate, ServoWindows, data_cost, fit
from identification.servo.parameters import OPTIONAL, PLACE, TERMS
from identification.servo.recorded_motion import ServoMotion
from identification.servo.start import STARTS, prior_of, start_of

ITERATIONS: Final = 12
_FINE: Final = 7  # iterations on the halved grid
_ROUGH: Final = 12  # iterations of each start
_TRIAL: Final = 4  # of each fit of a fold
_FOLDS: Final = 2
_FEWEST_WINDOWS: Final = 4  # of which one half is predicted from the other
_CHANCE: Final = 3.84  # of chi square with one degree of freedom, 95 %
_LARGEST: Final = 1.0  # rad or m of an error, as of a model that falls over


@dataclass(frozen=True)
class TermChoice:
    """Whether a model of one joint has some terms, and what prediction says.

    Attributes:
        terms: names.
        joint: index.
        present: whether they are in the model.
        gain: by which they lower the root mean square of the prediction error, as a fraction.
    """

    terms: tuple[str, ...]
    joint: int
    present: bool
    gain: float


@dataclass(frozen=True, eq=False)
class ServoFit:
    """An estimate, and how its terms were chosen.

    Attributes:
        estimate: of all windows.
        choices: of terms.
        windows: number of windows.
        shown: whether the fit is worse without a term, by more than chance (n, P).
    """

    estimate: ServoEstimate
    choices: tuple[TermChoice, ...]
    windows: int
    shown: NDArray[np.bool_]


def steps_of_a_fit() -> int:
    """Return the number of iterations that `fit_servos` reports at most."""
    return len(STARTS) * _ROUGH + (1 + len(OPTIONAL)) * _FOLDS * _TRIAL + ITERATIONS + _FINE


def fit_servos(
    motions: Sequence[ServoMotion],
    fine: Sequence[ServoMotion],
    resolution: Array,
    *,
    done: Callable[[], None] = lambda: None,
) -> ServoFit:
    """Fit the servos of an arm to motions, with the terms that predict best.

    Args:
        motions: that are fitted.
        fine: the same on the halved grid, for the last iterations.
        resolution: standard deviation of the measured positions (n,).
        done: called after each iteration.
    """
    windows = ServoWindows.of(motions)
    prior = prior_of(motions, resolution)
    present = np.ones((windows.n_joints, len(TERMS)), np.bool_)
    rough = [
        fit(
            windows,
            prior,
            present,
            start_of(prior, start),
            resolution,
            iterations=_ROUGH,
            rough=True,
            done=done,
        )
        for start in STARTS
    ]
    best = min(rough, key=lambda each: float(_errors(windows, each, resolution).sum()))
    enough = windows.count >= _FEWEST_WINDOWS
    choices = _choices(windows, best, resolution, done) if enough else ()
    chosen = present.copy()
    for choice in choices:
        chosen[choice.joint, [PLACE[name] for name in choice.terms]] = choice.present
    final = fit(
        windows, prior, chosen, best.coordinates, resolution, iterations=ITERATIONS,
        bus=best.bus_delay, done=done,
    )  # fmt: skip
    finely = ServoWindows.of(fine)
    final = fit(
        finely, prior, chosen, final.coordinates, resolution, iterations=_FINE,
        bus=final.bus_delay, done=done,
    )  # fmt: skip
    return ServoFit(final, choices, windows.count, shown_terms(finely, final))


def shown_terms(windows: ServoWindows, estimate: ServoEstimate) -> NDArray[np.bool_]:
    """Return whether the cost without a term is higher, by more than chance (n, P)."""
    shown = np.ones_like(estimate.present)
    before = data_cost(windows, estimate, estimate.present)
    for terms in OPTIONAL:
        places = [PLACE[name] for name in terms]
        other = estimate.present.copy()
        other[:, places] = False
        change = data_cost(windows, estimate, other) - before
        shown[:, places] = (change > _CHANCE)[:, None]
    return shown


def _errors(windows: ServoWindows, estimate: ServoEstimate, resolution: Array) -> Array:
    """Return the logarithms of mean squared errors of windows and joints (w, n).

    Errors below the step of the encoder count as that.
    """
    residuals = windows.residuals(estimate.values[None])[:, 0]
    squares = np.minimum((residuals**2).mean(axis=0), _LARGEST**2)
    return np.asarray(np.log(squares + 12.0 * resolution**2))


def _choices(
    windows: ServoWindows, full: ServoEstimate, resolution: Array, done: Callable[[], None]
) -> tuple[TermChoice, ...]:
    """Choose by the errors of windows that were not fitted, for each joint by itself."""
    with_all = _predicted(windows, full, full.present, resolution, done)
    choices = []
    for terms in OPTIONAL:
        other = full.present.copy()
        other[:, [PLACE[name] for name in terms]] = False
        change = _predicted(windows, full, other, resolution, done) - with_all
        gains = 0.5 * change.mean(axis=0)
        deviations = 0.5 * change.std(axis=0) / np.sqrt(max(1, len(change) - 1))
        choices += [
            TermChoice(terms, joint, bool(gain > -deviation), float(gain))
            for joint, (gain, deviation) in enumerate(zip(gains, deviations, strict=True))
        ]
    return tuple(choices)


def _predicted(
    windows: ServoWindows,
    start: ServoEstimate,
    present: NDArray[np.bool_],
    resolution: Array,
    done: Callable[[], None],
) -> Array:
    """Return logarithms of mean squared errors of windows (w, n), each predicted from others."""
    errors = np.empty((windows.count, windows.n_joints))
    number = np.arange(windows.count)
    for fold in range(_FOLDS):
        inside = number % _FOLDS == fold
        fitted = windows.some(np.flatnonzero(~inside))
        estimate = fit(
            fitted, start.prior, present, start.coordinates, resolution, iterations=_TRIAL,
            scales=(start.scatter[~inside], start.alike), bus=start.bus_delay, rough=True,
            done=done,
        )  # fmt: skip
        held = np.flatnonzero(inside)
        errors[held] = _errors(windows.some(held), estimate, resolution)
    return errors
