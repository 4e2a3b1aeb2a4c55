"""The campaign folder: its files, and its manifest of complete archives.

`manifest.json` has the checksums of cell, URDF and plan, and every closed archive with its checksum
and outcome. It is replaced atomically after each archive: a killed run loses at most the last one.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from hil.archive import ArchiveName
from hil.archive.campaign_archives import Below, Entry, Manifest, RecordedCampaign
from hil.base.errors import CampaignFolderError
from hil.base.files import (
    digest,
    file_digest,
    file_lock,
    json_digest,
    write_atomically,
    write_output,
)
from hil.base.safe_input import open_file, parse_toml
from hil.base.terminal_text import typed
from identification.errors import ModelError
from identification.model.urdf_text import urdf_tree

from .errors import NotRehearsedError

if TYPE_CHECKING:
    from hil.cell import Cell

    from .plan import CampaignPlan

T = TypeVar("T")

LOCK: Final = "campaign.lock"
LOCK_TIMEOUT: Final = 0.5  # s to wait for a lock
MESH: Final = "mesh "  # Prefix of the entry of a mesh, by its name in the URDF
MISSING: Final = "missing"
PAYLOADS: Final = "payload"
"""Folder within a campaign's folder, with one folder per payload that it weighs."""
PAYLOAD_RESULT: Final = "payload.json"
"""File of a payload that was weighed, in its folder."""
SIDES: Final = ("bare", "loaded")
"""Campaigns in the folder of a payload: the same motion without and with it."""
_ANOTHER: Final = "{} is not the one with which this campaign began"
_RESTORE: Final = "restore it, or begin a new campaign"


def save_record(path: Path, record: Any, version: int) -> None:
    """Write a dataclass for `load_record` (OutputError if the disk refuses)."""
    content = {"format_version": version, **asdict(record)}
    write_output(path, json.dumps(content, indent=1) + "\n")


def checksums(contents: Mapping[str, bytes], root: Path) -> dict[str, str]:
    """Return the checksums of the inputs of a plan and of its collision meshes, by file name.

    `contents` are of `cell.toml`, `robot.urdf` and `plan.json`, as far as they exist; paths in them
    are relative to `root`. A mesh that cannot be read is "missing".
    """
    sums = {name: digest(content) for name, content in contents.items()}
    try:
        urdf = urdf_tree(as_text(contents.get("robot.urdf", b"")))
        mesh_elements = urdf.iterfind("./link/collision/geometry/mesh")
        meshes = sorted({name for mesh in mesh_elements if (name := mesh.get("filename"))})
    except (ModelError, UnicodeDecodeError):  # reported by whoever loads it
        return sums
    try:
        cell = parse_toml(as_text(contents.get("cell.toml", b"")))
        folders = [root / name for name in cell["cell"]["mesh_folders"]]
    except (ValueError, KeyError, TypeError):  # as above
        folders = []
    for mesh in meshes:
        name = mesh.removeprefix("package://").removeprefix("file://")
        places = folders if mesh.startswith("package://") else [root, *folders]
        sums[MESH + mesh] = next(filter(None, (_sum(place / name) for place in places)), MISSING)
    return sums


def as_text(content: bytes) -> str:
    """Decode a file's content as a text file (UTF-8, any line ends)."""
    return io.TextIOWrapper(io.BytesIO(content), "utf-8").read()


def _sum(path: Path) -> str | None:
    try:
        return file_digest(path)
    except OSError:
        return None


