"""Reduced samples: sums over the rows of recordings.

A :class:`Factor` sums the rows [W | y] joint by joint and by blocks of time, as Gram matrices or
triangles. Factors add over chunks, repetitions, archives and processes; joint weights are applied
afterwards. Gram matrices square the condition: from 1e5 on triangles are used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.errors import IdentificationError
from identification.factor.blocks import (
    FINE_BLOCK,
    add_grams,
    added,
    block_slices,
    count_by_block,
    equal_runs,
    merged,
    part_edges,
)
from identification.factor.normal_equations import (
    NormalEquations,
    Solution,
    rows_of,
    solve,
    solve_rows,
)
from identification.factor.rows import augmented_rows
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Storage = Literal["gram", "qr"]

_MAX_FINE_BLOCKS: Final = 4  # fine blocks in a block of a long recording
_MANY_BLOCKS: Final = 400  # from which on they are longer: a covariance needs some tens

MAX_GRAM_CONDITION: Final = 1e5
MIN_NOISE: Final = 1e-6
"""Smallest noise that Gram matrices resolve, as a share of the torque's RMS."""


@dataclass(frozen=True, eq=False)
class Factor:
    """Sums over the rows of [W | y] in B blocks of time, joint by joint.

    Blocks give the scores of a cluster-robust covariance for any weights and parameters; estimates
    need their sum only. Other columns than W are in
    :mod:`identification.factor.columns`.
    """

    #: of joint j over its columns and the torque (B, c_j + 1, c_j + 1): the Gram matrix G of the
    #: rows, or an upper triangle R with R'R = G
    matrices: tuple[Array, ...]
    columns: tuple[Indices, ...]  #: per joint the parameter indices of its columns (c_j,)
    counts: Indices  #: rows (B, n)
    parameter_names: tuple[str, ...]  #: (p,)
    storage: Storage = "gram"
    block: float = FINE_BLOCK  #: duration of a block [s]

    @classmethod
    def zero(cls, model: RobotModel, blocks: int = 0, storage: Storage = "gram") -> Self:
        """Return the factor of no samples."""
        counts = np.zeros((blocks, model.n_joints), dtype=np.intp)
        return cls.of_rows((), counts, model.plan.columns, model.parameter_names, storage)

    @classmethod
    def of(
        cls,
        model: RobotModel,
        samples: Samples,
        storage: Storage = "gram",
        index: Indices | None = None,
    ) -> Self:
        """Reduce the usable rows of a recording.

        Args:
            model: of the arm.
            samples: of the recording.
            storage: Gram matrices, or QR.
            index: rising block of each row (m,); by default one block.

        Raises:
            ShapeError: wrong shape of an array.
        """
        index = np.zeros(len(samples.torque), dtype=np.intp) if index is None else index
        chunks = ((index[rows], tables) for rows, tables in augmented_rows(model, samples))
        counts = count_by_block(index, samples.usable)
        return cls.of_rows(chunks, counts, model.plan.columns, model.parameter_names, storage)

    @classmethod
    def by_time(cls, model: RobotModel, samples: Samples) -> Self:
        """Reduce the usable rows of a recording by blocks of `FINE_BLOCK`, longer ones if many."""
        index, block = time_blocks(samples)
        return replace(cls.of(model, samples, index=index), block=block)

    @classmethod
    def from_samples(
        cls, model: RobotModel, motion: Motion, torque: Array, mask: NDArray[np.bool_] | None = None
    ) -> Self:
        """Reduce m samples of a motion and its torque.

        Args:
            model: of the arm.
            motion: of the samples.
            torque: W pi (m, n) [N·m or N].
            mask: usable rows (m, n), by default all; see :meth:`RobotModel.moving`.

        Raises:
            ShapeError: wrong shape of an array.
        """
        usable = np.ones(np.shape(torque), dtype=np.bool_) if mask is None else mask
        nothing = np.full(model.n_joints, np.inf)
        return cls.of(model, Samples(motion, torque, usable, (), 0.0, nothing))

    @classmethod
    def of_rows(
        cls,
        chunks: Iterable[tuple[Indices, Iterable[Array]]],
        counts: Indices,
        columns: tuple[Indices, ...],
        names: tuple[str, ...],
        storage: Storage = "gram",
    ) -> Self:
        """Reduce chunks of k rows.

        Args:
            chunks: rising block indices (k,), and a table (c_j + 1, k) for each joint: its columns
                and, last, the torque, zero for unusable rows.
            counts: usable rows (B, n).
            columns: parameters of each joint's table (c_j,).
            names: of the parameters.
            storage: Gram matrices, or QR.
        """
        widths = [len(joint_columns) + 1 for joint_columns in columns]
        matrices = tuple(np.zeros((len(counts), width, width)) for width in widths)
        factor = cls(matrices, columns, counts, names, storage)
        for index, tables in chunks:
            factor.add_rows(index, tables)
        return factor

    @classmethod
    def of_gram(cls, gram: Array, samples: Indices, names: tuple[str, ...]) -> Self:
        """Return the factor of Gram matrices (n, p + 1, p + 1) of `samples` (n,) rows."""
        return cls(tuple(gram[:, None]), (np.arange(len(names)),) * len(gram), samples[None], names)

    def add_rows(self, index: Indices, tables: Iterable[Array]) -> None:
        """Add a chunk of :meth:`of_rows` to the matrices, in place."""
        if self.storage == "gram":
            runs = equal_runs(index)
            for total, table in zip(self.matrices, tables, strict=True):
                add_grams(total, table, runs)
            return
        for total, table in zip(self.matrices, tables, strict=True):
            for block, at in block_slices(index):
                total[block] = _triangle(np.concatenate([total[block], table[:, at].T]))

    # Sums over the blocks

    @cached_property
    def samples(self) -> Indices:
        """Rows per joint (n,)."""
        return np.asarray(self.counts.sum(axis=0))

    @cached_property
    def gram(self) -> Array:
        """Gram matrices (n, p + 1, p + 1), symmetric; of triangles with loss of digits."""
        width = self.n_parameters + 1
        whole = np.zeros((self.n_joints, width, width))
        for joint, joint_sum in enumerate(self._sums):
            place = self._places(joint)
            whole[joint, place[:, None], place] = joint_sum
        return whole

    @cached_property
    def _sums(self) -> tuple[Array, ...]:
        """Gram matrices over the columns of each joint (c_j + 1, c_j + 1)."""
        if self.storage == "gram":
            # That of one block is no copy, which can be large.
            return tuple(
                matrix[0] if len(matrix) == 1 else matrix.sum(axis=0) for matrix in self.matrices
            )
        return tuple(np.einsum("bki,bkj->ij", triangles, triangles) for triangles in self.matrices)

    @property
    def smallest_noise(self) -> float:
        """Smallest noise as a share of the torque's RMS, for joints that fit exactly."""
        return 1e-12 if self.storage == "qr" else MIN_NOISE

    @property
    def smallest_variance(self) -> Array:
        """Variance (n,) of the smallest noise, above zero."""
        torque = self.products(np.eye(self.n_parameters + 1)[:, -1:])[:, 0, 0]
        floor = self.smallest_noise**2 * torque / np.maximum(self.samples, 1)
        return np.asarray(np.maximum(floor, np.finfo(np.float64).tiny))

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.matrices)

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return len(self.parameter_names)

    def weighted(self, weights: Array) -> NormalEquations:
        """Return the normal equations with one weight per joint (n,): 1/variance."""
        total = self.weighted_gram(weights)
        return NormalEquations(
            A=total[:-1, :-1], b=total[:-1, -1], yy=float(total[-1, -1]), n=int(self.samples.sum())
        )

    def weighted_gram(self, weights: Array) -> Array:
        """Return the Gram matrix of [W | y] (p + 1, p + 1) with joint weights (n,)."""
        # One product of flat matrices: a general sum takes several times as long.
        total = weights @ self.gram.reshape(len(weights), -1)
        return np.asarray(total.reshape(self.gram.shape[1:]))

    @property
    def squared_torque(self) -> Array:
        """Sum of the squared torque per joint (n,)."""
        return np.array([total[-1, -1] for total in self._sums])

    def squared_errors(self, values: Array) -> Array:
        """Return the sum of squared torque errors of parameters (p,) per joint (n,)."""
        augmented = np.ones(self.n_parameters + 1)
        np.negative(values, out=augmented[:-1])
        return np.maximum((self.gram @ augmented) @ augmented, 0.0)

    def squared_errors_by_block(self, values: Array) -> Array:
        """Return the sum of squared torque errors (B, n) of own parameters of each block (B, p)."""
        assert self.storage == "gram"
        augmented = np.column_stack([-values, np.ones(len(values))])
        squares = np.zeros((len(self), self.n_joints))
        for joint, grams in enumerate(self.matrices):
            joint_gram = augmented[:, self._places(joint)]
            squares[:, joint] = (joint_gram[:, None] @ grams @ joint_gram[:, :, None])[:, 0, 0]
        return np.maximum(squares, 0.0)

    def residual_rms(self, values: Array) -> Array:
        """Return the RMS residual of parameters (p,) per joint (n,), NaN without rows.

        At least the smallest noise: sums of squares do not resolve a better fit.
        """
        variance = self.squared_errors(values) / np.maximum(self.samples, 1)
        rms = np.sqrt(np.maximum(variance, self.smallest_variance))
        return np.where(self.samples > 0, rms, np.nan)

    def relative_errors(self, values: Array) -> Array:
        """Return ||e|| / ||tau|| of parameters (p,) per joint (n,), NaN without torque."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.squared_errors(values) / self.gram[:, -1, -1])

    def relative_error(self, values: Array) -> float:
        """Return ||e|| / ||tau|| of parameters (p,) over all joints, NaN without torque."""
        power = float(self.gram[:, -1, -1].sum())
        return float(np.sqrt(self.squared_errors(values).sum() / power)) if power > 0.0 else np.nan

    def rows(self, weights: Array) -> tuple[Array, Array]:
        """Return equivalent rows (k, p) and target (k,) with joint weights (n,)."""
        if self.storage == "gram":
            return rows_of(self.weighted(weights))
        wide = np.concatenate([self._wide(j) * np.sqrt(w) for j, w in enumerate(weights)])
        triangle = _triangle(wide)
        return triangle[:-1, :-1], triangle[:-1, -1]

    def solve(self, weights: Array) -> Solution:
        """Solve the weighted least-squares problem, weights (n,); triangles without squaring."""
        if self.storage == "gram":
            return solve(self.weighted(weights))
        return solve_rows(*self.rows(weights))

    def products(self, directions: Array) -> Array:
        """Return ``D' G_j D`` (n, k, k) for directions D (p, k), or (p + 1, k) with the torque."""
        size = len(directions)
        if self.storage == "gram":
            return np.asarray(directions.T @ self.gram[:, :size, :size] @ directions)
        moved = [self._wide(joint)[:, :size] @ directions for joint in range(self.n_joints)]
        return np.array([triangle.T @ triangle for triangle in moved])

    # Blocks

    def __len__(self) -> int:
        """Number B of blocks."""
        return len(self.counts)

    def __add__(self, other: Self) -> Self:
        """Add blocks at equal times since the origin, as of repetitions of a motion.

        They are as long as the longer ones.

        Raises:
            IdentificationError: the two belong to different models.
        """
        same = self.n_joints == other.n_joints and self.storage == other.storage
        if not same or self.parameter_names != other.parameter_names:
            raise IdentificationError("factors with different joints or parameters cannot be added")
        longest = max((part.block for part in (self, other) if len(part)), default=self.block)
        mine, its = (part.of_blocks(longest) for part in (self, other))
        add = added if self.storage == "gram" else _triangles_of_both
        matrices = tuple(add(a, b) for a, b in zip(mine.matrices, its.matrices, strict=True))
        counts = added(mine.counts, its.counts)
        return replace(mine, matrices=matrices, counts=counts)

    def by_block(self, weights: Array) -> Array:
        """Return the Gram matrices of the blocks (B, p + 1, p + 1) with joint weights (n,)."""
        assert self.storage == "gram"
        width = self.n_parameters + 1
        whole = np.zeros((len(self), width * width))
        for joint, (weight, gram) in enumerate(zip(weights, self.matrices, strict=True)):
            place = self._places(joint)
            flat = (place[:, None] * width + place).ravel()
            whole[:, flat] += weight * gram.reshape(len(gram), -1)
        return whole.reshape(-1, width, width)

    def scores(self, weights: Array, values: Array) -> Array:
        """Return the scores ``W' w (y - W values)`` of each block (B, p)."""
        assert self.storage == "gram"
        pull = np.zeros((len(self), self.n_parameters))
        for weight, gram, used in zip(weights, self.matrices, self.columns, strict=True):
            pull[:, used] += weight * (gram[:, :-1] @ np.append(-values[used], 1.0))
        return pull

    def blocks(self, which: slice | NDArray[np.bool_]) -> Self:
        """Return some blocks, by slice or mask (B,)."""
        matrices = tuple(matrix[which] for matrix in self.matrices)
        return replace(self, matrices=matrices, counts=self.counts[which])

    def without(self, which: slice | NDArray[np.bool_]) -> Self:
        """Return the sum of all blocks but some, by slice or mask (B,), as one block."""
        assert self.storage == "gram"
        matrices = tuple(
            (total - matrix[which].sum(axis=0))[None]
            for total, matrix in zip(self._sums, self.matrices, strict=True)
        )
        counts = self.samples - self.counts[which].sum(axis=0)
        return replace(self, matrices=matrices, counts=counts[None])

    def occupied(self) -> Self:
        """Return the blocks with rows."""
        rows = np.asarray(self.counts.any(axis=1))
        if rows.all():
            return self
        used = np.flatnonzero(rows)
        if len(used) and used[-1] - used[0] < len(used):  # without a gap, so that none is copied
            return self.blocks(slice(int(used[0]), int(used[-1]) + 1))
        return self.blocks(rows)

    def merged(self, length: int) -> Self:
        """Merge runs of `length` blocks; the last one may be shorter."""
        assert self.storage == "gram"
        matrices = tuple(merged(matrix, length) for matrix in self.matrices)
        counts = merged(self.counts, length)
        block = length * self.block
        return replace(self, matrices=matrices, counts=counts, block=block)

    def scaled(self, times: float) -> Self:
        """Return the sums with every row weighted by `times`."""
        counts = np.rint(times * self.counts).astype(np.intp)
        return replace(self, matrices=tuple(times * m for m in self.matrices), counts=counts)

    def parts(self, count: int) -> Self:
        """Return the sums of equal parts of the occupied blocks; these, if they are fewer."""
        assert self.storage == "gram"
        factor = self.occupied()
        if len(factor) <= count:
            return factor
        edges = part_edges(len(factor), count)
        matrices = tuple(np.add.reduceat(matrix, edges) for matrix in factor.matrices)
        return replace(factor, matrices=matrices, counts=np.add.reduceat(factor.counts, edges))

    def of_blocks(self, block: float) -> Self:
        """Merge blocks to this duration [s], a multiple of theirs."""
        length = round(block / self.block)
        if length == 1 or not len(self):
            return replace(self, block=block)
        return self.merged(length)

    def restricted(self, chosen: Indices) -> Self:
        """Return the factor of the parameters `chosen` (k,), in that order."""
        index = np.full(self.n_parameters, -1, dtype=np.intp)
        index[chosen] = np.arange(len(chosen))
        matrices = []
        columns = []
        for matrix, used in zip(self.matrices, self.columns, strict=True):
            stays = np.flatnonzero(index[used] >= 0)
            both = np.append(stays, len(used))
            matrices.append(matrix[:, both[:, None], both])
            columns.append(index[used[stays]])
        names = tuple(self.parameter_names[k] for k in chosen)
        return replace(
            self, matrices=tuple(matrices), columns=tuple(columns), parameter_names=names
        )

    def _places(self, joint: int) -> Indices:
        """Return the indices of a joint's columns among all p + 1, torque last."""
        used = self.columns[joint]
        places = np.empty(len(used) + 1, dtype=np.intp)
        places[:-1] = used
        places[-1] = self.n_parameters
        return places

    def _wide(self, joint: int) -> Array:
        """Return the triangles of a joint as rows (k, p + 1)."""
        stacked = self.matrices[joint].reshape(-1, self.matrices[joint].shape[-1])
        wide = np.zeros((len(stacked), self.n_parameters + 1))
        wide[:, self._places(joint)] = stacked
        return wide


