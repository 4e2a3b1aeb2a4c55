"""Errors of any estimate on a motion, as quadratic forms of the estimate.

The error that parameters leave is linear in them, Phi pi - tau, and so is a low-pass. Its squared
length is therefore y' G y with y = [-pi; 1] and G the Gram matrix of the low-passed [Phi | tau]:
one matrix for each motion tells the error of every estimate there will ever be.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from hil.results.frozen import Frozen
from identification import RobotModel
from identification.preprocessing import Samples
from identification.smoothing_spline import low_pass
from identification.validation import FIGURE_BANDWIDTH

Array = NDArray[np.float64]


class MotionForm(Frozen):
    """Gram matrices of one held-out motion, over its usable rows; p parameters, n joints."""

    archive: str
    torque_squared: list[float]
    """Sum of the measured torque², per joint."""
    columns: list[list[int]]
    """Parameters that each joint's torque depends on."""
    slow: list[str]
    """Of the low-passed [Phi | tau] of each joint, in these columns: packed lower triangles."""
    whole: str
    """Of Phi as it is, all joints together (p, p)."""

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return len(unpacked(self.whole))

    @model_validator(mode="after")
    def _of_one_model(self) -> Self:
        if not len(self.torque_squared) == len(self.columns) == len(self.slow) > 0:
            raise ValueError("torque_squared, columns and slow have one entry for each joint")
        parameters = range(self.n_parameters)
        for used, text in zip(self.columns, self.slow, strict=True):
            if not set(used) <= set(parameters) or len(unpacked(text)) != len(used) + 1:
                raise ValueError("columns that are none of the parameters")
        return self


def motion_form(model: RobotModel, archive: str, run: Samples) -> MotionForm:
    """Form of one motion; rows that are not usable count as nothing, as in the errors."""
    blocks, columns = run.regressor(model)
    n = model.n_parameters
    whole, slow = np.zeros((n, n)), []
    for j, (block, used) in enumerate(zip(blocks, columns, strict=True)):
        usable = run.usable[:, j]
        table = np.column_stack([block, run.torque[:, j]]) * usable[:, None]
        whole[np.ix_(used, used)] += table[:, :-1].T @ table[:, :-1]
        passed = low_passed(run, table)[usable]
        slow.append(packed(passed.T @ passed))
    return MotionForm(
        archive=archive,
        torque_squared=(np.where(run.usable, run.torque, 0.0) ** 2).sum(axis=0).tolist(),
        columns=[[int(k) for k in used] for used in columns],
        slow=slow,
        whole=packed(whole),
    )


def low_passed(run: Samples, values: Array) -> Array:
    """Values (m, c) low-passed as the paper's Fig. 4 is, part by part of a recording with gaps.

    A part without a usable row stays zero.
    """
    slow = np.zeros_like(values)
    for part in run.segments:
        if run.usable[part].any():
            slow[part] = low_pass(run.motion.time[part], values[part], FIGURE_BANDWIDTH)
    return slow


@dataclass(frozen=True, eq=False)
class ClassForms:
    """The forms of all motions of one class; m motions, n joints, p parameters.

    Attributes:
        slow: of the low-passed [Phi | tau] (m, n, p + 1, p + 1).
        whole: of Phi, all joints together (m, p, p).
        torque_squared: (m, n).
    """

    slow: Array
    whole: Array
    torque_squared: Array

    @classmethod
    def of(cls, forms: Sequence[MotionForm]) -> ClassForms:
        """Unpack what was kept."""
        motions, joints = len(forms), len(forms[0].columns)
        whole = np.array([unpacked(one.whole) for one in forms])
        size = whole.shape[1] + 1
        slow = np.zeros((motions, joints, size, size))
        for m, one in enumerate(forms):
            for j, (used, text) in enumerate(zip(one.columns, one.slow, strict=True)):
                index = [*used, size - 1]
                slow[m, j][np.ix_(index, index)] = unpacked(text)
        return cls(slow, whole, np.array([one.torque_squared for one in forms]))

    def torque_kernels(self, values: Array, joint: int | None = None) -> Array:
        """Inner products (m, r, r) of the low-passed errors that r estimates (r, p) leave.

        The error of any weighted mean of these estimates is the same mean of their errors. All
        joints together, or one of them.
        """
        gram = self.slow.sum(axis=1) if joint is None else self.slow[:, joint]
        left = np.column_stack([-values, np.ones(len(values))])
        return np.asarray(left @ gram @ left.T)

    def own_kernels(self, values: Array, truth: Array) -> Array:
        """The same (m, r, r) of Phi (pi - truth): what the estimates themselves are off by."""
        away = values - truth
        return np.asarray(away @ self.whole @ away.T)

    def overall(self, estimate: Array) -> Array:
        """||e|| / ||tau|| of one estimate (p,) on each motion (m,), low-passed."""
        return self._relative(self.torque_kernels(estimate[None]))

    def own(self, estimate: Array, truth: Array) -> Array:
        """||Phi (pi - truth)|| / ||tau|| of one estimate (p,) on each motion (m,)."""
        return self._relative(self.own_kernels(estimate[None], truth))

    def _relative(self, kernels: Array) -> Array:
        squared = np.maximum(kernels[:, 0, 0], 0.0)
        return np.asarray(np.sqrt(squared / self.torque_squared.sum(axis=1)))


def packed(gram: Array) -> str:
    """Return the lower triangle of a symmetric matrix as text."""
    triangle = gram[np.tril_indices(len(gram))].astype("<f8")
    return base64.b64encode(triangle.tobytes()).decode("ascii")


def unpacked(text: str) -> Array:
    """Return the symmetric matrix of which `packed` made a text.

    Raises:
        ValueError: it is the text of something else.
    """
    triangle = np.frombuffer(base64.b64decode(text, validate=True), dtype="<f8")
    size = round((np.sqrt(8.0 * len(triangle) + 1.0) - 1.0) / 2.0)
    gram = np.zeros((size, size))
    gram[np.tril_indices(size)] = triangle
    return gram + np.tril(gram, -1).T
