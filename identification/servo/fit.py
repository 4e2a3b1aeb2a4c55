"""Servo and friction of each joint by nonlinear least squares over simulated windows.

The posterior of a prior for each parameter; residuals count robustly, and as many of them as one as
the scatter between windows says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.servo.parameters import (
    BUS_DELAY_SPREAD,
    PLACE,
    POSITIVE,
    TERMS,
    natural,
    without_absent,
)
from identification.servo.recorded_motion import ServoMotion, side_by_side
from identification.servo.servo_simulation import JointInputs, simulate

_MAX_WINDOW_SECONDS: Final = 10.0  # s of a window
_MIN_WINDOW_SECONDS: Final = 4.0
_WINDOW_COUNT: Final = 24  # that a short recording is cut to
ROBUST: Final = 3.0  # scatters from which on a residual counts less
_DIFFERENCE_STEPS: Final = np.where(POSITIVE, 0.03, 3e-4)  # of the coordinates, for derivatives
# that are tried in each iteration, times the last
_DAMPING_FACTORS: Final = (1e-3, 1e-1, 1.0, 1e1, 1e2)
_MAX_STEP: Final = np.where(POSITIVE, 0.7, 0.01)  # of a coordinate in an iteration
_COST_TOLERANCE: Final = 3e-4  # relative decrease of the cost at which a fit ends
_INITIAL_CORRELATION_TIME: Final = 0.5  # s that residuals are correlated over, before a fit says it
_CENTRAL_DIFFERENCE_ROUNDS: Final = 2  # last iterations with differences to both sides
_QUARTERS: Final = 4  # parts of all windows, each of windows that follow each other
_P: Final = len(TERMS)

Done = Callable[[], None]


@dataclass(frozen=True, eq=False)
class ServoWindows:
    """w windows of recorded motions, n joints side by side.

    Attributes:
        inputs: what acts on the w n joints.
        measured: positions (K, w, n).
        count: number w.
        every: steps between samples.
        motion: index of the motion of each window (w,).
        start, end: of each window in its motion (w,) [s].
    """

    inputs: JointInputs
    measured: Array
    count: int
    every: int
    motion: NDArray[np.intp]
    start: Array
    end: Array

    @classmethod
    def of(cls, motions: Sequence[ServoMotion]) -> ServoWindows:
        """Return the windows of motions, which follow each other without overlap."""
        total = sum(motion.duration for motion in motions)
        duration = float(np.clip(total / _WINDOW_COUNT, _MIN_WINDOW_SECONDS, _MAX_WINDOW_SECONDS))
        every = motions[0].every
        longest = min(duration, *(motion.duration for motion in motions))
        steps = every * max(1, int(longest / (every * motions[0].step)))
        places = [
            (number, first)
            for number, motion in enumerate(motions)
            for first in range(0, len(motion.position) - steps + 1, steps)
        ]
        parts = [motions[number].inputs(first, steps) for number, first in places]
        measured = np.stack(
            [motions[number].position[first : first + steps : every] for number, first in places],
            axis=1,
        )
        numbers, firsts = np.array(places, np.intp).T
        start = motions[0].step * firsts
        end = start + motions[0].step * steps
        return cls(side_by_side(parts), measured, len(places), every, numbers, start, end)

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.measured.shape[2])

    def some(self, chosen: NDArray[np.intp]) -> ServoWindows:
        """Return some of the windows."""
        columns = (chosen[:, None] * self.n_joints + np.arange(self.n_joints)).ravel()

        def cut(name: str) -> Array:
            return np.ascontiguousarray(getattr(self.inputs, name)[..., columns])

        return ServoWindows(
            self.inputs.mapped(cut),
            self.measured[:, chosen],
            len(chosen),
            self.every,
            self.motion[chosen],
            self.start[chosen],
            self.end[chosen],
        )

    def residuals(self, values: Array) -> Array:
        """Return simulated less measured positions (K, V, w, n) at values (V, n, P)."""
        simulated = simulate(self.inputs, np.tile(values, (1, self.count, 1)), self.every)
        shape = (len(simulated), len(values), self.count, self.n_joints)
        return np.asarray(simulated.reshape(shape) - self.measured[:, None])


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before a fit: coordinates (n, P) and their standard deviations (n, P)."""

    mean: Array
    spread: Array


