"""What the ``hil`` record says of the archive it stands in, once it has been checked.

Its checksum says that it is as it was written, not that whoever wrote it kept the profile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

from hil.archive import foreign_json

MOST_JOINTS: Final = 256
_LONGEST_PERIOD: Final = 1e9  # s
_SHORTEST_PERIOD: Final = 1e-9  # s, the resolution of stamps


class DescriptionError(ValueError):
    """An entry of the ``hil`` record that says nothing that can be used.

    Attributes:
        field: the entry.
        problem: what is wrong with it.
    """

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field} {problem}")
        self.field = field
        self.problem = problem


@dataclass(frozen=True)
class Description:
    """What a reader must know of an archive.

    Attributes:
        joint_names: in the order of the columns.
        attachments: names of those that must be there.
        period: cycle time [s]; None without a fixed one.
    """

    joint_names: tuple[str, ...]
    attachments: tuple[str, ...]
    period: float | None

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> Self:
        """Read the entries of the record.

        Raises:
            DescriptionError: the first one that cannot be used.
        """
        joints, attachments = joint_names(metadata), attachment_names(metadata)
        return cls(joints, attachments, period(metadata))


def joint_names(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """The names of the joints.

    Raises:
        DescriptionError: they are not different names that can be printed, or too many.
    """
    found = foreign_json.names(metadata.get("joint_names", ""))
    if not found or "" in found or len(set(found)) != len(found):
        raise DescriptionError("joint_names", "is no JSON list of different names")
    if len(found) > MOST_JOINTS:
        raise DescriptionError("joint_names", f"names {len(found)} joints, known are {MOST_JOINTS}")
    return found


def attachment_names(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """The names of the attachments that must be there.

    Raises:
        DescriptionError: they are no list of names.
    """
    found = foreign_json.names(metadata.get("attachments", ""))
    if found is None:
        raise DescriptionError("attachments", "is no JSON list of names")
    return found


def period(metadata: Mapping[str, str]) -> float | None:
    """The cycle time [s]; None where the record states none.

    Raises:
        DescriptionError: it is no time.
    """
    if "period" not in metadata:
        return None
    stated = foreign_json.loads(metadata["period"])
    number = isinstance(stated, int | float) and not isinstance(stated, bool)
    if not number or not _SHORTEST_PERIOD <= stated <= _LONGEST_PERIOD:
        shown = metadata["period"]
        shown = shown if len(shown) <= 40 else f"{shown[:40]}..."
        raise DescriptionError("period", f"is {shown!r}, not a time in seconds")
    return float(stated)
