"""Fits to few rows under many changes: which changes, signs and orders are worth comparing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.estimators.prior import TorqueSums, body_priors
from identification.factor.columns import every_torque_factor
from identification.factor.factor import MIN_NOISE, Factor
from identification.hypotheses.joint_changes import (
    AS_READ,
    GRAVITIES,
    Axes,
    Change,
    Meaning,
    change_of_motion,
    changed_samples,
    kind_of,
    mounted_model,
    order_change,
)
from identification.hypotheses.little_torque import little_torque
from identification.hypotheses.mirror_images import Signs
from identification.hypotheses.scores import ROWS_PER_FACT, friction_columns
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

ORDER_STARTS: Final = 10
"""Starts of the search for an order: as read, then at random until the best order is reached twice.
From a third of the starts the right one is reached: ten miss it in 2 % of the cases."""
_COMPARED_ORDERS: Final = 2  # best orders of each kind that are compared
_COMPARED_CHANGES: Final = 12  # changes of least error on fewer rows, which are compared
_SAME_ERROR_DIGITS: Final = 6  # of the logarithm of two errors that are one
_RIDGE: Final = 1e-6  # of the squares of a column, where others say the same
_NOISE_ROUNDS: Final = 3  # from the noise as read: a fit that is far off need not settle
_FITS_AT_ONCE: Final = 24  # fits, so that their sums stay in the processor's cache


class FewRowFits:
    """Fits to all of few rows under changes of a reading.

    A motion is reduced once for all torques: orders and signs of torques are parts of its sums.
    """

    def __init__(
        self, model: RobotModel, samples: Samples, mountings: Mapping[str, RobotModel]
    ) -> None:
        self.model = model
        self._samples = samples
        self._mountings = mountings
        torque = np.sqrt(np.square(samples.torque).sum(axis=0))
        self._counts = ~little_torque(torque, ~np.array(model.chain.revolute))
        self._sums: dict[Change, Factor] = {}  # of every torque, by the change of the motion
        self._weights: Array | None = None  # of the recorded torques, as they are read

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self._samples.torque)

    def errors(self, changes: Sequence[Change]) -> dict[Change, float]:
        """Return logarithms of the squared errors of fits, each summed over the torques.

        Small ones are aside: a fit makes their share as small as it likes.
        """
        errors: dict[Change, float] = {}
        by_gravity: dict[str | None, list[Change]] = {}
        for change in changes:
            gravity = change.name if change.meaning in GRAVITIES else None
            by_gravity.setdefault(gravity, []).append(change)
        for alike in by_gravity.values():
            model = mounted_model(self.model, alike[0], self._mountings)
            for first in range(0, len(alike), _FITS_AT_ONCE):
                errors.update(self._errors(model, alike[first : first + _FITS_AT_ONCE]))
        return errors

    def _errors(self, model: RobotModel, changes: Sequence[Change]) -> dict[Change, float]:
        """Return the errors of changes under one gravity."""
        motions = [change_of_motion(change) for change in changes]
        axes = [Axes.of([change], self.model.n_joints) for change in changes]
        errors = self._errors_as_read(model, motions, axes)
        return dict(zip(changes, errors, strict=True))

    def _reduce(self, model: RobotModel, motions: Sequence[Change]) -> None:
        """Reduce each motion once, for all torques."""
        if new := list(dict.fromkeys(motion for motion in motions if motion not in self._sums)):
            moved = [changed_samples(self.model, self._samples, motion) for motion in new]
            factor = every_torque_factor(model, moved)
            for block, motion in enumerate(new):
                self._sums[motion] = factor.blocks(slice(block, block + 1))

    def by_friction(self, positions: Sequence[Array]) -> list[Signs]:
        """Complete position signs (n,) with the torque signs that make friction dissipate energy.

        Each joint is fitted alone, as the other torques may have any sign.
        """
        columns = friction_columns(self.model, self._samples)
        motions = [_negated_positions(position) for position in positions]
        for first in range(0, len(motions), _FITS_AT_ONCE):
            self._reduce(self.model, motions[first : first + _FITS_AT_ONCE])
        signs = []
        for position, motion in zip(positions, motions, strict=True):
            torque = np.ones(len(position))
            factor = self._sums[motion]
            for joint, (matrix,) in enumerate(factor.matrices):
                width = len(matrix) - factor.n_joints
                own = matrix[:width, :width]
                ridge = _RIDGE * np.diag(own.diagonal() + np.finfo(np.float64).tiny)
                fitted = np.linalg.solve(own + ridge, matrix[:width, width + joint])
                friction = columns[joint, factor.columns[joint][:width]] @ fitted
                torque[joint] = -1.0 if friction < 0.0 else 1.0
            signs.append(Signs(position, torque))
        return signs

    def with_best_torques(self, signs: Signs) -> Signs:
        """Return the signs after flipping torque signs one by one while the fit improves."""
        (error,) = self.of_signs([signs])
        while True:
            torques = signs.torque * (1.0 - 2.0 * np.eye(len(signs.torque)))
            others = [signs._replace(torque=torque) for torque in torques]
            errors = self.of_signs(others)
            best = int(np.argmin(errors))
            if errors[best] >= error:
                return signs
            signs, error = others[best], errors[best]

    def of_signs(self, signs: Sequence[Signs]) -> list[float]:
        """Return the error of each combination of joint signs."""
        errors: list[float] = []
        for first in range(0, len(signs), _FITS_AT_ONCE):
            some = signs[first : first + _FITS_AT_ONCE]
            motions = [_negated_positions(each.position) for each in some]
            axes = [Axes.of(each.changes, self.model.n_joints) for each in some]
            errors += self._errors_as_read(self.model, motions, axes)
        return errors

    def _errors_as_read(
        self, model: RobotModel, motions: Sequence[Change], axes: Sequence[Axes]
    ) -> list[float]:
        """Return the errors of motions, each with the torque as its axes read it."""
        self._reduce(model, motions)
        sums = of_torques([self._sums[motion] for motion in motions], axes)
        priors = body_priors(model, sums)
        errors = []
        for each, read, mean, information in zip(sums.each(), axes, *priors, strict=True):
            values, _ = each.posterior(
                mean,
                ROWS_PER_FACT * information,
                MIN_NOISE,
                self._weights_as_read()[read.torque_order],
                rounds=_NOISE_ROUNDS,
            )
            squares = each.squared_errors(values)[self._counts[read.torque_order]]
            errors.append(float(np.log(np.where(squares > 0.0, squares, 1.0)).sum()))
        return errors

    def _weights_as_read(self) -> Array:
        """Return the weights of the recorded torques (n,) in a fit of the rows as they are read."""
        if self._weights is None:
            self._reduce(self.model, [AS_READ])
            sums = of_torques([self._sums[AS_READ]], [Axes.of([], self.model.n_joints)])
            ((mean,), (information,)) = body_priors(self.model, sums)
            (only,) = sums.each()
            _, self._weights = only.posterior(mean, ROWS_PER_FACT * information, MIN_NOISE)
        return self._weights


def to_compare(errors: Mapping[Change, float], excluded: float) -> list[Change]:
    """Return the changes to compare on all rows: the best ones, and the best of each kind.

    Of changes that the fits exclude, only the best of each meaning: it shows how certain they are.
    Of zeros of one joint that fit exactly alike, as about the vertical, one is enough.

    Args:
        errors: of fits to few rows.
        excluded: error from which a change is certainly worse than none.
    """
    chosen: list[Change] = []
    kinds: set[object] = set()
    meanings: set[Meaning] = set()
    zeros: set[tuple[tuple[int, ...], float]] = set()
    for place, change in enumerate(sorted(errors, key=lambda change: errors[change])):
        if change.meaning == "zero":
            fit = change.joints, round(errors[change], _SAME_ERROR_DIGITS)
            if fit in zeros:
                continue
            zeros.add(fit)
        is_new = place < _COMPARED_CHANGES or kind_of(change) not in kinds
        if (is_new and errors[change] < excluded) or change.meaning not in meanings:
            chosen.append(change)
        kinds.add(kind_of(change))
        meanings.add(change.meaning)
    return chosen


def _negated_positions(sign: Array) -> Change:
    """Return the change of the motion to positions with signs (n,)."""
    joints = tuple(np.flatnonzero(sign < 0.0).tolist())
    return Change("position sign", joints) if joints else AS_READ


def of_torques(every: Sequence[Factor], axes: Sequence[Axes]) -> TorqueSums:
    """Return the sums of [W | y], y as axes read it, from the sums of every torque."""
    n = every[0].n_joints
    p = every[0].n_parameters + 1 - n
    gram = np.zeros((len(every), n, p + 1, p + 1))
    for factor, read, parts in zip(every, axes, gram, strict=True):
        for joint, (part, (matrix,)) in enumerate(zip(parts, factor.matrices, strict=True)):
            width = len(matrix) - n
            columns = factor.columns[joint][:width]
            torque = width + read.torque_order[joint]
            part[columns[:, None], columns] = matrix[:width, :width]
            part[columns, p] = part[p, columns] = read.torque_sign[joint] * matrix[torque, :width]
            part[p, p] = matrix[torque, torque]
    return TorqueSums(gram, np.array([factor.samples for factor in every]))


def best_orders(fits: FewRowFits, kind: Meaning, starts: int) -> list[tuple[int, ...]]:
    """Return the orders of least error on few rows."""
    errors: dict[tuple[int, ...], float] = {}

    def best_of(orders: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
        new = {order: order_change(kind, order) for order in orders if order not in errors}
        found = fits.errors(list(dict.fromkeys(new.values())))
        errors.update((order, found[change]) for order, change in new.items())
        return min(orders, key=errors.__getitem__)

    n = fits.model.n_joints
    rng = np.random.default_rng(0)
    reached: list[tuple[int, ...]] = []
    for start in range(starts):
        order = tuple(range(n)) if start == 0 else tuple(rng.permutation(n).tolist())
        while True:
            others = [_exchanged(order, pair) for pair in combinations(range(n), 2)]
            best = best_of([order, *others])
            if best == order:
                break
            order = best
        reached.append(order)
        if reached.count(best_of(reached)) > 1:
            break
    return sorted(errors, key=lambda order: errors[order])[:_COMPARED_ORDERS]


def _exchanged(order: tuple[int, ...], pair: tuple[int, int]) -> tuple[int, ...]:
    places = list(order)
    first, second = pair
    places[first], places[second] = places[second], places[first]
    return tuple(places)
