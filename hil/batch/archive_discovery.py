"""Search for archives below folders, and selection of the fitted ones."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal, NamedTuple, Protocol

from hil.archive import Archive, ArchiveName, ArchiveOutcome, open_archive
from hil.archive.campaign_archives import Entry, RecordedCampaign
from hil.archive.check import recording_date
from hil.archive.header import KIND_NAMES, KINDS, SUFFIX
from hil.base.errors import ArchiveError, CampaignFolderError, InputError
from hil.base.files import digest, file_digest, json_digest
from hil.base.progress import Reporter
from hil.base.terminal_text import typed
from hil.cell import Cell
from identification.selection.settings import Settings

from .cache import JSON, CacheError, CacheLocation, code_digest
from .cluster import Cluster, ClusterTask, SkippedArchive, reason_of
from .places import (
    Stamp,
    as_file,
    folder_of,
    is_url,
    name_of,
    stamp_of,
    text_at,
)
from .recording_search import KindsOfLogs, find_recordings
from .setup import NO_SETUP, Setup

USES: Final = ("excitation", "validation", "standstill")
"""Uses of archives in a batch; archives of other kinds are skipped."""

_ARCHIVES: Final = "/archives"  # folder of a campaign's archives
_REHEARSAL: Final = "/rehearsal/"  # see `hil.campaign.folder`
_LOADED: Final = re.compile(r"/payload/[^/]+/loaded/")  # see `hil.weighing.payload_campaign`
_COMPLETED: Final = "completed"
_NEVER_FITTED: Final = frozenset(KINDS) - {*USES, "imported"}
_UNCHECKED: Final = (
    "is not listed in its campaign's manifest.json: its quality was not checked (the run was"
    " killed; the next run adds it)"
)
_MIN_UNCHANGED_NS: Final = 2_000_000_000
"""Age of time stamps [ns] from which on they show the next change; some have steps of 2 s."""
JOINT_TEMPERATURE: Final = "joint_temperature"
_FIELDS: Final = (
    *("cycle", "gap", "position", "torque"),
    *("target_current", "motor_current", "commanded_position", JOINT_TEMPERATURE),
)


_UNKNOWN: Final = Stamp("")


DatedBy = Literal["", "clock", "name", "file"]
"""Where the date of a recording is from: "" for its archive, or an unknown one."""


class GroupKey(NamedTuple):
    """Key of archives that are fitted together."""

    arm: str  #: digest of URDF, model, friction law and drive train
    campaign: str  #: the folder the archives were recorded into
    setup: Setup = NO_SETUP  #: stated by their cells


@dataclass(frozen=True, slots=True)
class ArchiveRef:
    """Location and properties of an archive, without its samples."""

    location: str  #: path or URL
    sha256: str  #: of all bytes
    #: "excitation" (fitted), "validation" (predicted), "standstill" (noise), or the kind of an
    #: archive that a batch does not use, for which `arm` and `cell` are ""
    use: str
    #: see :class:`GroupKey`
    arm: str
    campaign: str
    index: int  #: of the interval within its kind; 0 for imported ones
    cell: str  #: digest of the texts of cell file and URDF
    motion: str  #: digest of the planned motion, "" where unknown
    when: str = ""  #: time of recording, ISO 8601; "" in simulation
    setup: Setup = NO_SETUP
    stamp: Stamp = _UNKNOWN  #: of the file when it was hashed
    kind: str = ""  #: as in its metadata
    attempt: int = 0  #: 0 where the archive does not number them
    outcome: str = "completed"  #: how the recording ended
    record: str = ""  #: digest of the metadata
    simulated: bool = False  #: whether only a simulated arm moved
    source: str = ""  #: the log or bag that it was imported from by a batch; "" for none
    robot: str = ""  #: name or serial number; "" if all with one `arm` are one robot
    arm_type: str = ""  #: digest that robots of one type share; "" without a robot
    dated_by: DatedBy = ""
    content: str = ""  #: digest of the bytes of the log; "" of an archive
    #: what a log has in addition to its motion: means of columns, and texts, by name
    facts: Mapping[str, float | str] = field(default_factory=dict, hash=False)

    @property
    def origin(self) -> str:
        """What the user named: the log or bag, or the archive itself."""
        return self.source or self.location

    @property
    def name(self) -> str:
        """File name."""
        return name_of(self.origin)

    @property
    def folder(self) -> str:
        """Folder of the file."""
        return folder_of(self.origin)

    @property
    def type_key(self) -> str:
        """Digest that robots of one type share."""
        return self.arm_type or self.arm

    @property
    def key(self) -> GroupKey:
        """Group of the archive."""
        return GroupKey(self.arm, self.campaign, self.setup)

    @property
    def order(self) -> tuple[str, str, str, str, Setup, int, str, str]:
        """Sort key: sums are added in this order."""
        return self.type_key, self.robot, *self.key, self.index, self.name, self.sha256


@dataclass(frozen=True)
class _Note:
    """Cached properties of an archive whose file has not changed."""

    code: str  #: digest of the programs that read it
    ref: ArchiveRef


@dataclass(frozen=True)
class CellTexts:
    """Texts of a cell, cached for several archives."""

    cell: str
    urdf: str


_PLACES_PER_TASK: Final = 16
"""Archives whose metadata one task reads: a task costs 2.5 ms, as much as the metadata of one."""


class Discovery(NamedTuple):
    """Result of a search."""

    refs: tuple[ArchiveRef, ...]  #: archives to use, in the order of sums
    broken: tuple[SkippedArchive, ...]  #: files that cannot be used and folders that cannot be read
    skipped: tuple[SkippedArchive, ...]  #: archives that are not intended for fitting


class LogImport(KindsOfLogs, Protocol):
    """Finds logs and bags, and imports them."""

    def imported(self, logs: Sequence[str]) -> Mapping[str, ArchiveRef | SkippedArchive]:
        """Return the archive of each log, or why there is none."""


def discover(
    roots: Sequence[str],
    cache: CacheLocation,
    cluster: Cluster,
    reporter: Reporter,
    importing: LogImport | None = None,
    place: Callable[[ArchiveRef], ArchiveRef] = lambda ref: ref,
) -> Discovery:
    """Find every archive at or below some places, and import logs and bags if that is stated.

    Workers hash each archive and read its metadata. One whose file has not changed since the last
    search is not opened.

    Args:
        roots: folders, files, patterns or URLs.
        cache: of what was read.
        cluster: of workers.
        reporter: of progress.
        importing: of logs and bags, which count only with it.
        place: adds what is known of the robot and the date of each archive.

    Raises:
        InputError: a place does not exist, or there is no archive.
        ClusterError: the cluster cannot be used.
        CacheError: the cache cannot be written.
    """
    found = find_recordings(roots, importing)
    places = found.archives
    if not (places or found.logs):
        reasons = [
            f"there is no archive (*{SUFFIX}){'' if importing is None else ', log or bag'} in it",
            *(f"{unused.path} {unused.message}" for unused in found.refused[:1]),
        ]
        remedy = "give other files or folders" + (
            ""
            if importing is not None
            else ", or describe the arm of logs and bags: --urdf ARM.urdf"
        )
        raise InputError(", ".join(roots), "; ".join(reasons), remedy=remedy)
    imported = {} if importing is None else importing.imported(found.logs)
    refs: dict[str, ArchiveRef | SkippedArchive] = {}
    with reporter.task("reading the metadata of archives", len(places)) as task:
        for location in places:
            with suppress(ArchiveError):  # it has disappeared: the worker reports it
                if (ref := _cached_ref(location, cache)) is not None:
                    refs[location] = ref
        task.advance(len(refs))
        new = [location for location in places if location not in refs]
        refs.update(_inspected(new, cache, cluster, task.advance))
    inspected = {location: refs[location] for location in places} | {**imported}
    selected = _select({location: _placed(ref, place) for location, ref in inspected.items()})
    return selected._replace(broken=(*found.refused, *selected.broken))


def _placed(
    ref: ArchiveRef | SkippedArchive, place: Callable[[ArchiveRef], ArchiveRef]
) -> ArchiveRef | SkippedArchive:
    """Return what was inspected with robot and date, or why these are unknown."""
    if isinstance(ref, SkippedArchive):
        return ref
    try:
        return place(ref)
    except InputError as error:
        return SkippedArchive(ref.origin, reason_of(error, ref.origin))


def _inspected(
    places: Sequence[str],
    cache: CacheLocation,
    cluster: Cluster,
    advance: Callable[[float], None],
) -> dict[str, ArchiveRef | SkippedArchive]:
    """Return what workers find in archives; the archives of a failed task are tried one by one."""
    refs: dict[str, ArchiveRef | SkippedArchive] = {}
    chunks = [places[k : k + _PLACES_PER_TASK] for k in range(0, len(places), _PLACES_PER_TASK)]
    tasks = [ClusterTask(chunk[0], inspect_archives, (chunk, cache)) for chunk in chunks]
    failed: list[str] = []
    results = cluster.results(tasks, lambda n: advance(n * _PLACES_PER_TASK), archives=len(places))
    for chunk, result in zip(chunks, results, strict=True):
        if isinstance(result, SkippedArchive):
            failed += chunk
        else:
            refs.update(zip(chunk, result, strict=True))
    singles = [ClusterTask(place, inspect_archive, (place, cache)) for place in failed]
    refs.update(zip(failed, cluster.results(singles), strict=True))
    return refs


# An archive


def open_ref(ref: ArchiveRef) -> Archive:
    """Open an archive with the columns that identification reads.

    Raises:
        ArchiveError: it cannot be read, is damaged, or has changed since it was found.
    """
    with errors_of_origin(ref):
        _require_same(ref)
        try:
            with as_file(ref.location) as path:
                archive = open_archive(path, fields=_FIELDS)
                if archive.header.by_controller_program:
                    archive = open_archive(path, fields=(*_FIELDS, "target_position", "status"))
        finally:  # an error may be due to a change
            _require_same(ref)
        require_complete(archive, ref.location)
    return archive


@contextmanager
def errors_of_origin(ref: ArchiveRef) -> Iterator[None]:
    """Name the log in errors about its archive."""
    try:
        yield
    except InputError as error:
        if not ref.source or error.path != Path(ref.location):
            raise
        source = Path(ref.source)
        raise ArchiveError(source, error.problem, field=error.field, remedy=error.remedy) from error


def open_only(ref: ArchiveRef) -> None:
    """Open an archive, to find out whether that fails or ends this process."""
    open_ref(ref)


def require_complete(archive: Archive, location: str) -> None:
    """Raise an `ArchiveError` with the command of the repair if an archive is damaged."""
    if archive.damage is not None:
        remedy = f"hil archive repair {typed(location)}"
        if is_url(location):
            remedy = "repair it where it is stored: hil archive repair"
        raise ArchiveError(location, str(archive.damage), remedy=remedy)


def _require_same(ref: ArchiveRef) -> None:
    if stamp_of(ref.location) != ref.stamp:
        raise changed_error(ref.location)


def changed_error(location: str) -> ArchiveError:
    """Return the error about an archive that was written to while the batch ran."""
    return ArchiveError(location, "was changed while it was read", remedy="run the batch again")


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, or raise an `ArchiveError`."""
    try:
        return file_digest(path)
    except OSError as error:
        raise ArchiveError(path, f"cannot be read: {error.strerror}") from error


