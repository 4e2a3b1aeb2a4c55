"""The file a design leaves behind: the motion, how good it is, and all that it came from."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hil.cell import Cell
from hil.errors import InputError
from hil.files import write_atomically
from hil.io import digest, json_digest
from hil.reading import text_of
from hil.version import software
from identification.excitation import (
    Criteria,
    Design,
    Excitation,
    Objective,
    coupling_index_max,
)
from planner import FourierSeries, JointLimits, PiecewiseCubic, PlanFile, PlannerError, in_child
from planner.toml_text import Angles, from_text, to_text

from .settings import RESULT_FORMAT, DesignSettings, SettingsError, settings_of

Array = NDArray[np.float64]

Whole = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
Index = Annotated[float, Field(ge=0.0)]
"""Of coupling."""
Condition = Annotated[float, Field(ge=1.0)]


class _Table(BaseModel):
    """A table of the file: finite numbers, none parsed from a text."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)


class CriteriaTable(_Table):
    """`[criteria]`: see :class:`identification.excitation.Criteria`."""

    log10_det: float
    coupling_index: Index
    fitness: float
    n_samples: Positive
    condition: Condition | None = None
    scaled_condition: Condition | None = None


class SearchTable(_Table):
    """`[search]`: how the motion was found; `parameters` is None for all of the model's."""

    method: str
    seed: Whole
    tried: Whole
    generations: Whole
    n_parameters: Positive
    parameters: list[str] | None = None
    infeasible: dict[str, int]


class FrontTable(_Table):
    """`[front]`: its points, and which of them the motion is; None where it was polished."""

    chosen: int | None = None
    log10_det: list[float]
    coupling_index: list[float]
    duration: list[float]

    @model_validator(mode="after")
    def _alike(self) -> Self:
        if not len(self.log10_det) == len(self.coupling_index) == len(self.duration):
            raise ValueError("its lists are not equally long")
        return self

    @property
    def points(self) -> Array:
        """log10 det, coupling index and duration [s] of each point (k, 3)."""
        columns = (self.log10_det, self.coupling_index, self.duration)
        return np.array(columns, dtype=np.float64).T


class Origin(_Table):
    """`[polished_from]`: the point that a polish began with, and its criteria at 1 ms."""

    point: Whole
    log10_det: float
    coupling_index: Index

    @classmethod
    def of(cls, design: Design) -> Self:
        """Return the origin of a design."""
        one = design.origin_criteria
        return cls(point=design.origin, log10_det=one.log10_det, coupling_index=one.coupling_index)


class _Figures(_Table):
    """The tables whose figures are checked."""

    criteria: CriteriaTable
    search: SearchTable
    front: FrontTable
    polished_from: Origin | None = None


_DIGITS = 16
# What a motion and its criteria are made from. A change of the rest (walls, motors, home) leaves
# them what they are: whether the motion may be sent is checked before it is, in the cell as it is
# then.
DECISIVE = ("urdf", "robot", "limits")


def fingerprint(cell: Cell) -> dict[str, str]:
    """Return a digest of each part of a cell that a design may depend on, by the part's name.

    Tables are compared by content, so that comments, order and spelling of numbers do not count.
    The limits are those in URDF angles.
    """
    limits = cell.joint_limits
    home = cell.file.campaign
    parts: dict[str, Any] = {
        "urdf": cell.urdf,
        "robot": _document(cell.file.robot),
        "limits": {
            name: getattr(limits, name).tolist()
            for name in ("lower", "upper", "velocity", "acceleration", "jerk")
        },
        "torque_limit": None if cell.torque_limit is None else cell.torque_limit.tolist(),
        "drive_train": _document(cell.file.drive_train),
        "nominal": _document(cell.file.nominal),
        "workspace": _document(cell.file.workspace),
        "home": None if home is None else home.home_deg,
    }
    return {name: json_digest(part)[:_DIGITS] for name, part in parts.items()}


def _document(table: BaseModel | None) -> Any:
    return None if table is None else table.model_dump(mode="json")


_ANGLES = ("lower", "upper", "velocity", "acceleration", "jerk")


