"""Rows and clock of a recording in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from identification.signals.masks import RowReason
from identification.signals.position_steps import PositionJump
from identification.signals.row_faults import RowFault, RowFaultKind, RowFaults
from identification.signals.sample_times import MAX_STEP_DEVIATION, SampleTimes, TimeBase
from identification.text import duration_text, number, percentage

ROW_REASONS: Final[Mapping[RowReason, str]] = {
    RowReason.EDGE: "next to a gap or an end of the recording",
    RowReason.UNMEASURED: "joint torque zero or constant throughout",
    RowReason.SATURATED: "torque or current saturated",
    RowReason.REST: "at rest",
    RowReason.STANDSTILL: "below the standstill speed",
    RowReason.REVERSAL: "near a velocity reversal",
    RowReason.SPIKE: "isolated spike of torque or current",
}


def clock_lines(clock: TimeBase) -> list[str]:
    """Return lines on the time stamps, at least one."""
    lines = [f"{clock.samples} samples in {clock.duration:.6g} s, {clock.rate:.6g} Hz"]
    if clock.largest_deviation > MAX_STEP_DEVIATION:
        lines.append(
            f"uneven: steps vary by {percentage(clock.jitter, 1)} of the usual step, at most"
            f" {percentage(clock.largest_deviation)}"
        )
    if clock.repeated:
        lines.append(f"{clock.repeated} samples repeat the previous time stamp")
    if clock.backward:
        lines.append(f"{clock.backward} time stamps are earlier than the previous one")
    if clock.dropped:
        lines.append(
            "1 sample missing" if clock.dropped == 1 else f"{clock.dropped} samples missing"
        )
    if gaps := clock.gaps - clock.pauses:
        lines.append(f"{gaps} gap{'s' if gaps > 1 else ''}")
    if clock.pauses == 1:
        lines.append(f"cut at a pause of {duration_text(clock.longest_pause)}")
    elif clock.pauses:
        longest = duration_text(clock.longest_pause)
        lines.append(f"cut at {clock.pauses} pauses, the longest of {longest}")
    return lines


def time_lines(times: SampleTimes) -> list[str]:
    """Return lines on the times that are used; none for even stamps without repetition."""
    lines = []
    if times.removed:
        lines.append(
            f"dropped {times.removed} rows that repeat the previous sample while the arm moves"
        )
    if times.even or not np.isnan(times.share):
        used = f"even times, {times.missing} missing samples counted"
        used = used if times.even else "the stamps"
        if not times.certain or (times.share < 0.5 and not times.even):
            used += " (positions are inconclusive)"
        lines.append(
            f"the time stamps vary by {percentage(times.scatter, 1)} of a step; the positions"
            f" confirm a fraction of {times.share:.2f} ± {times.deviation:.1g} of this;"
            f" high-frequency residual over noise: {times.residuals[0]:.3g} with the stamps,"
            f" {times.residuals[1]:.3g} with even times; used: {used}"
        )
    return lines


def times_words(times: SampleTimes) -> str:
    """Return the times that are used in a few words; "" for even stamps without repetition."""
    parts = [f"dropped {times.removed} repeated rows"] if times.removed else []
    if times.even or not np.isnan(times.share):
        used = "even times used" if times.even else "stamps used"
        parts.append(f"stamps vary by {percentage(times.scatter, 1)}: {used}")
    return "; ".join(parts)


def jump_words(jump: PositionJump) -> str:
    """Return what is wrong with a step of a position."""
    return (
        f"the position of {jump.joint} jumps by {number(jump.size, 2)} {jump.unit} at"
        f" {number(jump.time, 4)} s, faster than an arm can move"
    )


def faults_words(faults: RowFaults) -> str:
    """Return what is wrong with rows in one place or more, and what was done about it."""
    if len(faults.faults) == 1:
        return _fault_words(faults.faults[0])
    at = f"in {len(faults.faults)} places (first at {number(faults.faults[0].time, 4)} s)"
    match faults.kind:
        case RowFaultKind.FROZEN:
            longest = max(fault.duration for fault in faults.faults)
            return (
                f"the log repeats one row {at} for up to {duration_text(longest)} while the arm"
                f" keeps moving: dropped {faults.rows} rows"
            )
        case RowFaultKind.WRITTEN_TWICE:
            return f"dropped {faults.rows} rows {at} that repeat earlier rows bit for bit"
        case RowFaultKind.DISPLACED:
            largest = max(faults.faults, key=lambda fault: fault.size)
            return (
                f"the position of {', '.join(faults.joints)} is off by up to"
                f" {number(largest.size, 2)} {largest.unit} {at} and then returns:"
                f" dropped {faults.rows} rows"
            )
        case RowFaultKind.JUMP:
            return (
                f"the positions of {', '.join(faults.joints)} jump {at}, further than any arm moves"
                " in a step: several motions in one file, or missing rows that the stamps do not"
                " show; all parts are used, but not the rows next to a jump"
            )


def _fault_words(fault: RowFault) -> str:
    """Return what is wrong with rows in one place."""
    at = f"at {number(fault.time, 4)} s"
    match fault.kind:
        case RowFaultKind.FROZEN:
            return (
                f"the log repeats one row for {duration_text(fault.duration)} {at} while the arm"
                f" keeps moving: dropped {fault.rows} rows"
            )
        case RowFaultKind.WRITTEN_TWICE:
            return f"dropped {fault.rows} rows {at} that repeat earlier rows bit for bit"
        case RowFaultKind.DISPLACED:
            one = fault.rows == 1
            return (
                f"the position of {', '.join(fault.joints)} is off by up to"
                f" {number(fault.size, 2)} {fault.unit} in {fault.rows} row{'' if one else 's'}"
                f" {at if one else f'(first {at})'} and then returns: dropped"
                f" {'this row' if one else 'these rows'}"
            )
        case RowFaultKind.JUMP:
            return (
                f"the positions of {', '.join(fault.joints)} jump {at}, further than any arm moves"
                " in a step: two motions in one file, or missing rows that the stamps do not show;"
                " both parts are used, but not the rows next to the jump"
            )
