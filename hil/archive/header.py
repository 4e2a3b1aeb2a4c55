"""File name, header and outcome of an archive, parsed and bounded once when the file is opened."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
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

from hil.base.safe_input import parse_count

KINDS = ("standstill", "move", "warmup", "dryrun", "excitation", "validation", "imported")
SUFFIX = ".mcap"
KIND_NAMES = {
    "dryrun": "dry run",
    "warmup": "warm-up",
    "excitation": "repetition",
    "imported": "recording",
}
"""Names of kinds in messages, where they differ from the kind."""

FORMAT_VERSION = 1
METADATA = "hil"  # Name of the metadata record with the header
OUTCOME = "hil.outcome"  # Name of the metadata record with the outcome
DESCRIPTION = "description"
"""Entry of the outcome: checksum of the header it belongs to. Older files have none."""
CHUNKS = "chunks"  # Entry of the outcome in files of earlier versions; not read
SEALS = (DESCRIPTION, CHUNKS)  # Entries of the outcome that only serve to verify the file
CONTROLLER_PROGRAM = "controller"
"""Entry ``motion`` of an archive whose motion was made by a program of the controller."""
REPLIES_LOST = "AnswersLost"  # Name of the event `drivers.events.RepliesLost`
EPISODE = "episode"  # Entry of an imported recording: its number, where a file has several
REJECTED = "rejected"  # Outcome of a motion that completed and failed its quality check
MAX_RECORDED_JOINTS: Final = 256
SEQUENCE_MODULUS: Final = 1 << 32  # of the numbers of messages

_PATTERN = re.compile(
    r"(?P<kind>[a-z]+)_(?P<index>[0-9]{3,18})_a(?P<attempt>[1-9][0-9]{0,17})\.mcap"
)


def motion_name(kind: str, index: int) -> str:
    """Return the name of a motion in messages, numbered from 1: "repetition 1" is excitation 0."""
    return f"{KIND_NAMES.get(kind, kind)} {index + 1}"


@dataclass(frozen=True, order=True)
class ArchiveName:
    """File name of an archive: ``excitation_007_a1.mcap`` is kind, index and attempt.

    `kind` is one of `KINDS`, `index` the number of the interval within its kind, from 0, `attempt`
    from 1: a truncated or stopped interval is repeated as the next attempt.
    """

    kind: str
    index: int
    attempt: int = 1

    def __str__(self) -> str:
        return f"{self.kind}_{self.index:03d}_a{self.attempt}{SUFFIX}"

    def __fspath__(self) -> str:
        """The file name, so that a folder can be joined with it."""
        return str(self)

    @classmethod
    def parse(cls, path: str | PathLike[str]) -> ArchiveName | None:
        """Read kind, index and attempt from a file name; None where it is not such a name."""
        match = _PATTERN.fullmatch(Path(path).name)
        if match is None or match["kind"] not in KINDS:
            return None
        return cls(match["kind"], int(match["index"]), int(match["attempt"]))

    @property
    def motion(self) -> str:
        """Name of the motion in messages, without the attempt."""
        return motion_name(self.kind, self.index)

    def metadata(self) -> dict[str, str]:
        """Return the name as entries of the header."""
        return {"kind": self.kind, "index": str(self.index), "attempt": str(self.attempt)}


class HeaderError(ValueError):
    """Invalid entries of a header; `problems` states what is wrong, by entry."""

    def __init__(self, problems: Mapping[str, str]) -> None:
        self.problems = dict(problems)
        super().__init__("; ".join(f"{name} {problem}" for name, problem in self.problems.items()))


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError("cannot be printed")
    return name


def _readable_or_default(
    value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
) -> Any:
    """Replace an informative entry that cannot be read: it makes no archive invalid."""
    try:
        return handler(value)
    except ValidationError:
        return _UNREADABLE[info.field_name or ""]


class Findings(BaseModel):
    """Results of an import: time base and ranges; possible errors of the column map."""

    model_config = ConfigDict(frozen=True, strict=True, defer_build=True)

    lines: tuple[str, ...]
    warnings: tuple[str, ...] = Field(validation_alias=AliasChoices("warnings", "doubts"))


_UNREADABLE: Final[Mapping[str, Any]] = {
    "planted": {},
    "findings": Findings(lines=(), warnings=("the findings of the import cannot be read",)),
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
        attachments: names of the required attachments.
        period: cycle time [s]; None of an imported recording without a fixed one.
        index, attempt: of the interval within its kind, None where not stated.
        motion: `CONTROLLER_PROGRAM`, or empty.
        simulated: "yes" where only a simulated arm can have moved, "no", or empty where unknown.
        use: of an imported recording, the kind that identification uses it as.
        plan_hash: digest of cell, URDF and plan.
        recorded_at: time of day, None in virtual time.
        payload: name of the payload that the arm carried, empty for none or one without a name.
        effects: effects of a simulated arm that the model does not contain.
        motor_from_joint: motor angles per joint angle, n rows of n numbers.
        planted: true parameters of a simulated arm by name; None where not stated, empty where
            unreadable.
        entries: all entries as texts, without the checksum.
    """

    model_config = ConfigDict(frozen=True, defer_build=True)

    kind: str
    joint_names: Json[Annotated[tuple[_Name, ...], Field(min_length=1)]]
    attachments: _Names
    period: Json[Annotated[_Finite, Field(ge=1e-9, le=1e9)]] | None = None
    index: _Count = None
    attempt: _Count = None
    motion: str = ""
    simulated: str = ""
    use: str = "excitation"
    plan_hash: str = ""
    recorded_at: str | None = None
    payload: str = ""
    effects: _Names = ()
    held_joints: _Names = ()
    motor_from_joint: Json[tuple[tuple[_Finite, ...], ...]] | None = None
    planted: Annotated[Json[dict[str, _Finite]] | None, WrapValidator(_readable_or_default)] = None
    findings: Annotated[Json[Findings], WrapValidator(_readable_or_default)] = Findings(
        lines=(), warnings=()
    )
    entries: Mapping[str, str] = Field(default_factory=dict)

    @classmethod
    def of(cls, entries: Mapping[str, str]) -> Self:
        """Parse the entries of the ``hil`` record; `HeaderError` if some are invalid."""
        try:
            return cls.model_validate({**entries, "entries": entries})
        except ValidationError as error:
            raise HeaderError(
                {
                    (name := str(problem["loc"][0])): f"cannot be used: {problem['msg']}"
                    if name in entries
                    else "is missing"
                    for problem in error.errors(include_url=False)
                }
            ) from error

    @field_validator("joint_names")
    @classmethod
    def _check_joints(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if "" in names or len(set(names)) != len(names):
            raise ValueError("names are empty or not unique")
        if len(names) > MAX_RECORDED_JOINTS:
            raise ValueError(f"{len(names)} joints, at most {MAX_RECORDED_JOINTS} are supported")
        return names

    @field_validator("motor_from_joint")
    @classmethod
    def _check_motors(
        cls, rows: tuple[tuple[float, ...], ...] | None, info: ValidationInfo
    ) -> tuple[tuple[float, ...], ...] | None:
        n = len(info.data.get("joint_names", ()))
        if rows is not None and [len(row) for row in rows] != [n] * n:
            raise ValueError(f"is not a matrix of {n} by {n} numbers")
        return rows

    @property
    def only_simulated(self) -> bool:
        """Whether no robot moved."""
        return self.simulated == "yes"

    @property
    def simulated_by_unknown(self) -> bool:
        """Whether a program at the other end of a link simulated the arm: it is not known which."""
        return self.only_simulated and self.recorded_at is not None and self.planted is None

    @property
    def by_controller_program(self) -> bool:
        """Whether a program of the controller made the motion."""
        return self.motion == CONTROLLER_PROGRAM

    @property
    def purpose(self) -> str:
        """The kind that identification uses the archive as."""
        return self.use if self.kind == "imported" else self.kind


class ArchiveOutcome(BaseModel):
    """How a recording ended, and what was written; an invalid count is None.

    Attributes:
        outcome, reason: such as ``completed``, ``stopped``, ``refused``; why it did not complete.
        samples, events: numbers written.
        lost_packets, records_lost, events_lost: lost by the link and by this PC.
        late_packets: that came late themselves; None if none did, or none were counted.
        late_replies: late, or omitted because a newer packet had arrived.
        repaired: whether the file was repaired with loss.
        samples_lost, losses: by repairs, None where unknown; a sentence each.
        description: checksum of the header, None in older files.
        record: all entries as texts, without the checksum of the record.
    """

    model_config = ConfigDict(frozen=True, defer_build=True)

    outcome: str = "unknown"
    reason: str = ""
    samples: _Count = None
    events: _Count = None
    lost_packets: _Count = None
    records_lost: _Count = None
    events_lost: _Count = None
    late_packets: _Count = None
    late_replies: Annotated[_Count, Field(alias="late_answers")] = None
    replies_not_accepted: Annotated[_Count, Field(alias="answers_not_taken")] = None
    repaired: Annotated[bool, BeforeValidator(lambda text: text == "yes")] = False
    samples_lost: Annotated[_Count, Field(alias="repaired.samples_lost")] = 0
    losses: Annotated[
        _Names, WrapValidator(_readable_or_default), Field(alias="repaired.losses")
    ] = ()
    description: str | None = None
    record: Mapping[str, str] = Field(default_factory=dict)

    @classmethod
    def of(cls, entries: Mapping[str, str]) -> Self:
        """Parse the entries of the ``hil.outcome`` record."""
        return cls.model_validate({**entries, "record": entries})

    @property
    def entries(self) -> dict[str, str]:
        """The entries about the recording: all but `SEALS`."""
        return {key: text for key, text in self.record.items() if key not in SEALS}

    def belongs_to(self, header: ArchiveHeader | None) -> bool:
        """Return whether it may belong to the recording with this header (older files: always)."""
        return header is None or self.description in (None, checksum(header.entries))


def is_supported(entries: Mapping[str, str]) -> bool:
    """Return whether the entries of a header have the version that this software reads."""
    return entries.get("format_version") == str(FORMAT_VERSION)


def checksum(entries: Mapping[str, str]) -> str:
    """Return the CRC-32 of metadata entries; MCAP itself protects chunks and attachments only."""
    text = json.dumps(dict(entries), sort_keys=True, separators=(",", ":"))
    return f"{zlib.crc32(text.encode()):08x}"


def with_checksum(entries: Mapping[str, str]) -> dict[str, str]:
    """Return the entries of a metadata record with their checksum."""
    return {**entries, "checksum": checksum(entries)}
