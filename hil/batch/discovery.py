"""Search for archives below folders and URLs, and selection of those that are fitted."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

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
from .remote import archives_below, is_url, local_file
from .types import ArchiveRef, Unused
from .workers import ArchiveTask, Workers

USES: Final = ("excitation", "validation", "standstill")
"""Uses of archives in a batch; archives of other kinds are skipped."""

_SUFFIX: Final = ".mcap"
_ARCHIVES: Final = "archives"  # folder of a campaign's archives
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
        InputError: a place does not exist, an address cannot be read, or there is no archive.
        CacheError: the cache cannot be written.
    """
    places, refused = find_archives(roots)
    if not places:
        reasons = ["there is no archive (*.mcap) in it", *(" ".join(one) for one in refused[:1])]
        raise InputError(", ".join(roots), "; ".join(reasons), remedy="name others")
    known: dict[Location, ArchiveRef | Unused] = {}
    with reporter.task("reading the metadata of archives", len(places)) as task:
        for place in places if workers.local else ():  # else the cache is on the workers
            with suppress(ArchiveError):  # it has disappeared: the worker reports it
                if (ref := _known(place, cache)) is not None:
                    known[place] = ref
        task.advance(len(known))
        unknown = [place for place in places if place not in known]
        tasks = [ArchiveTask(place.location, inspect_archive, (place, cache)) for place in unknown]
        known.update(zip(unknown, workers.results(tasks, task.advance), strict=True))
    found = _select([(place, known[place]) for place in places])
    return found._replace(broken=(*refused, *found.broken))


# Locations


class Location(NamedTuple):
    """Location of an archive, and the version of its content without opening it."""

    location: str  #: path or URL
    version: str = ""  #: of a remote object, "" where its store states none

    @property
    def name(self) -> str:
        """File name."""
        return self.location.rsplit("/", 1)[-1]

    @property
    def folder(self) -> str:
        """Folder of the file."""
        return self.location.rsplit("/", 1)[0]

    @property
    def campaign(self) -> str:
        """Folder of the campaign: that of the archives, or the one above."""
        above, _, name = self.folder.rpartition("/")
        return above if name == _ARCHIVES and above else self.folder


def find_archives(roots: Sequence[str]) -> tuple[list[Location], list[Unused]]:
    """Return the archives at or below some folders, archives, or URLs of either, by location.

    Further, folders and files that cannot be read. Links are followed; a folder reached by several
    links is searched once, under its own name.

    Raises:
        InputError: a place does not exist, or an address cannot be read.
    """
    found: set[Location] = set()
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
                    found.add(Location(path.as_posix()))
                else:
                    refused.append(Unused(path.as_posix(), "is no regular file that can be read"))

    for root in roots:
        path = Path(root)
        if is_url(root):
            found.update(Location(url, version) for url, version in archives_below(root))
        elif path.is_file():
            found.add(Location(path.resolve().as_posix()))
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


def inspect_archive(place: Location, cache: CacheLocation) -> ArchiveRef:
    """Return the reference of an archive, and cache it.

    Raises:
        HilError: it cannot be read, is damaged, or was changed meanwhile.
        CacheError: the cache cannot be written.
    """
    if (known := _known(place, cache)) is not None:
        return known
    begun, stamp = time.time_ns(), _stamp(place)
    with local_file(place.location) as path:
        ref = _read_ref(place, path, cache)
        if stamp is not None and stamp_of(path) != stamp:
            raise changed_error(place.location)
    ref = replace(ref, stamp=stamp)
    untouched = stamp is None or begun - max(stamp[1:3]) > _UNTOUCHED
    if (stamp is not None or place.version) and untouched:
        cache.store(place.location).put(_key(place), {"token": _token(place, stamp), "ref": ref})
    return ref


def _known(place: Location, cache: CacheLocation) -> ArchiveRef | None:
    """Return the cached reference of an archive whose file has not changed; None if none."""
    note = cache.store(place.location).get(_key(place), dict)
    if note is None:
        return None
    stamp = _stamp(place)
    if note.get("token") != _token(place, stamp):
        return None
    ref: ArchiveRef = note["ref"]
    return replace(ref, location=place.location, campaign=place.campaign, stamp=stamp)


def _stamp(place: Location) -> tuple[int, ...] | None:
    """Return the stamp of a local file now; None of a remote one."""
    return None if is_url(place.location) else stamp_of(Path(place.location))