def time_blocks(samples: Samples) -> tuple[Indices, float]:
    """Return the block of each sample (m,), and its duration [s]: longer ones if many."""
    index = samples.blocks(FINE_BLOCK)
    length = 1
    while length < _MAX_FINE_BLOCKS and index.max(initial=0) >= length * _MANY_BLOCKS:
        length *= 2
    return index // length, length * FINE_BLOCK


def joined(parts: Sequence[Factor]) -> Factor:
    """Concatenate the blocks of several factors."""
    grams = zip(*(part.matrices for part in parts), strict=True)
    counts = np.concatenate([part.counts for part in parts])
    return replace(parts[0], matrices=tuple(map(np.concatenate, grams)), counts=counts)


def total_factor(model: RobotModel, recordings: Iterable[Samples]) -> Factor:
    """Return the sum of the factors of recordings by time, each read once."""
    return sum((Factor.by_time(model, samples) for samples in recordings), Factor.zero(model))


def mean_factor(factors: Sequence[Factor], shares: Sequence[float]) -> Factor:
    """Return the weighted mean of factors by time of the same rows, smoothed differently."""
    if len(factors) == 1:
        return factors[0]

    def mean(stack: Sequence[Array | Indices]) -> Array:
        return np.asarray(sum(s * part for s, part in zip(shares, stack, strict=True)))

    matrices = tuple(map(mean, zip(*(factor.matrices for factor in factors), strict=True)))
    counts = np.rint(mean([factor.counts for factor in factors])).astype(np.intp)
    return replace(factors[0], matrices=matrices, counts=counts)


