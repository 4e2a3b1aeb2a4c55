"""Recordings as sums over columns of torque, and the changes that are known of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import numpy as np

from identification.arrays import Array
from identification.hypotheses.column_scores import ColumnScore, column_score
from identification.hypotheses.explanation import ExplainedFit, Explanation
from identification.hypotheses.joint_changes import Change, changed_samples
from identification.hypotheses.sizes import ChangeSize, estimated_size
from identification.hypotheses.torque_columns import BLOCKS, ColumnSums, columns_of
from identification.model.link_wrenches import N_LINK
from identification.model.robot import RobotModel
from identification.signals.recording import MIN_MOVEMENT
from identification.signals.samples import Samples

_SCALE_ROUNDS: Final = 20  # fits, each with the scale of the one before undone
_SCALE_TOLERANCE: Final = 1e-3  # relative change of a scale
_LOAD: Final = Change("payload")  # that nobody stated
_PARTS_PER_BLOCK: Final = 4  # parts of a block whose scatter gives the interval of a size


@dataclass(frozen=True, eq=False)
class ColumnFit:
    """Recordings as sums, with known changes.

    Attributes:
        model: of the arm.
        fitted: the fit whose errors are to be explained.
        recorded: the recordings as they are.
        recordings: these with scales of torques undone.
        tables: sums over their columns, block by block.
        moved: joints whose scale and friction the fitted rows show.
        seen: recordings, from the first, in which no change begins.
        blocks: of the tables.
        known: changes that every score has columns for.
    """

    model: RobotModel
    fitted: ExplainedFit
    recorded: Sequence[Samples]
    recordings: Sequence[Samples]
    tables: ColumnSums
    moved: tuple[int, ...]
    seen: int
    blocks: int
    known: tuple[Change, ...] = ()

    @classmethod
    def of(
        cls,
        model: RobotModel,
        recordings: Sequence[Samples],
        fitted: ExplainedFit,
        *,
        seen: int = 0,
        blocks: int = BLOCKS,
    ) -> Self:
        """Reduce recordings, without any known change.

        Args:
            model: of the arm.
            recordings: of one arm.
            fitted: fit whose errors are to be explained.
            seen: recordings, from the first, in which no change begins.
            blocks: in all recordings together.
        """
        fit = recordings[:seen] or recordings
        travel = np.max([np.ptp(samples.motion.position, axis=0) for samples in fit], axis=0)
        usable = np.any([samples.usable.any(axis=0) for samples in fit], axis=0)
        moved = np.flatnonzero((travel > MIN_MOVEMENT) & usable).tolist()
        tables = ColumnSums.of(model, recordings, fitted.values, blocks=blocks)
        return cls(model, fitted, recordings, recordings, tables, tuple(moved), seen, blocks)

    def knowing(self, changes: Sequence[Change]) -> Self:
        """Return it with these changes known, and no others."""
        return replace(self, known=tuple(changes))

    def as_recorded(self) -> Self:
        """Return it with all scales of torques as they were recorded."""
        return self._refitted(self.recorded, self.fitted.values)

    def _refitted(self, recordings: Sequence[Samples], values: Array) -> Self:
        return replace(
            self,
            fitted=replace(self.fitted, values=values),
            recordings=recordings,
            tables=ColumnSums.of(self.model, recordings, values, blocks=self.blocks),
        )

    def columns(self, change: Change) -> Array:
        """Return the columns of a change (B, n, q, r)."""
        return columns_of(self.tables, self.model, self.fitted.values, change)

    def score(self, *changes: Change) -> ColumnScore:
        """Predict every fifth block from the others, with changes in addition to the known."""
        columns = np.concatenate([*map(self.columns, changes), self._of_known], axis=3)
        return column_score(self.tables, columns, self.tables.torques)

    @cached_property
    def usual(self) -> ColumnScore:
        """The score of what is known."""
        return self.score()

    @cached_property
    def _of_known(self) -> Array:
        none = np.zeros((*self.tables.gram.shape[:3], 0))
        return np.concatenate([none, *map(self.columns, self.known)], axis=3)

    @cached_property
    def noise(self) -> Array:
        """Sums of squared noise (n,)."""
        noise = self.fitted.noise
        noise = np.zeros(self.model.n_joints) if noise is None else np.nan_to_num(noise)
        return np.asarray(noise**2 * self.tables.rows.sum(axis=0))

    def sized(self, explanation: Explanation, values: Array | None = None) -> Explanation:
        """Return an explanation with the size that is most probable, by a fit with it (p,).

        A torque constant has none where its size with an unknown load is another one.
        """
        values = self.fitted.values if values is None else values
        if explanation.change.meaning == "arm":
            return explanation
        tables = ColumnSums.of(
            self.model, self.recordings, values, blocks=self.blocks, divided=_PARTS_PER_BLOCK
        )

        def given(known: Sequence[Change]) -> ChangeSize | None:
            return estimated_size(
                explanation.change,
                tables,
                self.model,
                values,
                known=known,
                prior=self.fitted.prior,
                scale_std=self.fitted.scale_std,
            )

        found = given(self.known)
        if found is not None and explanation.change.is_constant and _LOAD not in self.known:
            # It changes the torques that a constant is compared with.
            loaded = given([*self.known, _LOAD])
            if loaded is not None:
                is_other = loaded.differs_from(found)
                found = None if is_other else found.or_as(loaded)
        if found is None:
            return explanation._replace(size=None, std=0.0)
        return explanation._replace(
            size=found.size, std=found.std, interval_factor=found.interval_factor
        )

    def without_scale(self, scale: Change, load: Change) -> tuple[Self, float, float]:
        """Return it with the scale of a joint's torque undone, that scale and its deviation.

        The scale multiplies the torque of a load as well, so that it is found in rounds.
        """
        size = std = 0.0
        fit = self
        for _ in range(_SCALE_ROUNDS):
            undone = scale._replace(size=size)
            recordings = [changed_samples(self.model, each, undone) for each in self.recordings]
            both = fit._refitted(recordings, fit.fitted.values).score(load, scale)
            more = both.added[:, N_LINK]  # after the columns of the load
            std = (1.0 + size) * float(np.sqrt((len(more) - 1) * more.var()))
            size = (1.0 + size) * (1.0 + float(more.mean())) - 1.0
            fit = fit._refitted(recordings, both.values.mean(axis=0))
            if abs(more.mean()) < _SCALE_TOLERANCE:
                break
        return fit, size, std
