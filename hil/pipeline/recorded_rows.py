"""Findings about rows and clock of recordings, without a model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from hil.archive.imported import ROW_COUNTER
from hil.pipeline.sources import Source, has_commands_as_positions
from identification.signals.position_steps import position_steps
from identification.signals.row_faults import RowFaultKind, by_kind
from identification.validation.finding import Finding, RemedyKey, Value
from identification.validation.findings.recordings import of_jumps

_REMEDIES: Final[Mapping[RowFaultKind, RemedyKey]] = {
    RowFaultKind.FROZEN: "find why the logger stopped",
    RowFaultKind.WRITTEN_TWICE: "check what wrote rows twice",
    RowFaultKind.DISPLACED: "check what displaced rows",
    RowFaultKind.JUMP: "separate the motions",
}


def row_findings(sources: Sequence[Source]) -> Iterator[Finding]:
    """Yield what is wrong with rows and stamps, once for both parts of a recording."""
    yield from commanded_positions(sources)
    yield from faulty_rows(sources)
    yield from row_counters(sources)
    yield from retimed(sources)
    steps = [position_steps(source.recording, source.name) for source in sources]
    if (jumps := of_jumps([jump for each in steps for jump in each.jumps])) is not None:
        yield jumps


def commanded_positions(sources: Sequence[Source], delay: float | None = None) -> Iterator[Finding]:
    """Yield a finding about positions that are commands.

    Args:
        sources: recordings.
        delay: of the torque [s], where one was found.
    """
    copies = [source for source in sources if has_commands_as_positions(source.recording)]
    names = tuple(dict.fromkeys(source.path.name for source in copies))
    if not names:
        return
    values: dict[str, Value] = {"recordings": names}
    if delay is not None:
        values["delay"] = 1e3 * delay
    yield Finding("commanded positions", "wrong", "record the positions", "cause", values)


def faulty_rows(sources: Sequence[Source]) -> Iterator[Finding]:
    """Yield findings about rows that are not of one motion."""
    for source in {source.path: source for source in sources}.values():
        for faults in by_kind(source.faults):
            values: dict[str, Value] = {"recording": source.path.name, "faults": faults}
            yield Finding("faulty rows", "doubtful", _REMEDIES[faults.kind], values=values)


def row_counters(sources: Sequence[Source]) -> Iterator[Finding]:
    """Yield a finding about times that count rows, and that a map reads in a unit."""
    for source in {source.path: source for source in sources}.values():
        unit = source.recording.provenance.get(ROW_COUNTER)
        if unit is not None:
            values: dict[str, Value] = {"recording": source.path.name, "unit": unit}
            yield Finding("counted rows", "doubtful", "state the sampling rate", "cause", values)


def retimed(sources: Sequence[Source]) -> Iterator[Finding]:
    """Yield a finding about stamps that are not the times of the samples."""
    found = [source for source in sources if source.retimed]
    if found and (times := found[0].times) is not None:
        values: dict[str, Value] = {
            "recordings": tuple(source.name for source in found),
            "times": times,
        }
        yield Finding("retimed", "doubtful", "log the time", values=values)
