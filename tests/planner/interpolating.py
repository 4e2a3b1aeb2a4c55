"""What the tests of the interpolator share."""

from __future__ import annotations

import numpy as np

from planner.interpolator import Interpolator
from planner.rrs import FlybyCriterion, Status

PERIOD = 0.002


def ready(limits, position, *, fly=None, advance=1, **options):
    """An interpolator that waits for targets, flying by `fly` %."""
    interpolator = Interpolator(limits, PERIOD, **options)
    assert interpolator.initialize() == Status.OK
    assert interpolator.set_initial_position(position) == Status.OK
    if fly is not None:
        interpolator.select_flyby_mode(True)
        interpolator.set_flyby_criteria_parameter(FlybyCriterion.PERCENT, fly)
    interpolator.set_advance_motion(advance)
    return interpolator


def queue(interpolator, points, first=1):
    for target_id, point in enumerate(points, first):
        assert interpolator.set_next_target(target_id, point) >= 0, interpolator.refusal


def steps_to_rest(interpolator, at_most=20_000):
    """All steps up to one that is final."""
    steps = []
    while not steps or steps[-1].status in (Status.OK, Status.NEED_MORE_DATA):
        steps.append(interpolator.get_next_step())
        assert len(steps) < at_most
    assert steps[-1].status == Status.FINAL_STEP
    return steps


def positions(steps):
    return np.array([step.position for step in steps])


def events(steps):
    return [(event.kind, event.target_id) for step in steps for event in step.events]


def worst_ratios(start, q, limits, period=PERIOD):
    """Largest velocity, acceleration, jerk of set-points from rest to rest, by differences."""
    padded = np.concatenate((np.tile(start, (4, 1)), q, np.tile(q[-1], (4, 1))))
    return [
        np.max(np.abs(np.diff(padded, order, axis=0)) / period**order / bound)
        for order, bound in enumerate((limits.velocity, limits.acceleration, limits.jerk), 1)
    ]
