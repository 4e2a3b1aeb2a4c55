"""The motion that a search found, with its criteria and origin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from identification.arrays import Array
from identification.excitation.criteria import Criteria
from planner.arrays import DAMAGED_DATA_ERRORS, Whole, numbers, strict
from planner.fourier import FourierSeries
from planner.moves import Move
from planner.piecewise_cubic import PiecewiseCubic


@dataclass(frozen=True, eq=False)
class ViaPointMotion:
    """A motion planned through via points."""

    via_points: Array  #: (n_points, n) [rad], home at both ends included
    speed: Array  #: (n,) fraction of each joint's velocity limit
    fly: float  #: corner rounding, 0 to 1
    trajectory: PiecewiseCubic  #: the planned motion

    @property
    def moves(self) -> tuple[Move, ...]:
        """Moves from the first via point on; they plan to the same trajectory bit for bit."""
        return moves_through(self.via_points, self.speed, self.fly)


def moves_through(via_points: Array, speed: Array, fly: float) -> tuple[Move, ...]:
    """Return one move to each via point after the first, as `planner.plan` makes them."""
    percent = 100.0 * fly
    return tuple(Move(point, joint_speed=speed, fly_percent=percent) for point in via_points[1:])


@dataclass(frozen=True, eq=False)
class Excitation:
    """The best motion of a search."""

    trajectory: PiecewiseCubic | FourierSeries  #: planned through via points, or a sum of sines
    criteria: Criteria  #: its excitation criteria
    method: str  #: search method
    seed: int  #: of the search
    tried: int  #: number of evaluated motions
    rejected: Mapping[str, int]  #: number of infeasible ones by kind of constraint
    #: (n_points, n) [rad], both ends included; like speed and fly None for sines
    via_points: Array | None = None
    speed: Array | None = None  #: (n,) fraction of each joint's velocity limit
    fly: float | None = None  #: corner rounding, 0 to 1

    @property
    def moves(self) -> tuple[Move, ...] | None:
        """Moves from the first via point on (see `ViaPointMotion.moves`); None for sines."""
        if self.via_points is None or self.speed is None or self.fly is None:
            return None
        return moves_through(self.via_points, self.speed, self.fly)

    def to_dict(self) -> dict[str, Any]:
        """Return data for JSON; `from_dict` restores them bit-identically."""
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

        Raises:
            ValueError: the data are not an excitation.
        """
        try:
            trajectory = trajectory_from_dict(data["trajectory"])
            sines = isinstance(trajectory, FourierSeries)
            return cls(
                trajectory=trajectory,
                criteria=Criteria.from_dict(data["criteria"]),
                method=strict(str, data.get("method", "random")),  # missing in the oldest files
                seed=strict(Whole, data["seed"]),
                tried=strict(Whole, data["tried"]),
                rejected=strict(dict[str, Whole], data["rejected"]),
                **({} if sines else _planned(data, trajectory.n_joints)),
            )
        except DAMAGED_DATA_ERRORS as error:
            raise ValueError(f"not an excitation: {error!r:.300}") from error


def _planned(data: Mapping[str, Any], n_joints: int) -> dict[str, Any]:
    points = numbers(data["via_points"], 2)
    speed = numbers(data["speed"], 1)
    if len(points) < 2 or points.shape[1] != n_joints or len(speed) != n_joints:
        raise ValueError(f"via points {points.shape} and speeds {speed.shape} of {n_joints} joints")
    return {"via_points": points, "speed": speed, "fly": strict(float, data["fly"])}


def trajectory_from_dict(data: Mapping[str, Any]) -> PiecewiseCubic | FourierSeries:
    """Restore a motion of either kind.

    Raises:
        TypeError, ValueError: the data are not a motion.
    """
    if data.get("type") == "fourier_series":
        return FourierSeries.from_dict(data)
    return PiecewiseCubic.from_dict(data)