@dataclass(frozen=True, eq=False)
class ServoEstimate:
    """Fitted coordinates of n joints.

    Attributes:
        coordinates: (n, P).
        present: terms of the model (n, P).
        prior: of the coordinates.
        covariance: of the coordinates, that of the bus last (n P + 1, n P + 1).
        scatter: of the residuals of each window and joint (w, n) [rad or m].
        alike: residuals that count as one (n,).
        bus_delay: delay of the bus [s].
        cost: of each joint (n,).
        between: covariances of the coordinates of each joint, for the windows alone without the
            prior, by leaving out a window each, and a quarter of the windows each (2, n, P, P):
            what a model lacks may be alike in all windows of a motion.
    """

    coordinates: Array
    present: NDArray[np.bool_]
    prior: Prior
    covariance: Array
    scatter: Array
    alike: Array
    bus_delay: float
    cost: Array
    between: Array

    @property
    def values(self) -> Array:
        """Parameters in position errors of the servo (n, P)."""
        return without_absent(natural(self.coordinates), self.present)

    @property
    def from_prior(self) -> float:
        """Square of the distance from the prior in its deviations, of delays to that of the bus."""
        distance = self.coordinates - self.prior.mean
        distance[:, PLACE["delay"]] = self.coordinates[:, PLACE["delay"]] - self.bus_delay
        squares = np.where(self.present, distance / self.prior.spread, 0.0) ** 2
        return float(squares.sum()) + (self.bus_delay / BUS_DELAY_SPREAD) ** 2

    @property
    def deviations(self) -> Array:
        """Standard deviations of the coordinates (n, P)."""
        variances = np.diag(self.covariance)[:-1]
        return np.sqrt(variances).reshape(self.coordinates.shape)


def _weights(relative: Array) -> Array:
    return np.asarray(1.0 / np.sqrt(1.0 + (relative / ROBUST) ** 2))


def losses(relative: Array) -> Array:
    """Return the robust squares of residuals over their scatter, about r² where these are small."""
    return np.asarray(2.0 * ROBUST**2 * (np.sqrt(1.0 + (relative / ROBUST) ** 2) - 1.0))


def _jackknife(whole: Array, parts: Array, scores: Array) -> Array:
    """Return the covariance (k, k) by estimates that leave out a part each, to first order.

    Args:
        whole: normal matrix with the prior (k, k).
        parts: share of each part in it (p, k, k).
        scores: gradient of each part (p, k).
    """
    shifts = np.linalg.solve(whole - parts, scores[..., None])[..., 0]
    count = len(shifts)
    return np.asarray(shifts.T @ shifts * (count - 1) / count)


