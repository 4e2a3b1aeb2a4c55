"""Which archives there are: found below folders, examined where they lie, sorted.

Workers hash an archive and look into it; no sample is decoded. What an archive is goes into the
cache, and is believed as long as nobody has touched the file and the programs are the same.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from stat import S_ISREG
from sys import intern
from typing import Any, Final, NamedTuple

from hil.archive import Archive, ArchiveHeader, ArchiveName, ArchiveOutcome, open_archive
from hil.archive.header import KINDS
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder, Entry
from hil.cell import Cell
from hil.cell.schema import PayloadTable
from hil.errors import ArchiveError, InputError
from hil.identify.settings import stated_delay
from hil.io import digest, json_digest
from hil.progress import Reporter, Silent

from .cache import BESIDE, Store, Where, arm_digest, belief_digest, code_digest
from .factors import cell_in, digest_of, stamp_of
from .remote import archives_below, is_url, local_file
from .types import ArchiveRef, Broken, ChangedError, FileStamp, NothingToFitError, TornError
from .workers import ArchiveTask, Part, Workers

USES: Final = ("excitation", "validation", "standstill")
"""What archives are used for; those of other kinds are left alone."""

_SUFFIX: Final = ".mcap"
_ARCHIVES: Final = "archives"  # folder of a campaign's archives
_REHEARSAL: Final = "/rehearsal/"  # see `hil.campaign.folder`
_LOADED: Final = re.compile(r"/payload/[^/]+/loaded/")  # see `hil.weighing`
_FOR_VIEWERS: Final = "annotated"  # see `hil.annotating`
_COMPLETED: Final = "completed"
_NEVER_FITTED: Final = frozenset(KINDS) - {*USES, "imported"}
_NOT_ENTERED: Final = (
    "is not named in its campaign's manifest.json: nobody has judged it (a run was killed; the "
    "next one takes it in)"
)
_UNTOUCHED: Final = 2_000_000_000
"""ns that a file must have been left alone before its time stamps are believed to show the next
change: file systems count in steps, some of them of two seconds."""


class Discovery(NamedTuple):
    """What was found.

    Attributes:
        refs: archives to use, in canonical order.
        broken: files that cannot be used and folders that cannot be looked into, by path.
        skipped: archives that are not meant to be fitted, and why, by path.
    """

    refs: tuple[ArchiveRef, ...]
    broken: tuple[Broken, ...]
    skipped: tuple[Broken, ...]


def discover(
    roots: Sequence[str],
    where: Where,
    workers: Workers,
    reporter: Reporter = Silent(),  # noqa: B008 - without state
) -> Discovery:
    """Find every archive at or below some places.

    An archive that was examined before, and whose file nobody has touched since, is not opened.

    Args:
        roots: folders, archives, or URLs of either.
        where: what is known of archives is cached.
        workers: who does the work on archives.
        reporter: of progress.

    Raises:
        InputError: a place does not exist, or an address cannot be read.
        NothingToFitError: there is no archive below any.
        CacheError: the cache cannot be written.
    """
    places, refused, left = places_below(roots)
    if not places:
        problem = "there is no archive (*.mcap) in it"
        if refused:
            problem += f", and {refused[0].path} {refused[0].reason}"
        raise NothingToFitError(roots[0] if roots else None, problem, remedy="name others")
    known: dict[Place, ArchiveRef | Broken] = {}
    with reporter.task("looking into archives", len(places)) as task:
        if workers.near:  # else the cache is where the archives are
            for place in places:
                try:
                    if (ref := _known(place, where)) is not None:
                        known[place] = ref
                except ArchiveError as error:
                    known[place] = Broken(place.location, str(error))
            task.advance(len(known))
        unknown = [place for place in places if place not in known]
        tasks: list[ArchiveTask[None, ArchiveRef]] = [
            ArchiveTask(place.location, examined, (place, where)) for place in unknown
        ]
        notes = workers.notes(tasks, done=task.advance)
        known.update(zip(unknown, notes, strict=True))
    found_in = _sorted_out([(place, known[place]) for place in places])
    return Discovery(found_in.refs, (*refused, *found_in.broken), (*left, *found_in.skipped))


# Where archives lie


class Place(NamedTuple):
    """Where an archive lies, and what is known of its file without opening it.

    Attributes:
        location: path or URL.
        version: of a remote object's content, "" where its store does not say.
    """

    location: str
    version: str = ""

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
        """The campaign's folder: that of the archives, or the one above."""
        above, _, name = self.folder.rpartition("/")
        return above if name == _ARCHIVES and above else self.folder


