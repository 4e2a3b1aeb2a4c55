"""Rows of a look that need no masses: clock, units, slopes, rests, wraps and filters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from hil.archive.imported import COPIED_COMMANDS
from hil.base.arrays import Array
from hil.base.safe_input import parse_toml
from hil.cell import Cell
from hil.importers.commands import COMMANDED
from hil.importers.conclusions import (
    Certainty,
    ChannelMeaning,
    ConcludedUnit,
    Conclusion,
    CopiedCommands,
    EpisodeUnits,
    FixedFingers,
    JointOrder,
    NameBasis,
    RecordedArm,
    StatedUnit,
    UnitBasis,
    UnitsFrom,
)
from hil.importers.lerobot import STATE
from hil.importers.plausibility import MIN_CORRELATION, against_position, outside_limits
from hil.importers.recording_import import ImportedRecording
from hil.importers.units import Kind
from hil.look.readings import (
    Basis,
    Channels,
    ClockReading,
    CoarsePositions,
    Correlation,
    Fact,
    LateVelocity,
    MapKey,
    NextStep,
    NotSlopes,
    RowsReading,
    SlopeFactors,
    SlopeRatio,
    SmoothPositions,
    StillJoints,
    Travel,
    Wrapped,
    ZeroTorques,
)
from hil.look.result import Aspect, Row
from hil.pipeline.sources import Source, has_commands_as_positions
from identification.signals.angle_wraps import (
    UNWRAPPED,
)
from identification.signals.noise import has_small_noise, hidden_by_rounding, noiseless_above
from identification.signals.position_steps import position_steps
from identification.signals.recording import (
    MIN_MOVEMENT,
    Recording,
)
from identification.signals.sample_times import TimeBase, time_base

_MAX_RATIO_DEVIATION: Final = 0.1  # relative deviation of their ratio
_MAX_LAG_SECONDS: Final = 0.1  # s
_MIN_LAG_STEPS: Final = 1.5  # sampling steps
_MIN_LAG_CORRELATION: Final = 0.95
_UNIT_CONCLUSIONS: Final = (ConcludedUnit, StatedUnit)
_Unit = ConcludedUnit | StatedUnit
_ASPECTS: Final[Mapping[Kind, Aspect]] = {
    "position": "position",
    "velocity": "velocity",
    "torque": "torque",
    "motor_current": "motor current",
    "commanded_position": "commanded position",
}
_SLOPES: Final[Mapping[float, Fact]] = {
    57.2958: Fact.SLOPE_IN_DEGREES,
    math.radians(1.0): Fact.SLOPE_OF_DEGREES,
    -1.0: Fact.NEGATED_SLOPE,
    9.5493: Fact.SLOPE_IN_REVOLUTIONS,
}
"""What a velocity is whose factor to the slope of the position is this."""
_COMMANDS: Final = "the commanded positions"  # of an archive, whose columns have no names


def rows(source: Source, imported: ImportedRecording, arm: Cell | None) -> list[Row]:
    """Return the rows; `arm` is the recorded arm, None without a description."""
    recording = source.recording
    concluded = imported.concluded
    units = [each for each in imported.examined.found if isinstance(each, _UNIT_CONCLUSIONS)]
    by_map = "time" in parse_toml(imported.map_text or "")
    base = time_base(recording.time, recording.gap_before)
    clock = _time(base, concluded, units, by_map=by_map)
    table = [replace(clock, evidence=(base, *clock.evidence))]
    jumps = position_steps(recording, source.name).jumps
    if source.faults or source.retimed or jumps:
        times = source.times if source.retimed else None
        found = RowsReading(source.faults, times, jumps)
        step = NextStep.CHECK_ENCODER if jumps else None
        table.append(
            Row(
                "rows",
                found,
                Certainty.CERTAIN,
                (Basis.POSITIONS_ALONE, *(() if times is None else (times,))),
                step,
                is_fault=bool(jumps),
            )
        )
    table += [row for each in concluded if (row := _concluded(each, units)) is not None]
    table += _silent(recording)
    if recording.velocity is not None:
        table.append(_velocity(recording))
    table += [
        _rests(recording),
        _wraps(recording),
        _measured(recording, concluded, imported.examined.found),
    ]
    if arm is not None:
        table.append(_range(recording, arm))
    return table


def _time(
    base: TimeBase, concluded: Sequence[Conclusion], units: Sequence[_Unit], *, by_map: bool
) -> Row:
    meanings = [each for each in concluded if isinstance(each, ChannelMeaning)]
    stated = next((each for each in meanings if each.kind == "time"), None)
    unit = next((each for each in units if each.kind == "time"), None)
    if isinstance(unit, ConcludedUnit):
        decider = MapKey(unit.decided_by)
        return Row(
            "time", ClockReading(base, unit.unit), unit.certainty, (Basis.USUAL_RATE,), decider
        )
    if any(each.basis is NameBasis.MESSAGE for each in meanings):
        clock = ClockReading(base, of_messages=True)
        return Row("time", clock, Certainty.CERTAIN, (Basis.MESSAGE_TYPE,))
    if any(isinstance(each, EpisodeUnits) for each in concluded):
        return Row("time", ClockReading(base, "s"), Certainty.CERTAIN, (Basis.DATA_SET,))
    if stated is None:
        basis = Basis.MAP if by_map else Basis.GIVEN_RATE
        return Row("time", ClockReading(base), Certainty.CERTAIN, (basis,))
    basis = Basis.NAME_AND_RATE if stated.unit is None else Basis.STATED_UNIT
    return Row("time", ClockReading(base, stated.unit or "s"), Certainty.CERTAIN, (basis,))


def _concluded(conclusion: Conclusion, units: Sequence[_Unit]) -> Row | None:
    """Return the row of what was concluded of channels or joints; None if another row has it."""
    if isinstance(conclusion, JointOrder):
        return Row("joints", conclusion, Certainty.CERTAIN, (Basis.ROW_NAMES,))
    if isinstance(conclusion, FixedFingers):
        joints = Channels(", ".join(conclusion.positions))
        return Row("fixed", joints, Certainty.LIKELY, (conclusion,))
    if isinstance(conclusion, RecordedArm):
        return Row("recorded arm", Channels(conclusion.arm), Certainty.LIKELY, (conclusion,))
    if isinstance(conclusion, EpisodeUnits):
        is_sure = conclusion.basis not in (UnitsFrom.CALIBRATION, UnitsFrom.BEYOND_LIMITS)
        certainty = Certainty.CERTAIN if is_sure else Certainty.LIKELY
        decider = None if is_sure else NextStep.STATE_UNITS
        return Row("position", Channels(STATE, conclusion.unit), certainty, (conclusion,), decider)
    if not isinstance(conclusion, ChannelMeaning) or conclusion.kind == "time":
        return None
    kind = conclusion.kind
    if kind in ("position", "velocity") and conclusion.unit_basis is UnitBasis.NUMBERS:
        unit = next((each for each in units if each.kind == kind), None)
        usual = "rad" if kind == "position" else "rad/s"
        reading = Channels(conclusion.channels, usual if unit is None else unit.unit)
        certainty = Certainty.LIKELY if unit is None else unit.certainty
        return Row(kind, reading, certainty, (unit or conclusion,))
    reading = Channels(conclusion.channels)
    return Row(_ASPECTS[kind], reading, conclusion.certainty, (conclusion,))


def _velocity(recording: Recording) -> Row:
    """Return the ratio of the velocity to the slope of the position."""
    assert recording.velocity is not None
    moving = np.flatnonzero(np.ptp(recording.position, axis=0) > MIN_MOVEMENT)
    if not moving.size:
        open_ = Certainty.UNDETERMINED
        return Row("velocity", Fact.NOT_EXAMINED, open_, (Basis.NO_MOTION,))
    factor, correlation = against_position(
        recording.time, recording.position[:, moving], recording.velocity[:, moving]
    )
    itself = np.diag(correlation)
    names = [recording.joint_names[joint] for joint in moving]
    if itself.min() < MIN_CORRELATION:
        bad = tuple(name for name, r in zip(names, itself, strict=True) if r < MIN_CORRELATION)
        evidence = Correlation(float(itself.min()))
        decider = NextStep.CHECK_COLUMNS
        return Row("velocity", NotSlopes(bad), Certainty.CERTAIN, (evidence,), decider)
    if np.all(np.abs(factor - 1.0) < _MAX_RATIO_DEVIATION):
        ratio = SlopeRatio(float(1.0 / np.mean(factor)))
        return Row("velocity", Fact.SLOPE, Certainty.CERTAIN, (ratio,))
    explanations = [
        fact
        for size, fact in _SLOPES.items()
        if np.all(np.abs(factor / size - 1.0) < _MAX_RATIO_DEVIATION)
    ]
    factors = SlopeFactors(dict(zip(names, factor.tolist(), strict=True)))
    reading = explanations[0] if explanations else Fact.SCALED_SLOPE
    decider = NextStep.STATE_UNIT_OR_GEARS
    return Row("velocity", reading, Certainty.CERTAIN, (factors,), decider)


def _silent(recording: Recording) -> list[Row]:
    """Return the row of joints that move and whose torque is zero, none if there are none."""
    if recording.torque is None:
        return []
    silent = (np.ptp(recording.position, axis=0) > MIN_MOVEMENT) & ~recording.torque.any(axis=0)
    zero = tuple(np.array(recording.joint_names)[silent].tolist())
    if not zero:
        return []
    certain = Certainty.CERTAIN
    step = NextStep.RECORD_TORQUE
    return [Row("torque", ZeroTorques(zero), certain, (Basis.CHANNELS,), step, is_fault=True)]


def _rests(recording: Recording) -> Row:
    travel = np.ptp(recording.position, axis=0)
    rests = [
        name
        for name, size in zip(recording.joint_names, travel, strict=True)
        if size <= MIN_MOVEMENT
    ]
    if not rests:
        moved = Travel(float(travel.min()), at_least=True)
        return Row("motion", Fact.EVERY_JOINT_MOVES, Certainty.CERTAIN, (moved,))
    evidence = Travel(MIN_MOVEMENT, at_least=False)
    still = StillJoints(tuple(rests))
    return Row("motion", still, Certainty.CERTAIN, (evidence,), NextStep.MOVE_ALL_OR_LOCK)


def _wraps(recording: Recording) -> Row:
    wrapped = recording.provenance.get(UNWRAPPED)
    if wrapped is None:
        return Row("wraps", Fact.CONTINUOUS, Certainty.CERTAIN, (Basis.NO_TURN,))
    return Row("wraps", Wrapped(wrapped), Certainty.CERTAIN, (Basis.TURNS,))


def _range(recording: Recording, cell: Cell) -> Row:
    outside = outside_limits(recording.position, cell.joint_names, cell.urdf)
    if outside is None:
        return Row("range", Fact.WITHIN_LIMITS, Certainty.CERTAIN, (Basis.EVERY_ROW,))
    return Row("range", outside, Certainty.CERTAIN, (Basis.LIMITS,), outside)


def _measured(
    recording: Recording, concluded: Sequence[Conclusion], found: Sequence[Conclusion]
) -> Row:
    """Return whether positions are measured, by their noise and the lag of the velocity."""
    if has_commands_as_positions(recording):
        commands = recording.provenance.get(COPIED_COMMANDS, _COMMANDS)
        copies = (each for each in found if isinstance(each, CopiedCommands))
        copied = next(copies, CopiedCommands(commands, ()))
        decider = NextStep.RECORD_MEASURED
        return Row(
            "positions", Fact.COMMANDED, Certainty.CERTAIN, (copied,), decider, is_fault=True
        )
    names = [
        each.channels
        for each in concluded
        if isinstance(each, ChannelMeaning) and each.kind == "position"
    ]
    if any(COMMANDED.search(name) for name in names):
        decider = NextStep.RECORD_MEASURED_IF_ANY
        return Row("positions", Fact.COMMANDED, Certainty.LIKELY, (Basis.NAME,), decider)
    quiet = noiseless_above(recording.time, recording.position, recording.segments())
    lag = velocity_lag(recording)
    if lag is not None and lag > 0.0:
        evidence = (LateVelocity(lag),)
        decider = NextStep.RECORD_MEASURED
        likely = Certainty.LIKELY
        return Row("positions", Fact.COMMANDED, likely, evidence, decider, is_fault=True)
    if quiet is None:
        return Row("positions", Fact.MEASURED, Certainty.CERTAIN, (Basis.ENCODER_NOISE,))
    joints = recording.position[:, np.ptp(recording.position, axis=0) > MIN_MOVEMENT]
    if has_small_noise(recording.time, joints, recording.segments(), quiet):
        return Row("positions", Fact.MEASURED, Certainty.LIKELY, (Basis.SMALL_NOISE,))
    open_ = Certainty.UNDETERMINED
    step = hidden_by_rounding(recording.time, joints, recording.segments())
    if step is not None:
        coarse = CoarsePositions(step)
        hidden = (Basis.HIDDEN_BY_ROUNDING,)
        return Row("positions", coarse, open_, hidden, NextStep.ASK_FOR_POSITIONS)
    reading = SmoothPositions(quiet)
    return Row("positions", reading, open_, (Basis.NO_NOISE,), NextStep.ASK_FOR_POSITIONS)


def velocity_lag(recording: Recording) -> float | None:
    """Return by how much the velocity comes after the slope of the positions [s].

    None without a velocity, without a common lag, or if the two come together.
    """
    if recording.velocity is None or recording.n_samples < 32:
        return None
    step = float(np.median(np.diff(recording.time)))
    even = np.arange(recording.time[0], recording.time[-1], step)
    most = max(2, round(_MAX_LAG_SECONDS / step))
    if len(even) <= 4 * most or not step > 0.0:
        return None
    lags = []
    for position, velocity in zip(recording.position.T, recording.velocity.T, strict=True):
        if np.ptp(position) <= MIN_MOVEMENT:
            continue
        q = np.interp(even, recording.time, position)
        moved = np.cumsum(np.interp(even, recording.time, velocity)) * step
        lags.append(_lag(q, moved, most))
    delays = np.array([lag for lag in lags if lag is not None]) * step
    if delays.size < 2:
        return None
    lag = float(np.median(delays))
    alike = np.abs(delays - lag) <= max(step, 0.25 * abs(lag))
    clear = abs(lag) > _MIN_LAG_STEPS * step and np.mean(alike) > 0.5
    return lag if clear else None


def _lag(first: Array, second: Array, most: int) -> float | None:
    """Return the steps by which the second signal comes after the first; None if unlike."""
    inner = slice(most, len(first) - most)
    reference = first[inner] - first[inner].mean()
    scores = []
    for lag in range(-most, most + 1):
        moved = second[most + lag : len(second) - most + lag]
        moved = moved - moved.mean()
        size = np.linalg.norm(reference) * np.linalg.norm(moved)
        scores.append(float(reference @ moved / size) if size > 0.0 else 0.0)
    best = int(np.argmax(scores))
    if scores[best] < _MIN_LAG_CORRELATION or best in (0, 2 * most):
        return None
    left, middle, right = scores[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    return best - most + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