def cell_in(archive: Archive, settings: Settings | None = None) -> Cell:
    """Return the cell of an archive, with the friction law of settings if given.

    Raises:
        ArchiveError: the archive has no cell or no URDF, or they are not text.
        CellError: the cell is invalid.
    """
    friction = {} if settings is None else settings.friction
    return cell_from(archive.text("cell.toml"), archive.text("robot.urdf"), friction)


def cell_from(text: str, urdf: str, friction: Mapping[str, Any]) -> Cell:
    """Return the cell of these texts, with a friction law of these entries if there are any."""
    return _cell_from(text, urdf, json.dumps(dict(friction), sort_keys=True))


@lru_cache(maxsize=8)
def _cell_from(text: str, urdf: str, friction: str) -> Cell:
    cell = Cell.from_texts(text, urdf, Path("cell.toml"))
    entries = json.loads(friction)
    return cell.with_friction(
        **{
            key: tuple(value) if isinstance(value, list) else value
            for key, value in entries.items()
        }
    )


def arm_digest(cell: Cell, drive_train: bytes | None, *, simulated: bool = False) -> str:
    """Return the digest that identifies a robot: links, joints, friction law, drives.

    Payload and delay are not part of it (see :class:`Setup`). The drive
    train of the archive takes precedence over the cell's.
    """
    drives = cell.file.drive_train
    parts = {
        "urdf": digest(cell.urdf),
        "simulated": simulated,
        "robot": cell.file.robot.model_dump(mode="json", exclude={"payload"}),
        "drives": drives.model_dump(mode="json") if drives is not None else None,
        "in force": None if drive_train is None else digest(drive_train),
    }
    # Users store it in tables, so the text must not change.
    return digest(json.dumps(parts, sort_keys=True, separators=(",", ":")))


