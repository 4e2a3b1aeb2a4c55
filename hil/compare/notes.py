"""What limits a comparison of campaigns, as values; `hil.compare.messages` words them."""

from __future__ import annotations

from dataclasses import dataclass

from hil.batch.cluster import SkippedArchive
from hil.batch.setup import Setup
from hil.pipeline.notes import Note


@dataclass(frozen=True)
class UnusableArchive(Note):
    """An archive that could not be used."""

    archive: SkippedArchive


@dataclass(frozen=True)
class OtherSetups(Note):
    """Campaigns whose cells state different payloads or delays."""

    setups: tuple[tuple[str, Setup], ...]  #: campaign and what its cell states


@dataclass(frozen=True)
class SingleRepetition(Note):
    """A campaign without the scatter of repetitions in its intervals."""

    campaign: str


@dataclass(frozen=True)
class OfCampaign(Note):
    """A note on the archives or the estimate of one campaign."""

    campaign: str
    note: Note


@dataclass(frozen=True)
class UnknownDailyVariation(Note):
    """How much an arm varies from day to day is not known from a few campaigns."""
