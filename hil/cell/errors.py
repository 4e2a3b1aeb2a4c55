"""What a bad cell file gets: one sentence with file, field, value and remedy.

`hil new` writes `"?"` where neither the URDF nor the controller says anything. A cell file that
still has one cannot be used: nothing is assumed in its place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

from pydantic import BaseModel, ValidationError

from hil.errors import InputError


class CellError(InputError):
    """The cell file cannot be used.

    Attributes:
        path: the file.
        field: dotted name of the field, or "" for the file as a whole.
        value: what stood there (None if nothing did).
    """

    def __init__(self, path: Path, field: str, value: object, problem: str, remedy: str) -> None:
        self.value = value
        found = "" if value is None else f" = {_short(value)}"
        super().__init__(path, problem, field=f"{field}{found}", remedy=remedy)
        self.field = field


def first_error(path: Path, error: ValidationError, schema: type[BaseModel]) -> CellError:
    """The first complaint of pydantic, in our words."""
    detail = error.errors(include_url=False)[0]
    place, value, kind = _place(schema, detail["loc"]), detail["input"], detail["type"]
    if kind.startswith("union_tag"):
        given = value.get("kind") if isinstance(value, dict) else None
        problem = "is missing" if given is None else "is not a kind that is known here"
        remedy = f"the list must be {place.description}"
        return CellError(path, f"{place.name}.kind", given, problem, remedy)
    if kind == "missing":
        return CellError(path, place.name, None, "is missing", f"add it: {place.description}")
    if kind == "extra_forbidden":
        remedy = f"known are: {', '.join(place.siblings)}"
        return CellError(path, place.name, value, "is not a field that is known here", remedy)
    problem, _, remedy = detail["msg"].removeprefix("Value error, ").partition("; ")
    problem = problem[0].lower() + problem[1:]
    remedy = remedy or f"it must be {place.description}"
    return CellError(path, place.name, None if isinstance(value, dict) else value, problem, remedy)


class _Place(NamedTuple):
    """A field by its dotted name, what it must be, and the fields of its table."""

    name: str
    description: str
    siblings: list[str]


def _place(schema: type[BaseModel], location: Sequence[str | int]) -> _Place:
    """Where a location of pydantic leads; its own names of kinds and unions are left out."""
    name, description = "", "as the documentation of the cell file says"
    models, siblings = [schema], list[str]()
    for part in location:
        of_kind = [model for model in models if part in _kinds(model)]
        if of_kind or (isinstance(part, str) and ("[" in part or part in _UNION_TAGS)):
            models = of_kind or models
            continue
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else part
        fields = models[0].model_fields if models else {}
        siblings = sorted(fields)
        if isinstance(part, str) and part in fields:
            description = fields[part].description or f"a table [{part}]"
            models = list(_models_of(fields[part].annotation))
    return _Place(name, description, siblings)


_UNION_TAGS: Final = {"none", "str", "list", "float"}


def _kinds(model: type[BaseModel]) -> tuple[object, ...]:
    return get_args(model.model_fields["kind"].annotation) if "kind" in model.model_fields else ()


def _models_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Every model within an annotation, such as those of a list of several kinds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models_of(part)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


UNKNOWN: Final = "?"

WHERE: Final[Mapping[str, str]] = {
    "cell.mesh_folders": "find the folder in which the package:// paths of the URDF's meshes begin",
    "limits.lower_deg": "data sheet, or the controller's stroke ends ($STRK_END_N)",
    "limits.upper_deg": "data sheet, or the controller's stroke ends ($STRK_END_P)",
    "limits.velocity_deg": "data sheet, largest joint speeds",
    "limits.acceleration_deg": "data sheet or the maker; rarely published. Full speed in 0.3 s is "
    "a fair start, and then an assumption: name the field in cell.assumed",
    "limits.jerk_deg": "the maker; rarely published. Full acceleration in 0.1 s is a fair start, "
    "and then an assumption: name the field in cell.assumed",
    "nominal.rotor_inertia": "the motors' data sheet, times the square of the gear ratio",
    "nominal.coulomb": "the maker; without a figure 5 to 10 % of the joint's largest torque, and "
    "then an assumption: name the field in cell.assumed",
    "nominal.viscous": "the maker; without a figure what adds as much again at full speed as "
    "Coulomb friction, and then an assumption: name the field in cell.assumed",
    "drive_train.gear_ratio": "the controller's init packet (hil new --from-controller)",
    "drive_train.calibration": "the controller's init packet (hil new --from-controller)",
    "drive_train.k54": "the controller's init packet; 0.0 where motors do not turn together",
    "drive_train.k64": "the controller's init packet; 0.0 where motors do not turn together",
    "drive_train.k65": "the controller's init packet; 0.0 where motors do not turn together",
    "drive_train.joint_sign": "jog each joint by a few degrees: 1 where the pendant's angle grows "
    "while the arm turns about the URDF's axis by the right-hand rule, else -1",
    "drive_train.joint_offset_deg": "put the arm where all angles of the URDF are zero and read "
    "the pendant",
    "drive_train.torque_constant": "the motors' plates or data sheets; or hil gains, with a known "
    "load",
    "drive_train.current_limit": "the controller's init packet (hil new --from-controller)",
    "drive_train.following_error": "the controller's init packet (hil new --from-controller)",
    "drive_train.encoder_counts_per_revolution": "the motors' data sheets",
    "controller.cycle_ms": "what the controller's Open option was set to",
    "controller.host": "the address of the controller's board that sends, 10.2.12.150 as delivered",
    "workspace.floor": "height of the floor over the robot's base frame, negative on a pedestal",
    "workspace.walls": "measure all that the arm can reach; [] where there is nothing",
    "campaign.home_deg": "a posture with room in all directions",
}
"""Where each figure is found, by field."""


class UnknownFieldsError(CellError):
    """A cell file in which values are still to be filled in.

    Attributes:
        fields: their dotted names.
    """

    def __init__(self, path: Path, fields: Mapping[str, str]) -> None:
        self.fields = tuple(fields)
        lines = "".join(f"\n  {name}: {text}" for name, text in fields.items())
        count = f"{len(fields)} fields" if len(fields) > 1 else "one field"
        super().__init__(
            path, "", None, f'{count} still unknown ("{UNKNOWN}")', f"fill in what is true:{lines}"
        )


def require_known(path: Path, raw: Mapping[str, Any], schema: type[BaseModel]) -> None:
    """Refuse a file in which a value is `"?"`, by the names of all such fields at once.

    Raises:
        UnknownFieldsError: each field with what it must be and where that is found.
    """
    fields: dict[str, str] = {}
    for location, places in _unknown(raw, ()):
        name = ".".join(location)
        which = f" (entry {', '.join(map(str, places))})" if places else ""
        where = f"; {WHERE[name]}" if name in WHERE else ""
        fields[name + which] = _place(schema, location).description + where
    if fields:
        raise UnknownFieldsError(path, fields)


def _unknown(
    table: Mapping[str, Any], above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], list[int]]]:
    """Fields that are unknown, each with the entries of its list that are, from 1; [] for all."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _unknown(value, (*above, key))
        elif value == UNKNOWN:
            yield (*above, key), []
        elif isinstance(value, list):
            places = [place for place, entry in enumerate(value, 1) if entry == UNKNOWN]
            if places:
                yield (*above, key), [] if len(places) == len(value) else places