@dataclass(frozen=True)
class CampaignFolder(RecordedCampaign):
    """Paths below one campaign folder, and its manifest, which is written here.

    Attributes:
        confirmed: options that replace an operator's confirmations in its command; "" for none.
        rehearsed: folder of the rehearsal's own campaigns.
        second_session: folder of a simulated session at the same time, while it runs.
    """

    confirmed: str = ""

    cell = Below("cell.toml")
    urdf = Below("robot.urdf")
    plan = Below("plan.json")
    results = Below("results.json")
    report = Below("report.html")
    rehearsal = Below("rehearsal.json")
    rehearsed = Below("rehearsal")
    second_session = Below("second_session")
    dry_run = Below("dry_run.json")
    warmup = Below("warmup.json")
    precision = Below("precision.json")

    @property
    def weighs(self) -> tuple[Path, str] | None:
        """Folder of the campaign and name of the payload that this is a side of, if it is one."""
        *_, payloads, name, side = ("", "", "", *self.root.resolve().parts)
        if payloads != PAYLOADS or side not in SIDES:
            return None
        return self.root / "../../..", name

    @property
    def run_command(self) -> str:
        """The command that runs it."""
        if self.weighs is None:
            return f"hil run {typed(self.root)}"
        campaign, name = self.weighs
        command = f"hil run {typed(os.path.normpath(campaign))} --payload {typed(name)}"
        return f"{command} {self.confirmed}".rstrip()

    @property
    def plan_hash(self) -> str:
        """SHA-256 over the present cell, URDF, plan and collision meshes."""
        return json_digest(self._inputs())

    def hash_of(self, cell: Cell, plan: CampaignPlan) -> str:
        """Return the hash of a cell and a plan in memory, which must equal the folder's.

        Raises:
            CampaignFolderError: one of the files was changed since it was read.
        """
        contents = self._contents()
        names = self.cell.name, self.urdf.name, self.plan.name
        texts = [as_text(contents.get(name, b"")) for name in names]
        same = texts[0] == cell.text, texts[1] == cell.urdf, plan.is_of(texts[2])
        for name, unchanged in zip(names, same, strict=True):
            if not unchanged:
                raise CampaignFolderError(
                    self.root,
                    f"{name} was changed after it was read",
                    "open the campaign again, and repeat this step",
                )
        return json_digest(self._checksums(contents))

    def locked(self) -> AbstractContextManager[None]:
        """Lock the folder against other runs; the lock of a killed run is released.

        Raises:
            CampaignFolderError: it is locked by another run, or the disk refuses.
        """

        def refusal(error: OSError) -> CampaignFolderError:
            if isinstance(error, BlockingIOError):
                return CampaignFolderError(
                    self.root, "another run is using it", "wait until it ends, or stop it"
                )
            problem = f"{LOCK} cannot be written ({error.strerror})"
            return CampaignFolderError(self.root, problem, "make it a writable file")

        return file_lock(self.root / LOCK, refusal, patience=LOCK_TIMEOUT)

    def seal(self) -> None:
        """Create the manifest with the checksums of cell, URDF, plan and meshes."""
        self._save(Manifest(self._inputs(), []))

    def accept_changes(self) -> None:
        """Accept changes of cell, URDF and plan; CampaignFolderError if there are recordings."""
        manifest = self._manifest()
        if not manifest.archives:
            if manifest.inputs != self._inputs():
                self.seal()
        elif changed := self._changed():
            raise CampaignFolderError(self.root, _ANOTHER.format(changed), _RESTORE)

    def require_unchanged(self) -> None:
        """Require cell, URDF and plan of the manifest; NotRehearsedError names a changed file."""
        if changed := self._changed():
            again = f"restore it, or rehearse again (`hil rehearse {typed(self.root)}`)"
            remedy = _RESTORE if self.manifest() else again
            raise NotRehearsedError(self.root, f"was edited: {_ANOTHER.format(changed)}", remedy)

    def add(self, name: str, outcome: str, reason: str = "") -> None:
        """Enter a closed archive in the manifest, or change the outcome of one."""
        manifest = self._manifest()
        new = Entry(name, outcome, file_digest(self.archives / name), reason)
        entries = [new if entry.name == name else entry for entry in manifest.archives]
        entries += [] if new in entries else [new]
        self._save(replace(manifest, archives=entries))

    def next_name(self, kind: str, index: int) -> ArchiveName:
        """Return the name of the next attempt at a motion; no name is used twice."""
        used = {entry.name for entry in self.manifest()}
        attempt = 1
        while (name := str(ArchiveName(kind, index, attempt))) in used or (
            self.archives / name
        ).exists():
            attempt += 1
        return ArchiveName(kind, index, attempt)

    def _changed(self) -> str | None:
        """Return the first file that differs from the manifest."""
        sealed = self._manifest().inputs
        present = self._inputs()
        for name in sorted(sealed.keys() | present.keys()):
            if sealed.get(name) != present.get(name):
                return name
        return None

    def _contents(self) -> dict[str, bytes]:
        """Return the contents of cell, plan and URDF by file name."""
        contents = {}
        for file in (self.cell, self.plan, self.urdf):
            try:
                with open_file(file) as stream:
                    contents[file.name] = stream.read()
            except FileNotFoundError:
                continue
            except OSError as error:
                problem = f"{file.name} cannot be read ({error.strerror})"
                raise CampaignFolderError(self.root, problem, _RESTORE) from error
        return contents

    def _inputs(self) -> dict[str, str]:
        """Return the checksums of cell, plan, URDF and meshes by name."""
        return self._checksums(self._contents())

    def _checksums(self, contents: dict[str, bytes]) -> dict[str, str]:
        """Return checksums; for a mesh that is not on this computer, the manifest's."""
        sums = checksums(contents, self.root)
        if MISSING in sums.values():
            sealed = self._manifest().inputs
            sums |= {
                n: sealed[n] for n, checksum in sums.items() if checksum == MISSING and n in sealed
            }
        return sums

    def _save(self, manifest: Manifest) -> None:
        # One line per archive; `indent` would leave a reference cycle in each call.
        archives = ",\n".join(json.dumps(asdict(entry)) for entry in manifest.archives)
        text = f'{{"inputs": {json.dumps(manifest.inputs)},\n"archives": [\n{archives}\n]}}\n'
        try:
            write_atomically(self._path, text)
        except OSError as error:
            raise CampaignFolderError(
                self.root, f"manifest.json cannot be written ({error})", "make room and run again"
            ) from error
