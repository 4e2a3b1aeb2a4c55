"""Search for archives below folders and URLs, and selection of those that are fitted."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from stat import S_ISREG
from typing import Any, Final, NamedTuple

from hil.archive import ArchiveName, ArchiveOutcome, open_archive
from hil.archive.header import KINDS
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder, Entry
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.files import digest, json_digest
from hil.identify.settings import stated_delay
from hil.progress import Reporter, Silent

from .cache import BESIDE, CacheLocation, arm_digest, code_digest
from .factors import cell_in, digest_of, require_complete, stamp_of
from .remote import archives_below, is_url, local_file
from .types import ArchiveRef, ChangedError, Stamp, Unused
from .workers import ArchiveTask, Workers

USES: Final = ("excitation", "validation", "standstill")
"""Uses of archives in a batch; archives of other kinds are skipped."""

_SUFFIX: Final = ".mcap"
_ARCHIVES: Final = "archives"  # folder of a campaign's archives
_REHEARSAL: Final = "/rehearsal/"  # see `hil.campaign.folder`
_LOADED: Final = re.compile(r"/payload/[^/]+/loaded/")  # see `hil.weighing`
_FOR_VIEWERS: Final = "/annotated"  # see `hil.annotating`
_COMPLETED: Final = "completed"
_NEVER_FITTED: Final = frozenset(KINDS) - {*USES, "imported"}
_UNTOUCHED: Final = 2_000_000_000
"""Age of time stamps [ns] from which on they show the next change; some have steps of 2 s."""


class Discovery(NamedTuple):
    """Result of a search."""

    refs: tuple[ArchiveRef, ...]  #: archives to use, in the order of sums
    #: files that cannot be used and folders that cannot be read, by path
    broken: tuple[Unused, ...]
    skipped: tuple[Unused, ...]  #: archives that are not intended for fitting, by path


def discover(
    roots: Sequence[str],
    cache: CacheLocation,
    workers: Workers,
    reporter: Reporter = Silent(),  # noqa: B008 - without state
) -> Discovery:
    """Find every archive at or below some places.

    Workers hash each archive and read its metadata. One whose file has not changed since the last
    search is not opened.

    Raises:
        InputError: a place does not exist, an address cannot be read, or there is no archive.
        CacheError: the cache cannot be written.
    """
    places, refused, left = find_archives(roots)
    if not places:
        problem = "there is no archive (*.mcap) in it"
        if refused:
            problem += f", and {refused[0].path} {refused[0].reason}"
        raise InputError(roots[0] if roots else None, problem, remedy="name others")
    known: dict[Location, ArchiveRef | Unused] = {}
    with reporter.task("reading the metadata of archives", len(places)) as task:
        if workers.local:  # else the cache is on the workers
            for place in places:
                try:
                    if (ref := _known(place, cache)) is not None:
                        known[place] = ref
                except ArchiveError as error:
                    known[place] = Unused(place.location, str(error))
            task.advance(len(known))
        unknown = [place for place in places if place not in known]
        tasks = [ArchiveTask(place.location, inspect_archive, (place, cache)) for place in unknown]
        known.update(zip(unknown, workers.results(tasks, task.advance), strict=True))
    found = _select([(place, known[place]) for place in places])
    return Discovery(found.refs, (*refused, *found.broken), (*left, *found.skipped))


# Locations


class Location(NamedTuple):
    """Location of an archive, and the version of its file without opening it."""

    location: str  #: path or URL
    version: str = ""  #: of a remote object's content, "" where its store states none

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

    @property
    def stamp(self) -> Stamp | None:
        """Stamp of the file now; None of a remote one."""
        return None if is_url(self.location) else stamp_of(Path(self.location))


def find_archives(roots: Sequence[str]) -> tuple[list[Location], list[Unused], list[Unused]]:
    """Return the archives at or below some folders, archives, or URLs of either, by location.

    Further, folders and files that cannot be read, and broken links. Links are followed; a folder
    reached by several links is searched once, under its own name.

    Raises:
        InputError: a place does not exist, or an address cannot be read.
    """
    found: set[Location] = set()
    refused: list[Unused] = []
    left: list[Unused] = []
    visited: set[Path] = set()

    def refuse(error: OSError) -> None:
        cache = Path(os.fsdecode(error.filename)).as_posix()
        refused.append(Unused(cache, f"cannot be read: {error.strerror}"))

    def add_file(path: Path) -> None:
        try:
            regular = S_ISREG(path.stat().st_mode)
        except OSError as error:
            if path.suffix == _SUFFIX:
                refuse(error)
            elif path.is_symlink():
                left.append(Unused(path.as_posix(), "is a broken link"))
            return
        if path.suffix == _SUFFIX and regular:
            found.add(Location(path.as_posix()))
        elif path.suffix == _SUFFIX:
            refused.append(Unused(path.as_posix(), "is not a regular file"))

    def walk(root: Path) -> None:
        for name, folders, files in os.walk(root, followlinks=True, onerror=refuse):
            folder = Path(name).resolve()
            if folder in visited:
                folders.clear()
                continue
            visited.add(folder)
            folders[:] = [one for one in folders if one != BESIDE]
            for file in files:
                add_file(folder / file)

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
    return sorted(found), refused, left


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
    begun, stamp = time.time_ns(), place.stamp
    with local_file(place.location) as path:
        ref = _read_ref(place, path, cache)
        if stamp is not None and stamp_of(path) != stamp:
            raise ChangedError(place.location)
    ref = replace(ref, stamp=stamp)
    untouched = stamp is None or begun - max(stamp[1:3]) > _UNTOUCHED
    if (stamp is not None or place.version) and untouched:
        cache.store(place.location).put(_key(place), {"token": _token(place, stamp), "ref": ref})
    return ref


def _known(place: Location, cache: CacheLocation) -> ArchiveRef | None:
    """Return the cached reference of an archive whose file has not changed; None if none."""
    stamp = place.stamp
    if stamp is None and not place.version:  # only its bytes would show a change
        return None
    note = cache.store(place.location).get(_key(place), dict)
    if note is None or note.get("token") != _token(place, stamp):
        return None
    ref: ArchiveRef = note["ref"]
    return replace(ref, location=place.location, campaign=place.campaign, stamp=stamp)


def _key(place: Location) -> str:
    return digest(f"archive {place.name}".encode("utf-8", "surrogateescape"))


def _token(place: Location, stamp: Stamp | None) -> list[Any]:
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
    read: list[ArchiveRef] = []
    unusable: list[tuple[Location, str]] = []
    skipped: list[Unused] = []
    for place, one in found:
        entries = None if place.campaign == place.folder else manifests.get(place.campaign)
        entry = None if entries is None else entries.get(place.name)
        if isinstance(one, Unused):
            unusable.append((place, one.reason))
        elif entry is not None and entry.sha256 != one.sha256:
            unusable.append((place, "differs from its entry in the campaign's manifest.json"))
        elif entry is not None and entry.outcome not in ("", _COMPLETED):
            read.append(replace(one, outcome=entry.outcome))
        elif (
            entry is None
            and entries is not None
            and one.use in USES
            and ArchiveName.parse(place.name)
        ):
            reason = (
                "is not listed in its campaign's manifest.json: its quality was not checked (the "
                "run was killed; the next run adds it)"
            )
            skipped.append(Unused(place.location, reason))
        else:
            read.append(one)
    latest: _Attempts = {}
    for ref in read:
        if ref.attempt and ref.outcome == _COMPLETED:
            key = (Location(ref.location).folder, ref.kind, ref.index)
            latest[key] = max(latest.get(key, 0), ref.attempt)
    for place, reason in unusable:
        replaced = _replaced(place, latest)
        (skipped if replaced else broken).append(Unused(place.location, replaced or reason))
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
    """Return the manifest entries by name of each campaign, and unreadable manifests."""
    found: dict[str, dict[str, Entry]] = {}
    broken = []
    for campaign in dict.fromkeys(one.campaign for one in places if one.campaign != one.folder):
        folder = CampaignFolder(Path(campaign))
        try:
            if not is_url(campaign) and folder.sealed:
                found[campaign] = {entry.name: entry for entry in folder.manifest()}
        except CampaignFolderError as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            broken.append(Unused(f"{campaign}/manifest.json", reason))
    return found, broken


def _replaced(place: Location, latest: _Attempts) -> str:
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
    folder = Location(ref.location).folder
    last = latest.get((folder, ref.kind, ref.index), ref.attempt)
    if ref.attempt and ref.attempt < last:
        return f"was replaced by attempt {last}"
    if ref.sha256 in seen and ref.use != "standstill":
        return f"is a copy of {seen[ref.sha256]}"
    if ref.attempt:
        first = seen.setdefault(f"{folder} {ref.record}", ref.name)
        if first != ref.name:
            return f"is a copy or a repaired version of {first}"
    seen[ref.sha256] = ref.location
    return ""
