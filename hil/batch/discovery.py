"""Which archives there are: found below folders, told apart, hashed, no sample decoded."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from hashlib import file_digest
from pathlib import Path
from typing import Any, Final, NamedTuple

from hil.archive import ArchiveName, open_archive
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder
from hil.errors import ArchiveError, HilError, InputError
from hil.progress import Reporter, Silent

from .cache import BESIDE, Store, Where
from .errors import CacheError, ChangedError, NothingToFitError, TornError
from .factors import cell_in, local_file, stamp_of
from .keys import arm_digest, text_digest
from .types import ArchiveRef, Broken, FileStamp

USES: Final = ("excitation", "validation", "standstill")
"""What archives are used for; those of other kinds are left alone."""

_ARCHIVES: Final = "archives"  # folder of a campaign's archives
_SETTLED: Final = 2_000_000_000
"""ns that a file must have been left alone before its time stamps are believed to tell of the next
change: file systems count in steps, some of them of two seconds."""
_NOTES: Final = 2
"""Version of the notes on archives."""


class Discovery(NamedTuple):
    """What was found.

    Attributes:
        refs: archives to use, in canonical order.
        broken: files that cannot be used, by path.
        skipped: archives that are not meant to be fitted, and why, by path.
    """

    refs: tuple[ArchiveRef, ...]
    broken: tuple[Broken, ...]
    skipped: tuple[Broken, ...]


class _Found(NamedTuple):
    """What the inside of an archive tells, wherever it lies."""

    sha256: str
    kind: str
    use: str
    number: int
    attempt: int
    outcome: str
    record: str
    arm: str
    cell: str
    motion: str
    when: str


def discover(
    roots: Sequence[str],
    where: Where,
    *,
    threads: int = 1,
    reporter: Reporter = Silent(),  # noqa: B008 - without state
) -> Discovery:
    """Find every archive at or below some places.

    An archive that was hashed before, and whose file nobody has touched since, is not opened.

    Args:
        roots: folders, archives, or URLs of either.
        where: notes on archives are kept.
        threads: that hash.
        reporter: of progress.

    Raises:
        InputError: a place does not exist.
        NothingToFitError: there is no archive below any.
    """
    places = sorted({place for root in roots for place in _below(root)})
    if not places:
        raise NothingToFitError(
            roots[0] if roots else None, "there is no archive (*.mcap) in it", remedy="name others"
        )

    def examined(place: _Place) -> _Examined | Broken:
        try:
            return _examined(place, where)
        except CacheError:
            raise
        except HilError as error:
            return Broken(place.location, str(error))
        except Exception as error:  # whatever a stranger's file does costs that file alone
            return Broken(place.location, f"cannot be read ({type(error).__name__}: {error})")

    found = []
    with (
        reporter.task("looking for archives", len(places)) as task,
        ThreadPoolExecutor(threads) as pool,
    ):
        for place, one in zip(places, pool.map(examined, places), strict=True):
            found.append(one)
            task.advance(1, place.name)
    return _sorted_out(places, found)


class _Examined(NamedTuple):
    """What an archive is, and of which state of its file that was told."""

    found: _Found
    stamp: FileStamp | None


class _Place(NamedTuple):
    """Where an archive lies, and what is known of its file without opening it."""

    location: str
    version: str = ""  # of a remote object's content, "" where its store does not say

    @property
    def remote(self) -> bool:
        return "://" in self.location

    @property
    def name(self) -> str:
        return self.location.rsplit("/", 1)[-1]

    @property
    def folder(self) -> str:
        return self.location.rsplit("/", 1)[0]

    @property
    def campaign(self) -> str:
        """The campaign's folder: that of the archives, or the one above."""
        folder = self.folder
        above, _, name = folder.rpartition("/")
        return above if name == _ARCHIVES and above else folder


def _below(root: str) -> Iterator[_Place]:
    if "://" in root:
        from .remote_files import listed  # needs an extra

        yield from (_Place(file.url, file.version) for file in listed(root))
        return
    path = Path(root).resolve()
    if path.is_file():
        yield _Place(path.as_posix())
    elif path.is_dir():
        for found in path.rglob("*.mcap"):
            if BESIDE not in found.parts and found.is_file():
                yield _Place(found.as_posix())
    else:
        raise InputError(root, "does not exist", remedy="name a folder with archives below it")


def _examined(place: _Place, where: Where) -> _Examined:
    """What an archive is; from the note on it, if that is still about the same file."""
    store = where.store(place.location)
    begun = time.time_ns()
    stamp = None if place.remote else stamp_of(Path(place.location))
    token: list[Any] = [_NOTES, place.version, *(stamp or ())]
    told = stamp is not None or place.version  # else only its bytes tell of a remote object
    note = store.note(place.name) if told else None
    if isinstance(note, dict) and _is_note(note, token):
        return _Examined(_Found(**note["found"]), stamp)
    with local_file(place.location) as path:
        found = _inspected(place, path, store)
        if stamp is not None and stamp_of(path) != stamp:
            raise ChangedError(place.location)
    if told and (stamp is None or begun - max(stamp.mtime_ns, stamp.ctime_ns) > _SETTLED):
        store.put_note(place.name, {"token": token, "found": found._asdict()})
    return _Examined(found, stamp)


