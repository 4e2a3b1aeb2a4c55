"""The campaign folder: what lies where, and which archives are whole.

`manifest.json` holds the checksums of cell, URDF and plan, and names every closed archive with its
checksum and outcome. It is replaced atomically after each archive, so a killed run loses at most
the archive being written, and that file is recognised as torn because the manifest does not name
it.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hil.archive import ArchiveName
from hil.files import write_atomically

from .errors import CampaignFolderError

LOCK = "campaign.lock"


@dataclass(frozen=True)
class Entry:
    """One closed archive."""

    name: str
    outcome: str
    sha256: str


@dataclass(frozen=True)
class CampaignFolder:
    """Paths below one campaign folder."""

    root: Path

    @property
    def archives(self) -> Path:
        """Folder of the MCAP files."""
        return self.root / "archives"

    @property
    def cell(self) -> Path:
        """The campaign's own copy of the cell file."""
        return self.root / "cell.toml"

    @property
    def urdf(self) -> Path:
        """The campaign's own copy of the URDF."""
        return self.root / "robot.urdf"

    @property
    def plan(self) -> Path:
        """Excitation and validation motions, as planned."""
        return self.root / "plan.json"

    @property
    def results(self) -> Path:
        """What the identification found."""
        return self.root / "results.json"

    @property
    def report(self) -> Path:
        """The report for people."""
        return self.root / "report.html"

    @property
    def _manifest(self) -> Path:
        return self.root / "manifest.json"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep every other run out of the folder; a run that dies lets go of it.

        Raises:
            CampaignFolderError: another run is at work on it, or the disk refuses.
        """
        try:
            lock = os.open(self.root / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise CampaignFolderError(
                self.root, f"{LOCK} cannot be written ({error.strerror})", "make it writable"
            ) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            raise CampaignFolderError(
                self.root, "another run is at work on it", "wait for its end, or stop it"
            ) from error
        try:
            yield
        finally:
            os.close(lock)

    def seal(self) -> None:
        """Begin the manifest with the checksums of what the campaign is about."""
        self._save({"inputs": self._inputs(), "archives": []})

    def require_unchanged(self) -> None:
        """Refuse to go on if cell, URDF or plan are not those the campaign began with.

        Raises:
            CampaignFolderError: names the file that changed.
        """
        sealed, now = self._content()["inputs"], self._inputs()
        for name in sorted(sealed.keys() | now.keys()):
            if sealed.get(name) != now.get(name):
                raise CampaignFolderError(
                    self.root,
                    f"{name} is not the one this campaign began with",
                    "restore it, or begin a new campaign",
                )

    def manifest(self) -> list[Entry]:
        """Closed archives in the order they were made.

        Raises:
            CampaignFolderError: the manifest cannot be read.
        """
        try:
            entries = [Entry(**entry) for entry in self._content()["archives"]]
            if not all(isinstance(text, str) for e in entries for text in asdict(e).values()):
                raise TypeError("an entry is not made of words")
            return entries
        except (KeyError, TypeError) as error:
            raise self._damaged(error) from error

    def add(self, name: str, outcome: str) -> None:
        """Enter a closed archive into the manifest.

        Raises:
            CampaignFolderError: the disk refuses.
        """
        content = self._content()
        entry = Entry(name, outcome, _sha256(self.archives / name))
        self._save(content | {"archives": [*content["archives"], asdict(entry)]})

    def whole(self, kind: str, index: int) -> str | None:
        """Name of the whole archive of this interval, if there is one with outcome `completed`."""
        for entry in reversed(self.manifest()):
            name = ArchiveName.parse(entry.name)
            if (
                name is not None
                and (name.kind, name.index, entry.outcome) == (kind, index, "completed")
                and self._unchanged(entry)
            ):
                return entry.name
        return None

    def completed(self, kind: str) -> list[Path]:
        """Whole archives of one kind, by index; of several attempts the last completed one."""
        latest: dict[int, str] = {}
        for entry in self.manifest():
            name = ArchiveName.parse(entry.name)
            if (
                name is not None
                and name.kind == kind
                and entry.outcome == "completed"
                and self._unchanged(entry)
            ):
                latest[name.index] = entry.name
        return [self.archives / latest[index] for index in sorted(latest)]

    def damaged(self) -> list[str]:
        """What the manifest names and is missing, or is not what was written, in words."""
        return [
            f"{entry.name} is missing or is not what was recorded, and was left out"
            for entry in self.manifest()
            if not self._unchanged(entry)
        ]

    def next_name(self, kind: str, index: int) -> ArchiveName:
        """Name of the next attempt at an interval; never that of an existing file."""
        attempt = 1
        while (self.archives / ArchiveName(kind, index, attempt).filename).exists():
            attempt += 1
        return ArchiveName(kind, index, attempt)

    def _unchanged(self, entry: Entry) -> bool:
        path = self.archives / entry.name
        return path.is_file() and _sha256(path) == entry.sha256

    def _inputs(self) -> dict[str, str]:
        """Checksums of cell, plan and URDF by file name."""
        files = [self.cell, self.plan, self.urdf]
        return {file.name: _sha256(file) for file in files if file.exists()}

    def _content(self) -> dict[str, Any]:
        if not self._manifest.exists():
            return {"inputs": {}, "archives": []}
        try:
            content = json.loads(self._manifest.read_text("utf-8"))
            return {"inputs": dict(content["inputs"]), "archives": list(content["archives"])}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self._damaged(error) from error

    def _save(self, content: dict[str, Any]) -> None:
        try:
            write_atomically(self._manifest, json.dumps(content, indent=1) + "\n")
        except OSError as error:
            raise CampaignFolderError(
                self.root, f"manifest.json cannot be written ({error})", "make room and run again"
            ) from error

    def _damaged(self, error: Exception) -> CampaignFolderError:
        return CampaignFolderError(
            self.root, f"manifest.json is damaged ({error})", "restore it or start a new folder"
        )


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