def places_below(roots: Sequence[str]) -> tuple[list[Place], list[Broken], list[Broken]]:
    """Find every archive at or below some folders, archives, or URLs of either.

    Links are followed, and a folder that several lead to is looked into once, under its own name.

    Returns:
        Archives in the order of their locations; folders and files that cannot be looked into;
        links that lead nowhere.

    Raises:
        InputError: a place does not exist, or an address cannot be read.
    """
    found: set[Place] = set()
    refused: list[Broken] = []
    left: list[Broken] = []
    visited: set[Path] = set()

    def refuse(error: OSError) -> None:
        where = Path(os.fsdecode(error.filename)).as_posix()
        refused.append(Broken(where, f"cannot be looked into: {error.strerror}"))

    def is_archive(path: Path) -> bool:
        if path.suffix != _SUFFIX:
            if path.is_symlink() and not path.exists():
                left.append(Broken(path.as_posix(), "is a link that leads nowhere"))
            return False
        try:
            regular = S_ISREG(path.stat().st_mode)
        except OSError as error:  # a link to nothing, or to itself
            refuse(error)
            return False
        if not regular:
            refused.append(Broken(path.as_posix(), "is no file"))
        return regular

    def walk(root: Path) -> Iterator[Path]:
        for name, folders, files in os.walk(root, followlinks=True, onerror=refuse):
            folder = Path(name).resolve()
            if folder in visited:
                folders.clear()
                continue
            visited.add(folder)
            if BESIDE in folders:
                folders.remove(BESIDE)
            yield from (folder / file for file in files if is_archive(folder / file))

    for root in roots:
        path = Path(root)
        if is_url(root):
            found.update(Place(url, version) for url, version in archives_below(root))
        elif path.is_file():
            found.add(Place(path.resolve().as_posix()))
        elif path.is_dir():
            found.update(Place(file.as_posix()) for file in walk(path.resolve()))
        else:
            raise InputError(root, "does not exist", remedy="name a folder with archives below it")
    return sorted(found), refused, left


# What an archive is


def setup_of(cell: Cell) -> str:
    """Delay of the torque and payload of a cell in words, with every digit; "" for neither."""
    delay = stated_delay(cell)
    lag = f"torque lags by {1e3 * delay:.12g} ms" if delay else ""
    return ", ".join(filter(None, (lag, _load(cell.file.robot.payload))))


def _load(payload: PayloadTable | None) -> str:
    if payload is None or not (payload.mass or any(payload.inertia)):
        return ""
    frame = f" in {payload.frame}" if payload.frame else ""
    words = f"carries {payload.mass:.12g} kg at {_row(payload.centre)} m{frame}"
    return words + (f", {_row(payload.inertia)} kg·m²" if any(payload.inertia) else "")


def _row(figures: Iterable[float]) -> str:
    return f"({', '.join(f'{figure:.12g}' for figure in figures)})"


def examined(place: Place, where: Where) -> Part[None, ArchiveRef]:
    """Find out what an archive is, and cache it.

    Raises:
        HilError: it cannot be read, is torn, or was changed meanwhile.
        CacheError: the cache cannot be written.
    """
    known = _known(place, where)
    if known is not None:
        return Part(None, known)
    begun, stamp = time.time_ns(), _stamp(place)
    store = where.store(place.location)
    with local_file(place.location) as path:
        ref = replace(_inspected(place, path, store), stamp=stamp)
        if stamp is not None and stamp_of(path) != stamp:
            raise ChangedError(place.location)
    untouched = stamp is None or begun - max(stamp.mtime_ns, stamp.ctime_ns) > _UNTOUCHED
    if _shows_changes(place, stamp) and untouched:
        facts = asdict(ref)
        for own in ("location", "campaign", "stamp"):
            del facts[own]
        store.put(_key(place), {"token": _token(place, stamp), "facts": facts})
    return Part(None, ref)


