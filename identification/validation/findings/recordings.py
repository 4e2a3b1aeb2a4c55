"""Findings about the recordings: joints that were tested, position jumps, delay, limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identification.distributions import SIGNIFICANT_SIGMAS
from identification.signals.position_steps import PositionJump
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Thresholds, Value


def nothing_held_out(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return that all errors are on fitted motion."""
    if not evidence.in_sample:
        return None
    return Finding("nothing held out", "wrong", "hold out a motion")


def joints_not_fitted(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints of a large error that no fitted row moves, and held-out ones do."""
    large = np.nan_to_num(evidence.held_out.relative) > limits.axis
    joints = large & evidence.unfitted
    if not joints.any():
        return None
    return Finding("joints not fitted", "wrong", "cover the motion", "cause").about(joints)


def joints_at_rest(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints that hardly moved on held-out motion."""
    moved = evidence.moved
    still = evidence.held_out.rows == 0 if moved is None else moved < limits.moved
    unmeasured = [each for each in evidence.context.corrections if each.key == "no torque"]
    still[[joint for each in unmeasured for joint in each.joints]] = False
    if not still.any():
        return None
    least = {"least": limits.moved}
    return Finding("joints at rest", "wrong", "move the joints", values=least).about(still)


def no_torque(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return the joints whose measured torque is zero throughout held-out motion."""
    error = evidence.held_out
    silent = (error.rows > 0) & (error.torque_squared == 0.0)
    if not silent.any():
        return None
    return Finding("no torque", "wrong", "resolve the torque").about(silent)


def position_jumps(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return steps of measured positions that an arm cannot make."""
    return of_jumps(evidence.context.jumps)


def of_jumps(found: Sequence[PositionJump]) -> Finding | None:
    """Return steps that an arm cannot make as a finding, the largest first; None without any."""
    jumps = tuple(sorted(found, key=lambda jump: -abs(jump.size)))
    if not jumps:
        return None
    jumping = tuple(dict.fromkeys(jump.joint for jump in jumps))
    values: dict[str, Value] = {"jumps": jumps, "jumping": jumping}
    return Finding("position jumps", "wrong", "check the encoder", "cause", values)


def play(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return the joints whose positions step to and fro where their load reverses."""
    found = evidence.context.play
    if not found:
        return None
    n = len(evidence.held_out.rows)
    joints = np.zeros(n, dtype=np.bool_)
    size, half, count = np.zeros((3, n))
    for each in found:
        joints[each.joint] = True
        unit = float(np.degrees(1.0)) if evidence.revolute(each.joint) else 1e3
        size[each.joint], half[each.joint] = unit * each.size, unit * each.half_interval
        count[each.joint] = each.number
    units = ["°" if evidence.revolute(joint) else "mm" for joint in range(n)]
    return Finding("play", "doubtful", "measure the play", "cause").about(
        joints, size=size, half_interval=half, count=count.astype(int), unit=units
    )


def corrections(evidence: Evidence, _: Thresholds) -> tuple[Finding, ...]:
    """Return the faults of the recordings that were corrected before the fit."""
    return evidence.context.corrections


def delay(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Compare the estimated delay of the torque behind the position with the assumed one.

    None where it was not determined; behind commanded positions it is the lag of the servo.
    """
    delays = evidence.context.delays
    assumed = evidence.context.assumed_delay
    if delays is None or evidence.context.commanded_positions:
        return None
    beyond = max(limits.delay * delays.cycle, SIGNIFICANT_SIGMAS * delays.std)
    differs = abs(delays.delay - assumed) > beyond
    far = abs(delays.delay - delays.assumed) > beyond  # and yet combined with what is stated
    values: dict[str, Value] = {
        "delay": 1e3 * delays.delay,
        "half_interval": 1e3 * delays.half_interval,
        "stated": 1e3 * delays.assumed,
        "assumed": 1e3 * assumed,
    }
    if delays.significant and (assumed == delays.applied or (far and assumed != delays.assumed)):
        if assumed != delays.delay:
            values["used"] = 1e3 * assumed
        return Finding("compensated delay", "doubtful", "state the delay", values=values)
    # With a poor motion a delay cannot be separated from the parameters.
    estimate = evidence.estimate
    poor = bool(estimate.undetermined) or estimate.condition > limits.condition
    if delays.determined and not poor:
        if differs:
            return Finding(
                "other delay",
                "doubtful",
                "compare with the delay found, or correct the cell",
                "cause",
                values,
            )
        if assumed != delays.assumed:
            values["used"] = 1e3 * assumed
        if abs(delays.delay - assumed) > delays.half_interval:
            values["tolerance"] = 1e3 * beyond
        return Finding("assumed delay", "good", values=values)
    if delays.significant and differs:
        return Finding("suspected delay", "doubtful", "compare with the delay found", values=values)
    return None


def saturation(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose torque or current was at its limit, or that there are none."""
    share = evidence.context.saturated
    if share is None:
        return None
    full = np.asarray(share > limits.saturated)
    if not full.any():
        return Finding("no saturation", "good")
    found = Finding("saturation", "doubtful", "slow the motion down", "cause")
    return found.about(full, saturated=share)
