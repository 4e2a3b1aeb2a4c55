"""The result file of a design: motion, criteria, settings and provenance."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import json_digest, write_atomically
from hil.base.safe_input import read_text, remedy_for_missing
from hil.base.toml_text import Angles, from_text, to_text
from hil.base.version import software
from hil.cell import Cell
from identification.excitation import (
    Criteria,
    Design,
    Excitation,
    Objective,
    coupling_index_max,
)
from planner import FourierSeries, PiecewiseCubic, PlanFile, PlannerError, in_child
from planner.arrays import DAMAGED_DATA_ERRORS, Whole, numbers, strict
from planner.plan_file import PLAN_TOLERANCE

from .settings import RESULT_FORMAT, DesignSettings, settings_of, with_present_fields

VERSION: Final = 1
RESULT: Final = "excitation.toml"
DECISIVE: Final = ("urdf", "robot", "limits")
"""Parts of a cell that determine a motion and its criteria. The others (walls, motors, home) are
checked before the motion is sent."""

_DIGEST_DIGITS: Final = 16
_COMPARED_INSTANTS: Final = 9  # of a stored motion with the same one planned on another computer
_LIMITS: Final = ("lower", "upper", "velocity", "acceleration", "jerk")
_REMEDY: Final = "design it again (`hil design`)"
_HEAD: Final = """\
# Result of `hil design`. Values of names that end in _deg are in degrees, degrees/s, degrees/s^2
# or degrees/s^3 of the URDF's angles. `hil demo --excitation` runs the motion. Do not edit this
# file: its seal would not match.
"""
_COMMENTS: Final = {
    "criteria": "Of the motion sampled every millisecond. Compare log10_det only between motions "
    "of one\nrobot in the same units; coupling_index (0 to coupling_index_max) has no unit.",
    "search": "infeasible: number of motions that violated each kind of constraint.",
    "front": "Pareto front by the second criterion, at the sample period of the search. chosen: "
    "index\n(from 0) of the motion in this file; without it the gradient improved it, see "
    "polished_from.",
    "polished_from": "Index (from 0) in the front of the motion that the gradient started from, "
    "and its criteria,\nsampled every millisecond.",
    "settings": "Settings of the search; `hil design --settings` can read them from this file.",
    "cell": "Name of the cell, and digests of its parts.",
    "precision": "Requirements: the worst quantity, half of its 95 % interval as promised for the\n"
    "planned repetitions and as required (shares, N·m), what the torque's scale alone leaves, and\n"
    "how many repetitions, or different motions of this kind, meet it.",
    "plan": "The motion: it is planned from these moves.",
    "sines": "The motion: offset + ramp x sum of amplitude x sin(frequency x t), rad/s.",
    "seal": "Digest of the tables above, and positions of the motion at equal intervals.",
}


def fingerprint(cell: Cell) -> dict[str, str]:
    """Return a digest of each part of a cell that affects a design, by the part's name.

    Tables are compared by content, limits in URDF angles.
    """
    file = cell.file
    limits = cell.joint_limits
    home = cell.file.campaign
    parts: dict[str, Any] = {
        "urdf": cell.urdf,
        "limits": {name: getattr(limits, name).tolist() for name in _LIMITS},
        "torque_limit": None if cell.torque_limit is None else cell.torque_limit.tolist(),
        "home": None if home is None else home.home_deg,
    }
    for name in ("robot", "drive_train", "nominal", "workspace"):
        table = getattr(file, name)
        # How well torque constants are known affects no motion.
        parts[name] = (
            None if table is None else table.model_dump(mode="json", exclude={"torque_uncertainty"})
        )
    return {name: json_digest(part)[:_DIGEST_DIGITS] for name, part in parts.items()}


@dataclass(frozen=True, eq=False)
class DesignResult:
    """Content of `excitation.toml`."""

    data: Mapping[str, Any]  #: its tables, without the seal
    settings: DesignSettings  #: of the design
    excitation: Excitation  #: the motion and its criteria

    @property
    def complete(self) -> bool:
        """Whether the search ran to its end."""
        return bool(self.data["complete"])

    @classmethod
    def of(cls, cell: Cell, settings: DesignSettings, design: Design, objective: Objective) -> Self:
        """Return the result of a design.

        Args:
            cell: of the arm.
            settings: of the search.
            design: that it found.
            objective: of the search.
        """
        names = objective.model.parameter_names
        chosen = objective.parameters
        front = design.front
        excitation = design.excitation
        origin = design.origin_criteria
        data: dict[str, Any] = {
            "format": RESULT_FORMAT,
            "version": VERSION,
            "complete": design.complete,
            "criteria": asdict(excitation.criteria)
            | {
                "coupling_index_max": coupling_index_max(objective.n_parameters),
                "duration": float(excitation.trajectory.duration),
            },
            "search": {
                "method": excitation.method,
                "seed": excitation.seed,
                "tried": excitation.tried,
                "generations": design.generations,
                "n_parameters": objective.n_parameters,
                "parameters": None if chosen is None else [names[k] for k in chosen],
                "infeasible": {name: int(n) for name, n in excitation.rejected.items()},
            },
            "front": {"chosen": design.chosen}
            | {name: front.measure(name).tolist() for name in front.criteria}
            | {"duration": front.duration.tolist()},
        }
        if design.chosen is None:
            measures = {name: getattr(origin, name) for name in front.criteria}
            data["polished_from"] = {"point": design.origin, **measures}
        data["settings"] = settings.to_dict()
        data["cell"] = {"name": cell.name, **fingerprint(cell)}
        data["software"] = software()
        return cls(data | _motion_data(excitation, cell), settings, excitation)

    def with_precision(self, promised: Sequence[Mapping[str, Any]]) -> Self:
        """Return the result with what the motion promises for each requirement."""
        return replace(self, data={**self.data, "precision": [*promised]})

    def save(self, path: Path) -> None:
        """Write the file.

        Raises:
            InputError: it cannot be written.
        """
        text = _HEAD + to_text(self.data, _COMMENTS)
        positions = _positions(self.excitation.trajectory).tolist()
        seal = {"sha256": _seal(text), "positions": Angles(positions)}
        try:
            write_atomically(path, text + "\n" + to_text({"seal": seal}, _COMMENTS))
        except OSError as error:
            raise InputError(
                path,
                f"cannot be written ({error.strerror})",
                remedy="free disk space, then repeat the command with --resume, which reads the "
                "scores from the journal",
            ) from error

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the file, or that in a folder, and plan its motion again.

        Raises:
            InputError: it cannot be read, was changed, or its moves plan to another motion.
        """
        path = path / RESULT if path.is_dir() else path
        try:
            text = read_text(path)
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            remedy = remedy_for_missing(path, "give a file that `hil design` wrote")
            raise InputError(path, f"cannot be read ({reason})", remedy=remedy) from error
        try:
            data = from_text(text)
            for key, expected in (("format", RESULT_FORMAT), ("version", VERSION)):
                if data.get(key) != expected:
                    raise ValueError(f"{key} is {data.get(key)!r:.60}, this reads {expected!r}")
            seal = data.pop("seal")
            positions = numbers(seal["positions"], 2)
            if seal["sha256"] != _seal(text):
                raise InputError(
                    path, "was changed after it was written", remedy=f"restore it, or {_REMEDY}"
                )
            result = cls._from_data(data, path)
        except (PlannerError, *DAMAGED_DATA_ERRORS) as error:
            problem = f"is not a designed excitation ({' '.join(str(error).split()):.200})"
            raise InputError(path, problem, remedy=_REMEDY) from error
        planned = _positions(result.excitation.trajectory)
        if positions.shape != planned.shape or np.any(np.abs(planned - positions) > PLAN_TOLERANCE):
            raise InputError(
                path,
                "planning its moves does not give the designed motion",
                remedy=f"{_REMEDY}, or use the software listed in [software]",
            )
        return result

    def require_cell(self, cell: Cell, path: Path) -> None:
        """Check that the motion was designed for the `DECISIVE` parts of a cell.

        Raises:
            InputError: names the cells and the parts that differ.
        """
        present = fingerprint(cell)
        then = self.data["cell"]
        different = [part for part in DECISIVE if present[part] != then.get(part)]
        if different:
            raise InputError(
                path,
                f"was designed for the cell {then['name']!r}, which differs from {cell.name!r} in "
                f"{' and '.join(different)}",
                field="cell",
                remedy=f"give its own cell, or {_REMEDY}",
            )

    @classmethod
    def _from_data(cls, data: Mapping[str, Any], path: Path) -> Self:
        settings = settings_of(with_present_fields(data["settings"]), path)
        search = data["search"]
        via = settings.via_points
        figures = {k: v for k, v in data["criteria"].items() if k in Criteria.__dataclass_fields__}
        excitation = Excitation(
            criteria=Criteria.from_dict(figures),
            method=strict(str, search["method"]),
            seed=strict(Whole, search["seed"]),
            tried=strict(Whole, search["tried"]),
            rejected=strict(dict[str, Whole], search["infeasible"]),
            **_motion_from_data(data, None if via is None else via.fly),
        )
        strict(bool, data["complete"])
        strict(str, strict(dict[str, str], data["cell"])["name"])
        return cls(data, settings, excitation)