def motion_data(
    excitation: Excitation, joint_names: Sequence[str], limits: JointLimits
) -> dict[str, Any]:
    """Return the table `plan` (as a plan file has it, without the motion) or `sines`."""
    trajectory = excitation.trajectory
    if isinstance(trajectory, FourierSeries):
        data = {"joints": list(joint_names)} | trajectory.to_dict()
        for name in ("offset", "amplitude"):
            data[name] = Angles(data[name])
        return {"sines": data}
    moves, points = excitation.moves, excitation.via_points
    if moves is None or points is None:
        raise ValueError("a motion in pieces without its moves cannot be written down")
    plan = PlanFile(tuple(joint_names), points[0], moves, limits=limits).to_dict()
    plan["start"] = Angles(plan["start"])
    plan["limits"] = {name: Angles(plan["limits"][name]) for name in _ANGLES}
    plan["moves"] = [{**move, "target": Angles(move["target"])} for move in plan["moves"]]
    return {"plan": plan}


def motion_from_data(data: Mapping[str, Any], fly: float | None) -> dict[str, Any]:
    """Return the trajectory, and what it was planned from, as arguments of an `Excitation`.

    Args:
        data: the whole file, which holds one of the two tables.
        fly: how far corners are rounded, as the settings say.

    Raises:
        KeyError, TypeError, ValueError, PlannerError: the data are no motion.
    """
    if "sines" in data:
        sines = {name: value for name, value in data["sines"].items() if name != "joints"}
        return {"trajectory": FourierSeries.from_dict(sines)}
    file = PlanFile.from_dict(data["plan"])
    speed = file.moves[0].joint_speed
    if fly is None or speed is None:
        raise ValueError("the moves lack fly or speed")
    points = np.array([file.start, *(move.target for move in file.moves)])
    planned = in_child(file.plan)  # the solver can take its process with it
    return {
        "trajectory": planned.trajectory,
        "via_points": points,
        "speed": np.broadcast_to(np.asarray(speed, dtype=np.float64), points[0].shape).copy(),
        "fly": fly,
    }


