"""Fit of friction that depends on the transmitted torque, as a fixed point.

The torque that a gear transmits depends on the parameters of the bodies, see
:meth:`RobotModel.gear_torque`. For a given load the torque is linear in all parameters, so a fit
with the load of the last one is repeated until the predicted torque stays. Each pass reduces the
error of the load by about the share fl of the torque that becomes friction, some 2 to 15 % for
strain-wave gears.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np

from identification.arrays import Array
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

MAX_TORQUE_CHANGE: Final = 1e-3
"""Change of the predicted torque by a pass below which it is the last, relative to its rms."""
MAX_PASSES: Final = 4
"""With a share of 15 % the third fit changes the torque by some 0.3 % of it, the fourth less."""


class Fitted(Protocol):
    """A result with parameters."""

    @property
    def values(self) -> Array:
        """Parameters (p,)."""


Result = TypeVar("Result", bound=Fitted)


@dataclass(frozen=True, eq=False)
class LoadFit(Generic[Result]):
    """A fit with the load of the previous fit."""

    result: Result  #: of the last fit
    samples: tuple[Samples, ...]  #: with the load of the result, for all that follows
    passes: int  #: fits that were made, 1 without load-dependent friction
    #: of the predicted torque by the last pass, relative to its rms: the largest of the joints;
    #: zero without load-dependent friction, infinite after one pass with it
    change: float

    @property
    def converged(self) -> bool:
        """Whether the last pass changed the torque by less than `MAX_TORQUE_CHANGE`."""
        return self.change < MAX_TORQUE_CHANGE


def fit_with_load(
    model: RobotModel,
    recordings: Sequence[Samples],
    fit: Callable[[tuple[Samples, ...]], Result],
    *,
    most: int = MAX_PASSES,
) -> LoadFit[Result]:
    """Return the fixed point of fits, each with the load of the previous one.

    The first fit has the load that the samples carry (:meth:`Samples.with_load` of an estimate
    without such friction saves a pass). Where they carry none, it is zero: the columns of the
    shares are zero in the first pass, and the fit has to leave these undetermined.

    Args:
        model: of the arm; one without such friction is fitted once, to the samples as they are.
        recordings: prepared.
        fit: estimator.
        most: number of passes.
    """
    samples = tuple(recordings)
    if not model.friction.has_load:
        return LoadFit(fit(samples), samples, 1, 0.0)
    samples = tuple(
        recording
        if recording.motion.load is not None
        else recording.with_given_load(_no_load(recording))
        for recording in samples
    )
    predicted: list[Array] | None = None
    passes = 0
    change = np.inf
    while True:
        result = fit(samples)
        passes += 1
        samples = tuple(recording.with_load(model, result.values) for recording in samples)
        previous = predicted
        predicted = [_predicted(model, result.values, recording) for recording in samples]
        if previous is not None:
            change = _change(previous, predicted)
        if passes >= most or change < MAX_TORQUE_CHANGE:
            return LoadFit(result, samples, passes, change)


def _no_load(samples: Samples) -> Array:
    return np.zeros_like(samples.whole.motion.position)


def _predicted(model: RobotModel, values: Array, samples: Samples) -> Array:
    """Return the predicted torque of usable rows (m, n), zero elsewhere."""
    return np.where(samples.usable, samples.predicted_torque(model, values), 0.0)


def _change(before: Sequence[Array], after: Sequence[Array]) -> float:
    """Return the largest change over the joints relative to the joint's rms."""
    changed = sum(((a - b) ** 2).sum(axis=0) for a, b in zip(after, before, strict=True))
    size: Any = sum((a**2).sum(axis=0) for a in after)
    return float(np.sqrt(np.max(changed / np.where(size > 0.0, size, 1.0), initial=0.0)))
