"""Says whether a file keeps the archive profile, aspect by aspect.

`docs/archive-format.md` is the profile in words; each rule here is one of its sentences. The check
is of the file alone: whether the motion in it is any good is not asked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from hil.archive import description, schema
from hil.archive.amend import REJECTED
from hil.archive.check_messages import message_faults
from hil.archive.description import DescriptionError
from hil.archive.names import KINDS, ArchiveName
from hil.archive.order import checksums
from hil.archive.standing import Survey
from hil.archive.survey import survey
from hil.errors import NotAnArchiveError

ASPECTS = {
    "container": "MCAP records in order, header of profile ros2 by hil",
    "metadata": "record hil: version, kind, joints, period; its checksum",
    "attachments": "those that the metadata name; their checksums",
    "schemas": "texts of the messages",
    "channels": "topics, types and encodings",
    "chunks": "zstd, one per 100 ms; their checksums",
    "sizes": "messages of a channel have one layout",
    "sequence": "messages are counted from 0 without a hole",
    "times": "log time, publish time and stamp agree; cycles grow",
    "joint_states": "repeat the columns of the cycles",
    "outcome": "record hil.outcome: word and counts; its checksum",
    "index": "message indexes, statistics and summary fit the data",
}
"""What is checked, and of what it consists."""

OUTCOMES = ("completed", REJECTED, "stopped", "refused", "lost", "void", "interrupted", "unknown")
_MOST = 5  # faults of one aspect that are listed


@dataclass(frozen=True)
class Check:
    """Whether a file keeps the profile.

    Attributes:
        path: the file.
        version: of the profile, as the file says.
        faults: what is wrong, by aspect; an aspect without entry is kept.
        samples: samples that can be read.
        repaired: whether the file says that it was repaired.
    """

    path: Path
    version: str
    faults: Mapping[str, tuple[str, ...]]
    samples: int
    repaired: bool

    @property
    def keeps(self) -> bool:
        """Whether the profile is kept in all aspects."""
        return not self.faults


def check_archive(path: str | PathLike[str]) -> Check:
    """Check a file.

    Raises:
        NotAnArchiveError: it is of another kind.
        ArchiveError: it cannot be read.
    """
    path = Path(path)
    found = survey(path)
    faults: dict[str, list[str]] = {}
    for fault in found.faults:
        faults.setdefault(fault.aspect, []).append(fault.text)
    if found.metadata is None:
        if not any(repr(schema.METADATA) in text for text in faults.get("metadata", ())):
            raise _another_kind(found)
        described = ["without the record hil the rest cannot be checked"]
    else:
        described = _description_faults(path, found.metadata)
    faults.setdefault("metadata", []).extend(described)
    if found.outcome is not None:
        faults.setdefault("outcome", []).extend(_outcome_faults(found.outcome))
    if not described and found.pieces:
        for aspect, text in message_faults(found):
            faults.setdefault(aspect, []).append(text)
    return Check(
        path=path,
        version=(found.metadata or {}).get("format_version", "unknown"),
        faults={aspect: _shortened(faults[aspect]) for aspect in ASPECTS if faults.get(aspect)},
        samples=found.samples,
        repaired=(found.outcome or {}).get("repaired") == "yes",
    )


def _another_kind(found: Survey) -> NotAnArchiveError:
    if found.size == 0:
        return NotAnArchiveError(found.path, "is empty")
    if found.header is None:
        return NotAnArchiveError(found.path, "is not an MCAP file")
    profile, library = found.header
    return NotAnArchiveError(
        found.path,
        f"is an MCAP file of profile {profile!r} written by {library!r}, but not an archive of hil",
        remedy="import it first",
    )


def _shortened(texts: list[str]) -> tuple[str, ...]:
    unique = list(dict.fromkeys(texts))
    more = len(unique) - _MOST
    return tuple([*unique[:_MOST], f"and {more} more of the kind"] if more > 0 else unique)


def _description_faults(path: Path, metadata: Mapping[str, str]) -> list[str]:
    """What is wrong with the ``hil`` record."""
    faults = []
    version = metadata.get("format_version")
    if version != str(schema.FORMAT_VERSION):
        return [f"format_version is {version!r}, known is '{schema.FORMAT_VERSION}'"]
    kind = metadata.get("kind")
    if kind not in KINDS:
        faults.append(f"kind is {kind!r}, not one of {', '.join(KINDS)}")
    for read in (description.joint_names, description.attachment_names, description.period):
        try:
            read(metadata)
        except DescriptionError as error:
            faults.append(str(error))
    if "period" not in metadata and kind != "imported":
        faults.append("period is missing")
    name = ArchiveName.parse(path)
    for key, value in (name.metadata() if name else {}).items():
        if metadata.get(key) != value:
            faults.append(f"{key} is {metadata.get(key)!r}, but the file name says {value!r}")
    return faults


def _outcome_faults(outcome: Mapping[str, str]) -> list[str]:
    """What is wrong with the ``hil.outcome`` record, but for its counts."""
    word = outcome.get("outcome")
    if word not in OUTCOMES:
        return [f"outcome is {word!r}, not one of {', '.join(OUTCOMES)}"]
    if checksums(outcome.get(schema.CHUNKS, "")) is None:
        return [f"{schema.CHUNKS} is no list of checksums"]
    return []
