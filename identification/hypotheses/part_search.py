r"""The part of recordings in which something is other than in the rest: from when to when.

For every interval of blocks, least squares tells by how much columns that act in it alone reduce
the error of a fit of all parameters:

.. math::

    c^T S^{-1} c, \qquad S = C^T C - C^T W (W^T W)^{-1} W^T C, \qquad c = C^T (\tau - W \hat\pi)

with the columns C of the interval and W of the parameters. All sums are differences of two
cumulative ones, so that thousands of intervals take some milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.factor.normal_equations import solve_with_ridge
from identification.hypotheses.column_scores import MIN_ROWS
from identification.hypotheses.torque_columns import ColumnRows, ColumnSums

_RIDGE: Final = 1e-6  # of each column's information


class Interval(NamedTuple):
    """Blocks from `first` to before `end`, and the alternative whose columns found it."""

    first: int
    end: int
    name: str
    reduction: float  # of the weighted sum of squared errors


@dataclass(frozen=True, eq=False)
class PartScan:
    """Sums over blocks of weighted products of `[W | C | torque]`."""

    gram: Array  # (B, p + r + 1, p + r + 1)
    columns: Array  # W, C and the torque as combinations of the columns of the sums (B, n, q, k)
    weights: Array  # of the joints (n,)
    recording: NDArray[np.intp]  # (B,)
    n_parameters: int  # p, with the columns of what is known

    @classmethod
    def of(cls, sums: ColumnSums, known: Array, columns: Array, fitted: Array) -> PartScan:
        """Weight the joints by what is usual of the blocks, of which a part may be other.

        Args:
            sums: over blocks.
            known: columns of what is known (B, n, q, k).
            columns: that may act in a part (B, n, q, r).
            fitted: parameters, and coefficients of what is known (p + k,).
        """
        blocks, n, width, _ = sums.gram.shape
        p = sums.n_parameters
        each = np.broadcast_to
        parameters = np.concatenate([each(np.eye(width, p), (blocks, n, width, p)), known], axis=3)
        torque = each(sums.torques[:, :, None], (blocks, n, width, 1))
        residual = torque[..., 0] - parameters @ fitted
        squares = np.einsum("bji,bjik,bjk->bj", residual, sums.gram, residual, optimize=True)
        variance = np.where(sums.rows >= MIN_ROWS, squares / np.maximum(sums.rows, 1), np.nan)
        power = np.einsum("bji,bjik,bjk->j", torque[..., 0], sums.gram, torque[..., 0])
        floor = 1e-12 * power / np.maximum(sums.rows.sum(axis=0), 1) + np.finfo(np.float64).tiny
        has_rows = np.isfinite(variance).any(axis=0)
        usual = np.full(n, np.inf)
        usual[has_rows] = np.maximum(np.nanmedian(variance[:, has_rows], axis=0), floor[has_rows])
        weights = 1.0 / usual
        wide = np.concatenate([parameters, columns, torque], axis=3)
        products = np.swapaxes(wide, 2, 3) @ (weights[:, None, None] * (sums.gram @ wide))
        return cls(products.sum(axis=1), wide, weights, sums.recording, parameters.shape[3])

    def best(
        self, alternatives: Mapping[str, Sequence[int]], first: int, shortest: int
    ) -> Interval | None:
        """Return the interval in which some columns reduce the error most.

        It is within a recording, or lasts to the end of all of them.

        Args:
            alternatives: columns that act together, by name.
            first: first block that may be in it.
            shortest: fewest blocks of it, and before and after it.
        """
        p = self.n_parameters
        normal = self.gram[:, :p, :p].sum(axis=0)
        length = np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
        root = np.linalg.cholesky(normal / np.outer(length, length) + _RIDGE * np.eye(p))
        mixed = np.linalg.solve(root, self.gram[:, :p, p:] / length[:, None])
        whole = mixed[..., -1].sum(axis=0)
        products = self.gram[:, p:-1, p:-1]
        right = self.gram[:, p:-1, -1] - np.einsum("bpr,p->br", mixed[..., :-1], whole)
        intervals = self._intervals(first, shortest)
        if not len(intervals):
            return None
        right = _differences(np.asarray(right), intervals)
        mixed = _differences(np.asarray(mixed[..., :-1]), intervals)
        products = _differences(products, intervals)
        schur = products - np.swapaxes(mixed, 1, 2) @ mixed
        best: Interval | None = None
        for name, columns in alternatives.items():
            reduction = _reduction(schur, right, products, columns)
            k = int(reduction.argmax())
            if best is None or reduction[k] > best.reduction:
                a, b = intervals[k].tolist()
                best = Interval(a, b, name, float(reduction[k]))
        return best

    def _intervals(self, first: int, shortest: int) -> NDArray[np.intp]:
        blocks = len(self.recording)
        end_of = np.searchsorted(self.recording, self.recording, side="right")
        found = [
            (a, b)
            for a in range(max(first, shortest), blocks - shortest + 1)
            for b in (*range(a + shortest, min(end_of[a], blocks - shortest) + 1), blocks)
        ]
        return np.array(found, dtype=np.intp).reshape(-1, 2)

    def edges(
        self,
        rows: ColumnRows,
        edges: NDArray[np.intp],
        interval: Interval,
        columns: Sequence[int],
    ) -> tuple[int, int]:
        """Return the first row of an interval, and the first after it, to a row.

        They are where the columns that found it begin and cease to predict the rows better.

        Args:
            rows: of the sums.
            edges: of the blocks (B + 1,).
            interval: of blocks.
            columns: that act in it.
        """
        p = self.n_parameters
        some = [p + k for k in columns]
        chosen = [*range(p), *some]
        inside = slice(interval.first, interval.end)
        normal = np.zeros((len(chosen),) * 2)
        right = np.zeros(len(chosen))
        total = self.gram.sum(axis=0)
        part = self.gram[inside].sum(axis=0)
        normal[:p, :p] = total[:p, :p]
        normal[:p, p:] = part[np.ix_(range(p), some)]
        normal[p:, :p] = normal[:p, p:].T
        normal[p:, p:] = part[np.ix_(some, some)]
        right[:p] = total[:p, -1]
        right[p:] = part[some, -1]
        solution = solve_with_ridge(normal, right, _RIDGE)
        found = []
        for at, is_first in ((interval.first, True), (interval.end, False)):
            if at == len(self.recording) or edges[at] == 0:
                found.append(int(edges[at]))
                continue
            window = slice(int(edges[max(at - 1, 0)]), int(edges[min(at + 1, len(edges) - 1)]))
            better = self._better(rows, window, min(at, len(self.columns) - 1), solution, some)
            sums = np.cumsum(better[::-1])[::-1] if is_first else np.cumsum(better)
            least = int(sums.argmax())
            found.append(window.start + (least if is_first else least + 1))
        return found[0], found[1]

    def _better(
        self, rows: ColumnRows, window: slice, block: int, solution: Array, some: Sequence[int]
    ) -> Array:
        """Return by how much the columns reduce the squared error of some rows (k,)."""
        p = self.n_parameters
        columns = self.columns[block]
        without = columns[..., -1] - columns[..., :p] @ solution[:p]
        with_part = without - columns[..., some] @ solution[p:]
        table = rows.columns[:, window]
        errors = [np.einsum("jkq,jq->jk", table, each) ** 2 for each in (without, with_part)]
        return np.asarray(self.weights @ (errors[0] - errors[1]))


def _differences(blocks: Array, intervals: NDArray[np.intp]) -> Array:
    """Return the sums of blocks (B, ...) over intervals (I, ...)."""
    sums = np.concatenate([np.zeros_like(blocks[:1]), np.cumsum(blocks, axis=0)])
    return np.asarray(sums[intervals[:, 1]] - sums[intervals[:, 0]])


def _reduction(schur: Array, right: Array, products: Array, columns: Sequence[int]) -> Array:
    """Return by how much columns reduce the squared error, by interval (I,)."""
    some = np.ix_(range(len(schur)), columns, columns)
    size = np.einsum("ikk->ik", products[some])
    size = np.where(size > 0.0, size, 1.0)
    matrix = schur[some] + _RIDGE * size[:, :, None] * np.eye(len(columns))
    vector = right[:, columns]
    solution = np.linalg.solve(matrix, vector[..., None])[..., 0]
    return np.asarray(np.einsum("ik,ik->i", vector, solution))