def _triangles_of_both(first: Array, second: Array) -> Array:
    """Add triangles (B, c, c) of possibly different number."""
    longer, shorter = (first, second) if len(first) >= len(second) else (second, first)
    both = [_triangle(np.concatenate(pair)) for pair in zip(longer, shorter, strict=False)]
    return np.array([*both, *longer[len(shorter) :]]).reshape(longer.shape)


def _triangle(rows: Array) -> Array:
    """Return upper triangular R with R'R = rows'rows, square, missing rows zero."""
    triangle = np.linalg.qr(rows, mode="r")
    square = np.zeros((rows.shape[1], rows.shape[1]))
    square[: len(triangle)] = triangle
    return square


def require_rows(model: RobotModel, factor: Factor) -> None:
    """Raise IdentificationError without usable rows."""
    if not factor.samples.any():
        raise IdentificationError(no_rows_message(model))


def no_rows_message(model: RobotModel) -> str:
    """Return the error message for no usable rows."""
    slowest = float(np.min(model.friction.standstill))
    return (
        "there is not one usable sample: no joint moves faster than the standstill speed of"
        f" {slowest:g} rad/s or m/s away from ends and gaps of the recordings; record a longer or"
        " faster motion"
    )


def reduced(model: RobotModel, recordings: Sequence[Samples], gram: Factor) -> Factor:
    """Return Gram matrices of recordings, or triangles above a condition `MAX_GRAM_CONDITION`.

    Triangles read the samples once more; without recordings the Gram matrices are returned.

    Raises:
        IdentificationError: no usable row.
    """
    require_rows(model, gram)
    if not recordings or gram.solve(np.ones(model.n_joints)).condition <= MAX_GRAM_CONDITION:
        return gram
    triangles = (Factor.of(model, samples, "qr") for samples in recordings)
    return sum(triangles, Factor.zero(model, storage="qr"))