def inspect_archives(
    places: Sequence[str], cache: CacheLocation
) -> list[ArchiveRef | SkippedArchive]:
    """Return what `inspect_archive` finds in each archive, or why it cannot be used.

    Raises:
        CacheError: the cache cannot be written.
    """
    refs: list[ArchiveRef | SkippedArchive] = []
    for place in places:
        try:
            refs.append(inspect_archive(place, cache))
        except CacheError:
            raise
        except Exception as error:
            refs.append(SkippedArchive(place, reason_of(error, place)))
    return refs


def _date_of(path: Path, archive: Archive) -> str:
    """Return the date of a recording, ISO 8601; of an imported one by its clock, "" if unknown."""
    if archive.kind == "imported":
        archive = open_archive(path, fields=("stamp",))
    return recording_date(archive) or ""


def inspect_archive(place: str, cache: CacheLocation) -> ArchiveRef:
    """Hash an archive, read its metadata, and cache both with the texts of its cell.

    Raises:
        HilError: it cannot be read, is damaged, or was changed meanwhile.
        CacheError: the cache cannot be written.
    """
    if (cached := _cached_ref(place, cache)) is not None:
        return cached
    begun = time.time_ns()
    ref = described_archive(place, cache)
    if is_untouched(ref.stamp, begun):
        cache.put(place, _key(place), _Note(code_digest(), ref))
    return ref


