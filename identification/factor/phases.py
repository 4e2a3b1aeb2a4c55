"""Gram matrices of [W | y] by short blocks of time: factor and covariance in one pass.

Their sum over blocks is the :class:`identification.factor.factor.Factor`; blocks give the scores of
a cluster-robust covariance for any weights and parameters. Instrumental variables use [Z | W | y],
gains [W | t | i].
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.factor.factor import Factor, augmented_rows
from identification.model.motion import Motion
from identification.model.payload import Load, Payload
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]
Blocks = TypeVar("Blocks", NDArray[np.float64], NDArray[np.intp])

FINE_BLOCK: Final = 0.125  # s
_MOST_BLOCKS: Final = 400  # of one recording, for gains


@dataclass(frozen=True, eq=False)
class PhaseFactor:
    """Factors of B short blocks of time since the motion's origin; repetitions add up."""

    gram: tuple[Array, ...]  #: per joint j over its columns and the torque, (B, c_j + 1, c_j + 1)
    columns: tuple[NDArray[np.intp], ...]  #: per joint the parameter indices of its columns (c_j,)
    samples: NDArray[np.intp]  #: usable rows (B, n)
    parameter_names: tuple[str, ...]  #: (p,)

    @classmethod
    def zero(cls, model: RobotModel) -> PhaseFactor:
        """Return the factor of no samples."""
        nothing = np.zeros(0, dtype=np.int64), np.zeros((0, model.n_joints), dtype=np.bool_)
        return cls.of_rows(*nothing, model.plan.columns, model.parameter_names, ())

    @classmethod
    def from_samples(cls, model: RobotModel, samples: Samples) -> PhaseFactor:
        """Reduce a recording by blocks; rows before the origin belong to the first."""
        index, rows = fine_blocks(samples), augmented_rows(model, samples)
        columns = model.plan.columns
        return cls.of_rows(index, samples.usable, columns, model.parameter_names, rows)

    @classmethod
    def of_rows(
        cls,
        index: NDArray[np.int64],
        usable: NDArray[np.bool_],
        columns: tuple[NDArray[np.intp], ...],
        names: tuple[str, ...],
        chunks: Iterable[tuple[slice, Sequence[Array]]],
    ) -> PhaseFactor:
        """Reduce chunks: per joint columns and torque (c_j + 1, k), zero if not usable (m, n).

        `index` is the block of each row (m,), rising; `columns` the parameters of each joint's
        columns.
        """
        count = int(index[-1]) + 1 if len(index) else 0
        gram = tuple(np.zeros((count, len(own) + 1, len(own) + 1)) for own in columns)
        for part, rows in chunks:
            runs = equal_runs(index[part])
            for total, block in zip(gram, rows, strict=True):
                add_grams(total, block, runs)
        return cls(gram, columns, samples_by_cell(index, usable), names)

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.gram)

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return len(self.parameter_names)

    def __len__(self) -> int:
        """Number B of blocks."""
        return len(self.samples)

    def __add__(self, other: PhaseFactor) -> PhaseFactor:
        """Add blocks at equal times since the origin.

        Raises:
            IdentificationError: the two belong to different models.
        """
        if self.parameter_names != other.parameter_names or self.n_joints != other.n_joints:
            raise IdentificationError("factors with different joints or parameters cannot be added")
        gram = tuple(_added(a, b) for a, b in zip(self.gram, other.gram, strict=True))
        return replace(self, gram=gram, samples=_added(self.samples, other.samples))

    def places(self, joint: int) -> NDArray[np.intp]:
        """Return the indices of a joint's columns among all p + 1, torque last."""
        return np.append(self.columns[joint], self.n_parameters)

    def weighted(self, weights: Array) -> Array:
        """Return the Gram matrices of the blocks (B, p + 1, p + 1) with joint weights (n,)."""
        width = self.n_parameters + 1
        whole = np.zeros((len(self.samples), width * width))
        for joint, (weight, gram) in enumerate(zip(weights, self.gram, strict=True)):
            place = self.places(joint)
            flat = (place[:, None] * width + place).ravel()
            whole[:, flat] += weight * gram.reshape(len(gram), -1)
        return whole.reshape(-1, width, width)

    def scores(self, weights: Array, values: Array) -> Array:
        """Return the scores ``W' w (y - W values)`` of each block (B, p)."""
        pull = np.zeros((len(self.samples), self.n_parameters))
        for weight, gram, used in zip(weights, self.gram, self.columns, strict=True):
            pull[:, used] += weight * (gram[:, :-1] @ np.append(-values[used], 1.0))
        return pull

    def blocks(self, which: slice | NDArray[np.bool_]) -> PhaseFactor:
        """Return some blocks, by slice or mask (B,)."""
        gram = tuple(own[which] for own in self.gram)
        return replace(self, gram=gram, samples=self.samples[which])

    def occupied(self) -> PhaseFactor:
        """Return the blocks with rows."""
        rows = np.asarray(self.samples.any(axis=1))
        return self if rows.all() else self.blocks(rows)

    def merged(self, length: int) -> PhaseFactor:
        """Merge runs of `length` blocks; the last one may be shorter."""
        gram = tuple(merged(own, length) for own in self.gram)
        return replace(self, gram=gram, samples=merged(self.samples, length))

    @property
    def total(self) -> Factor:
        """Factor of all blocks."""
        width = self.n_parameters + 1
        whole = np.zeros((self.n_joints, width, width))
        for joint, gram in enumerate(self.gram):
            place = self.places(joint)
            whole[joint][np.ix_(place, place)] = gram.sum(axis=0)
        return Factor(whole, self.samples.sum(axis=0), self.parameter_names)

    def restricted(self, chosen: NDArray[np.intp]) -> PhaseFactor:
        """Return the factor of the parameters `chosen` (k,), in that order."""
        place = np.full(self.n_parameters, -1, dtype=np.intp)
        place[chosen] = np.arange(len(chosen))
        gram, columns = [], []
        for own, used in zip(self.gram, self.columns, strict=True):
            stays = np.flatnonzero(place[used] >= 0)
            both = np.append(stays, len(used))
            gram.append(own[:, both[:, None], both])
            columns.append(place[used[stays]])
        names = tuple(self.parameter_names[k] for k in chosen)
        return PhaseFactor(tuple(gram), tuple(columns), self.samples, names)


