"""What must hold in the records of a session, judged by differences of what was commanded."""

from __future__ import annotations

from collections import Counter

import numpy as np

from drivers import State
from tests.drivers.rig import limits

PERIOD = 0.002
POSITION_MODES = (1, 4, 5)


class Violation(AssertionError):
    """Something that must never happen did."""


def answered_as_open(rows: np.ndarray) -> np.ndarray:
    """Which records hold a set-point of open mode; the one that asks for its end is one, too."""
    in_open: np.ndarray = rows["state"] == State.OPEN
    ends = (rows["state"][1:] == State.EXITING) & in_open[:-1]
    in_open[1:] |= ends & (rows["mode"][1:] == rows["mode"][:-1]).all(axis=1)
    return in_open


def check_records(rows: np.ndarray, mode: int, plan_only: bool, tally: Counter[str]) -> None:
    """Set-points of a block: where they may be, and the differences between them.

    Raises:
        Violation: a set-point outside open mode, or outside the guard.
    """
    bounds, state = limits(), rows["state"]
    in_open = answered_as_open(rows)
    of_positions = mode in (*POSITION_MODES, 7)
    sent = rows["commanded_position" if of_positions else "commanded_velocity"]
    whole = np.isfinite(sent).all(axis=1)
    anywhere = np.isfinite(rows["commanded_position"]).any(axis=1)
    if anywhere[~np.isin(state, (State.OPENING, State.OPEN, State.EXITING))].any():
        raise Violation("a set-point outside of open mode")
    open_rows = rows[state == State.OPEN]
    if (open_rows["mode"] != mode).any() or (open_rows["status"] != 5).any():
        raise Violation("open without every axis open and the drive on")
    tally["set-points"] += int((whole & in_open).sum())
    check_leaving(rows, mode)
    if mode in (7, 9):
        return
    # A correction has the bounds of a stop from being stopped on, without asking for them.
    of_a_plan = plan_only and mode in POSITION_MODES
    factor_a, factor_j = (1.0, 1.0) if of_a_plan else (2.0, 3.0)
    rates = (bounds.velocity, factor_a * bounds.acceleration, factor_j * bounds.jerk)
    first_order = 1 if mode in POSITION_MODES else 0
    interval = np.where(whole & in_open, rows["interval"], -1)
    for index in np.unique(interval[interval >= 0]):
        q = sent[interval == index]
        # An interval begins at rest: its first set-point, at zero velocity.
        q = np.vstack([q[:1]] * 3 + [q])
        for k, bound in enumerate(rates):
            order = first_order + k
            found = np.abs(np.diff(q, order, axis=0)) / PERIOD**order
            rounding = 2**order * 1e-15 / PERIOD**order
            if not (found <= bound * (1 + 2e-6) + rounding).all():
                raise Violation(f"derivative {order} is {found.max()}, allowed {bound.max()}")
        if first_order == 1:
            tally["moving"] += int(np.any(np.diff(q, axis=0), axis=1).sum())
            if not ((q >= bounds.lower - 1e-5) & (q <= bounds.upper + 1e-5)).all():
                raise Violation("position")
        else:
            tally["moving"] += int(q.any(axis=1).sum())


def check_leaving(rows: np.ndarray, mode: int) -> None:
    """While open mode is left, a joint is held where it was, or at the target received.

    Raises:
        Violation: it is somewhere else, or not at rest.
    """
    if mode not in POSITION_MODES:
        return
    in_open = answered_as_open(rows)
    last = {int(row["interval"]): row["commanded_position"] for row in rows[in_open]}
    for row in rows[(rows["state"] == State.EXITING) & ~in_open]:
        q, target = row["commanded_position"], row["target_position"]
        held = last.get(int(row["interval"]), target)
        at_rest = np.nan_to_num(row["commanded_velocity"]) == 0.0
        if not (np.isnan(q) | (q == held) | (q == target)).all() or not at_rest.all():
            raise Violation(f"leaving open mode at {q}, held {held}, target {target}")
