"""A motion that was chosen because it excites the parameters, and how it was found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from identification.excitation.criteria import Criteria
from planner import FlyPercent, FourierSeries, Move, PiecewiseCubic
from planner.checked_data import DAMAGED, Whole, numbers, strict

Array = NDArray[np.float64]

# Excitations that were written down without a method came from a random search.
_FIRST_METHOD: Final = "random"


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A motion, and what it was planned from."""

    via_points: Array  #: (n_points, n) [rad], home at both ends included
    speed: Array  #: (n,) share of each joint's velocity limit
    fly: float  #: how far corners are rounded, 0 to 1
    trajectory: PiecewiseCubic  #: the motion planned from these

    @property
    def moves(self) -> tuple[Move, ...]:
        """The moves from the first via point on; they plan to the trajectory, bit for bit."""
        return moves_through(self.via_points, self.speed, self.fly)


def moves_through(via_points: Array, speed: Array, fly: float) -> tuple[Move, ...]:
    """Return one move to each via point but the first, as `planner.plan` makes them."""
    passing = FlyPercent(100.0 * fly)
    return tuple(Move(point, joint_speed=speed, fly=passing) for point in via_points[1:])


@dataclass(frozen=True, eq=False)
class Excitation:
    """The best motion of a search, and how it was found."""

    #: the motion; pieces planned through via points, or a sum of sines
    trajectory: PiecewiseCubic | FourierSeries
    criteria: Criteria  #: how good it is
    method: str  #: name of the search that found it
    seed: int  #: of the search
    tried: int  #: how many motions were looked at
    rejected: Mapping[str, int]  #: how many of them were not feasible, by kind of constraint
    #: (n_points, n) [rad], both ends included; None for sines, as the next two
    via_points: Array | None = None
    speed: Array | None = None  #: (n,) share of each joint's velocity limit
    fly: float | None = None  #: how far corners are rounded, 0 to 1

    @property
    def moves(self) -> tuple[Move, ...] | None:
        """The moves from the first via point on; they plan to the trajectory, bit for bit.

        None for a motion that was not planned from moves.
        """
        if self.via_points is None or self.speed is None or self.fly is None:
            return None
        return moves_through(self.via_points, self.speed, self.fly)

    def to_dict(self) -> dict[str, Any]:
        """Return data; `from_dict` restores every bit, through JSON too."""
        planned: dict[str, Any] = {}
        if self.via_points is not None and self.speed is not None:
            planned = {
                "via_points": self.via_points.tolist(),
                "speed": self.speed.tolist(),
                "fly": self.fly,
            }
        return {
            "method": self.method,
            **planned,
            "trajectory": self.trajectory.to_dict(),
            "criteria": asdict(self.criteria),
            "seed": self.seed,
            "tried": self.tried,
            "rejected": dict(self.rejected),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Restore what `to_dict` returned.

        Data without a method are those of a random search.

        Raises:
            ValueError: the data are no excitation.
        """
        try:
            trajectory = trajectory_from_dict(data["trajectory"])
            sines = isinstance(trajectory, FourierSeries)
            return cls(
                trajectory=trajectory,
                criteria=Criteria.from_dict(data["criteria"]),
                method=strict(Name, data.get("method", _FIRST_METHOD)),
                seed=strict(Whole, data["seed"]),
                tried=strict(Whole, data["tried"]),
                rejected=strict(dict[Name, Whole], data["rejected"]),
                **({} if sines else _planned(data, trajectory.n_joints)),
            )
        except DAMAGED as error:
            raise ValueError(f"not an excitation: {error!r:.300}") from error


def _planned(data: Mapping[str, Any], n_joints: int) -> dict[str, Any]:
    points, speed = numbers(data["via_points"], 2), numbers(data["speed"], 1)
    if len(points) < 2 or points.shape[1] != n_joints or len(speed) != n_joints:
        raise ValueError(f"via points {points.shape} and speeds {speed.shape} of {n_joints} joints")
    return {"via_points": points, "speed": speed, "fly": strict(float, data["fly"])}


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError(f"{name!r:.80} cannot be printed")
    return name


Name = Annotated[str, AfterValidator(_printable)]


def trajectory_from_dict(data: Mapping[str, Any]) -> PiecewiseCubic | FourierSeries:
    """Restore a motion of either kind from its data.

    Raises:
        TypeError, ValueError: the data are no motion.
    """
    if data.get("type") == "fourier_series":
        return FourierSeries.from_dict(data)
    return PiecewiseCubic.from_dict(data)