def is_untouched(stamp: Stamp, begun: int) -> bool:
    """Return whether a stamp will show the next change of a file that was read at `begun` [ns]."""
    return bool(stamp.text) and begun - stamp.changed > _MIN_UNCHANGED_NS


def described_archive(place: str, cache: CacheLocation, source: str = "") -> ArchiveRef:
    """Hash an archive, read its metadata, and cache the texts of its cell.

    That of a log, its `source`, belongs to the folder of the log.

    Raises:
        HilError: it cannot be read, is damaged, or was changed meanwhile.
        CacheError: the cache cannot be written.
    """
    origin = source or place
    stamp = stamp_of(place)
    with as_file(place) as path:
        sha256 = digest_of(path)
        # Of an intact file this reads summary, metadata, attachments and one chunk.
        archive = open_archive(path, fields=(), stop=-1.0)
        when = _date_of(path, archive)
    require_complete(archive, place)
    header = archive.header
    plan = archive.attachments.get("plan.json")
    index = header.index
    attempt = header.attempt
    if index is None or attempt is None:  # else as stated in the archive, even if renamed
        name = ArchiveName.parse(name_of(origin))
        index, attempt = (0, 0) if name is None else (name.index, name.attempt)
    ref = ArchiveRef(
        location=place,
        sha256=sha256,
        use=header.purpose,
        arm="",
        campaign=campaign_of(origin),
        index=index,
        cell="",
        motion="" if plan is None else digest(plan),
        when=when,
        dated_by="clock" if when and archive.kind == "imported" else "",
        stamp=stamp,
        kind=archive.kind,
        attempt=attempt,
        outcome=(archive.outcome or ArchiveOutcome()).outcome,
        record=json_digest(dict(header.entries)),
        simulated=header.only_simulated,
        source=source,
    )
    if ref.use in USES:
        cell = cell_in(archive)
        drives = archive.attachments.get("drive_train.json")
        key = json_digest([cell.text, cell.urdf])
        if not cache.has(origin, key, JSON):
            cache.put(origin, key, CellTexts(cell.text, cell.urdf))
        arm = arm_digest(cell, drives, simulated=ref.simulated)
        ref = replace(ref, arm=arm, cell=key, setup=Setup.of(cell))
    if stamp_of(place) != stamp:
        raise changed_error(place)
    return ref


