"""What a campaign is going to do: its excitation and its validation motions, in one small file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from hil.errors import InputError
from hil.files import write_atomically
from hil.reading import json_of, text_of
from identification.excitation import Excitation
from identification.excitation.excitation import trajectory_from_dict
from planner import FourierSeries, PiecewiseCubic, PlanFile

FORMAT_VERSION = 4
"""1 kept no moves: of validation motions the trajectories only, and no limits. 2 knew excitations
through via points only, without their method, 3 validation motions in pieces only, no sines."""
READ = (1, 2, 3, FORMAT_VERSION)


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A motion, and the moves that it was planned from.

    Attributes:
        trajectory: the motion.
        moves: start, moves and limits, without the motion; None where they were not stored.
    """

    trajectory: PiecewiseCubic | FourierSeries
    moves: PlanFile | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return data; `from_dict` restores every bit, through JSON too."""
        return {"trajectory": self.trajectory.to_dict(), **moves_to_dict(self.moves)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Restore what `to_dict` returned.

        Raises:
            KeyError, TypeError, ValueError: the data are no planned motion.
        """
        return cls(trajectory_from_dict(data["trajectory"]), moves_from_dict(data))


def moves_to_dict(moves: PlanFile | None) -> dict[str, Any]:
    """Return the entry `moves` of data, a plan file without its motion; none without moves.

    The motion stands beside it, so that it is not stored twice.
    """
    return {} if moves is None else {"moves": replace(moves, trajectory=None).to_dict()}


def moves_from_dict(data: Mapping[str, Any]) -> PlanFile | None:
    """Return the entry `moves` of data, None if there is none."""
    return PlanFile.from_dict(data["moves"]) if "moves" in data else None


@dataclass(frozen=True, eq=False)
class CampaignPlan:
    """The excitation, and the motions that are kept for validation and never fitted.

    Attributes:
        excitation: the motion to fit, and how it was found.
        validation: the motions to predict.
        moves: those of the excitation, with the limits that it was planned for; None for sines,
            and where they were not stored.
    """

    excitation: Excitation
    validation: tuple[PlannedMotion, ...]
    moves: PlanFile | None = None

    def save(self, path: Path) -> None:
        """Write the plan as JSON."""
        write_atomically(path, self.to_text())

    def to_text(self) -> str:
        """The plan as JSON."""
        content = {
            "format_version": FORMAT_VERSION,
            "excitation": self.excitation.to_dict(),
            **moves_to_dict(self.moves),
            "validation": [motion.to_dict() for motion in self.validation],
        }
        return json.dumps(content) + "\n"

    def is_of(self, text: str) -> bool:
        """Whether a text is this plan's, in whatever version and layout."""
        own = self.to_text()
        try:
            return text == own or CampaignPlan.from_text(text).to_text() == own
        except (ValueError, KeyError, TypeError, AttributeError):
            return False

    @classmethod
    def load(cls, path: Path) -> CampaignPlan:
        """Read a plan.

        Raises:
            InputError: the file is not a plan.
        """
        try:
            return cls.from_text(text_of(path))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                path, f"is not a campaign plan ({error})", remedy="design the excitation again"
            ) from error

    @classmethod
    def from_text(cls, text: str) -> CampaignPlan:
        """The plan from its JSON.

        Raises:
            ValueError, KeyError, TypeError, AttributeError: it is none.
        """
        content: dict[str, Any] = json_of(text)
        version = content["format_version"]
        if version not in READ:
            raise ValueError(f"format version {version}")
        return cls(
            Excitation.from_dict(content["excitation"]),
            tuple(
                PlannedMotion(PiecewiseCubic.from_dict(motion))
                if version == 1
                else PlannedMotion.from_dict(motion)
                for motion in content["validation"]
            ),
            moves_from_dict(content),
        )