def _key(place: Location) -> str:
    return digest(f"archive {place.name}".encode("utf-8", "surrogateescape"))


def _token(place: Location, stamp: tuple[int, ...] | None) -> list[Any]:
    return [code_digest(), place.version, *(stamp or ())]


def _read_ref(place: Location, path: Path, cache: CacheLocation) -> ArchiveRef:
    """Hash a file, read its metadata, and cache the texts of its cell."""
    sha256 = digest_of(path)
    # Of an intact file this reads summary, metadata, attachments and one chunk.
    archive = open_archive(path, fields=(), stop=-1.0)
    require_complete(archive, place.location)
    header, plan = archive.header, archive.attachments.get("plan.json")
    index, attempt = header.index, header.attempt
    if index is None or attempt is None:  # else as stated in the archive, even if renamed
        name = ArchiveName.parse(place.name)
        index, attempt = (0, 0) if name is None else (name.index, name.attempt)
    ref = ArchiveRef(
        location=place.location,
        sha256=sha256,
        use=header.purpose,
        arm="",
        campaign=place.campaign,
        index=index,
        cell="",
        motion="" if plan is None else digest(plan),
        when=header.recorded_at or "",
        kind=archive.kind,
        attempt=attempt,
        outcome=(archive.outcome or ArchiveOutcome()).outcome,
        record=json_digest(dict(header.entries)),
        simulated=header.only_simulated,
    )
    if ref.use not in USES:
        return ref
    cell, store = cell_in(archive), cache.store(place.location)
    key = json_digest([cell.text, cell.urdf])
    if not store.has(key):
        store.put(key, [cell.text, cell.urdf])
    drives = archive.attachments.get("drive_train.json")
    return replace(
        ref,
        arm=arm_digest(cell, drives, simulated=ref.simulated),
        cell=key,
        setup=describe_setup(cell),
    )


# Selection

_Attempts = dict[tuple[str, str, int], int]
"""The last attempt by folder, kind and index."""


def _select(found: Sequence[tuple[Location, ArchiveRef | Unused]]) -> Discovery:
    """Separate archives to be fitted from copies, failures and earlier attempts."""
    manifests, broken = _manifests([place for place, _ in found])
    read, unusable, skipped = list[ArchiveRef](), list[Unused](), list[Unused]()
    for place, one in found:
        entries = manifests.get(place.folder)
        entry = None if entries is None else entries.get(place.name)
        if isinstance(one, Unused):
            unusable.append(one)
        elif entry is None:
            if entries is not None and one.use in USES and ArchiveName.parse(place.name):
                skipped.append(Unused(place.location, _UNCHECKED))
            else:
                read.append(one)
        elif entry.sha256 != one.sha256:
            reason = "differs from its entry in the campaign's manifest.json"
            unusable.append(Unused(place.location, reason))
        elif entry.outcome not in ("", _COMPLETED):
            read.append(replace(one, outcome=entry.outcome))
        else:
            read.append(one)
    latest: _Attempts = {}
    for ref in read:
        if ref.attempt and ref.outcome == _COMPLETED:
            key = (ref.folder, ref.kind, ref.index)
            latest[key] = max(latest.get(key, 0), ref.attempt)
    for one in unusable:
        if reason := _not_needed(Location(one.path), latest):
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


def _manifests(places: Iterable[Location]) -> tuple[dict[str, dict[str, Entry]], list[Unused]]:
    """Return the manifest entries by name of each folder of archives, and damaged manifests."""
    found: dict[str, dict[str, Entry]] = {}
    broken = []
    folders = {one.folder: one.campaign for one in places if not is_url(one.location)}
    for folder, campaign in folders.items():
        try:
            if folder != campaign and (records := CampaignFolder(Path(campaign))).sealed:
                found[folder] = {entry.name: entry for entry in records.manifest()}
        except CampaignFolderError as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            broken.append(Unused(f"{campaign}/manifest.json", reason))
    return found, broken


def _not_needed(place: Location, latest: _Attempts) -> str:
    """Return why an unusable archive, such as one of a killed run, is not needed; "" if it is."""
    name = ArchiveName.parse(place.name)
    if place.folder.endswith(_FOR_VIEWERS):
        return "is a copy for viewers"
    if name is None:
        return ""
    if name.kind in _NEVER_FITTED:
        return f"is a {name.kind}"
    last = latest.get((place.folder, name.kind, name.index), 0)
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
