"""What an archive is: hashed and looked into where it lies, no sample decoded.

Only small facts leave here. They are noted beside the archive, and the note is believed as long as
nobody has touched the file and the programs are the same.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple, get_type_hints

from hil.archive import Archive, ArchiveHeader, ArchiveName, ArchiveOutcome, open_archive
from hil.cell import Cell
from hil.cell.schema import PayloadTable
from hil.identify.settings import stated_delay

from .cache import Store, Where
from .errors import ChangedError, TornError
from .factors import cell_in, digest_of, local_file, stamp_of
from .keys import arm_digest, belief_digest, code_digest, text_digest
from .on_workers import Part
from .places import Place
from .types import FileStamp


def setup_of(cell: Cell) -> str:
    """Delay of the torque and payload of a cell in words, with every digit; "" for neither."""
    return ", ".join(filter(None, (_lag(stated_delay(cell)), _load(cell.file.robot.payload))))


def _lag(delay: float) -> str:
    return f"torque lags by {1e3 * delay:.12g} ms" if delay else ""


def _load(payload: PayloadTable | None) -> str:
    if payload is None or not (payload.mass or any(payload.inertia)):
        return ""
    frame = f" in {payload.frame}" if payload.frame else ""
    words = f"carries {payload.mass:.12g} kg at {_row(payload.centre)} m{frame}"
    return words + (f", {_row(payload.inertia)} kg·m²" if any(payload.inertia) else "")


def _row(figures: Iterable[float]) -> str:
    return f"({', '.join(f'{figure:.12g}' for figure in figures)})"


USES: Final = ("excitation", "validation", "standstill")
"""What archives are used for; those of other kinds are left alone."""

_SETTLED: Final = 2_000_000_000
"""ns that a file must have been left alone before its time stamps are believed to tell of the next
change: file systems count in steps, some of them of two seconds."""


class Facts(NamedTuple):
    """What the inside of an archive tells, wherever it lies.

    Attributes:
        sha256: of all bytes.
        kind: as its metadata say.
        use: see :class:`hil.batch.types.ArchiveRef`.
        number: of the interval within its kind.
        attempt: at that interval; 0 where the archive does not count them.
        outcome: how the recording ended.
        record: digest of the metadata.
        simulated: whether no arm moved.
        arm: likewise, "" for an archive of another use.
        cell: likewise.
        setup: likewise.
        belief: likewise.
        motion: likewise.
        when: likewise.
    """

    sha256: str
    kind: str
    use: str
    number: int
    attempt: int
    outcome: str
    record: str
    simulated: bool
    arm: str
    cell: str
    setup: str
    belief: str
    motion: str
    when: str


_KINDS = get_type_hints(Facts)


class Examined(NamedTuple):
    """What an archive is, and of which state of its file that was told."""

    facts: Facts
    stamp: FileStamp | None


def noted(place: Place, where: Where) -> Examined | None:
    """What is known of an archive without opening it; None if nothing.

    Raises:
        ArchiveError: there is no such file.
    """
    stamp = _stamp(place)
    if not _tells(place, stamp):
        return None
    note = where.store(place.location).note(place.name)
    if not isinstance(note, dict) or note.get("token") != _token(place, stamp):
        return None
    facts = note.get("facts")
    if not isinstance(facts, dict) or facts.keys() != set(Facts._fields):
        return None
    if any(type(facts[name]) is not kind for name, kind in _KINDS.items()):
        return None
    return Examined(Facts(**facts), stamp)


def examined(place: Place, where: Where) -> Part[None, Examined]:
    """Find out what an archive is, and note it.

    Raises:
        HilError: it cannot be read, is torn, or was changed meanwhile.
        CacheError: the note cannot be written.
    """
    known = noted(place, where)
    if known is not None:
        return Part(None, known)
    begun, stamp = time.time_ns(), _stamp(place)
    store = where.store(place.location)
    with local_file(place.location) as path:
        facts = _inspected(place, path, store)
        if stamp is not None and stamp_of(path) != stamp:
            raise ChangedError(place.location)
    settled = stamp is None or begun - max(stamp.mtime_ns, stamp.ctime_ns) > _SETTLED
    if _tells(place, stamp) and settled:
        note = {"token": _token(place, stamp), "facts": facts._asdict()}
        store.put_note(place.name, note)
    return Part(None, Examined(facts, stamp))


def _stamp(place: Place) -> FileStamp | None:
    return None if place.remote else stamp_of(Path(place.location))


def _tells(place: Place, stamp: FileStamp | None) -> bool:
    """Whether a change of the file would show; of other remote objects only their bytes tell."""
    return stamp is not None or bool(place.version)


def _token(place: Place, stamp: FileStamp | None) -> list[Any]:
    return [code_digest(), place.version, *(stamp or ())]


def _inspected(place: Place, path: Path, store: Store) -> Facts:
    """Hash a file, look into it, and keep the texts of its cell."""
    sha256 = digest_of(path)
    # Of a whole file this reads its summary and what stands outside of chunks, and one chunk.
    archive = open_archive(path, fields=(), stop=-1.0)
    if archive.damage is not None:
        raise TornError(place.location, str(archive.damage))
    number, attempt = _interval(archive.header, place.name)
    kind = archive.kind
    use = archive.header.serves_as
    plan = archive.attachments.get("plan.json")
    return Facts(
        sha256=sha256,
        kind=kind,
        use=use,
        number=number,
        attempt=attempt,
        outcome=(archive.outcome or ArchiveOutcome()).outcome,
        record=text_digest(json.dumps(dict(archive.header.entries), sort_keys=True)),
        simulated=_simulated(archive),
        **(_of_cell(archive, store) if use in USES else _NO_CELL),
        motion="" if plan is None else text_digest(plan),
        when=archive.header.recorded_at or "",
    )


_NO_CELL: Final = dict.fromkeys(("arm", "cell", "setup", "belief"), "")


def _of_cell(archive: Archive, store: Store) -> dict[str, str]:
    """What the archive's cell tells; its texts are kept."""
    cell = cell_in(archive)
    key = text_digest(cell.text, cell.urdf)
    if not store.has(key):
        store.put(key, {"cell.toml": cell.text, "robot.urdf": cell.urdf})
    return {
        "arm": arm_digest(
            cell, archive.attachments.get("drive_train.json"), simulated=_simulated(archive)
        ),
        "cell": key,
        "setup": setup_of(cell),
        "belief": belief_digest(cell),
    }


def _simulated(archive: Archive) -> bool:
    return archive.header.only_simulated


def _interval(header: ArchiveHeader, name: str) -> tuple[int, int]:
    """Index and attempt: as the archive says, whatever its file is called now; else by its name."""
    if header.index is not None and header.attempt is not None:
        return header.index, header.attempt
    parsed = ArchiveName.parse(name)
    return (0, 0) if parsed is None else (parsed.index, parsed.attempt)
