"""The campaign folder: what lies where, and which archives are whole.

`manifest.json` holds the checksums of cell, URDF and plan, and names every closed archive with its
checksum and outcome. It is replaced atomically after each archive, so a killed run loses at most
the archive being written, and that file is recognised as torn because the manifest does not name
it.
"""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hil.archive import ArchiveName
from hil.archive.header import REJECTED
from hil.files import write_atomically
from hil.io import digest, file_digest, is_locked, json_digest, locked
from hil.reading import is_no_file, json_of, lies_there, opened, text_of

from .errors import CampaignFolderError, NotRehearsedError

if TYPE_CHECKING:
    from hil.cell import Cell

    from .plan import CampaignPlan


import io
from collections.abc import Mapping
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from hil.reading import toml_of
from identification.errors import ModelError
from identification.model.urdf_text import urdf_tree

T = TypeVar("T")


def read_back(kind: type[T], text: str, *, strict: bool = True) -> T:
    """An object of a dataclass or model, from the JSON that its fields were written as.

    Args:
        kind: of the object.
        text: the JSON.
        strict: numbers are no texts. If not, each field is as strict as it says itself: a model
            writes infinite numbers as words.

    Raises:
        ValueError: it is no JSON, or a field is not what it has to be; names the first one.
    """
    try:
        return TypeAdapter(kind).validate_json(text, strict=strict or None)
    except ValidationError as error:
        raise ValueError(first_of(error)) from error


def first_of(error: ValidationError) -> str:
    """The first thing that is wrong, with its place."""
    first = error.errors()[0]
    place = ".".join(map(str, first["loc"]))
    return f"{place}: {first['msg']}" if place else str(first["msg"])


LOCK: Final = "campaign.lock"
LOCK_PATIENCE: Final = 0.5
"""s to wait for a lock: whoever looks whether somebody is at work holds it for a moment."""
MESH: Final = "mesh "
"""Begins the entry of a mesh, by its name in the URDF."""
MISSING: Final = "missing"
_PACKAGE: Final = "package://"
_FILE: Final = "file://"


def checksums(contents: Mapping[str, bytes], root: Path) -> dict[str, str]:
    """Checksums of the inputs of a plan, and of the collision meshes that they name.

    Args:
        contents: of `cell.toml`, `robot.urdf` and `plan.json`, as far as they are there.
        root: folder that relative paths in them begin at.

    Returns:
        By file name; a mesh that cannot be read is "missing" (no motion is checked without).
    """
    sums = {name: digest(content) for name, content in contents.items()}
    for mesh in _collision_meshes(contents.get("robot.urdf", b"")):
        places = _places(mesh, _mesh_folders(contents.get("cell.toml", b""), root), root)
        sums[MESH + mesh] = next(filter(None, map(_read, places)), MISSING)
    return sums


def combined(sums: Mapping[str, str]) -> str:
    """One checksum over all."""
    return json_digest(dict(sums))


def as_text(content: bytes) -> str:
    """A file's content as reading it as text gives it (UTF-8, any line ends)."""
    return io.TextIOWrapper(io.BytesIO(content), "utf-8").read()


def _collision_meshes(urdf: bytes) -> list[str]:
    try:
        root = urdf_tree(as_text(urdf))
    except (ModelError, UnicodeDecodeError):  # whoever loads it says so
        return []
    found = root.iterfind("./link/collision/geometry/mesh")
    return sorted({name for mesh in found if (name := mesh.get("filename"))})


def _mesh_folders(cell: bytes, root: Path) -> list[Path]:
    try:
        named = toml_of(as_text(cell))["cell"]["mesh_folders"]
        return [root / name for name in named]
    except (ValueError, KeyError, TypeError):  # likewise
        return []


def _places(mesh: str, folders: list[Path], root: Path) -> list[Path]:
    """Where a mesh is looked for, in that order."""
    if mesh.startswith(_PACKAGE):
        return [folder / mesh.removeprefix(_PACKAGE) for folder in folders]
    name = mesh.removeprefix(_FILE)
    return [root / name, *(folder / name for folder in folders)]


def _read(path: Path) -> str | None:
    try:
        return file_digest(path)
    except OSError:
        return None


_ANOTHER: Final = "{} is not the one this campaign began with"
_RESTORE: Final = "restore it, or begin a new campaign"


