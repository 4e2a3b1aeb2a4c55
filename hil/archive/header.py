"""What an archive says of itself: file name, header and outcome, parsed and bounded once.

MCAP metadata are texts by name, and whoever wrote a file may have written anything into them. Here
they become typed values, once for each file that is opened; what stands behind trusts them.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import (
    AfterValidator,
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Json,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
)

from hil.reading import parse_count

KINDS = ("standstill", "move", "warmup", "dryrun", "excitation", "validation", "imported")
SUFFIX = ".mcap"
WORDS = {
    "dryrun": "dry run",
    "warmup": "warm-up",
    "excitation": "repetition",
    "imported": "recording",
}
"""What a person calls a kind, where that is another word."""

FORMAT_VERSION = 1
METADATA = "hil"
"""Name of the metadata record that holds the header."""
OUTCOME = "hil.outcome"
"""Name of the metadata record that holds the outcome."""
DESCRIPTION = "description"
"""Entry of the outcome: checksum of the header it belongs to. Older files have none."""
CHUNKS = "chunks"
"""Entry of the outcome: the checksums of all chunks in order. Older files have none."""
SEALS = (DESCRIPTION, CHUNKS)
"""Entries of the outcome that serve to verify the file, and say nothing of the recording."""
CONTROLLERS_OWN = "controller"
"""Entry ``motion`` of an archive whose motion was made by the controller's own program."""
REJECTED = "rejected"
"""Outcome of a motion that ended well and failed its quality check."""
MOST_JOINTS: Final = 256

_DIGITS = 8  # of a checksum
_PATTERN = re.compile(
    r"(?P<kind>[a-z]+)_(?P<index>[0-9]{3,18})_a(?P<attempt>[1-9][0-9]{0,17})\.mcap"
)


def motion_name(kind: str, index: int) -> str:
    """What a person calls a motion, counted from 1: "repetition 1" for the excitation 0."""
    return f"{WORDS.get(kind, kind)} {index + 1}"


@dataclass(frozen=True, order=True)
class ArchiveName:
    """What an archive is called: ``excitation_007_a1.mcap`` is kind, index and attempt.

    Attributes:
        kind: why the arm moved, one of `KINDS`.
        index: number of the interval within its kind, from 0.
        attempt: 1 for the first try at this interval; a torn or stopped one is done again.
    """

    kind: str
    index: int
    attempt: int = 1

    @property
    def filename(self) -> str:
        """The name of the file, without folder."""
        return f"{self.kind}_{self.index:03d}_a{self.attempt}{SUFFIX}"

    def __str__(self) -> str:
        return self.filename

    def __fspath__(self) -> str:
        """The file name, so that a folder can be joined with it."""
        return self.filename

    @classmethod
    def parse(cls, path: str | PathLike[str]) -> ArchiveName | None:
        """Read kind, index and attempt from a file name; None when it is not such a name."""
        match = _PATTERN.fullmatch(Path(path).name)
        if match is None or match["kind"] not in KINDS:
            return None
        return cls(match["kind"], int(match["index"]), int(match["attempt"]))

    @property
    def motion(self) -> str:
        """What a person calls it; without the attempt."""
        return motion_name(self.kind, self.index)

    def metadata(self) -> dict[str, str]:
        """The name as entries of the header."""
        return {"kind": self.kind, "index": str(self.index), "attempt": str(self.attempt)}


class HeaderError(ValueError):
    """Entries of a header that cannot be used.

    Attributes:
        problems: what is wrong, by entry.
    """

    def __init__(self, problems: Mapping[str, str]) -> None:
        self.problems = dict(problems)
        super().__init__("; ".join(f"{name} {problem}" for name, problem in self.problems.items()))


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError("cannot be printed")
    return name