def joints_of(data: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the joints that a motion is for."""
    return tuple(data["sines" if "sines" in data else "plan"]["joints"])


def motion_digest(trajectory: PiecewiseCubic | FourierSeries) -> str:
    """Return what two motions share only if they are the same to the last bit."""
    return digest(json.dumps(trajectory.to_dict()))


VERSION: Final = 1
RESULT: Final = "excitation.toml"

_FRONT = (
    "Motions of which none is better than another in both, by rising coupling index, as the\n"
    "search sampled them. "
)
_CHOSEN = "chosen, counting from 0, is the motion of this file."
_POLISHED = "The motion of this file is none of them: a polish made it from one, see polished_from."

# Planned on another machine a motion may differ in its last digits, at so many instants by no more.
_SAME = 1e-9  # rad
_INSTANTS = 9
_REMEDY = "design it again (`hil design`)"
_HEAD = """\
# An excitation that `hil design` found. Names that end in _deg hold degrees, degrees/s,
# degrees/s^2, degrees/s^3 of the URDF's angles. `hil demo --excitation` runs it. Do not change
# anything here: the seal at the end would break.
"""
_COMMENTS = {
    "criteria": "Of the motion sampled every millisecond. Compare log10_det only between motions "
    "of one\nrobot in the same units; coupling_index (0 to coupling_index_max) has none.",
    "search": "How it was found. Of the motions tried so many broke a constraint of each kind.",
    "polished_from": "The point of the front, counting from 0, that the motion grew from, and its "
    "criteria by\nthe millisecond.",
    "settings": "As the search was asked; `hil design --settings` takes them from this file.",
    "cell": "The cell it was designed for: its name, and a fingerprint of what the design rests "
    "on.",
    "plan": "The motion: planning these moves gives it to the last bit.",
    "sines": "The motion: offset + ramp x sum of amplitude x sin(frequency x t), rad/s.",
    "earlier": "Archives whose information was added.",
    "seal": "What the lines above and the motion are recognised by.",
}


@dataclass(frozen=True, eq=False)
class DesignResult:
    """What `excitation.toml` says.

    Attributes:
        cell_name: the cell that the motion was designed for.
        cell_parts: digest of each part of its description.
        joint_names: the motion's joints.
        settings: of the design.
        excitation: the motion and its criteria.
        generations: how many generations were finished.
        complete: whether the search came to its end.
        n_parameters: how many parameters were judged.
        parameters: their names, None for all of the model's.
        front: log10 det, coupling index and duration [s] of each point of the front, (k, 3).
        chosen: which point of the front the motion is; None where a polish found a better one.
        polished_from: the point that it grew from then, else None.
        versions: of the software.
        archives: name and SHA-256 of the earlier archives it adds to.
    """

    cell_name: str
    cell_parts: Mapping[str, str]
    joint_names: tuple[str, ...]
    settings: DesignSettings
    excitation: Excitation
    generations: int
    complete: bool
    n_parameters: int
    parameters: tuple[str, ...] | None
    front: Array
    chosen: int | None
    polished_from: Origin | None
    versions: Mapping[str, str]
    archives: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(
        cls,
        cell: Cell,
        settings: DesignSettings,
        design: Design,
        objective: Objective,
        archives: tuple[tuple[str, str], ...] = (),
    ) -> Self:
        """Return the record of a design."""
        names = objective.model.parameter_names
        chosen = objective.parameters
        front = design.front
        return cls(
            cell_name=cell.name,
            cell_parts=fingerprint(cell),
            joint_names=cell.joint_names,
            settings=settings,
            excitation=design.excitation,
            generations=len(design.history),
            complete=design.complete,
            n_parameters=objective.n_parameters,
            parameters=None if chosen is None else tuple(names[k] for k in chosen),
            front=np.column_stack((front.log10_det, front.coupling_index, front.duration)),
            chosen=design.chosen,
            polished_from=None if design.chosen is not None else Origin.of(design),
            versions=software(),
            archives=archives,
        )

    def save(self, path: Path, cell: Cell) -> None:
        """Write the file.

        Raises:
            InputError: it cannot be written.
        """
        front = _FRONT + (_CHOSEN if self.polished_from is None else _POLISHED)
        text = _HEAD + to_text(self._data(cell), {**_COMMENTS, "front": front})
        trajectory = self.excitation.trajectory
        seal = {
            "sha256": _seal(text),
            "motion_sha256": motion_digest(trajectory),
            "positions": Angles(_positions(trajectory).tolist()),
        }
        try:
            write_atomically(path, text + "\n" + to_text({"seal": seal}, _COMMENTS))
        except OSError as error:
            raise InputError(
                path,
                f"the motion is found but cannot be written ({error.strerror})",
                remedy="make room, then repeat the command with --resume: what was scored is in "
                "the journal",
            ) from error

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the file, or that of a folder, and plan its motion again.

        Raises:
            InputError: it cannot be read, was changed, or its motion does not come out again.
        """
        path = path / RESULT if path.is_dir() else path
        try:
            text = text_of(path)
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise InputError(
                path, f"cannot be read ({why})", remedy="name a file that `hil design` wrote"
            ) from error
        try:
            data = from_text(text)
            if data.get("format") != RESULT_FORMAT:
                raise ValueError(f"format is {data.get('format')!r:.60}")
            if data.get("version") != VERSION:
                raise ValueError(f"version is {data.get('version')!r:.60}, this reads {VERSION}")
            seal = data.pop("seal")
            digest, motion = seal["sha256"], seal["motion_sha256"]
            positions = np.array(seal["positions"], dtype=np.float64)
            if digest != _seal(text):
                raise InputError(
                    path, "was changed after it was written", remedy=f"restore it, or {_REMEDY}"
                )
            result = cls._from_data(data)
        except SettingsError as error:
            raise InputError(path, str(error), remedy=_REMEDY) from error
        except ValidationError as error:
            first = error.errors()[0]
            name, *inner = first["loc"] or ("front",)
            rest = (f".{part}" if isinstance(part, str) else f"[{part}]" for part in inner)
            problem = f"is {first['input']!r:.60}, not a figure: {first['msg'].lower()}"
            field = f"{name}{''.join(rest)}"
            raise InputError(path, problem, field=field, remedy=_REMEDY) from error
        except (PlannerError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise InputError(
                path, f"is not a designed excitation ({error})", remedy=_REMEDY
            ) from error
        if motion_digest(result.excitation.trajectory) != motion:
            result._require_alike(path, positions)
        return result

    def require_cell(self, cell: Cell, path: Path) -> None:
        """Refuse a cell whose robot or limits are not those that the motion was designed for.

        Raises:
            InputError: names the two cells and what differs.
        """
        now = fingerprint(cell)
        different = [part for part in DECISIVE if now[part] != self.cell_parts.get(part)]
        if different:
            raise InputError(
                path,
                f"was designed for the cell {self.cell_name!r}, whose {' and '.join(different)} "
                f"{'is' if len(different) == 1 else 'are'} not that of {cell.name!r}",
                field="cell",
                remedy=f"name its own cell, or {_REMEDY}",
            )

    def _require_alike(self, path: Path, positions: Array) -> None:
        """Refuse a motion that is another than the one that was written down."""
        again = _positions(self.excitation.trajectory)
        if positions.shape == again.shape and np.all(np.abs(again - positions) <= _SAME):
            return
        now = software()
        other = [
            f"{k} {v} (here {now.get(k)})" for k, v in self.versions.items() if now.get(k) != v
        ]
        raise InputError(
            path,
            "its moves do not plan to the motion that was designed",
            remedy=f"{_REMEDY}, or use the software it was designed with"
            + (f": {', '.join(other)}" if other else ""),
        )

    def _data(self, cell: Cell) -> dict[str, Any]:
        excitation = self.excitation
        criteria = asdict(excitation.criteria)
        return {
            "format": RESULT_FORMAT,
            "version": VERSION,
            "complete": self.complete,
            "criteria": criteria
            | {
                "coupling_index_max": coupling_index_max(self.n_parameters),
                "duration": float(excitation.trajectory.duration),
            },
            "search": {
                "method": excitation.method,
                "seed": excitation.seed,
                "tried": excitation.tried,
                "generations": self.generations,
                "n_parameters": self.n_parameters,
                "parameters": None if self.parameters is None else list(self.parameters),
                "infeasible": {name: int(n) for name, n in excitation.rejected.items()},
            },
            "front": {
                "chosen": self.chosen,
                "log10_det": self.front[:, 0].tolist(),
                "coupling_index": self.front[:, 1].tolist(),
                "duration": self.front[:, 2].tolist(),
            },
            **({"polished_from": self.polished_from.model_dump()} if self.polished_from else {}),
            "settings": self.settings.to_dict(),
            **(
                {"earlier": {"archives": [list(a) for a in self.archives]}} if self.archives else {}
            ),
            "cell": {"name": self.cell_name, **self.cell_parts},
            "software": dict(self.versions),
            **motion_data(excitation, self.joint_names, cell.joint_limits),
        }

    @classmethod
    def _from_data(cls, data: Mapping[str, Any]) -> Self:
        settings = settings_of(data["settings"])
        figures = _Figures.model_validate(
            {name: data[name] for name in _Figures.model_fields if name in data}
        )
        search, via = figures.search, settings.via_points
        excitation = Excitation(
            criteria=Criteria(**figures.criteria.model_dump()),
            method=search.method,
            seed=search.seed,
            tried=search.tried,
            rejected=search.infeasible,
            **motion_from_data(data, None if via is None else via.fly),
        )
        return cls(
            cell_name=data["cell"]["name"],
            cell_parts={name: part for name, part in data["cell"].items() if name != "name"},
            joint_names=joints_of(data),
            settings=settings,
            excitation=excitation,
            generations=search.generations,
            complete=data["complete"],
            n_parameters=search.n_parameters,
            parameters=None if search.parameters is None else tuple(search.parameters),
            front=figures.front.points,
            chosen=figures.front.chosen,
            polished_from=figures.polished_from,
            versions=data["software"],
            archives=tuple(
                (name, digest) for name, digest in data.get("earlier", {}).get("archives", ())
            ),
        )


def load_design(path: Path, cell: Cell | None = None) -> Excitation:
    """Read the motion of a design, from its file or folder, with its criteria.

    Args:
        path: `excitation.toml`, or the folder it lies in.
        cell: for which it must have been designed; None for any.

    Raises:
        InputError: the file cannot be read, was changed, is for another cell, or its motion does
            not come out again.
    """
    result = DesignResult.load(path)
    if cell is not None:
        result.require_cell(cell, path)
    return result.excitation


def _positions(trajectory: PiecewiseCubic | FourierSeries) -> Array:
    """Return where the motion is at some instants from beginning to end (9, n) [rad]."""
    return trajectory.sample(np.linspace(0.0, trajectory.duration, _INSTANTS))[0]


def _seal(text: str) -> str:
    """Return a digest of what a text says; comments, blanks and the seal itself do not count."""
    data = tomllib.loads(text, parse_float=str)
    data.pop("seal", None)
    return json_digest(data)
