"""The file a design leaves behind: the motion, how good it is, and all that it came from."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, Self

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

VERSION: Final = 1
RESULT: Final = "excitation.toml"
DECISIVE: Final = ("urdf", "robot", "limits")
"""What a motion and its criteria are made from. A change of the rest (walls, motors, home) leaves
them what they are: whether the motion may be sent is checked before it is, in the cell as it is
then."""

_DIGITS: Final = 16
# Planned on another machine a motion may differ in its last digits, at so many instants by no more.
_SAME: Final = 1e-9  # rad
_INSTANTS: Final = 9
_REMEDY: Final = "design it again (`hil design`)"
_HEAD: Final = """\
# An excitation that `hil design` found. Names that end in _deg hold degrees, degrees/s,
# degrees/s^2, degrees/s^3 of the URDF's angles. `hil demo --excitation` runs it. Do not change
# anything here: the seal at the end would break.
"""
_FRONT: Final = (
    "Motions of which none is better than another in both, by rising coupling index, as the\n"
    "search sampled them. "
)
_CHOSEN: Final = "chosen, counting from 0, is the motion of this file."
_POLISHED: Final = (
    "The motion of this file is none of them: a polish made it from one, see polished_from."
)
_COMMENTS: Final = {
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


class Origin(_Table):
    """`[polished_from]`: the point that a polish began with, and its criteria at 1 ms."""

    point: Whole
    log10_det: float
    coupling_index: Index


class _Figures(_Table):
    """The tables whose figures are checked."""

    criteria: CriteriaTable
    search: SearchTable
    front: FrontTable
    polished_from: Origin | None = None


def fingerprint(cell: Cell) -> dict[str, str]:
    """Return a digest of each part of a cell that a design may depend on, by the part's name.

    Tables are compared by content, so that comments, order and spelling of numbers do not count.
    The limits are those in URDF angles.
    """
    file, limits, home = cell.file, cell.joint_limits, cell.file.campaign
    tables: dict[str, BaseModel | None] = {
        "robot": file.robot,
        "drive_train": file.drive_train,
        "nominal": file.nominal,
        "workspace": file.workspace,
    }
    documents = {k: None if v is None else v.model_dump(mode="json") for k, v in tables.items()}
    parts: dict[str, Any] = {
        "urdf": cell.urdf,
        "robot": documents["robot"],
        "limits": {name: getattr(limits, name).tolist() for name in _ANGLES},
        "torque_limit": None if cell.torque_limit is None else cell.torque_limit.tolist(),
        **documents,
        "home": None if home is None else home.home_deg,
    }
    return {name: json_digest(part)[:_DIGITS] for name, part in parts.items()}


_ANGLES: Final = ("lower", "upper", "velocity", "acceleration", "jerk")


def _motion_data(
    excitation: Excitation, joint_names: Sequence[str], limits: JointLimits
) -> dict[str, Any]:
    """Return the table `plan` (as a plan file has it, without the motion) or `sines`."""
    trajectory = excitation.trajectory
    if isinstance(trajectory, FourierSeries):
        data = {"joints": list(joint_names)} | trajectory.to_dict()
        return {"sines": data | {name: Angles(data[name]) for name in ("offset", "amplitude")}}
    moves, points = excitation.moves, excitation.via_points
    if moves is None or points is None:
        raise ValueError("a motion in pieces without its moves cannot be written down")
    plan = PlanFile(tuple(joint_names), points[0], moves, limits=limits).to_dict()
    plan["start"] = Angles(plan["start"])
    plan["limits"] = {name: Angles(plan["limits"][name]) for name in _ANGLES}
    plan["moves"] = [{**move, "target": Angles(move["target"])} for move in plan["moves"]]
    return {"plan": plan}


def _motion_from_data(data: Mapping[str, Any], fly: float | None) -> dict[str, Any]:
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
    return {
        "trajectory": in_child(file.plan).trajectory,  # the solver can take its process with it
        "via_points": points,
        "speed": np.broadcast_to(np.asarray(speed, dtype=np.float64), points[0].shape).copy(),
        "fly": fly,
    }


def _motion_digest(trajectory: PiecewiseCubic | FourierSeries) -> str:
    """Return what two motions share only if they are the same to the last bit."""
    return digest(json.dumps(trajectory.to_dict()))


@dataclass(frozen=True, eq=False)
class DesignResult:
    """What `excitation.toml` says.

    Attributes:
        cell_name: the cell that the motion was designed for.
        cell_parts: digest of each part of its description.
        joint_names: the motion's joints.
        settings: of the design.
        excitation: the motion and its criteria.
        complete: whether the search came to its end.
        search: how the motion was found.
        front: points of which none is better than another in both criteria.
        polished_from: the point that the motion grew from, if it is none of them.
        versions: of the software.
        archives: name and SHA-256 of the earlier archives it adds to.
    """

    cell_name: str
    cell_parts: Mapping[str, str]
    joint_names: tuple[str, ...]
    settings: DesignSettings
    excitation: Excitation
    complete: bool
    search: SearchTable
    front: FrontTable
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
        names, judged, front = objective.model.parameter_names, objective.parameters, design.front
        excitation, grown = design.excitation, design.origin_criteria
        return cls(
            cell_name=cell.name,
            cell_parts=fingerprint(cell),
            joint_names=cell.joint_names,
            settings=settings,
            excitation=excitation,
            complete=design.complete,
            # As it is: what could not be read back is refused where it is read.
            search=SearchTable.model_construct(
                method=excitation.method,
                seed=excitation.seed,
                tried=excitation.tried,
                generations=len(design.history),
                n_parameters=objective.n_parameters,
                parameters=None if judged is None else [names[k] for k in judged],
                infeasible={name: int(n) for name, n in excitation.rejected.items()},
            ),
            front=FrontTable.model_construct(
                chosen=design.chosen,
                log10_det=np.asarray(front.log10_det).tolist(),
                coupling_index=np.asarray(front.coupling_index).tolist(),
                duration=np.asarray(front.duration).tolist(),
            ),
            polished_from=None
            if design.chosen is not None
            else Origin(
                point=design.origin,
                log10_det=grown.log10_det,
                coupling_index=grown.coupling_index,
            ),
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
            "motion_sha256": _motion_digest(trajectory),
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
            for key, known in (("format", RESULT_FORMAT), ("version", VERSION)):
                if data.get(key) != known:
                    raise ValueError(f"{key} is {data.get(key)!r:.60}, this reads {known!r}")
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
            raise InputError(
                path, problem, field=f"{name}{''.join(rest)}", remedy=_REMEDY
            ) from error
        except (PlannerError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise InputError(
                path, f"is not a designed excitation ({error})", remedy=_REMEDY
            ) from error
        if _motion_digest(result.excitation.trajectory) != motion:
            result._require_alike(path, positions)
        return result

    def require_cell(self, cell: Cell, path: Path, parts: Sequence[str] = DECISIVE) -> None:
        """Refuse a cell whose robot or limits are not those that the motion was designed for.

        Raises:
            InputError: names the two cells and what differs.
        """
        now = fingerprint(cell)
        different = [part for part in parts if now[part] != self.cell_parts.get(part)]
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
        again, now = _positions(self.excitation.trajectory), software()
        if positions.shape == again.shape and np.all(np.abs(again - positions) <= _SAME):
            return
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
        excitation, optional = self.excitation, dict[str, Any]()
        if self.polished_from is not None:
            optional["polished_from"] = self.polished_from.model_dump()
        optional["settings"] = self.settings.to_dict()
        if self.archives:
            optional["earlier"] = {"archives": [list(one) for one in self.archives]}
        bounds = {
            "coupling_index_max": coupling_index_max(self.search.n_parameters),
            "duration": float(excitation.trajectory.duration),
        }
        return {
            "format": RESULT_FORMAT,
            "version": VERSION,
            "complete": self.complete,
            "criteria": asdict(excitation.criteria) | bounds,
            "search": self.search.model_dump(),
            "front": self.front.model_dump(),
            **optional,
            "cell": {"name": self.cell_name, **self.cell_parts},
            "software": dict(self.versions),
            **_motion_data(excitation, self.joint_names, cell.joint_limits),
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
            **_motion_from_data(data, None if via is None else via.fly),
        )
        earlier = data.get("earlier", {}).get("archives", ())
        return cls(
            cell_name=data["cell"]["name"],
            cell_parts={name: part for name, part in data["cell"].items() if name != "name"},
            joint_names=tuple(data["sines" if "sines" in data else "plan"]["joints"]),
            settings=settings,
            excitation=excitation,
            complete=data["complete"],
            search=search,
            front=figures.front,
            polished_from=figures.polished_from,
            versions=data["software"],
            archives=tuple((name, digest) for name, digest in earlier),
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


# Earlier designs beside a new one


class References(NamedTuple):
    """Designs to compare with.

    Attributes:
        measures: (log10 det, coupling index) of each, by name.
        kinematic: names of those that were searched without looking at everything.
    """

    measures: dict[str, tuple[float, float]]
    kinematic: frozenset[str]


def references(
    paths: Sequence[Path], cell: Cell, settings: DesignSettings, *, together: bool
) -> References:
    """Return earlier designs whose numbers mean what those of a new one are going to mean.

    Args:
        paths: their files or folders.
        cell: of the new design.
        settings: of the new design.
        together: whether it adds to earlier archives.

    Raises:
        InputError: a file cannot be read, or its numbers must not be compared.
    """
    option = "--compare"
    if paths and together:
        raise InputError(
            None,
            "would be compared with what --earlier adds up, weighted, over all archives",
            field=option,
            remedy="leave out one of the two",
        )
    measures: dict[str, tuple[float, float]] = {}
    kinematic = set()
    for path in paths:
        result = DesignResult.load(path)
        result.require_cell(cell, path, ("urdf", "robot"))
        if result.archives:
            raise InputError(
                path,
                "was designed with --earlier: its numbers are of all archives together, weighted, "
                "not of its motion alone",
                field=option,
                remedy="name designs made without --earlier",
            )
        every = ["payload"], [*cell.model.parameter_names]
        ours, theirs = (
            set(every[0] if asked == "payload" else every[1] if named is None else named)
            for asked, named in (
                (settings.objective.parameters, settings.objective.named),
                (result.settings.objective.parameters, result.search.parameters),
            )
        )
        if ours != theirs:
            raise InputError(
                path,
                f"was judged by {len(theirs)} parameters, this design by {len(ours)}, of which "
                f"{len(ours & theirs)} are the same",
                field=option,
                remedy="name designs with the same [objective]",
            )
        method = result.excitation.method
        name = f"method {method.upper()}" if len(method) == 1 else method
        name = f"{name} ({path})" if name in measures else name
        criteria = result.excitation.criteria
        measures[name] = criteria.log10_det, criteria.coupling_index
        if result.settings.unchecked:
            kinematic.add(name)
    return References(measures, frozenset(kinematic))
