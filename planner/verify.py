"""Checks of a finished motion: limits, smoothness, rest at both ends."""

from __future__ import annotations

import numpy as np

from planner.errors import LimitExceeded, NotSmooth
from planner.fourier import FourierSeries
from planner.limits import Bounds, jump_rounding, position_rounding
from planner.piecewise_cubic import PiecewiseCubic, Trajectory


def check_limits(trajectory: PiecewiseCubic | FourierSeries, limits: Bounds) -> None:
    """Check analytically that a trajectory satisfies its limits at every instant.

    Raises:
        LimitExceeded: of the first quantity that breaks its limit, with its worst joint.
    """
    extrema = trajectory.extrema()
    slack = position_rounding(limits)
    for quantity, end, sign in (
        ("position", "lower", -1.0),
        ("position", "upper", 1.0),
        *((rate, rate, 1.0) for rate in ("velocity", "acceleration", "jerk")),
    ):
        value, bound = getattr(extrema, end), getattr(limits, end)
        excess = sign * (value - bound) - (slack if quantity == "position" else 0.0)
        if not np.all(excess <= 0.0):  # written so that NaN is refused too
            joint = int(np.argmax(excess))
            raise LimitExceeded(quantity, joint, float(value[joint]), float(bound[joint]))


def check_smooth(trajectory: PiecewiseCubic, limits: Bounds) -> None:
    """Check that a trajectory is C2 and at rest at both ends.

    Raises:
        NotSmooth: it is not.
    """
    scale = jump_rounding(limits, trajectory.duration)
    for joint, ends in enumerate(trajectory.ends()):
        starts = trajectory.coefficients[joint][:, :3]
        rest_before = [[starts[0, 0], 0.0, 0.0]]
        rest_after = [[ends[-1, 0], 0.0, 0.0]]
        jumps = np.abs(np.concatenate((starts, rest_after)) - np.concatenate((rest_before, ends)))
        if not np.all(jumps <= scale[joint]):
            knot, which = np.unravel_index(int(np.argmax(jumps / scale[joint])), jumps.shape)
            raise NotSmooth(
                ("position", "velocity", "acceleration")[which],
                joint,
                float(trajectory.knots[joint][knot]),
                float(jumps[knot, which]),
            )


def check_rest(trajectory: Trajectory, limits: Bounds) -> None:
    """Check that a trajectory of any kind is at rest at both ends.

    Raises:
        NotSmooth: it has a velocity or acceleration there.
    """
    scale = jump_rounding(limits, trajectory.duration)[:, 1:]
    times = np.array([0.0, trajectory.duration])
    _, *rates = trajectory.sample(times)
    left = np.abs(np.stack(rates, axis=2))  # (2, n, 2)
    if not np.all(left <= scale):  # written so that NaN is refused too
        end, joint, which = np.unravel_index(int(np.argmax(left / scale)), left.shape)
        raise NotSmooth(
            ("velocity", "acceleration")[which],
            int(joint),
            float(times[end]),
            float(left[end, joint, which]),
        )
