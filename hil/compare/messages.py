"""A comparison of campaigns in words."""

from __future__ import annotations

from collections.abc import Iterable

from hil.batch.messages import batch_lines, setup_words
from hil.pipeline.notes import Note

from .comparison import QuantityChange
from .notes import (
    CampaignName,
    OfCampaign,
    OtherSetups,
    SingleRepetition,
    UnknownDailyVariation,
    UnusableArchive,
)


def verdict_line(changed: Iterable[QuantityChange]) -> str:
    """Return one line: what changed, friction by axis."""
    names = dict.fromkeys(
        f"friction of {change.axis}" if change.kind == "friction" else change.parameter
        for change in changed
    )
    return f"Changed: {', '.join(names)}" if names else "No significant change"


def comparison_lines(notes: Iterable[Note]) -> list[str]:
    """Return sentences on what limits a comparison, without full stops."""
    return [line for note in notes for line in _lines(note)]


def campaign_words(name: CampaignName) -> str:
    """Return a campaign by folder, setup if several have this folder, and day."""
    setup = "" if name.setup is None else f", {setup_words(name.setup) or 'nothing stated'}"
    day = f" ({name.day})" if name.day else ""
    return f"{name.folder}{setup}{day}"


def _lines(note: Note) -> list[str]:
    match note:
        case UnusableArchive(archive):
            return [f"{archive.path} could not be used: {archive.message}"]
        case OtherSetups(setups):
            stated = "; ".join(
                f"{campaign_words(name)}: {setup_words(setup) or 'nothing'}"
                for name, setup in setups
            )
            return [f"the cells state different payloads or delays, compensated ({stated})"]
        case SingleRepetition(campaign):
            return [
                f"{campaign_words(campaign)}: with one repetition, uncertainty includes noise only,"
                " not the scatter of repetitions"
            ]
        case OfCampaign(campaign, inner):
            return [f"{campaign_words(campaign)}: {line}" for line in batch_lines([inner])]
        case UnknownDailyVariation():
            return [
                "the normal variation from day to day is not known from a few campaigns: friction"
                " of a cold arm is tens of per cent higher, so compare campaigns at the same"
                " temperature"
            ]
    return batch_lines([note])