def instrument_factor(
    model: RobotModel, samples: Samples, instrument: Motion, usable: NDArray[np.bool_] | None = None
) -> PhaseFactor:
    """Reduce a recording to blocks of [Z | W | y].

    Rows count if the noise-free instrument, known where `usable` (m, n), moves as well.
    """
    rows = samples.usable & model.moving(instrument.velocity)
    if usable is not None:
        rows &= usable
    columns = tuple(np.append(own, own + model.n_parameters) for own in model.plan.columns)
    measured = augmented_rows(model, replace(samples, usable=rows))
    # The same rows, with the same torque low-pass.
    planned = augmented_rows(model, replace(samples, motion=instrument, usable=rows))
    both = (
        (part, [np.concatenate([z[:-1], w]) for z, w in zip(quiet, noisy, strict=True)])
        for (part, noisy), (_, quiet) in zip(measured, planned, strict=True)
    )
    names = (*(f"Z {name}" for name in model.parameter_names), *model.parameter_names)
    return PhaseFactor.of_rows(fine_blocks(samples), rows, columns, names, both)


def measured_part(factor: PhaseFactor) -> PhaseFactor:
    """Return the part [W | y] of :func:`instrument_factor`, for least squares on equal rows."""
    p = factor.n_parameters // 2
    return factor.restricted(np.arange(p, 2 * p))


