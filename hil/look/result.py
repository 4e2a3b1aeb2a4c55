"""The result of a look at a recording: rows of one table, questions, and what can be determined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

from hil.importers.conclusions import Certainty, Conclusion
from hil.look.readings import (
    ArmChange,
    Changes,
    Decider,
    Evidence,
    MapEntries,
    NearestZero,
    NextBest,
    NextStep,
    NoBetter,
    Reading,
    Setting,
    Vector,
)
from identification.hypotheses.scores import MIN_REDUCTION

Aspect = Literal[
    "time",
    "rows",
    "joints",
    "position",
    "velocity",
    "torque",
    "motor current",
    "commanded position",
    "fixed",
    "recorded arm",
    "motion",
    "wraps",
    "positions",
    "range",
    "order",
    "signs",
    "angle unit",
    "zero",
    "scale",
    "spring",
    "coupling",
    "gravity",
    "mounting",
    "side",
    "payload",
    "as read",
    "delay",
    "low-pass",
    "arm",
    "bodies",
    "explanation",
    "changed part",
]
"""What a row is about, as a person and a program read it."""

_NEEDED: Final = (
    NextStep.IMPORT_COMMANDS,
    NextStep.RECORD_COMMANDS,
    NextStep.STATE_TORQUE_CONSTANT,
)
"""What a person has to do before an identification, however certain the row is."""


@dataclass(frozen=True)
class Row:
    """What one aspect of a recording is.

    Attributes:
        aspect: what it is about.
        reading: what it is.
        certainty: how certain that is.
        evidence: from what, most often one thing.
        decider: what would decide it; None if there is nothing.
        is_changed: whether the torque says that it is other than recorded.
        is_fault: whether it is wrong, and no map corrects it.
    """

    aspect: Aspect
    reading: Reading
    certainty: Certainty
    evidence: tuple[Evidence, ...]
    decider: Decider | None = None
    is_changed: bool = False
    is_fault: bool = False

    @property
    def has_step(self) -> bool:
        """Whether a person has something to do: to decide it, or to mend what is wrong."""
        if self.is_unsupported:
            return False
        if self.decider in _NEEDED:
            return True
        return self.decider is not None and (
            self.is_fault or self.certainty is Certainty.UNDETERMINED
        )

    @property
    def is_unsupported(self) -> bool:
        """Whether it leaves a zero or coupling open that nothing in the recording speaks for.

        Columns may have any sign or order. A zero or a coupling other than the URDF's is a fault of
        the arm or of its URDF, which needs evidence.
        """
        if self.aspect not in ("zero", "coupling") or self.certainty is not Certainty.UNDETERMINED:
            return False
        ratios = [each.ratio for each in self.evidence if isinstance(each, NearestZero | NextBest)]
        return bool(ratios) and min(ratios) > 1.0 - MIN_REDUCTION


@dataclass(frozen=True)
class TiedReading:
    """One of the readings that fit alike.

    Attributes:
        aspect: of the row.
        reading: what it would be: a change, the signs of all joints, or, where the side is open,
            what its setting says.
        error: of the torque, predicted from other parts of the recording, as a share of it; None
            if the motion says nothing about it.
        setting: what states it; None if nothing does.
    """

    aspect: Aspect
    reading: ArmChange | Changes | None
    error: float | None
    setting: Setting | None

    @property
    def entries(self) -> dict[str, Any]:
        """The entries of the map that state it, by dotted key; empty if none do."""
        return dict(self.setting.entries) if isinstance(self.setting, MapEntries) else {}


@dataclass(frozen=True)
class ParameterGroup:
    """How many parameters of a body or joint the recording determines."""

    body: str
    quantity: Literal["body", "friction"]
    identifiable: int
    weak: int
    missing: int


@dataclass(frozen=True)
class Look:
    """What a recording contains.

    Attributes:
        source: its file name.
        rows: of the table.
        questions: readings that fit alike, one tuple for each question.
        groups: parameters that the recording determines; empty without masses or geometry.
        map_text: the column map with the sure conclusions; None for a bag.
        gravity: for `hil identify`, in addition to the map [m/s²]; None if it is as stated.
        error: of the torque as read, predicted from other parts of the recording, as a share of
            it; None without a torque or an arm.
        bag_text: how the joint states of a bag were read, as a map; None for other recordings.
        no_better: changes that fit best, by no more than chance, or None.
    """

    source: str
    rows: tuple[Row, ...]
    questions: tuple[tuple[TiedReading, ...], ...]
    groups: tuple[ParameterGroup, ...]
    map_text: str | None
    gravity: Vector | None = None
    error: float | None = None
    bag_text: str | None = None
    no_better: NoBetter | None = None

    @property
    def is_of_archive(self) -> bool:
        """Whether it is of an archive, which no map describes."""
        return self.map_text is None and self.bag_text is None


@dataclass(frozen=True)
class ChangedReading(Conclusion):
    """A row of a look whose conclusion an identification uses.

    Attributes:
        row: of the look.
        source: name of the recording with the same columns that was looked at; "": this one.
    """

    row: Row
    source: str = ""
