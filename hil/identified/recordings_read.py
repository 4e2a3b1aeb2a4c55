"""What was read from logs and bags: their content, and how it differs from the file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from hil.base.terminal_text import plural
from hil.identified.staging import Staging
from hil.importers.conclusions import (
    ChannelMeaning,
    ConcludedUnit,
    Conclusion,
    JointOrder,
    JointRange,
    KnownCommands,
    LockedJoints,
    NoTorque,
    PartialVelocity,
    RecordedClock,
    ScaledVelocity,
    StatedUnit,
    UnrelatedVelocity,
    UnusedChannels,
    VelocityOrder,
)
from hil.importers.messages import sentence
from hil.importers.recording_import import ImportedRecording
from hil.look.readings import DoubtfulArm
from hil.look.result import ChangedReading
from hil.results.results import RecordingResult
from identification.signals.messages import clock_lines
from identification.text import duration_text, number

_ROUTINE_CONCLUSIONS: Final = (
    ChannelMeaning,
    ConcludedUnit,
    JointOrder,
    JointRange,
    KnownCommands,
    LockedJoints,
    RecordedClock,
    StatedUnit,
    ChangedReading,
    DoubtfulArm,
)


_NOT_OF_SERVOS: Final = (
    NoTorque,
    PartialVelocity,
    ScaledVelocity,
    UnrelatedVelocity,
    VelocityOrder,
)
"""What does not matter where no torque is identified: velocities are slopes of positions there."""


def recording_results(staging: Staging, predicted: Sequence[Path]) -> list[RecordingResult]:
    """Return what was read from each imported recording, for `results.json` and the report."""
    return [
        RecordingResult(
            file=staging.sources[place].name,
            use="predicted" if staging.sources[place] in predicted else "fitted",
            content=size(recording),
            changes=[
                sentence(found)
                for found in recording.concluded
                if isinstance(found, ChangedReading | DoubtfulArm | ConcludedUnit | JointOrder)
            ]
            + [sentence(found) for found in _unusual(recording)],
            channels=[sentence(conclusion) for conclusion in recording.concluded],
        )
        for place, recording in staging.recordings.items()
    ]


def content(recording: ImportedRecording) -> str:
    """Return joints, duration and rate of a recording, and what is unusual about it."""
    return "; ".join([size(recording), *map(sentence, _unusual(recording))])


def size(recording: ImportedRecording) -> str:
    """Return joints, duration and rate of a recording."""
    found = (*recording.concluded, *recording.examined.found)
    clock = next((each.base for each in found if isinstance(each, RecordedClock)), None)
    joints = sum(isinstance(each, JointRange) for each in found)
    parts = [plural(joints, "joint")]
    if clock is not None:
        parts = [f"{parts[0]}, {duration_text(clock.duration)} at {number(clock.rate, 4)} Hz"]
        parts += clock_lines(clock)[1:]
    return "; ".join(parts)


def unusual_of_servo(recording: ImportedRecording) -> list[str]:
    """Return what is unusual about a recording of positions and commands."""
    converted = [
        each
        for each in (*recording.concluded, *recording.examined.found)
        if isinstance(each, ConcludedUnit) and each.kind == "commanded_position"
    ]
    others = [each for each in _unusual(recording) if not isinstance(each, _NOT_OF_SERVOS)]
    found = [*converted, *others]
    return [*map(sentence, sorted(found, key=lambda each: isinstance(each, UnusedChannels)))]


def _unusual(recording: ImportedRecording) -> list[Conclusion]:
    found = (*recording.concluded, *recording.examined.found)
    return [
        *recording.examined.warnings,
        *(conclusion for conclusion in found if not isinstance(conclusion, _ROUTINE_CONCLUSIONS)),
    ]