def _cached_ref(place: str, cache: CacheLocation) -> ArchiveRef | None:
    """Return the cached reference of an archive whose file has not changed; None if none."""
    note = cache.get(place, _key(place), _Note)
    if note is None or note.code != code_digest() or stamp_of(place) != note.ref.stamp:
        return None
    return replace(note.ref, location=place, campaign=campaign_of(place))


def _key(place: str) -> str:
    return digest(f"archive {name_of(place)}".encode("utf-8", "surrogateescape"))


def campaign_of(place: str) -> str:
    """Return the campaign folder of an archive: its own folder, or the folder above."""
    folder = folder_of(place)
    return folder.removesuffix(_ARCHIVES) or folder


# Selection

_Attempts = dict[tuple[str, str, int], int]
"""The last attempt by folder, kind and index."""


def _select(inspected: dict[str, ArchiveRef | SkippedArchive]) -> Discovery:
    """Separate archives to be fitted from copies, failures and earlier attempts."""
    manifests, broken = _manifests(inspected)
    read = list[ArchiveRef]()
    unusable = list[SkippedArchive]()
    skipped = list[SkippedArchive]()
    for place, archive in inspected.items():
        entries = manifests.get(folder_of(place))
        entry = None if entries is None else entries.get(name_of(place))
        if isinstance(archive, SkippedArchive):
            unusable.append(archive)
        elif entry is None:
            if entries is not None and archive.use in USES and ArchiveName.parse(archive.name):
                skipped.append(SkippedArchive(place, _UNCHECKED, noun="unchecked recording"))
            else:
                read.append(archive)
        elif entry.sha256 != archive.sha256:
            reason = "differs from its entry in the campaign's manifest.json"
            unusable.append(SkippedArchive(place, reason))
        else:
            refused = entry.outcome not in ("", _COMPLETED)
            read.append(replace(archive, outcome=entry.outcome) if refused else archive)
    latest: _Attempts = {}
    for ref in read:
        if ref.attempt and ref.outcome == _COMPLETED:
            key = (ref.folder, ref.kind, ref.index)
            latest[key] = max(latest.get(key, 0), ref.attempt)
    for archive in unusable:
        if (excluded := _not_needed(archive.path, latest)) is not None:
            skipped.append(excluded)
        else:
            broken.append(archive)
    seen: dict[str, str] = {}
    refs: list[ArchiveRef] = []
    for ref in read:
        if (excluded := _exclusion(ref, latest)) is not None:
            skipped.append(excluded)
        elif (copy := _copy(ref, seen)) is not None:
            skipped.append(copy)
        else:
            refs.append(ref)
    refs.sort(key=lambda ref: ref.order)
    return Discovery(tuple(refs), tuple(broken), tuple(skipped))


