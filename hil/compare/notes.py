"""What limits a comparison of campaigns, as values; `hil.compare.messages` words them."""

from __future__ import annotations

from dataclasses import dataclass

from hil.batch.cluster import SkippedArchive
from hil.batch.setup import Setup
from hil.pipeline.notes import Note


@dataclass(frozen=True)
class CampaignName:
    """Name of a campaign among the ones it is compared with."""

    folder: str  #: below the folder that all are in
    setup: Setup | None = None  #: what its cell states, where several campaigns have this folder
    day: str = ""  #: of its recordings, ISO 8601; "": unknown


@dataclass(frozen=True)
class UnusableArchive(Note):
    """An archive that could not be used."""

    archive: SkippedArchive


@dataclass(frozen=True)
class OtherSetups(Note):
    """Campaigns whose cells state different payloads or delays."""

    setups: tuple[tuple[CampaignName, Setup], ...]  #: campaign and what its cell states


@dataclass(frozen=True)
class SingleRepetition(Note):
    """A campaign without the scatter of repetitions in its intervals."""

    campaign: CampaignName


@dataclass(frozen=True)
class OfCampaign(Note):
    """A note on the archives or the estimate of one campaign."""

    campaign: CampaignName
    note: Note


@dataclass(frozen=True)
class UnknownDailyVariation(Note):
    """How much an arm varies from day to day is not known from a few campaigns."""
