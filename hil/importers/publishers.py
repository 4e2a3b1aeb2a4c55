"""Samples of a second publisher in a recording."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.importers.conclusions import Alternation, Sample, SecondPublisher

MIN_SAMPLE_DISTANCE: Final = 0.1
"""rad or m between samples of one stamp, 20 ms at 5 rad/s."""
MAX_MESSAGES_PER_STAMP: Final = 3
"""Messages with one stamp, of one publisher."""
_MAX_RETURN_ERROR_SHARE: Final = 0.25  # of a step to another sequence, which the step back leaves
_MIN_ALTERNATING_SHARE: Final = 0.02  # of the samples, beyond single spikes


class FrozenSamples(NamedTuple):
    """Samples with one and the same pose between others that move."""

    rows: NDArray[np.bool_]  #: (m,)
    publisher: SecondPublisher | None  #: None if there are none


def second_publisher(position: Array, sample: Sample) -> FrozenSamples:
    """Find samples of a second publisher in positions (m, n) [rad or m]."""
    rows = _of_one_pose(position)
    if not rows.any():
        return FrozenSamples(rows, None)
    pose = position[np.argmax(rows)]
    where = tuple(pose.tolist()) if pose.any() else ()
    count = int(np.count_nonzero(rows))
    return FrozenSamples(rows, SecondPublisher(count, len(position), where, sample))


def _of_one_pose(position: Array) -> NDArray[np.bool_]:
    none = np.zeros(len(position), np.bool_)
    jumps = np.abs(np.diff(position, axis=0)).max(axis=1) > MIN_SAMPLE_DISTANCE
    if np.count_nonzero(jumps) <= 2 * MAX_MESSAGES_PER_STAMP:
        return none
    poses, counts = np.unique(position, axis=0, return_counts=True)
    pose = poses[np.argmax(counts)]
    silent = (position == pose).all(axis=1)
    others = position[~silent]
    alternating = np.count_nonzero(np.diff(silent.astype(np.int8))) > 2 * MAX_MESSAGES_PER_STAMP
    if not alternating or not len(others):
        return none
    moved = np.diff(others, axis=0).any(axis=1)
    if pose.any() and 2 * np.count_nonzero(moved) < len(moved):
        return none  # an arm that goes to and fro between two poses
    return (
        none
        if np.abs(others - pose).max(axis=1).min() < MIN_SAMPLE_DISTANCE
        else np.asarray(silent)
    )


def alternating_samples(position: Array, units: NDArray[np.str_]) -> Alternation | None:
    """Return how far apart two sequences are that positions (m, n) go to and fro between."""
    steps = np.abs(np.diff(position, axis=0)).max(axis=1)
    if len(steps) < 2:
        return None
    there_and_back = np.minimum(steps[:-1], steps[1:])
    left = np.abs(position[2:] - position[:-2]).max(axis=1)
    alternate = (there_and_back > MIN_SAMPLE_DISTANCE) & (
        left < _MAX_RETURN_ERROR_SHARE * there_and_back
    )
    count = np.count_nonzero(alternate)
    if count <= max(2 * MAX_MESSAGES_PER_STAMP, _MIN_ALTERNATING_SHARE * len(position)):
        return None
    row = int(np.argmax(np.where(alternate, there_and_back, 0.0)))
    joint = int(np.argmax(np.abs(position[row + 1] - position[row])))
    return Alternation(float(there_and_back[row]), int(count), str(units[joint]))
