"""One line per recording that was read, with remarks only on what is unusual."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Final

from hil.base.terminal_text import plural
from hil.identified.identified_arm import IdentifiedArm
from hil.identified.identified_servo import IdentifiedServo
from hil.identified.recordings_read import content, size, unusual_of_servo
from hil.importers.messages import sentence
from hil.look.readings import DoubtfulArm
from hil.look.result import ChangedReading
from hil.pipeline.sources import Source
from identification.text import duration_text

_MAX_RECORDING_LINES: Final = 3


def read_lines(arm: IdentifiedArm) -> list[tuple[str, str]]:
    """Return use and content of each recording; of many, the first ones and their number."""
    decisive = [*_decisive(arm)]
    lines = [*_imported(arm)]
    sources = arm.identification.prepared.sources
    imported = {*(() if arm.staging is None else arm.staging.recordings)}
    of_archives = [
        (use, [source for source in group if source.path not in imported])
        for use, group in (("fitted", sources.training), ("predicted", sources.held_out))
        if not (use == "predicted" and sources.in_sample)
    ]
    lines += [(use, _archives(group)) for use, group in of_archives if group and not _same(arm)]
    if (more := len(lines) - _MAX_RECORDING_LINES) > 0:
        lines = [
            *lines[: _MAX_RECORDING_LINES - 1],
            ("", f"and {plural(more + 1, 'recording')} more"),
        ]
    return [*decisive[:_MAX_RECORDING_LINES], *lines]


def _decisive(arm: IdentifiedArm) -> Iterator[tuple[str, str]]:
    """Yield what was changed in recordings, and why they may be from another arm."""
    if arm.staging is None:
        return
    for place, recording in arm.staging.recordings.items():
        for found in recording.concluded:
            if isinstance(found, DoubtfulArm | ChangedReading):
                label = "doubtful" if isinstance(found, DoubtfulArm) else "changed"
                yield label, f"{arm.staging.sources[place].name}: {sentence(found)}"


def servo_read_lines(servo: IdentifiedServo) -> list[tuple[str, str]]:
    """Return use and content of each recording without torque; of many the first ones."""
    staging = servo.staging
    if staging is None or not staging.recordings:
        return [("fitted", plural(len(servo.recordings), "archive"))]
    unusual = {place: unusual_of_servo(each) for place, each in staging.recordings.items()}
    common = [
        text
        for text in dict.fromkeys(chain(*unusual.values()))
        if len(unusual) > 1 and all(text in texts for texts in unusual.values())
    ]
    held_out = {each.archive for each in servo.results.validation}
    lines = []
    for place, recording in staging.recordings.items():
        use = "predicted" if place.name in held_out else "fitted"
        own = [text for text in unusual[place] if text not in common]
        lines.append((use, f"{staging.sources[place].name}: {'; '.join([size(recording), *own])}"))
    if (more := len(lines) - _MAX_RECORDING_LINES) > 0:
        lines = [
            *lines[: _MAX_RECORDING_LINES - 1],
            ("", f"and {plural(more + 1, 'recording')} more"),
        ]
    return [*lines, *(("all files", text) for text in common)]


def _same(arm: IdentifiedArm) -> bool:
    """Return whether every recording was imported: their archives need no line."""
    return arm.staging is not None and not any(
        isinstance(entry, Path) for entry in (*arm.staging.fitted, *arm.staging.predicted)
    )


def _imported(arm: IdentifiedArm) -> Iterator[tuple[str, str]]:
    staging = arm.staging
    if staging is None:
        return
    in_sample = arm.identification.prepared.sources.in_sample
    shared = not arm.predicted and len(staging.recordings) == 1 and not in_sample
    for place, recording in staging.recordings.items():
        source = staging.sources[place]
        use = "predicted" if source in arm.predicted else "fitted"
        text = content(recording)
        if shared:
            text = f"{text}; the end is predicted, not fitted"
        yield use, f"{source.name}: {text}"


def _archives(sources: Sequence[Source]) -> str:
    names = sources[0].name if len(sources) == 1 else plural(len(sources), "archive")
    duration = sum(
        float(source.recording.time[-1] - source.recording.time[0]) for source in sources
    )
    joints = plural(sources[0].recording.n_joints, "joint")
    return f"{names}: {joints}, {duration_text(duration)}"
