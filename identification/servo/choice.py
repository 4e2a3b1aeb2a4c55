"""Terms of a servo's model: all that do not make the prediction of windows worse.

A term that neither helps nor harms stays, with the interval that its prior and the motion give it.
It is shown where other windows are predicted worse without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.servo.fit import ServoEstimate, ServoWindows, fit
from identification.servo.parameters import OPTIONAL, PLACE, TERMS, natural
from identification.servo.recorded_motion import Grid, ServoMotion
from identification.servo.servo_fit import ServoFit, TermChoice
from identification.servo.start import (
    STARTS,
    moving_joints,
    prior_of,
    start_of,
    with_moving_joints,
)
from identification.servo.touches import touches_of, untouched, windows_without

FIT_ITERATIONS: Final = 12
_FINE_ITERATIONS: Final = 5  # iterations on the halved grid
_ROUGH_ITERATIONS: Final = 12  # iterations of each start
_BEST_START_ITERATIONS: Final = 6  # after the start that fits best, and without touched windows
_TRIAL_ITERATIONS: Final = 4  # of each fit of a fold
_FOLDS: Final = 2
_ACCELERATION_RATIOS: Final = np.exp([0.0, -1.5, -1.0, -0.6, -0.3, -0.15, 0.15, 0.3, 0.6, 1.0])
"""Accelerations of a set-point that are tried, over that of a fit."""
_MIN_WINDOWS: Final = 4  # of which one half is predicted from the other
_MOSTLY: Final = 0.5  # of the windows, without which none is left out
_LOG_LIKELIHOOD_95: Final = 1.92  # of a log-likelihood with one parameter more, 95 %
_HARM_SIGMAS: Final = 2.0  # of the mean over windows, from which on a term harms
_MAX_POSITION_ERROR: Final = 1.0  # rad or m of an error, as of a model that falls over


def steps_of_a_fit() -> int:
    """Return the number of iterations that `fit_servos` reports at most."""
    return (
        len(STARTS) * _ROUGH_ITERATIONS
        + 2 * _BEST_START_ITERATIONS
        + (1 + len(OPTIONAL)) * _FOLDS * _TRIAL_ITERATIONS
        + FIT_ITERATIONS
        + _FINE_ITERATIONS
    )


def fit_servos(
    motions: Callable[[Grid], Sequence[ServoMotion]],
    grid: Grid,
    resolution: Array,
    *,
    done: Callable[[], None] = lambda: None,
) -> ServoFit:
    """Fit the servos of an arm to motions, with the terms that predict best.

    Args:
        motions: that are fitted, on a grid.
        grid: of the simulation: starts and choices are on a coarser one, the end of the fit on the
            halved one.
        resolution: standard deviation of the measured positions (n,).
        done: called after each iteration.
    """
    rough = motions(grid.coarser)
    windows = ServoWindows.of(rough)
    prior = prior_of(rough, resolution)
    present = np.ones((windows.n_joints, len(TERMS)), np.bool_)
    starts = [
        fit(
            windows, prior, present, start_of(prior, start), resolution,
            iterations=_ROUGH_ITERATIONS, rough=True, done=done,
        )
        for start in STARTS
    ]  # fmt: skip
    alike = np.max([each.alike for each in starts], axis=0)
    best = min(starts, key=lambda each: _cost(windows, each, resolution, alike))
    best = _settled(windows, best, moving_joints(rough), resolution, done)
    first = ServoFit(best, (), windows.count, _shown((), present), ())
    touches = touches_of(rough, first, resolution)
    free = untouched(windows, touches)
    if np.count_nonzero(free) < max(_MIN_WINDOWS, _MOSTLY * windows.count):
        touches = []
    if touches:
        windows = windows_without(windows, touches)
        best = fit(
            windows, best.prior, present, best.coordinates, resolution,
            iterations=_BEST_START_ITERATIONS, scales=(best.scatter[free], best.alike),
            bus=best.bus_delay, rough=True, done=done,
        )  # fmt: skip
    enough = windows.count >= _MIN_WINDOWS
    choices = _choices(windows, best, resolution, done) if enough else ()
    chosen = present.copy()
    for choice in choices:
        chosen[choice.joint, [PLACE[name] for name in choice.terms]] = choice.present
    final = best
    for on, iterations in ((grid, FIT_ITERATIONS), (grid.halved, _FINE_ITERATIONS)):
        scales = (final.scatter, final.alike)
        windows = windows_without(ServoWindows.of(motions(on)), touches)
        final = fit(
            windows, best.prior, chosen, final.coordinates, resolution, iterations=iterations,
            scales=scales, bus=final.bus_delay, rough=on == grid, done=done,
        )  # fmt: skip
    shown = _shown(choices, chosen)
    return ServoFit(final, choices, windows.count, shown, tuple(touches))


def _shown(choices: Sequence[TermChoice], present: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether terms are shown (n, P): where nothing was predicted, only what always is."""
    shown = np.tile([term.always for term in TERMS], (len(present), 1))
    for choice in choices:
        shown[choice.joint, [PLACE[name] for name in choice.terms]] = choice.shown
    return shown & present


