"""Columns in which changes of recordings are linear, as sums of products by joint and block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.factor.blocks import FOLDS
from identification.hypotheses.joint_changes import Change
from identification.model.link_wrenches import N_LINK
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_MAX_ROWS: Final = 3000  # of all recordings together
BLOCKS: Final = 10  # of all recordings together
_STEP: Final = 1e-4  # rad, of a derivative


@dataclass(frozen=True, eq=False)
class ColumnSums:
    """Sums of products of columns over the rows of B blocks, joint by joint.

    Columns: parameters (p), payload (10), rate of the predicted torque, friction in proportion to
    the load, drift of each joint's zero by one radian (n), cosine and sine of the joint's own
    angle, torques of all joints (n).
    """

    gram: Array  # (B, n, q, q)
    rows: NDArray[np.intp]  # usable rows (B, n)
    recording: NDArray[np.intp]  # index of the recording of each block (B,)
    start: Array  # start time of each since its recording began (B,) [s]
    n_parameters: int  # p
    step: int = 1  # only every `step`-th row is in the sums

    @property
    def width(self) -> int:
        """Number q of columns."""
        return int(self.gram.shape[-1])

    @property
    def torques(self) -> Array:
        """The measured torque of each joint as a combination of the columns (n, q)."""
        n = self.gram.shape[1]
        return np.eye(n, self.width, self.width - n)

    @cached_property
    def of_parameters(self) -> Array:
        """Sums over the columns of the parameters (B, n, p, p)."""
        return np.ascontiguousarray(self.gram[..., : self.n_parameters, : self.n_parameters])

    @cached_property
    def by_fold(self) -> Array:
        """The same of each fold (F, n, p, p)."""
        return folded(self.of_parameters)

    def mask_of(self, change: Change) -> Array:
        """Return 1 for the blocks (B,) that a change concerns, 0 for the others.

        Its part is one of undivided blocks.
        """
        blocks = len(self.gram)
        if change.part is None:
            return np.ones(blocks)
        mask = np.array(change.part.blocks, dtype=np.float64)
        return np.repeat(mask, blocks // len(mask))

    @classmethod
    def of(
        cls,
        model: RobotModel,
        recordings: Sequence[Samples],
        values: Array,
        *,
        blocks: int = BLOCKS,
        divided: int = 1,
    ) -> ColumnSums:
        """Reduce some thousand rows to so many blocks, each `divided` into so many.

        Args:
            model: of the arm.
            recordings: prepared.
            values: parameters (p,) of the rate and the load of its torque.
            blocks: of all recordings together.
            divided: parts of each block.
        """
        count = divided * -(-blocks // len(recordings))
        step = row_step(recordings, _MAX_ROWS)
        grams = []
        rows = []
        starts = []
        for samples in recordings:
            some = np.arange(step // 2, len(samples.torque), step)
            tables = _tables(model, samples, values, some)
            edges = np.linspace(0, len(some), count + 1).round().astype(int)
            usable = samples.usable[some]
            tables *= usable.T[:, :, None]
            for a, b in pairwise(edges):
                block_rows = tables[:, a:b]
                grams.append(np.swapaxes(block_rows, 1, 2) @ block_rows)
                rows.append(np.count_nonzero(usable[a:b], axis=0))
                starts.append(samples.motion.time[some[a]] - samples.motion.time[0] if a else 0.0)
        recording = np.repeat(np.arange(len(recordings)), count)
        p = model.n_parameters
        return cls(np.array(grams), np.array(rows), recording, np.array(starts), p, step)


def row_step(recordings: Sequence[Samples], rows: int) -> int:
    """Return the step with which all recordings together have about these rows."""
    return max(1, sum(len(samples.torque) for samples in recordings) // rows)


def _tables(model: RobotModel, samples: Samples, values: Array, some: NDArray[np.intp]) -> Array:
    """Return the columns of some rows of each joint (n, k, q)."""
    n = model.n_joints
    p = model.n_parameters
    payload = RegressorPlan.of_bodies(model.chain, model.gravity, n - 1)
    filtered = samples.torque_bandwidth is not None or samples.parent is not None
    part = np.arange(len(samples.torque)) if filtered else some
    motion = samples.motion.rows(part)
    loads = payload.evaluate(motion.kinematics()).blocks
    if filtered:
        blocks, columns = samples.regressor(model)
        blocks = tuple(block[some] for block in blocks)
        loads = tuple(samples.as_measured(j, block)[some] for j, block in enumerate(loads))
    else:
        blocks, columns = model.regressor(motion)
    tables = np.zeros((n, len(some), p + N_LINK + 4 + 2 * n))
    for j in range(n):
        tables[j][:, columns[j]] = blocks[j]
        tables[j][:, p + payload.columns[j]] = loads[j]
    tables[:, :, p + N_LINK] = _rate(model, samples, values, some).T
    tables[:, :, p + N_LINK + 1] = _load_friction(model, samples, values, part, some).T
    tables[:, :, p + N_LINK + 2 : -n - 2] = _drift(model, samples, values, some)
    angle = samples.motion.position[some].T
    turns = np.array(model.chain.revolute, dtype=np.float64)[:, None]
    tables[:, :, -n - 2] = turns * np.cos(angle)
    tables[:, :, -n - 1] = turns * np.sin(angle)
    tables[:, :, -n:] = samples.torque[some]
    return tables


def _drift(model: RobotModel, samples: Samples, values: Array, some: NDArray[np.intp]) -> Array:
    """Return what zeros that drift by a radian add to each torque (n, k, n) in some rows.

    From the first to the last row of the recording, in proportion to the time, of joints that turn.
    """
    motion = samples.motion.rows(some)
    if motion.direction is None:
        motion = replace(motion, direction=model.friction.direction(motion))
    motion = replace(motion, load=None)
    time = samples.motion.time
    passed = (motion.time - time[0]) / max(float(time[-1] - time[0]), 1e-9)
    usual = model.torque(values, motion)
    drift = np.zeros((model.n_joints, len(some), model.n_joints))
    for joint in np.flatnonzero(model.chain.revolute):
        position = motion.position.copy()
        position[:, joint] += _STEP
        moved = model.torque(values, replace(motion, position=position))
        drift[:, :, joint] = ((moved - usual) / _STEP * passed[:, None]).T
    return drift


def _rate(model: RobotModel, samples: Samples, values: Array, some: NDArray[np.intp]) -> Array:
    """Return the rate of the predicted torque (k, n) in some rows, from their neighbours."""
    after = np.minimum(some + 1, len(samples.torque) - 1)
    before = np.maximum(some - 1, 0)
    now, first, last = (samples.motion.rows(rows) for rows in (some, before, after))
    direction = now.direction
    if direction is None:
        direction = model.friction.direction(now)
    low, high = (
        model.torque(values, replace(motion, direction=direction, load=None))
        for motion in (first, last)
    )
    return np.asarray((high - low) / np.maximum(last.time - first.time, 1e-9)[:, None])


def _load_friction(
    model: RobotModel,
    samples: Samples,
    values: Array,
    part: NDArray[np.intp],
    some: NDArray[np.intp],
) -> Array:
    """Return the transmitted torque against the direction of motion (k, n) in some rows.

    `part` are the rows that a filter of the torque needs.
    """
    motion = samples.motion.rows(part)
    direction = motion.direction
    if direction is None:
        direction = model.friction.direction(motion)
    load = np.abs(model.gear_torque(values, motion)) * direction[:, : model.n_joints]
    if len(part) == len(some):
        return np.asarray(load)
    columns = [samples.as_measured(j, load[:, j : j + 1])[some] for j in range(model.n_joints)]
    return np.hstack(columns)


def folded(blocks: Array) -> Array:
    """Return the sum of every fifth block (F, ...) of B (B, ...)."""
    return np.array([blocks[k::FOLDS].sum(axis=0) for k in range(FOLDS)])


def columns_of(tables: ColumnSums, model: RobotModel, values: Array, change: Change) -> Array:
    """Return the columns of a change as combinations of a table's columns (B, n, q, r).

    Friction drifts by a parabola of time.

    Args:
        tables: of the blocks.
        model: of the arm.
        values: parameters (p,).
        change: of what was recorded.
    """
    blocks, n, width, _ = tables.gram.shape
    p = model.n_parameters
    joints = list(change.joints or range(model.n_joints))
    if change.meaning == "friction drift":
        time = (np.arange(blocks) + 0.5) / blocks  # of all recordings, one after the other
        parts = np.zeros((n, width, len(joints)))
        parts[joints, :p, range(len(joints))] = values * model.friction_columns
        return np.concatenate([np.multiply.outer(time**k, parts) for k in (1, 2)], axis=3)
    counts = {"payload": N_LINK, "arm": p, "load friction": n, "spring": 2 * len(joints)}
    count = counts.get(change.meaning, 1)
    columns = np.zeros((n, width, count))
    if change.meaning == "delay":
        columns[joints, p + N_LINK, 0] = -1.0
    elif change.meaning == "load friction":
        columns[joints, p + N_LINK + 1, joints] = 1.0
    elif change.meaning == "drift":
        columns[:, p + N_LINK + 2 + joints[0], 0] = 1.0
    elif change.meaning == "spring":
        places = np.arange(len(joints))
        columns[joints, -n - 2, 2 * places] = columns[joints, -n - 1, 2 * places + 1] = 1.0
    elif change.meaning == "payload":
        columns[:, p : p + N_LINK] = np.eye(N_LINK)
    elif change.meaning == "arm":
        columns[:, :p] = np.eye(p)
    else:
        friction = change.meaning == "friction"
        columns[joints, :p, 0] = values * model.friction_columns if friction else values
    return np.asarray(tables.mask_of(change)[:, None, None, None] * columns)