def _known(place: Place, where: Where) -> ArchiveRef | None:
    """What is known of an archive without opening it; None if nothing.

    Raises:
        ArchiveError: there is no such file.
    """
    stamp = _stamp(place)
    if not _shows_changes(place, stamp):
        return None
    note = where.store(place.location).get(_key(place))
    if note is None or note.get("token") != _token(place, stamp):
        return None
    return ArchiveRef(
        location=place.location, campaign=place.campaign, stamp=stamp, **note["facts"]
    )


def _stamp(place: Place) -> FileStamp | None:
    return None if is_url(place.location) else stamp_of(Path(place.location))


def _shows_changes(place: Place, stamp: FileStamp | None) -> bool:
    """Whether a change of the file would show; of other remote objects only their bytes tell."""
    return stamp is not None or bool(place.version)


def _key(place: Place) -> str:
    return digest(f"archive {place.name}".encode("utf-8", "surrogateescape"))


def _token(place: Place, stamp: FileStamp | None) -> list[Any]:
    return [code_digest(), place.version, *(stamp or ())]


def _inspected(place: Place, path: Path, store: Store) -> ArchiveRef:
    """Hash a file, look into it, and cache the texts of its cell."""
    sha256 = digest_of(path)
    # Of a whole file this reads its summary and what stands outside of chunks, and one chunk.
    archive = open_archive(path, fields=(), stop=-1.0)
    if archive.damage is not None:
        raise TornError(place.location, str(archive.damage))
    header, use = archive.header, archive.header.serves_as
    index, attempt = _interval(header, place.name)
    plan = archive.attachments.get("plan.json")
    ref = ArchiveRef(
        location=place.location,
        sha256=sha256,
        use=use,
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
    return _with_cell(ref, archive, store) if use in USES else ref


def _with_cell(ref: ArchiveRef, archive: Archive, store: Store) -> ArchiveRef:
    """The reference with what the archive's cell says; its texts go into the cache."""
    cell = cell_in(archive)
    key = json_digest([cell.text, cell.urdf])
    if not store.has(key):
        store.put(key, [cell.text, cell.urdf])
    drives = archive.attachments.get("drive_train.json")
    return replace(
        ref,
        arm=arm_digest(cell, drives, simulated=ref.simulated),
        cell=key,
        setup=setup_of(cell),
        belief=belief_digest(cell),
    )


def _interval(header: ArchiveHeader, name: str) -> tuple[int, int]:
    """Index and attempt: as the archive says, whatever its file is called now; else by its name."""
    if header.index is not None and header.attempt is not None:
        return header.index, header.attempt
    parsed = ArchiveName.parse(name)
    return (0, 0) if parsed is None else (parsed.index, parsed.attempt)


# Which archives are meant to be fitted


class _Manifests:
    """The manifests of the campaigns that archives lie in, each read once.

    Attributes:
        broken: manifests that cannot be read; nothing can be checked against them.
    """

    def __init__(self) -> None:
        self.broken: list[Broken] = []
        self._known: dict[str, dict[str, Entry] | None] = {}

    def entries(self, place: Place) -> dict[str, Entry] | None:
        """Those of its campaign by name; None where there is no manifest to be read."""
        if is_url(place.location) or place.campaign == place.folder:
            return None
        if place.campaign not in self._known:
            self._known[place.campaign] = self._read(CampaignFolder(Path(place.campaign)))
        return self._known[place.campaign]

    def _read(self, folder: CampaignFolder) -> dict[str, Entry] | None:
        try:
            return {entry.name: entry for entry in folder.manifest()} if folder.sealed else None
        except CampaignFolderError as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            self.broken.append(Broken((folder.root / "manifest.json").as_posix(), reason))
            return None


def _sorted_out(found: Sequence[tuple[Place, ArchiveRef | Broken]]) -> Discovery:
    manifests = _Manifests()
    read: list[ArchiveRef] = []
    harmed: list[tuple[Place, Broken]] = []
    skipped: list[Broken] = []
    for place, one in found:
        entries = manifests.entries(place)
        entry = None if entries is None else entries.get(place.name)
        if isinstance(one, Broken):
            harmed.append((place, one))
        elif entry is not None and entry.sha256 != one.sha256:
            reason = "is not what its campaign's manifest.json says"
            harmed.append((place, Broken(place.location, reason)))
        elif entry is not None and entry.outcome not in ("", _COMPLETED):
            read.append(replace(one, outcome=entry.outcome))
        elif entry is None and entries is not None and _is_motion(place) and one.use in USES:
            # A run that was killed may have closed it and not lived to judge it.
            skipped.append(Broken(place.location, _NOT_ENTERED))
        else:
            read.append(one)
    sieve = _Sieve(read)
    broken: list[Broken] = []
    for place, harm in harmed:
        reason = sieve.replacement(place)
        skipped += [Broken(harm.path, reason)] if reason else []
        broken += [] if reason else [harm]
    refs: list[ArchiveRef] = []
    for ref in read:
        reason = sieve.objection(ref)
        skipped += [Broken(ref.location, reason)] if reason else []
        refs += [] if reason else [_small(ref)]
    refs.sort(key=lambda ref: ref.order)
    return Discovery(tuple(refs), (*manifests.broken, *broken), tuple(skipped))


def _is_motion(place: Place) -> bool:
    return ArchiveName.parse(place.name) is not None


class _Sieve:
    """Tells archives that are meant to be fitted from copies, failures and earlier attempts."""

    def __init__(self, read: Iterable[ArchiveRef]) -> None:
        self._latest: dict[tuple[str, str, int], int] = {}
        self._seen: dict[str, str] = {}
        for ref in read:
            if ref.attempt and ref.outcome == _COMPLETED:
                key = (Place(ref.location).folder, ref.kind, ref.index)
                self._latest[key] = max(self._latest.get(key, 0), ref.attempt)

    def replacement(self, place: Place) -> str:
        """Why nothing is missing with an archive that cannot be used; "" if something is.

        A run that was killed, or whose disk was full, leaves torn ones, and the next run makes the
        motion again.
        """
        name = ArchiveName.parse(place.name)
        if place.folder.endswith(f"/{_FOR_VIEWERS}"):
            return "is a copy for viewers"
        if name is None:
            return ""
        if name.kind in _NEVER_FITTED:
            return f"is a {name.kind}"
        last = self._latest.get((place.folder, name.kind, name.index), 0)
        return f"attempt {last} took the place of this unusable one" if name.attempt < last else ""

    def objection(self, ref: ArchiveRef) -> str:
        """Why an archive is not meant to be fitted; "" if it is."""
        if ref.use not in USES:
            return f"is a {ref.use}"
        if ref.simulated and _REHEARSAL in ref.location:
            return "belongs to a rehearsal"
        if _LOADED.search(ref.location):
            return "carries a payload that its cell does not state"
        if ref.outcome != _COMPLETED:
            return f"ended {ref.outcome}"
        folder = Place(ref.location).folder
        last = self._latest.get((folder, ref.kind, ref.index), ref.attempt)
        if ref.attempt and ref.attempt < last:
            return f"attempt {last} took its place"
        if ref.sha256 in self._seen and ref.use != "standstill":
            return f"holds the same as {self._seen[ref.sha256]}"
        if ref.attempt:
            first = self._seen.setdefault(f"{folder} {ref.record}", ref.name)
            if first != ref.name:
                return f"is a copy of {first}, or was repaired from it"
        self._seen[ref.sha256] = ref.location
        return ""


_SHARED: Final = ("use", "arm", "campaign", "cell", "motion", "when", "setup", "belief", "kind")


def _small(ref: ArchiveRef) -> ArchiveRef:
    """Texts that many archives share are held once: there may be very many archives."""
    shared: dict[str, Any] = {name: intern(getattr(ref, name)) for name in _SHARED}
    return replace(ref, record="", **shared)