def _with_best_acceleration(
    windows: ServoWindows, found: ServoEstimate, resolution: Array
) -> Array:
    """Return coordinates (n, P) with the acceleration of each joint that fits best of several.

    Of commands far beyond it, whole oscillations are lost: no slope leads to it.
    """
    place = PLACE["acceleration"]
    tried = np.repeat(found.coordinates[None], len(_ACCELERATION_RATIOS), axis=0)
    tried[..., place] += np.log(_ACCELERATION_RATIOS)[:, None]
    squares = (windows.residuals(natural(tried)) ** 2).mean(axis=0)
    errors = _log_errors(squares, resolution)
    fitted = (len(windows.measured) / found.alike * errors).sum(axis=1)
    distance = (tried[..., place] - found.prior.mean[:, place]) / found.prior.spread[:, place]
    best = np.argmin(fitted + distance**2, axis=0)
    return np.asarray(tried[best, np.arange(len(best))])


def _cost(windows: ServoWindows, estimate: ServoEstimate, resolution: Array, alike: Array) -> float:
    """Return minus twice the logarithm of the posterior of an estimate.

    Args:
        windows: that were fitted.
        estimate: of them.
        resolution: standard deviation of the measured positions (n,).
        alike: residuals that count as one (n,).
    """
    independent = len(windows.measured) / alike
    fitted = float((independent * _errors(windows, estimate, resolution)).sum())
    return fitted + estimate.from_prior


def _settled(
    windows: ServoWindows,
    found: ServoEstimate,
    moving: NDArray[np.bool_],
    resolution: Array,
    done: Callable[[], None],
) -> ServoEstimate:
    """Return an estimate from one that no slope leads on from.

    With the best of several accelerations, and with joints that stood as the others are, as far as
    they say.

    Args:
        windows: that were fitted.
        found: estimate of them.
        moving: joints that moved (n,).
        resolution: standard deviation of the measured positions (n,).
        done: called after each iteration.
    """
    start = _with_best_acceleration(windows, found, resolution)
    prior = with_moving_joints(found.prior, start, moving)
    if moving.any():
        start = np.where(moving[:, None], start, prior.mean)
    return fit(
        windows, prior, found.present, start, resolution, iterations=_BEST_START_ITERATIONS,
        scales=(found.scatter, found.alike), bus=found.bus_delay, rough=True, done=done,
    )  # fmt: skip


def _errors(windows: ServoWindows, estimate: ServoEstimate, resolution: Array) -> Array:
    """Return the logarithms of mean squared errors of windows and joints (w, n)."""
    residuals = windows.residuals(estimate.values[None])[:, 0]
    return _log_errors((residuals**2).mean(axis=0), resolution)


def _log_errors(squares: Array, resolution: Array) -> Array:
    """Return logarithms of mean squared errors; errors below an encoder step count as one."""
    return np.asarray(np.log(np.minimum(squares, _MAX_POSITION_ERROR**2) + 12.0 * resolution**2))


def _choices(
    windows: ServoWindows, full: ServoEstimate, resolution: Array, done: Callable[[], None]
) -> tuple[TermChoice, ...]:
    """Choose by the errors of windows that were not fitted, for each joint separately.

    A joint is left without one term at most: that with which they are predicted worst.
    """
    with_all = _predicted(windows, full, full.present, resolution, done)
    independent = len(windows.measured) / full.alike  # residuals of a window
    gains = np.empty((len(OPTIONAL), windows.n_joints))
    harms = np.empty_like(gains)
    shown = np.empty(gains.shape, np.bool_)
    for k, terms in enumerate(OPTIONAL):
        other = full.present.copy()
        other[:, [PLACE[name] for name in terms]] = False
        change = _predicted(windows, full, other, resolution, done) - with_all
        gains[k] = 0.5 * change.mean(axis=0)
        deviation = 0.5 * change.std(axis=0) / np.sqrt(max(1, len(change) - 1))
        likelier = 0.5 * independent * change
        total = likelier.sum(axis=0)
        harms[k] = np.where(gains[k] < -_HARM_SIGMAS * deviation, -total, 0.0)
        shown[k] = (total > _LOG_LIKELIHOOD_95) & (total > likelier.max(axis=0))
    # What others do is known with the worst term alone: without it they may well help.
    left_out = (harms > _LOG_LIKELIHOOD_95) & (harms == harms.max(axis=0))
    return tuple(
        TermChoice(
            terms,
            joint,
            present=not left_out[k, joint],
            gain=float(-np.expm1(-gains[k, joint])),
            shown=bool(shown[k, joint]),
        )
        for k, terms in enumerate(OPTIONAL)
        for joint in range(windows.n_joints)
    )


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
            fitted, start.prior, present, start.coordinates, resolution,
            iterations=_TRIAL_ITERATIONS,
            scales=(start.scatter[~inside], start.alike), fixed=True, bus=start.bus_delay,
            rough=True, done=done,
        )  # fmt: skip
        held = np.flatnonzero(inside)
        errors[held] = _errors(windows.some(held), estimate, resolution)
    return errors