def _motion_data(excitation: Excitation, cell: Cell) -> dict[str, Any]:
    """Return the table `plan` (a plan file without the motion) or `sines`."""
    trajectory = excitation.trajectory
    if isinstance(trajectory, FourierSeries):
        data = {"joints": list(cell.joint_names)} | trajectory.to_dict()
        return {"sines": data | {name: Angles(data[name]) for name in ("offset", "amplitude")}}
    moves = excitation.moves
    points = excitation.via_points
    assert moves is not None and points is not None
    plan = PlanFile(cell.joint_names, points[0], moves, limits=cell.joint_limits).to_dict()
    plan["start"] = Angles(plan["start"])
    plan["limits"] = {name: Angles(plan["limits"][name]) for name in _LIMITS}
    plan["moves"] = [{**move, "target": Angles(move["target"])} for move in plan["moves"]]
    return {"plan": plan}


def _motion_from_data(data: Mapping[str, Any], fly: float | None) -> dict[str, Any]:
    """Return trajectory, via points, speed and fly as arguments of an `Excitation`."""
    if "sines" in data:
        sines = {name: value for name, value in data["sines"].items() if name != "joints"}
        return {"trajectory": FourierSeries.from_dict(sines)}
    file = PlanFile.from_dict(data["plan"])
    speed = file.moves[0].joint_speed
    if fly is None or speed is None:
        raise ValueError("the moves lack fly or speed")
    points = np.array([file.start, *(move.target for move in file.moves)])
    return {
        "trajectory": in_child(file.plan).trajectory,  # the solver can crash its process
        "via_points": points,
        "speed": np.broadcast_to(np.asarray(speed, dtype=np.float64), points[0].shape).copy(),
        "fly": fly,
    }


def load_design(path: Path, cell: Cell | None = None) -> Excitation:
    """Read the motion of a design from its file or folder, and check that it is for a cell.

    Raises:
        InputError: the file cannot be read, was changed, is for another cell, or its moves plan to
            another motion.
    """
    result = DesignResult.load(path)
    if cell is not None:
        result.require_cell(cell, path)
    return result.excitation


def _positions(trajectory: PiecewiseCubic | FourierSeries) -> Array:
    """Return the positions at some instants from start to end (9, n) [rad]."""
    return trajectory.sample(np.linspace(0.0, trajectory.duration, _COMPARED_INSTANTS))[0]


def _seal(text: str) -> str:
    """Return a digest of the content of a TOML text without its seal."""
    data = tomllib.loads(text, parse_float=str)
    data.pop("seal", None)
    return json_digest(data)