def gain_factor(
    model: RobotModel,
    samples: Samples,
    motor_current: Array,
    *,
    payload: Payload | None = None,
    transmission: Array | None = None,
) -> PhaseFactor:
    """Reduce a recording to blocks of [W | t | i], one Gram matrix for each motor.

    A motor's current (m, n) [A] counts if the rows of all its joints do; t is the payload torque.
    `transmission`: motor angles per joint angle (n, n); identity: gains include gear ratios.
    """
    n, p, m = model.n_joints, model.n_parameters, len(samples.motion.time)
    turns = np.eye(n) if transmission is None else np.asarray(transmission, dtype=np.float64)
    blocks, columns = samples.regressor(model)
    load = model.elements.known(samples.motion.position)
    if payload is not None:
        load = load + Load(model.chain, model.gravity, payload).torque(*samples.motion[1:4])
    time = samples.motion.time - samples.motion.time[0]
    index = np.floor(time / max(FINE_BLOCK, time[-1] / _MOST_BLOCKS) + 1e-9).astype(np.int64)
    usable, tables = np.zeros((m, n), dtype=np.bool_), np.zeros((n, p + 2, m))
    for motor, share in enumerate(np.linalg.inv(turns).T):
        acting = np.flatnonzero(share).tolist()
        usable[:, motor] = samples.usable[:, acting].all(axis=1)
        for joint in acting:
            tables[motor, columns[joint]] += share[joint] * blocks[joint].T
            tables[motor, p] += share[joint] * samples.as_measured(joint, load[:, [joint]])[:, 0]
        tables[motor, p + 1] = motor_current[:, motor]
        tables[motor][:, ~usable[:, motor]] = 0.0
    names = (*model.parameter_names, "torque of the payload")
    every = (np.arange(p + 1),) * n
    return PhaseFactor.of_rows(index, usable, every, names, [(slice(None), [*tables])])


def joined(parts: Sequence[PhaseFactor]) -> PhaseFactor:
    """Concatenate the blocks of several recordings."""
    gram = tuple(np.concatenate(own) for own in zip(*(part.gram for part in parts), strict=True))
    samples = np.concatenate([part.samples for part in parts])
    return replace(parts[0], gram=gram, samples=samples)


def total_phase(model: RobotModel, recordings: Iterable[Samples]) -> PhaseFactor:
    """Return the sum of the factors of recordings, each read once."""
    return sum(
        (PhaseFactor.from_samples(model, samples) for samples in recordings),
        PhaseFactor.zero(model),
    )


def fine_blocks(samples: Samples) -> NDArray[np.int64]:
    """Return the block of each sample (m,), rising; rows before the origin belong to the first."""
    since = samples.motion.time - samples.origin
    return np.maximum(np.floor(since / FINE_BLOCK + 1e-9).astype(np.int64), 0)


def block_slices(index: NDArray[np.int64]) -> Iterator[tuple[int, slice]]:
    """Yield each value of a rising index with its slice."""
    edges = np.flatnonzero(np.diff(index)) + 1
    for start, stop in pairwise([0, *edges.tolist(), len(index)]):
        if stop > start:
            yield int(index[start]), slice(start, stop)


class EqualRuns(NamedTuple):
    """Consecutive blocks of equally many rows."""

    first: int  # block
    blocks: int
    start: int  # first row
    length: int  # rows per block


def equal_runs(index: NDArray[np.int64]) -> list[EqualRuns]:
    """Group :func:`block_slices` of a rising index, for few large operations."""
    groups: list[EqualRuns] = []
    for block, at in block_slices(index):
        length = at.stop - at.start
        last = groups[-1] if groups else None
        if last is not None and last.length == length and last.first + last.blocks == block:
            groups[-1] = last._replace(blocks=last.blocks + 1)
        else:
            groups.append(EqualRuns(block, 1, at.start, length))
    return groups


def add_grams(total: Array, rows: Array, runs: Iterable[EqualRuns]) -> None:
    """Add ``rows rows'`` of each block to the total (B, c, c), in place; rows is (c, k)."""
    for first, count, start, length in runs:
        own = rows[:, start : start + count * length].reshape(len(rows), count, length)
        # A product with the own transpose takes half the work.
        own = own.transpose(1, 0, 2)
        total[first : first + count] += own @ own.transpose(0, 2, 1)


