"""Whether a torque is the rate of an arm's torque, as a derivative of it that was logged."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from identification.hypotheses.scores import EXPLAINED_ERROR, Score, score_of
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_FEWEST_ROWS: Final = 100
_BETTER: Final = 0.5  # error ratio of the integral of a rate; that of a torque is not explained


def is_rate(model: RobotModel, samples: Samples, score: Score, rows: int) -> bool:
    """Return whether the integral of a torque follows the arm, and the torque does not.

    Args:
        model: of the arm.
        samples: of a recording, all of its rows.
        score: of some of them.
        rows: that are used of them.
    """
    if score.overall < EXPLAINED_ERROR:
        return False
    return _integrated_error(model, samples, rows) < min(EXPLAINED_ERROR, _BETTER * score.overall)


def _integrated_error(model: RobotModel, samples: Samples, rows: int) -> float:
    """Return the error of the integral of a torque over time, as a share of it.

    Of the longest stretch without a gap; where it began is an offset of each joint. Infinite where
    there is too little of it.
    """
    longest = max(samples.segments, key=lambda part: part.stop - part.start)
    part = samples.between(longest.start, longest.stop)
    if part.usable.any(axis=1).sum() < _FEWEST_ROWS:
        return float("inf")
    steps = np.diff(part.motion.time)[:, None] * (part.torque[1:] + part.torque[:-1]) / 2.0
    torque = np.cumsum(np.concatenate([np.zeros_like(part.torque[:1]), steps]), axis=0)
    integrated = replace(part, torque=np.asarray(torque - torque.mean(axis=0)), parent=None)
    few = integrated.thinned_to(rows)
    return score_of(model.with_friction(offset=True), few).overall