def _is_note(note: dict[str, Any], token: list[Any]) -> bool:
    if note.get("token") != token:
        return False
    found = note.get("found")
    return isinstance(found, dict) and found.keys() == set(_Found._fields)


def _inspected(place: _Place, path: Path, store: Store) -> _Found:
    """Hash a file, look into it, and keep the texts of its cell."""
    try:
        with path.open("rb") as stream:
            sha256 = file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ArchiveError(place.location, f"cannot be read: {error.strerror}") from error
    # Of a whole file this reads its summary and what stands outside of chunks, and one chunk.
    archive = open_archive(path, fields=(), stop=-1.0)
    if archive.damage is not None:
        raise TornError(place.location, str(archive.damage))
    kind = archive.kind
    index, attempt = _interval(archive.metadata, place.name)
    use = archive.metadata.get("use", "excitation") if kind == "imported" else kind
    arm = cell = ""
    if use in USES:
        own = cell_in(archive)
        arm = arm_digest(own, archive.attachments.get("drive_train.json"))
        cell = text_digest(own.text, own.urdf)
        if not store.has(cell):
            store.put(cell, {"cell.toml": own.text, "robot.urdf": own.urdf})
    plan = archive.attachments.get("plan.json")
    return _Found(
        sha256=sha256,
        kind=kind,
        use=use,
        number=index,
        attempt=attempt,
        outcome=(archive.outcome or {}).get("outcome", "completed"),
        record=text_digest(json.dumps(dict(archive.metadata), sort_keys=True)),
        arm=arm,
        cell=cell,
        motion="" if plan is None else text_digest(plan),
        when=archive.metadata.get("recorded_at", ""),
    )


def _interval(metadata: Mapping[str, str], name: str) -> tuple[int, int]:
    """Index and attempt: as the archive says, whatever its file is called now; else by its name."""
    said = metadata.get("index", ""), metadata.get("attempt", "")
    if all(text.isdecimal() for text in said):
        return int(said[0]), int(said[1])
    parsed = ArchiveName.parse(name)
    return (0, 0) if parsed is None else (parsed.index, parsed.attempt)


def _sorted_out(places: Sequence[_Place], found: Sequence[_Examined | Broken]) -> Discovery:
    refs: list[ArchiveRef] = []
    broken: list[Broken] = []
    skipped: list[Broken] = []
    manifests = _Manifests()
    latest: dict[tuple[str, str, int], int] = {}
    read: list[tuple[_Place, _Examined]] = []
    for place, one in zip(places, found, strict=True):
        reason = (
            one.reason if isinstance(one, Broken) else manifests.objection(place, one.found.sha256)
        )
        if reason or isinstance(one, Broken):
            broken.append(Broken(place.location, reason))
        else:
            read.append((place, one))
    for place, one in read:
        if one.found.attempt and one.found.outcome == "completed":
            key = (place.folder, one.found.kind, one.found.number)
            latest[key] = max(latest.get(key, 0), one.found.attempt)
    seen: dict[str, str] = {}
    for place, one in read:
        reason = _beside_the_point(place, one.found, latest, seen)
        if reason:
            skipped.append(Broken(place.location, reason))
            continue
        seen[one.found.sha256] = place.location
        refs.append(_ref(place, one))
    return Discovery(tuple(sorted(refs, key=lambda r: r.order)), tuple(broken), tuple(skipped))


def _beside_the_point(
    place: _Place,
    found: _Found,
    latest: dict[tuple[str, str, int], int],
    seen: dict[str, str],
) -> str:
    """Why an archive is not meant to be fitted; "" if it is."""
    if found.use not in USES:
        return f"is a {found.use}"
    if found.outcome != "completed":
        return f"ended {found.outcome}"
    last = latest.get((place.folder, found.kind, found.number), found.attempt)
    if found.attempt and found.attempt < last:
        return f"attempt {last} took its place"
    if found.sha256 in seen and found.use != "standstill":
        return f"holds the same as {seen[found.sha256]}"
    if found.attempt:
        first = seen.setdefault(f"{place.folder} {found.record}", place.name)
        if first != place.name:
            return f"is a copy of {first}, or was repaired from it"
    return ""


def _ref(place: _Place, examined: _Examined) -> ArchiveRef:
    found = examined.found
    return ArchiveRef(
        location=place.location,
        sha256=found.sha256,
        use=found.use,
        arm=found.arm,
        campaign=place.campaign,
        index=found.number,
        cell=found.cell,
        motion=found.motion,
        when=found.when,
        stamp=examined.stamp,
    )


class _Manifests:
    """What campaign folders say about their archives."""

    def __init__(self) -> None:
        self._known: dict[str, dict[str, str]] = {}

    def objection(self, place: _Place, sha256: str) -> str:
        """Why the campaign's manifest is against this archive; "" if it is not."""
        if place.remote or place.campaign == place.folder:
            return ""
        recorded = self._of(place.campaign).get(place.name, sha256)
        return "" if recorded == sha256 else "is not what its campaign's manifest.json says"

    def _of(self, campaign: str) -> dict[str, str]:
        if campaign not in self._known:
            try:
                entries = CampaignFolder(Path(campaign)).manifest()
            except CampaignFolderError:
                entries = []
            self._known[campaign] = {entry.name: entry.sha256 for entry in entries}
        return self._known[campaign]