def samples_by_cell(index: NDArray[np.int64], usable: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return usable rows per block (B, n) of a mask (m, n), by a rising index (m,)."""
    if not len(index):
        return np.zeros((0, usable.shape[1]), dtype=np.intp)
    ends = np.searchsorted(index, np.arange(int(index[-1]) + 1), side="right")
    sums = np.cumsum(usable, axis=0, dtype=np.intp)[np.maximum(ends - 1, 0)]
    sums[ends == 0] = 0
    return np.diff(sums, axis=0, prepend=0)


def merged(blocks: Blocks, length: int) -> Blocks:
    """Sum runs of `length` blocks along the first axis (B, ...); the last may be shorter."""
    total = blocks[::length].copy()
    for later in range(1, length):  # faster than np.add.reduceat
        own = blocks[later::length]
        total[: len(own)] += own
    return total


def _added(first: Blocks, second: Blocks) -> Blocks:
    """Add blocks (B, ...) of possibly different number."""
    longer, shorter = (first, second) if len(first) >= len(second) else (second, first)
    total = longer.copy()
    total[: len(shorter)] += shorter
    return total


# of one recording
_MOST_ROWS: Final = 1000


@dataclass(frozen=True, eq=False)
class StandardGram:
    """Sums of products of [W0 | Wx | Wy | Wz | y] in standard parameters, by joint.

    The regressor is affine in gravity: W(g) = W0 + gx Wx + gy Wy + gz Wz; one pass serves any.
    """

    gram: Array  # (n, 4 s + 1, 4 s + 1) for s standard parameters, friction, springs and balancers
    rows: NDArray[np.intp]  # summed rows (n,)

    def under(self, gravity: Array) -> Factor:
        """Return the factor of the s columns under a gravity (3,) [m/s²]."""
        share, n, s = np.append(1.0, gravity), len(self.gram), len(self.gram[0]) // 4
        parts = self.gram[:, :-1, :-1].reshape(n, 4, s, 4, s)
        found = np.empty((n, s + 1, s + 1))
        found[:, :s, :s] = np.einsum("a,jasbt,b->jst", share, parts, share, optimize=True)
        found[:, :s, s] = share @ self.gram[:, :-1, -1].reshape(n, 4, s)
        found[:, s, :s] = found[:, :s, s]
        found[:, s, s] = self.gram[:, -1, -1]
        return Factor(found, self.rows, ())

    @classmethod
    def of(cls, model: RobotModel, recordings: Sequence[Samples]) -> StandardGram:
        """Sum over about a thousand usable rows of each recording."""
        n, s = model.n_joints, model.layout.size
        s += len(model.friction.names) + len(model.elements.names)
        plans = [
            RegressorPlan(
                model.chain,
                gravity,
                [list(range(10))] * n,
                [model.layout.rotor_inertia] * n,
                model.friction,
                model.layout.pairs,
                model.elements,
            )
            for gravity in (np.zeros(3), *np.eye(3))
        ]
        gram, rows = np.zeros((n, 4 * s + 1, 4 * s + 1)), np.zeros(n, dtype=np.intp)
        for samples in recordings:
            every = max(1, len(samples.torque) // _MOST_ROWS)
            filtered = samples.torque_bandwidth is not None
            part = slice(None, None, 1 if filtered else every)  # filters need all rows
            found = [plan.evaluate(*(one[part] for one in samples.motion[1:4])) for plan in plans]
            for joint in range(n):
                usable = samples.usable[::every, joint]
                table = np.zeros((len(usable), 4 * s + 1))
                for k, (blocks, columns) in enumerate(found):
                    block = blocks[joint]
                    if filtered:
                        block = samples.as_measured(joint, block)[::every]
                    table[:, k * s + columns[joint]] = block
                for k in (1, 2, 3):
                    table[:, k * s : (k + 1) * s] -= table[:, :s]
                table[:, -1] = samples.torque[::every, joint]
                table = table[usable]
                gram[joint] += table.T @ table
                rows[joint] += len(table)
        return cls(gram, rows)