def _or_default(value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """An entry that only informs: one that cannot be read counts as unreadable, not as damage."""
    try:
        return handler(value)
    except ValidationError:
        return _UNREADABLE[info.field_name or ""]


class Findings(BaseModel):
    """What was found in a recording when it was imported.

    Attributes:
        lines: the time base, and the range of each joint.
        warnings: what looks like a slip of the column map, in sentences.
    """

    model_config = ConfigDict(frozen=True, strict=True)

    lines: tuple[str, ...]
    warnings: tuple[str, ...] = Field(validation_alias=AliasChoices("warnings", "doubts"))


_UNREADABLE: Final[Mapping[str, Any]] = {
    "planted": {},
    "findings": Findings(lines=(), warnings=("what its import found cannot be read",)),
    "losses": (),
}

_Name = Annotated[str, AfterValidator(_printable)]
_Names = Json[tuple[_Name, ...]]
_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Count = Annotated[int | None, BeforeValidator(parse_count)]


class ArchiveHeader(BaseModel):
    """The header of an archive.

    Attributes:
        kind: why the arm moved, one of `KINDS`.
        joint_names: in the order of the columns.
        attachments: names of those that must be there.
        period: cycle time [s]; None of an imported recording without a fixed one.
        index, attempt: of the interval within its kind, None where they are not stated.
        motion: `CONTROLLERS_OWN`, or empty.
        simulated: whether only a simulated arm can have moved, "yes" or "no"; empty where nothing
            says it.
        use: of an imported recording, the kind it serves as.
        cell: name of the cell.
        plan_hash: of cell, URDF and plan.
        recorded_at: time of day, None in virtual time.
        effects: of a simulated arm, what its model leaves out.
        held_joints: joints that did not move on purpose.
        motor_from_joint: motor angles per joint angle, n rows of n numbers.
        planted: parameters of a simulated arm by name; None where they are not stated, empty where
            they cannot be read.
        findings: of an import.
        entries: all entries as texts, the checksum left out.
    """

    model_config = ConfigDict(frozen=True)

    kind: str
    joint_names: Json[Annotated[tuple[_Name, ...], Field(min_length=1)]]
    attachments: _Names
    period: Json[Annotated[_Finite, Field(ge=1e-9, le=1e9)]] | None = None
    index: _Count = None
    attempt: _Count = None
    motion: str = ""
    simulated: str = ""
    use: str = "excitation"
    cell: str = ""
    plan_hash: str = ""
    recorded_at: str | None = None
    effects: _Names = ()
    held_joints: _Names = ()
    motor_from_joint: Json[tuple[tuple[_Finite, ...], ...]] | None = None
    planted: Annotated[Json[dict[str, _Finite]] | None, WrapValidator(_or_default)] = None
    findings: Annotated[Json[Findings], WrapValidator(_or_default)] = Findings(
        lines=(), warnings=()
    )
    entries: Mapping[str, str] = Field(default_factory=dict)

    @classmethod
    def of(cls, entries: Mapping[str, str]) -> Self:
        """Parse the entries of the ``hil`` record.

        Raises:
            HeaderError: some of them cannot be used.
        """
        try:
            return cls.model_validate({**entries, "entries": entries})
        except ValidationError as error:
            raise HeaderError(
                {
                    (name := str(one["loc"][0])): f"cannot be used: {one['msg']}"
                    if name in entries
                    else "is missing"
                    for one in error.errors(include_url=False)
                }
            ) from error

    @field_validator("joint_names")
    @classmethod
    def _check_joints(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if "" in names or len(set(names)) != len(names):
            raise ValueError("some are empty or alike")
        if len(names) > MOST_JOINTS:
            raise ValueError(f"{len(names)} joints, known are {MOST_JOINTS}")
        return names

    @field_validator("motor_from_joint")
    @classmethod
    def _check_motors(
        cls, rows: tuple[tuple[float, ...], ...] | None, info: ValidationInfo
    ) -> tuple[tuple[float, ...], ...] | None:
        n = len(info.data.get("joint_names", ()))
        if rows is not None and [len(row) for row in rows] != [n] * n:
            raise ValueError(f"is no matrix of {n} by {n} numbers")
        return rows

    @property
    def only_simulated(self) -> bool:
        """Whether no robot moved."""
        return self.simulated == "yes"

    @property
    def controllers_own(self) -> bool:
        """Whether the controller's own program made the motion."""
        return self.motion == CONTROLLERS_OWN

    @property
    def serves_as(self) -> str:
        """The kind that identification takes it for."""
        return self.use if self.kind == "imported" else self.kind


class ArchiveOutcome(BaseModel):
    """How a recording ended, and what was written; a count that is no number is None.

    Attributes:
        outcome: such as ``completed``, ``stopped``, ``refused``.
        reason: why, in a sentence, when it did not complete.
        samples, events, packets: how many were written.
        first_cycle, last_cycle: of the controller.
        lost_packets, records_lost, events_lost: what the link and this PC lost.
        late_replies: late, or left out for that to a newer packet.
        replies_not_accepted: those that the controller's target shows it did not accept.
        repaired: whether something was lost and the file repaired.
        samples_lost: by repairs, None where nobody can say.
        losses: by repairs, a sentence each.
        description: checksum of the header, None in older files.
        chunks: checksums of all chunks in order; None in older files, or where the entry is no
            such list.
        record: all entries as texts, the checksum of the record left out.
    """

    model_config = ConfigDict(frozen=True)

    outcome: str = "unknown"
    reason: str = ""
    samples: _Count = None
    events: _Count = None
    packets: _Count = None
    first_cycle: _Count = None
    last_cycle: _Count = None
    lost_packets: _Count = None
    records_lost: _Count = None
    events_lost: _Count = None
    late_replies: Annotated[_Count, Field(alias="late_answers")] = None
    replies_not_accepted: Annotated[_Count, Field(alias="answers_not_taken")] = None
    repaired: Annotated[bool, BeforeValidator(lambda text: text == "yes")] = False
    samples_lost: Annotated[_Count, Field(alias="repaired.samples_lost")] = 0
    losses: Annotated[_Names, WrapValidator(_or_default), Field(alias="repaired.losses")] = ()
    description: str | None = None
    chunks: Annotated[tuple[int, ...] | None, BeforeValidator(lambda text: checksums(text))] = None
    record: Mapping[str, str] = Field(default_factory=dict)

    @classmethod
    def of(cls, entries: Mapping[str, str]) -> Self:
        """Parse the entries of the ``hil.outcome`` record."""
        return cls.model_validate({**entries, "record": entries})

    @property
    def entries(self) -> dict[str, str]:
        """What the record says of the recording: all but the seals."""
        return {key: text for key, text in self.record.items() if key not in SEALS}

    def belongs_to(self, header: ArchiveHeader | None) -> bool:
        """Whether it is of the recording with this header, as far as is known."""
        return header is None or self.description in (None, checksum(header.entries))


def is_known(entries: Mapping[str, str]) -> bool:
    """Whether the entries of a header are of the version that this software reads."""
    return entries.get("format_version") == str(FORMAT_VERSION)


def chunk_list(chunks: Iterable[int]) -> str:
    """The checksums of chunks as the outcome lists them."""
    return "".join(f"{crc:08x}" for crc in chunks)


def checksums(text: str) -> tuple[int, ...] | None:
    """The checksums that such a list holds; None where it is none."""
    try:
        data = bytes.fromhex(text)
    except ValueError:
        return None
    if len(text) != 2 * len(data) or len(text) % _DIGITS:
        return None
    return struct.unpack(f">{len(data) // 4}I", data)


def checksum(entries: Mapping[str, str]) -> str:
    """CRC-32 of metadata entries; MCAP itself protects chunks and attachments only."""
    text = json.dumps(dict(entries), sort_keys=True, separators=(",", ":"))
    return f"{zlib.crc32(text.encode()):08x}"


def sealed(entries: Mapping[str, str]) -> dict[str, str]:
    """The entries of a metadata record with their checksum."""
    return {**entries, "checksum": checksum(entries)}
