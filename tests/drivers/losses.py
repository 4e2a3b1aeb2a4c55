"""A session that moves while packets are lost."""

from __future__ import annotations

import numpy as np

from drivers import State
from planner import JointLimits, TrajectoryPlayer, plan
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    limits,
    running,
)

FAR = {"lower": np.full(N, -9.0), "upper": np.full(N, 9.0)}


def at_speed(cycles: int = 600, speed: float = 1.9, **options) -> Rig:
    """An arm whose first joint moves at this speed, rad/s."""
    source = type("AtSpeed", (Cruise,), {"SPEED": speed, "RAMP": 1.0})()
    rig = running(source, **{"guard_limits": limits(**FAR), **options})
    rig.cycle(cycles)
    assert rig.state is State.OPEN
    return rig


def lose(rig: Rig, count: int):
    """Run cycles whose replies do not reach the controller, which holds its target."""
    follow = rig._follow
    rig._follow = lambda answer: rig.axes["d"].__setitem__((slice(None), [1, 3]), 0)
    answer = rig.cycle(count)
    rig._follow = follow
    return answer


def planned() -> TrajectoryPlayer:
    """A motion of the planner, six times as far as `MOVE`."""
    rates = ("lower", "upper", "velocity", "acceleration", "jerk")
    bounds = JointLimits(**{name: getattr(limits(), name) for name in rates})
    return TrajectoryPlayer(plan([START, START + MOVE * 6.0], bounds), PERIOD, bounds)
