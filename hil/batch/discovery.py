"""Search for archives below folders, and selection of those that are fitted."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from hil.archive import ArchiveName, ArchiveOutcome, open_archive
from hil.archive.header import KINDS
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder, Entry
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.files import digest, json_digest
from hil.identify.settings import stated_delay
from hil.progress import Reporter

from .cache import BESIDE, CacheLocation, arm_digest, code_digest
from .factors import cell_in, changed_error, digest_of, require_complete, stamp_of
from .types import ArchiveRef, Unused, folder_of, name_of
from .workers import ArchiveTask, Workers

USES: Final = ("excitation", "validation", "standstill")
"""Uses of archives in a batch; archives of other kinds are skipped."""

_SUFFIX: Final = ".mcap"
_ARCHIVES: Final = "/archives"  # folder of a campaign's archives
_REHEARSAL: Final = "/rehearsal/"  # see `hil.campaign.folder`
_LOADED: Final = re.compile(r"/payload/[^/]+/loaded/")  # campaigns of earlier versions
_FOR_VIEWERS: Final = "/annotated"  # copies that earlier versions wrote
_COMPLETED: Final = "completed"
_NEVER_FITTED: Final = frozenset(KINDS) - {*USES, "imported"}
_UNCHECKED: Final = (
    "is not listed in its campaign's manifest.json: its quality was not checked (the run was"
    " killed; the next run adds it)"
)
_UNTOUCHED: Final = 2_000_000_000
"""Age of time stamps [ns] from which on they show the next change; some have steps of 2 s."""


class Discovery(NamedTuple):
    """Result of a search."""

    refs: tuple[ArchiveRef, ...]  #: archives to use, in the order of sums
    broken: tuple[Unused, ...]  #: files that cannot be used and folders that cannot be read
    skipped: tuple[Unused, ...]  #: archives that are not intended for fitting


def discover(
    roots: Sequence[str], cache: CacheLocation, workers: Workers, reporter: Reporter
) -> Discovery:
    """Find every archive at or below some places.

    Workers hash each archive and read its metadata. One whose file has not changed since the last
    search is not opened.

    Raises:
        InputError: a place does not exist, or there is no archive.
        CacheError: the cache cannot be written.
    """
    places, refused = find_archives(roots)
    if not places:
        reasons = ["there is no archive (*.mcap) in it", *(" ".join(one) for one in refused[:1])]
        raise InputError(", ".join(roots), "; ".join(reasons), remedy="name others")
    known: dict[str, ArchiveRef | Unused] = {}
    with reporter.task("reading the metadata of archives", len(places)) as task:
        for place in places if workers.local else ():  # else the cache is on the workers
            with suppress(ArchiveError):  # it has disappeared: the worker reports it
                if (ref := _known(place, cache)) is not None:
                    known[place] = ref
        task.advance(len(known))
        unknown = [place for place in places if place not in known]
        tasks = [ArchiveTask(place, inspect_archive, (place, cache)) for place in unknown]
        known.update(zip(unknown, workers.results(tasks, task.advance), strict=True))
    found = _select({place: known[place] for place in places})
    return found._replace(broken=(*refused, *found.broken))


def find_archives(roots: Sequence[str]) -> tuple[list[str], list[Unused]]:
    """Return the paths of archives at or below some folders or archives, sorted.

    Further, folders and files that cannot be read. Links are followed; a folder reached by several
    links is searched once, under its own name.

    Raises:
        InputError: a place does not exist.
    """
    found: set[str] = set()
    refused: list[Unused] = []
    visited: set[Path] = set()

    def refuse(error: OSError) -> None:
        folder = Path(os.fsdecode(error.filename)).as_posix()
        refused.append(Unused(folder, f"cannot be read: {error.strerror}"))

    def walk(root: Path) -> None:
        for name, folders, files in os.walk(root, followlinks=True, onerror=refuse):
            folder = Path(name).resolve()
            if folder in visited:
                folders.clear()
                continue
            visited.add(folder)
            folders[:] = [one for one in folders if one != BESIDE]
            for path in (folder / file for file in files):
                if path.suffix != _SUFFIX:
                    continue
                if os.path.isfile(path):  # noqa: PTH113 - False where it cannot be reached
                    found.add(path.as_posix())
                else:
                    refused.append(Unused(path.as_posix(), "is no regular file that can be read"))

    for root in roots:
        path = Path(root)
        if path.is_file():
            found.add(path.resolve().as_posix())
        elif path.is_dir():
            walk(path.resolve())
        else:
            raise InputError(root, "does not exist", remedy="name a folder with archives below it")
    return sorted(found), refused


# Metadata


def describe_setup(cell: Cell) -> str:
    """Return torque delay and payload of a cell as text, with all digits; "" for neither."""

    def row(figures: Iterable[float]) -> str:
        return f"({', '.join(f'{figure:.12g}' for figure in figures)})"

    delay, payload = stated_delay(cell), cell.file.robot.payload
    words = [f"torque lags by {1e3 * delay:.12g} ms"] if delay else []
    if payload is not None and (payload.mass or any(payload.inertia)):
        frame = f" in {payload.frame}" if payload.frame else ""
        words.append(f"carries {payload.mass:.12g} kg at {row(payload.centre)} m{frame}")
        words += [f"{row(payload.inertia)} kg·m²"] if any(payload.inertia) else []
    return ", ".join(words)


def inspect_archive(place: str, cache: CacheLocation) -> ArchiveRef:
    """Hash an archive, read its metadata, and cache both with the texts of its cell.

    Raises:
        HilError: it cannot be read, is damaged, or was changed meanwhile.
        CacheError: the cache cannot be written.
    """
    if (known := _known(place, cache)) is not None:
        return known
    path, store = Path(place), cache.store(place)
    begun, stamp, sha256 = time.time_ns(), stamp_of(path), digest_of(path)
    # Of an intact file this reads summary, metadata, attachments and one chunk.
    archive = open_archive(path, fields=(), stop=-1.0)
    require_complete(archive, place)
    header, plan = archive.header, archive.attachments.get("plan.json")
    index, attempt = header.index, header.attempt
    if index is None or attempt is None:  # else as stated in the archive, even if renamed
        name = ArchiveName.parse(path.name)
        index, attempt = (0, 0) if name is None else (name.index, name.attempt)
    ref = ArchiveRef(
        location=place,
        sha256=sha256,
        use=header.purpose,
        arm="",
        campaign=_campaign_of(place),
        index=index,
        cell="",
        motion="" if plan is None else digest(plan),
        when=header.recorded_at or "",
        stamp=stamp,
        kind=archive.kind,
        attempt=attempt,
        outcome=(archive.outcome or ArchiveOutcome()).outcome,
        record=json_digest(dict(header.entries)),
        simulated=header.only_simulated,
    )
    if ref.use in USES:
        cell, drives = cell_in(archive), archive.attachments.get("drive_train.json")
        key = json_digest([cell.text, cell.urdf])
        if not store.has(key):
            store.put(key, [cell.text, cell.urdf])
        arm = arm_digest(cell, drives, simulated=ref.simulated)
        ref = replace(ref, arm=arm, cell=key, setup=describe_setup(cell))
    if stamp_of(path) != stamp:
        raise changed_error(place)
    if begun - max(stamp[1:3]) > _UNTOUCHED:
        store.put(_key(place), {"code": code_digest(), "ref": ref})
    return ref


def _known(place: str, cache: CacheLocation) -> ArchiveRef | None:
    """Return the cached reference of an archive whose file has not changed; None if none."""
    note = cache.store(place).get(_key(place), dict)
    if note is None or note.get("code") != code_digest():
        return None
    ref: ArchiveRef = note["ref"]
    if stamp_of(Path(place)) != ref.stamp:
        return None
    return replace(ref, location=place, campaign=_campaign_of(place))


def _key(place: str) -> str:
    return digest(f"archive {name_of(place)}".encode("utf-8", "surrogateescape"))


def _campaign_of(place: str) -> str:
    """Return the folder of the campaign of an archive: that of the archives, or the one above."""
    folder = folder_of(place)
    return folder.removesuffix(_ARCHIVES) or folder


# Selection

_Attempts = dict[tuple[str, str, int], int]
"""The last attempt by folder, kind and index."""


def _select(found: dict[str, ArchiveRef | Unused]) -> Discovery:
    """Separate archives to be fitted from copies, failures and earlier attempts."""
    manifests, broken = _manifests(found)
    read, unusable, skipped = list[ArchiveRef](), list[Unused](), list[Unused]()
    for place, one in found.items():
        entries = manifests.get(folder_of(place))
        entry = None if entries is None else entries.get(name_of(place))
        if isinstance(one, Unused):
            unusable.append(one)
        elif entry is None:
            if entries is not None and one.use in USES and ArchiveName.parse(one.name):
                skipped.append(Unused(place, _UNCHECKED))
            else:
                read.append(one)
        elif entry.sha256 != one.sha256:
            reason = "differs from its entry in the campaign's manifest.json"
            unusable.append(Unused(place, reason))
        else:
            refused = entry.outcome not in ("", _COMPLETED)
            read.append(replace(one, outcome=entry.outcome) if refused else one)
    latest: _Attempts = {}
    for ref in read:
        if ref.attempt and ref.outcome == _COMPLETED:
            key = (ref.folder, ref.kind, ref.index)
            latest[key] = max(latest.get(key, 0), ref.attempt)
    for one in unusable:
        if reason := _not_needed(one.path, latest):
            skipped.append(Unused(one.path, reason))
        else:
            broken.append(one)
    seen: dict[str, str] = {}
    refs: list[ArchiveRef] = []
    for ref in read:
        if reason := _exclusion(ref, latest, seen):
            skipped.append(Unused(ref.location, reason))
        else:
            refs.append(ref)
    refs.sort(key=lambda ref: ref.order)
    return Discovery(tuple(refs), tuple(broken), tuple(skipped))


def _manifests(places: Iterable[str]) -> tuple[dict[str, dict[str, Entry]], list[Unused]]:
    """Return the manifest entries by name of each folder of archives, and damaged manifests."""
    found: dict[str, dict[str, Entry]] = {}
    broken = []
    for folder, campaign in {folder_of(place): _campaign_of(place) for place in places}.items():
        try:
            if folder != campaign and (records := CampaignFolder(Path(campaign))).sealed:
                found[folder] = {entry.name: entry for entry in records.manifest()}
        except CampaignFolderError as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            broken.append(Unused(f"{campaign}/manifest.json", reason))
    return found, broken


def _not_needed(place: str, latest: _Attempts) -> str:
    """Return why an unusable archive, such as one of a killed run, is not needed; "" if it is."""
    name = ArchiveName.parse(name_of(place))
    if folder_of(place).endswith(_FOR_VIEWERS):
        return "is a copy for viewers"
    if name is None:
        return ""
    if name.kind in _NEVER_FITTED:
        return f"is a {name.kind}"
    last = latest.get((folder_of(place), name.kind, name.index), 0)
    return f"was replaced by attempt {last}" if name.attempt < last else ""


def _exclusion(ref: ArchiveRef, latest: _Attempts, seen: dict[str, str]) -> str:
    """Return why an archive is not to be fitted; "" if it is, and then add it to `seen`."""
    if ref.use not in USES:
        return f"is a {ref.use}"
    if ref.simulated and _REHEARSAL in ref.location:
        return "belongs to a rehearsal"
    if _LOADED.search(ref.location):
        return "was recorded with a payload that its cell does not state"
    if ref.outcome != _COMPLETED:
        return f"ended {ref.outcome}"
    last = latest.get((ref.folder, ref.kind, ref.index), ref.attempt)
    if ref.attempt and ref.attempt < last:
        return f"was replaced by attempt {last}"
    if ref.sha256 in seen and ref.use != "standstill":
        return f"is a copy of {seen[ref.sha256]}"
    if ref.attempt:
        first = seen.setdefault(f"{ref.folder} {ref.record}", ref.name)
        if first != ref.name:
            return f"is a copy or a repaired version of {first}"
    seen[ref.sha256] = ref.location
    return ""
