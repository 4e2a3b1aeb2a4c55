"""A campaign folder as others read it: which of its archives count.

`manifest.json` names every closed archive with its checksum and outcome. :mod:`hil.campaign.folder`
writes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from hil.archive import ArchiveName
from hil.base.errors import CampaignFolderError
from hil.base.files import file_digest
from hil.base.safe_input import is_not_a_file, parse_json, path_exists, read_text
from hil.base.type_adapter import adapter_of

T = TypeVar("T")


def read_back(kind: type[T], text: str, *, strict: bool = True) -> T:
    """Return an object of a dataclass or model from its JSON.

    With `strict` texts are refused as numbers; a model may write infinite numbers as texts.

    Raises:
        ValueError: it is not JSON, or a field is invalid; names the first one.
    """
    try:
        adapter = adapter_of(kind)  # type: ignore[arg-type]
        value: T = adapter.validate_json(text, strict=strict or None)
        return value
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise ValueError(f"{field}: {first['msg']}" if field else str(first["msg"])) from error


def load_record(
    kind: type[T], path: Path, remedy: str, *, version: int = 0, strict: bool = True
) -> T | None:
    """Read the file of a campaign's step; return None where there is none.

    Args:
        kind: class of the record.
        path: of the file.
        remedy: of the error.
        version: its `format_version`; 0 for any.
        strict: see `read_back`.

    Raises:
        CampaignFolderError: it cannot be read, or has another version.
    """
    if not path_exists(path):
        return None
    try:
        text = read_text(path)
        if version and (file_version := parse_json(text)["format_version"]) != version:
            raise ValueError(f"format version {file_version}, this is {version}")
        return read_back(kind, text, strict=strict)
    except (OSError, ValueError, KeyError, TypeError) as error:
        cause = getattr(error, "strerror", None) or error
        problem = f"{path.name} cannot be read ({cause})"
        raise CampaignFolderError(path.parent, problem, remedy) from error


@dataclass(frozen=True)
class Entry:
    """One closed archive: file name, outcome of its motion, SHA-256, and reason of the outcome.

    The outcome is "rejected" for a completed motion that failed its quality check.

    Raises:
        ValueError: `name` is a path to another folder.
    """

    name: str
    outcome: str
    sha256: str
    reason: str = ""

    def __post_init__(self) -> None:
        if Path(self.name).name != self.name or not self.name.strip("."):
            raise ValueError(f"{self.name!r} is not the name of a file in archives/")

    @property
    def kind(self) -> str:
        """Kind of its motion; "" for another file name."""
        name = ArchiveName.parse(self.name)
        return "" if name is None else name.kind


@dataclass(frozen=True)
class Manifest:
    """Checksums of a plan's inputs by name, and the closed archives in order."""

    inputs: dict[str, str]
    archives: list[Entry]


class Below:
    """A path in the folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, folder: RecordedCampaign, _owner: object = None) -> Path:
        return folder.root / self._name


@dataclass(frozen=True)
class RecordedCampaign:
    """Archives of a campaign folder.

    Attributes:
        archives: their folder.
        digests: cached checksums of archives by name; None to compute them each time.
    """

    root: Path
    digests: dict[str, str] | None = field(default=None, compare=False, repr=False)

    archives = Below("archives")
    _path = Below("manifest.json")

    @property
    def sealed(self) -> bool:
        """Whether there is a manifest."""
        return path_exists(self._path)

    def manifest(self) -> list[Entry]:
        """Return the closed archives in order (CampaignFolderError if it cannot be read)."""
        return self._manifest().archives

    def complete_archive(self, kind: str, index: int) -> str | None:
        """Return the name of the completed archive of this interval, or None."""
        return self._whole(kind, index).get(index)

    def completed(self, kind: str) -> list[Path]:
        """Return the completed archives of a kind by index; of several attempts the last one."""
        return [self.archives / name for _, name in sorted(self._whole(kind).items())]

    def damaged(self) -> list[str]:
        """Return a sentence for each archive of the manifest that is missing or was changed."""
        return [
            f"{entry.name} is missing or is not what was recorded, and was left out"
            for entry in self.manifest()
            if not self._unchanged(entry)
        ]

    def _whole(self, kind: str, index: int | None = None) -> dict[int, str]:
        """Return the names of the completed archives of a kind by index, the last attempts."""
        names: dict[int, str] = {}
        for entry in reversed(self.manifest()):
            name = ArchiveName.parse(entry.name)
            if (
                name is not None
                and (name.kind, entry.outcome) == (kind, "completed")
                and index in (None, name.index)
                and name.index not in names
                and self._unchanged(entry)
            ):
                names[name.index] = entry.name
        return names

    def _unchanged(self, entry: Entry) -> bool:
        digests = {} if self.digests is None else self.digests
        try:
            if entry.name not in digests:
                digests[entry.name] = file_digest(self.archives / entry.name)
            return digests[entry.name] == entry.sha256
        except OSError as error:
            if is_not_a_file(error):
                return False
            raise CampaignFolderError(
                self.root, f"{entry.name} cannot be read ({error.strerror})", "make it readable"
            ) from error

    def _manifest(self) -> Manifest:
        manifest = load_record(Manifest, self._path, "restore it or start a new folder")
        return manifest or Manifest({}, [])
