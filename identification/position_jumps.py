"""Steps of a measured position that no arm makes: an encoder that slipped, or lost its count.

A joint that moves at a speed of v changes it by at most its acceleration times the step of the
clock; its position therefore steps by about what the steps beside it say. A step that departs from
these and is not taken back is no motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.finding import Finding, listed
from identification.recording import Recording

Array = NDArray[np.float64]

# Robust standard deviations that a step must depart by.
_STANDS_OUT: Final = 15.0
# The same against the largest departures that come in numbers (starts, stops, reversals).
_USUAL: Final = 20  # departures
_BEYOND_USUAL: Final = 3.0
# Acceleration that turns a joint's speed within one step of the clock; robots reach a fifth of it.
_FASTEST: Final = 150.0  # rad/s² or m/s²
_BESIDE: Final = 4  # steps to either side
_SHOWN: Final = 3


@dataclass(frozen=True)
class PositionJump:
    """One step.

    Attributes:
        recording: its name.
        joint: name.
        time: of the sample after the step [s], since the recording began.
        size: of the step, apart from the motion [rad or m].
    """

    recording: str
    joint: str
    time: float
    size: float


def position_jumps(recording: Recording, name: str = "the recording") -> list[PositionJump]:
    """Lasting steps of the measured positions, in the order of time for each joint.

    Args:
        recording: positions in its stretches without gaps.
        name: by which the jumps say where they are.
    """
    found = []
    for joint, joint_name in enumerate(recording.joint_names):
        parts = [
            (part.start, *_departures(recording.time[part], recording.position[part, joint]))
            for part in recording.segments()
            if part.stop - part.start > 2 * _BESIDE + 2
        ]
        if not parts:
            continue
        size = np.abs(np.concatenate([departure for _, departure, _ in parts]))
        spread = 1.4826 * float(np.median(size))
        usual = float(np.partition(size, -_USUAL)[-_USUAL]) if size.size > 10 * _USUAL else 0.0
        for start, departure, steps in parts:
            least = np.maximum(
                max(_STANDS_OUT * spread, _BEYOND_USUAL * usual), _FASTEST * steps**2
            )
            for k in np.flatnonzero(np.abs(departure) > least).tolist():
                if not _lasts(departure, k):
                    continue
                at = start + k + 1
                found.append(
                    PositionJump(
                        name,
                        joint_name,
                        float(recording.time[at] - recording.time[0]),
                        float(departure[k]),
                    )
                )
    return found


def _departures(time: Array, position: Array) -> tuple[Array, Array]:
    """By how much each step departs from the speed beside it (m - 1,), and the clock's steps."""
    steps = np.diff(time)
    speed = np.diff(position) / steps
    padded = np.pad(speed, _BESIDE, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + 1)
    before, after = windows[:, :_BESIDE], windows[:, _BESIDE + 1 :]
    # The mean of both sides' medians follows a steady acceleration; one more jump beside is none.
    usual = 0.5 * (np.median(before, axis=1) + np.median(after, axis=1))
    return (speed - usual) * steps, steps


def _lasts(departure: Array, at: int) -> bool:
    """Whether the steps that follow and precede do not take it back."""
    around = departure[max(0, at - _BESIDE) : at + _BESIDE + 1]
    return bool(np.abs(around.sum()) > 0.5 * np.abs(departure[at]))


def jump_findings(jumps: Sequence[PositionJump]) -> list[Finding]:
    """What a verdict says of jumps: nothing where there are none."""
    if not jumps:
        return []
    names = tuple(dict.fromkeys(jump.joint for jump in jumps))
    largest = sorted(jumps, key=lambda jump: -abs(jump.size))
    where = [
        f"{jump.joint} by {jump.size:+.3g} after {jump.time:.3f} s of {jump.recording}"
        for jump in largest
    ]
    return [
        Finding(
            "position jumps",
            "wrong",
            "the measured position jumped where no arm can follow (rad or m): "
            + listed(where, _SHOWN),
            f"look at encoder, coupling and cable of {listed(names)}, and record again; or leave"
            " out what was recorded after the jump",
        )
    ]