@dataclass(eq=False)
class _Fit:
    """A fit in progress."""

    windows: ServoWindows
    prior: Prior
    present: NDArray[np.bool_]
    coordinates: Array
    scatter: Array
    alike: Array
    bus: float
    rough: bool = True
    damping: float = 1.0
    sign: float = 1.0
    cost: Array = field(default_factory=lambda: np.zeros(0))
    normal: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def values(self, coordinates: Array) -> Array:
        return without_absent(natural(coordinates), self.present)

    def joint_costs(self, residuals: Array, coordinates: Array, bus: Array) -> Array:
        """Return the costs (V, n) of residuals (K, V, w, n) at coordinates (V, n, P)."""
        fitted = losses(residuals / self.scatter).sum(axis=(0, 2)) / self.alike
        from_prior = self.from_prior(coordinates, bus)
        return np.asarray(fitted + (np.where(self.present, from_prior, 0.0) ** 2).sum(axis=-1))

    def from_prior(self, coordinates: Array, bus: Array) -> Array:
        """Return distances from the prior in its deviations (V, n, P)."""
        distance = coordinates - self.prior.mean
        delay = PLACE["delay"]
        distance[..., delay] = coordinates[..., delay] - bus[:, None]
        return np.asarray(distance / self.prior.spread)

    def iterate(self) -> float:
        """Make one step; return by how much the cost decreased, relatively."""
        x = self.coordinates
        terms = np.flatnonzero(self.present.any(axis=0))
        slopes, here = self._slopes(terms)
        before = self.joint_costs(here[:, None], x[None], np.array([self.bus]))[0]
        normal, gradient = self._equations(slopes, here, terms)
        self._correlate(slopes, here, terms)
        self.normal = normal
        size = np.diag(normal)
        dampings = self.damping * np.array(_DAMPING_FACTORS)
        steps_ = np.stack(
            [np.linalg.solve(normal + np.diag(damping * size), gradient) for damping in dampings]
        )
        moves = -steps_[:, :-1].reshape(-1, *x.shape)
        largest = (np.abs(moves) / _MAX_STEP).max(axis=2, keepdims=True)
        moves = moves / np.maximum(largest, 1.0)
        tried = x + np.where(self.present, moves, 0.0)
        delay = PLACE["delay"]
        tried[..., delay] = np.clip(tried[..., delay], 0.0, 0.24)
        buses = np.clip(self.bus - steps_[:, -1], 0.0, 0.24)
        costs = self.joint_costs(self.windows.residuals(self.values(tried)), tried, buses)
        # Joints are coupled by the delay of the bus only: each takes its own best step.
        best = np.argmin(costs, axis=0)
        joints = np.arange(len(best))
        better = costs[best, joints] < before
        self.coordinates = np.where(better[:, None], tried[best, joints], x)
        self.damping = float(np.clip(np.median(dampings[best]), 1e-6, 1e4))
        if not better.any():
            self.damping = min(self.damping * 1e2, 1e4)
        self.bus = self._bus_delay()
        self.cost = np.where(better, costs[best, joints], before)
        return float((before - self.cost).sum() / before.sum())

    def _slopes(self, terms: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return slopes of the residuals by terms (K, T, w, n), and the residuals (K, w, n)."""
        x = self.coordinates
        count = len(terms)
        shifted = np.repeat(x[None], 1 + (count if self.rough else 2 * count), axis=0)
        for k, term in enumerate(terms):
            shifted[1 + k, :, term] += self.sign * _DIFFERENCE_STEPS[term]
            if not self.rough:
                shifted[1 + count + k, :, term] -= self.sign * _DIFFERENCE_STEPS[term]
        residuals = self.windows.residuals(self.values(shifted))
        here = residuals[:, 0].copy()
        steps = (self.sign * _DIFFERENCE_STEPS[terms])[:, None, None]
        ahead = residuals[:, 1 : 1 + count]
        if self.rough:
            self.sign = -self.sign
            return (ahead - here[:, None]) / steps, here
        return (ahead - residuals[:, 1 + count :]) / (2.0 * steps), here

    def _bus_delay(self) -> float:
        delay = PLACE["delay"]
        spread = self.prior.spread[:, delay]
        weight = np.append(spread**-2.0, BUS_DELAY_SPREAD**-2.0)
        return float(np.average(np.append(self.coordinates[:, delay], 0.0), weights=weight))

    def _equations(
        self, slopes: Array, here: Array, terms: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Return the normal matrix and the gradient of coordinates and delay of the bus."""
        n = self.windows.n_joints
        size = n * _P + 1
        normal = np.zeros((size, size))
        gradient = np.zeros(size)
        relative = here / self.scatter
        weights = _weights(relative)
        for joint in range(n):
            columns = slopes[..., joint].transpose(0, 2, 1).reshape(-1, len(terms))
            scale = self.scatter[:, joint] ** 2 * self.alike[joint]
            weight = (weights[..., joint] / scale).ravel()
            places = joint * _P + terms
            normal[np.ix_(places, places)] += columns.T @ (columns * weight[:, None])
            gradient[places] += columns.T @ (weight * here[..., joint].ravel())
        precision = self.prior.spread.ravel() ** -2.0
        distance = self.from_prior(self.coordinates[None].copy(), np.array([self.bus]))[0]
        normal[:-1, :-1] += np.diag(precision)
        gradient[:-1] += np.where(self.present, distance / self.prior.spread, 0.0).ravel()
        delays = np.arange(n) * _P + PLACE["delay"]
        normal[-1, -1] = precision[delays].sum() + BUS_DELAY_SPREAD**-2.0
        normal[-1, delays] = normal[delays, -1] = -precision[delays]
        gradient[-1] = (
            self.bus * BUS_DELAY_SPREAD**-2.0
            - (distance[:, PLACE["delay"]] / self.prior.spread[:, PLACE["delay"]]).sum()
        )
        absent = np.append(~self.present.ravel(), False)
        gradient[absent] = 0.0
        return normal, gradient

    def _correlate(self, slopes: Array, here: Array, terms: NDArray[np.intp]) -> None:
        """Set how many residuals count as one, by estimates that leave out a window each.

        The scatter of these (jackknife, linear about the present estimate) over what independent
        residuals would give, the median of the terms: one at a limit may scatter anyhow.
        """
        self._alike = self.alike.copy()
        self._between = np.zeros((2, self.windows.n_joints, _P, _P))
        quarters = np.array_split(np.arange(self.windows.count), _QUARTERS)
        weights = _weights(here / self.scatter)
        for joint in range(self.windows.n_joints):
            inside = self.present[joint, terms]
            columns = slopes[..., joint][:, inside]
            scale = self.scatter[:, joint] ** 2 * self.alike[joint]
            weighted = columns * (weights[..., joint] / scale)[:, None]
            scores = np.einsum("kpw,kw->wp", weighted, here[..., joint])
            by_window = np.einsum("kpw,kqw->wpq", weighted, columns)
            of_data = by_window.sum(axis=0)
            whole = of_data + np.diag(self.prior.spread[joint, terms[inside]] ** -2.0)
            between = _jackknife(whole, by_window, scores)
            parts = [rows for rows in quarters if len(rows)]
            by_part = np.stack([by_window[rows].sum(axis=0) for rows in parts])
            scores_of_parts = np.stack([scores[rows].sum(axis=0) for rows in parts])
            places = np.ix_(terms[inside], terms[inside])
            self._between[0, joint][places] = between
            self._between[1, joint][places] = _jackknife(whole, by_part, scores_of_parts)
            scatter = np.diag(between)
            inverse = np.linalg.inv(whole)
            expected = np.diag(inverse @ of_data @ inverse)
            known = expected > 0.0
            ratio = float(np.median(scatter[known] / expected[known])) if known.any() else 1.0
            alike = self.alike[joint] * np.clip(ratio, 0.25, 4.0)
            self._alike[joint] = np.clip(alike, 1.0, len(here) * 0.5)

    def rescale(self) -> None:
        """Set scatter and correlation of the residuals from the present fit."""
        here = self.windows.residuals(self.values(self.coordinates[None]))[:, 0]
        weights = _weights(here / self.scatter)
        squares = (weights * here**2).mean(axis=0) / weights.mean(axis=0)
        # Half-way, on a logarithmic scale, between each window's own and that of all windows.
        scatter = (squares * squares.mean(axis=0)) ** 0.25
        self.scatter = np.maximum(scatter, self._least)
        self.alike = self._alike.copy()

    _alike: Array = field(default_factory=lambda: np.zeros(0))
    _between: Array = field(default_factory=lambda: np.zeros(0))
    _least: Array = field(default_factory=lambda: np.zeros(0))


def fit(
    windows: ServoWindows,
    prior: Prior,
    present: NDArray[np.bool_],
    start: Array,
    resolution: Array,
    *,
    iterations: int = 24,
    scales: tuple[Array, Array] | None = None,
    fixed: bool = False,
    bus: float | None = None,
    rough: bool = False,
    done: Done = lambda: None,
) -> ServoEstimate:
    """Fit coordinates (n, P) to windows, from a start.

    Args:
        windows: of the fitted motions.
        prior: of the coordinates.
        present: terms of the model (n, P).
        start: coordinates (n, P).
        resolution: standard deviation of the measured positions (n,).
        iterations: at most.
        scales: scatter and number of residuals that count as one of each joint, to start with.
        fixed: whether they stay.
        bus: delay of the bus to start with [s].
        rough: whether derivatives are differences to one side throughout, in half of the time;
            else the last ones are to both, of which the covariance is.
        done: called after each iteration.
    """
    step = windows.inputs.step * windows.every
    error = windows.residuals(without_absent(natural(start), present)[None])[:, 0]
    scatter = np.maximum(np.sqrt((error**2).mean(axis=(0, 1))) * 0.5, resolution)
    scatter = np.tile(scatter, (windows.count, 1))
    alike = np.full(windows.n_joints, _INITIAL_CORRELATION_TIME / step)
    if scales is not None:
        scatter, alike = scales
    progress = _Fit(
        windows, prior, present, start.copy(), scatter, alike,
        float(np.median(start[:, PLACE["delay"]])) if bus is None else bus,
    )  # fmt: skip
    progress._least = resolution
    calm = 0
    last = 0 if rough else _CENTRAL_DIFFERENCE_ROUNDS
    for k in range(iterations - last):
        decrease = progress.iterate()
        done()
        if not fixed and k % 3 == 2:
            progress.rescale()
        calm = calm + 1 if decrease < _COST_TOLERANCE else 0
        if calm >= 3 and k > 8:
            break
    progress.rough = False
    for _ in range(last):
        progress.iterate()
        done()
    return ServoEstimate(
        progress.coordinates,
        present,
        prior,
        np.asarray(np.linalg.inv(progress.normal), np.float64),
        progress.scatter,
        progress.alike,
        progress.bus,
        progress.cost,
        progress._between,
    )