def _manifests(places: Iterable[str]) -> tuple[dict[str, dict[str, Entry]], list[SkippedArchive]]:
    """Return the manifest entries by name of each folder of archives, and damaged manifests."""
    by_folder: dict[str, dict[str, Entry]] = {}
    broken = []
    for folder, campaign in {folder_of(place): campaign_of(place) for place in places}.items():
        if folder == campaign:
            continue
        try:
            with _campaign_records(campaign) as records:
                if records.sealed:
                    by_folder[folder] = {entry.name: entry for entry in records.manifest()}
        except (CampaignFolderError, ArchiveError) as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            broken.append(SkippedArchive(f"{campaign}/manifest.json", reason))
    return by_folder, broken


@contextmanager
def _campaign_records(campaign: str) -> Iterator[RecordedCampaign]:
    """Provide the folder of a campaign; of one at a URL, a folder with its manifest only."""
    if not is_url(campaign):
        yield RecordedCampaign(Path(campaign))
        return
    with TemporaryDirectory(prefix="hil-") as copy:
        text = text_at(f"{campaign}/manifest.json")
        if text is not None:
            Path(copy, "manifest.json").write_text(text, encoding="utf-8")
        yield RecordedCampaign(Path(copy))


def _not_needed(place: str, latest: _Attempts) -> SkippedArchive | None:
    """Return an unusable archive that is not needed, such as one of a killed run; None if it is."""
    name = ArchiveName.parse(name_of(place))
    if name is None:
        return None
    if name.kind in _NEVER_FITTED:
        return _of_kind(place, name.kind)
    last = latest.get((folder_of(place), name.kind, name.index), 0)
    return _replaced(place, last) if name.attempt < last else None


def _exclusion(ref: ArchiveRef, latest: _Attempts) -> SkippedArchive | None:
    """Return an archive that is not fitted, with the reason; None if it is, unless it is a copy."""
    if ref.use not in USES:
        return _of_kind(ref.origin, ref.use)
    if ref.simulated and _REHEARSAL in ref.origin:
        return SkippedArchive(ref.origin, "belongs to a rehearsal", noun="rehearsal recording")
    if _LOADED.search(ref.origin):
        reason = "was recorded with the payload of a payload campaign"
        return SkippedArchive(ref.origin, reason, noun="loaded recording")
    if ref.outcome != _COMPLETED:
        return SkippedArchive(ref.origin, f"ended {ref.outcome}", noun=f"{ref.outcome} motion")
    last = latest.get((ref.folder, ref.kind, ref.index), ref.attempt)
    return _replaced(ref.origin, last) if ref.attempt and ref.attempt < last else None


def _of_kind(place: str, kind: str) -> SkippedArchive:
    noun = KIND_NAMES.get(kind, kind)
    return SkippedArchive(place, f"is a {noun}", noun=noun)


def _replaced(place: str, attempt: int) -> SkippedArchive:
    return SkippedArchive(place, f"was replaced by attempt {attempt}", noun="replaced attempt")


def _copy(ref: ArchiveRef, seen: dict[str, str]) -> SkippedArchive | None:
    """Return the archive in `seen` that this one copies; else add it to `seen` and return None."""
    content = ref.content or ref.sha256
    if content in seen and ref.use != "standstill":
        return SkippedArchive(ref.origin, "is a copy", seen[content], "copy")
    if ref.attempt:
        first = seen.setdefault(f"{ref.folder} {ref.record}", ref.name)
        if first != ref.name:
            return SkippedArchive(ref.origin, "is a copy or a repaired version", first, "copy")
    seen[content] = ref.origin
    return None