@dataclass(frozen=True)
class Entry:
    """One closed archive.

    Attributes:
        name: of the file.
        outcome: how its motion ended; "rejected" for one that ended well and is of no use.
        sha256: checksum of the file.
        reason: why it was rejected, in words; "" for every other.
    """

    name: str
    outcome: str
    sha256: str
    reason: str = ""


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
    def rehearsal(self) -> Path:
        """How the rehearsal of the plan went."""
        return self.root / "rehearsal.json"

    @property
    def rehearsed(self) -> Path:
        """Folder of the rehearsal's own campaigns: its archives and reports."""
        return self.root / "rehearsal"

    @property
    def dry_run(self) -> Path:
        """Who accepted the slow dry run."""
        return self.root / "dry_run.json"

    @property
    def warmup(self) -> Path:
        """How the friction fell while the arm warmed up."""
        return self.root / "warmup.json"

    @property
    def plan_hash(self) -> str:
        """SHA-256 over cell, URDF, plan and collision meshes as they lie there."""
        return combined(self._inputs())

    @property
    def motion_hash(self) -> str:
        """The same but for the number of repetitions: of what moves the arm, however often.

        Raises:
            CampaignFolderError: one of them cannot be read.
        """
        contents = self._contents()
        sums = self._checksums(contents)
        try:
            cell = toml_of(as_text(contents[self.cell.name]))
        except (KeyError, ValueError):
            return combined(sums)  # no cell that anything could be run with
        cell.get("campaign", {}).pop("repetitions", None)
        return combined(sums | {self.cell.name: json_digest(cell)})

    def hash_of(self, cell: Cell, plan: CampaignPlan) -> str:
        """The hash of a cell and a plan in memory, which must be those that lie in the folder.

        What is judged, run and stamped is then one and the same, whatever is edited meanwhile.

        Raises:
            CampaignFolderError: one of them was changed since it was read.
        """
        contents = self._contents()
        same = {
            self.cell.name: as_text(contents.get(self.cell.name, b"")) == cell.text,
            self.urdf.name: as_text(contents.get(self.urdf.name, b"")) == cell.urdf,
            self.plan.name: plan.is_of(as_text(contents.get(self.plan.name, b""))),
        }
        for name, unchanged in same.items():
            if not unchanged:
                raise CampaignFolderError(
                    self.root,
                    f"{name} was changed after it was read",
                    "open the campaign anew, and begin this step again",
                )
        return combined(self._checksums(contents))

    @property
    def _manifest(self) -> Path:
        return self.root / "manifest.json"

    @property
    def sealed(self) -> bool:
        """Whether there is a manifest."""
        return lies_there(self._manifest)

    def locked(self) -> AbstractContextManager[None]:
        """Keep every other run out of the folder; a run that dies lets go of it.

        Raises:
            CampaignFolderError: another run is at work on it, or the disk refuses.
        """

        def refusal(error: OSError) -> CampaignFolderError:
            if isinstance(error, BlockingIOError):
                return CampaignFolderError(
                    self.root, "another run is at work on it", "wait for its end, or stop it"
                )
            problem = f"{LOCK} cannot be written ({error.strerror})"
            return CampaignFolderError(self.root, problem, "make it a writable file")

        return locked(self.root / LOCK, refusal, patience=LOCK_PATIENCE)

    @property
    def busy(self) -> bool:
        """Whether a run is at work on the folder at this moment."""
        return is_locked(self.root / LOCK)

    def seal(self) -> None:
        """Begin the manifest with the checksums of what the campaign is about."""
        self._save({"inputs": self._inputs(), "archives": []})

    def accept_changes(self) -> None:
        """Take cell, URDF and plan as they are, if nothing has been recorded with them yet.

        Raises:
            CampaignFolderError: something was recorded, and one of them changed since.
        """
        if not self._content()["archives"]:
            if self._content()["inputs"] != self._inputs():
                self.seal()
        elif changed := self._changed():
            raise CampaignFolderError(self.root, _ANOTHER.format(changed), _RESTORE)

    def require_unchanged(self) -> None:
        """Refuse to go on if cell, URDF or plan are not those the campaign began with.

        Raises:
            NotRehearsedError: names the file that changed.
        """
        changed = self._changed()
        if changed:
            remedy = (
                _RESTORE
                if self._content()["archives"]
                else f"restore it, or rehearse again (`hil rehearse {self.root}`)"
            )
            raise NotRehearsedError(self.root, f"was edited: {_ANOTHER.format(changed)}", remedy)

    def _changed(self) -> str | None:
        """The first file that is not the one that was sealed."""
        sealed: dict[str, str] = self._content()["inputs"]
        now = self._inputs()
        for name in sorted(sealed.keys() | now.keys()):
            if name.startswith(MESH) and name not in sealed:
                continue  # sealed by a version that did not look at meshes
            if sealed.get(name) != now.get(name):
                return name
        return None

    def manifest(self) -> list[Entry]:
        """Closed archives in the order they were made.

        Raises:
            CampaignFolderError: the manifest cannot be read.
        """
        try:
            entries = [Entry(**entry) for entry in self._content()["archives"]]
            if not all(isinstance(text, str) for e in entries for text in asdict(e).values()):
                raise TypeError("an entry is not made of words")
            if away := [
                e.name for e in entries if Path(e.name).name != e.name or not e.name.strip(".")
            ]:
                raise TypeError(f"{away[0]!r} is no name of a file in {self.archives.name}/")
            return entries
        except (KeyError, TypeError) as error:
            raise self._damaged(error) from error

    def add(self, name: str, outcome: str, reason: str = "") -> None:
        """Enter a closed archive into the manifest.

        Args:
            name: of the file.
            outcome: how its motion ended, or "rejected".
            reason: why it was rejected.

        Raises:
            CampaignFolderError: the disk refuses.
        """
        content = self._content()
        entry = Entry(name, outcome, file_digest(self.archives / name), reason)
        self._save(content | {"archives": [*content["archives"], asdict(entry)]})

    def reject(self, name: str, reason: str) -> None:
        """Enter an archive that was found good before as rejected; it says so itself by now.

        Raises:
            CampaignFolderError: the disk refuses.
        """
        content = self._content()
        now = asdict(Entry(name, REJECTED, file_digest(self.archives / name), reason))
        entries = [now if one["name"] == name else one for one in content["archives"]]
        self._save(content | {"archives": entries})

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
        """Name of the next attempt at an interval; never one that lies there or ever did.

        Raises:
            CampaignFolderError: the manifest cannot be read.
        """
        used = {entry.name for entry in self.manifest()}
        attempt = 1
        while (name := ArchiveName(kind, index, attempt).filename) in used or (
            self.archives / name
        ).exists():
            attempt += 1
        return ArchiveName(kind, index, attempt)

    def _unchanged(self, entry: Entry) -> bool:
        try:
            return file_digest(self.archives / entry.name) == entry.sha256
        except OSError as error:
            if is_no_file(error):
                return False
            raise CampaignFolderError(
                self.root, f"{entry.name} cannot be read ({error.strerror})", "make it readable"
            ) from error

    def _contents(self) -> dict[str, bytes]:
        """Cell, plan and URDF by file name, each read once.

        Raises:
            CampaignFolderError: one is there and cannot be read.
        """
        contents = {}
        for file in (self.cell, self.plan, self.urdf):
            try:
                with opened(file) as stream:
                    contents[file.name] = stream.read()
            except FileNotFoundError:
                continue
            except OSError as error:
                problem = f"{file.name} cannot be read ({error.strerror})"
                raise CampaignFolderError(self.root, problem, _RESTORE) from error
        return contents

    def _inputs(self) -> dict[str, str]:
        """Checksums of cell, plan, URDF and meshes by name."""
        return self._checksums(self._contents())

    def _checksums(self, contents: dict[str, bytes]) -> dict[str, str]:
        """Checksums of these; a mesh that is not on this computer counts as it was sealed."""
        sums = checksums(contents, self.root)
        if MISSING in sums.values():
            sealed = self._content()["inputs"]
            sums |= {
                name: sealed[name] for name in sums if sums[name] == MISSING and name in sealed
            }
        return sums

    def _content(self) -> dict[str, Any]:
        if not self.sealed:
            return {"inputs": {}, "archives": []}
        try:
            content = json_of(text_of(self._manifest))
            inputs = dict(content["inputs"])
            if not all(isinstance(text, str) for pair in inputs.items() for text in pair):
                raise TypeError("its inputs are not names and checksums")
            return {"inputs": inputs, "archives": list(content["archives"])}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self._damaged(error) from error

    def _save(self, content: dict[str, Any]) -> None:
        # A line an archive. With `indent` each call leaves a reference cycle, motion by motion.
        archives = ",\n".join(map(json.dumps, content["archives"]))
        text = f'{{"inputs": {json.dumps(content["inputs"])},\n"archives": [\n{archives}\n]}}\n'
        try:
            write_atomically(self._manifest, text)
        except OSError as error:
            raise CampaignFolderError(
                self.root, f"manifest.json cannot be written ({error})", "make room and run again"
            ) from error

    def _damaged(self, error: Exception) -> CampaignFolderError:
        return CampaignFolderError(
            self.root, f"manifest.json is damaged ({error})", "restore it or start a new folder"
        )
