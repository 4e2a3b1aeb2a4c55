"""Planning problems."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from planner import (
    JointLimits,
)
from planner.moves import Move, Overrides

shares = st.one_of(st.just(1.0), st.floats(0.02, 1.0))
flies = st.sampled_from([0.0, 1.0, 25.0, 50.0, 75.0, 100.0]) | st.floats(0.0, 100.0)


@st.composite
def robots(draw):
    """Limits of 1 to 10 joints of very different sizes and speeds."""
    n = draw(st.integers(1, 10))
    exponents = [draw(st.tuples(*[st.floats(-2, 1)] * 4)) for _ in range(n)]
    span, velocity, ramp, rise = 10.0 ** np.array(exponents).T
    acceleration = velocity / ramp
    centre = np.array(draw(st.lists(st.floats(-5, 5), min_size=n, max_size=n)))
    return JointLimits(
        centre - span, centre + span, velocity, acceleration, acceleration / rise * 10.0
    )


@st.composite
def routes(draw, limits: JointLimits):
    """Degenerate positions: on the limits, repeated, microscopic moves, one joint."""
    n = limits.n_joints
    span = (limits.upper - limits.lower) / 2.0
    centre = limits.lower + span
    rows = [centre]
    for _ in range(draw(st.integers(2, 6))):
        kind = draw(st.sampled_from(["random", "limits", "same", "back", "tiny", "one joint"]))
        row = rows[-1].copy()
        if kind == "random":
            row = centre + span * np.array(draw(st.lists(st.floats(-1, 1), min_size=n, max_size=n)))
        elif kind == "limits":
            on = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
            row = np.where(on, limits.lower, limits.upper)
        elif kind == "back" and len(rows) > 1:
            row = rows[-2].copy()
        elif kind == "tiny":
            row = row + draw(st.sampled_from([1e-320, 1e-15, 1e-12, 1e-9, 1e-6, 1e-4])) * span
        elif kind == "one joint":
            joint = draw(st.integers(0, n - 1))
            row[joint] = draw(st.sampled_from([limits.lower[joint], limits.upper[joint]]))
        rows.append(np.clip(row, limits.lower, limits.upper))
    return np.array(rows)


@st.composite
def problems(draw):
    limits = draw(robots())
    points = draw(routes(limits))
    n = limits.n_joints
    per_joint = st.one_of(st.none(), st.lists(shares, min_size=n, max_size=n))
    moves = [
        Move(
            point,
            speed=draw(shares),
            acceleration=draw(shares),
            joint_speed=draw(per_joint),
            joint_acceleration=draw(per_joint),
            joint_jerk=draw(per_joint),
            fly_percent=draw(flies),
        )
        for point in points[1:]
    ]
    joint = draw(st.one_of(shares, st.lists(shares, min_size=n, max_size=n)))
    overrides = Overrides(draw(shares), draw(shares), draw(shares), joint)
    return points, moves, limits, overrides
