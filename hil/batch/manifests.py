"""What campaign folders say about their archives."""

from __future__ import annotations

from pathlib import Path

from hil.archive import ArchiveName
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder, Entry

from .places import Place
from .types import Broken


class Manifests:
    """The manifests of the campaigns that archives lie in, each read once.

    Attributes:
        broken: manifests that cannot be read; nothing can be checked against them.
    """

    def __init__(self) -> None:
        self.broken: list[Broken] = []
        self._known: dict[str, dict[str, Entry] | None] = {}

    def objection(self, place: Place, sha256: str) -> str:
        """Why the manifest says that an archive is not what was recorded; "" if it does not."""
        entry = self._entry(place)
        if entry is None or entry.sha256 == sha256:
            return ""
        return "is not what its campaign's manifest.json says"

    def outcome(self, place: Place) -> str:
        """How the manifest says that an archive ended; "" if it does not say."""
        entry = self._entry(place)
        return "" if entry is None else entry.outcome

    def not_entered(self, place: Place) -> bool:
        """Whether an archive of a campaign's motion is not in the campaign's manifest.

        A run that was killed may have closed it and not lived to judge it.
        """
        entries = self._entries(place)
        return (
            entries is not None
            and place.name not in entries
            and bool(ArchiveName.parse(place.name))
        )

    def _entry(self, place: Place) -> Entry | None:
        return (self._entries(place) or {}).get(place.name)

    def _entries(self, place: Place) -> dict[str, Entry] | None:
        """Those of its campaign by name; None where there is no manifest to be read."""
        if place.remote or place.campaign == place.folder:
            return None
        if place.campaign not in self._known:
            self._known[place.campaign] = self._read(Path(place.campaign))
        return self._known[place.campaign]

    def _read(self, campaign: Path) -> dict[str, Entry] | None:
        folder = CampaignFolder(campaign)
        try:
            return {entry.name: entry for entry in folder.manifest()} if folder.sealed else None
        except CampaignFolderError as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            self.broken.append(Broken((campaign / "manifest.json").as_posix(), reason))
            return None
