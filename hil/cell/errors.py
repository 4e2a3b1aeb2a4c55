"""Errors of cell files; `"?"` marks unknown values, and a file with one is refused."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

from pydantic import BaseModel, ValidationError

from hil.base.errors import InputError
from hil.cell.field_error import FieldError


class CellError(InputError):
    """The cell file is invalid.

    Args:
        path: the cell file.
        field: dotted name; "" for the whole file.
        value: the invalid one.
        problem: what is wrong, as a clause.
        remedy: what to do.
    """

    def __init__(self, path: Path, field: str, value: object, problem: str, remedy: str) -> None:
        self.value = value
        given = "" if value is None else f" = {_short(value)}"
        super().__init__(path, problem, field=f"{field}{given}", remedy=remedy)
        self.field = field


def first_error(
    path: Path,
    error: ValidationError,
    schema: type[BaseModel],
    *,
    documentation: str = "docs/cell-file.md",
) -> CellError:
    """Convert the first error of pydantic.

    Args:
        path: of the file.
        error: of pydantic.
        schema: of the file.
        documentation: named for undescribed fields.
    """
    detail = error.errors(include_url=False)[0]
    place = _place(schema, detail["loc"])
    value = detail["input"]
    kind = detail["type"]
    if kind.startswith("union_tag"):
        given = value.get("kind") if isinstance(value, dict) else None
        problem = "is missing" if given is None else "is unknown"
        remedy = f"the list must be {place.description}"
        return CellError(path, f"{place.name}.kind", given, problem, remedy)
    if kind == "missing":
        remedy = f"add it: {place.description or f'see {documentation}'}"
        return CellError(path, place.name, None, "is missing", remedy)
    if kind == "extra_forbidden":
        remedy = f"valid fields: {', '.join(place.siblings)}"
        return CellError(path, place.name, value, "is not a field", remedy)
    cause = detail.get("ctx", {}).get("error")
    problem = str(cause or detail["msg"])
    remedy = ""
    if isinstance(cause, FieldError):
        problem = cause.problem
        remedy = cause.remedy
    problem = problem[0].lower() + problem[1:]
    remedy = remedy or (f"it must be {place.description}" if place.description else "")
    remedy = remedy or f"see {documentation}"
    return CellError(path, place.name, None if isinstance(value, dict) else value, problem, remedy)


class _Place(NamedTuple):
    """A field: dotted name, valid values or "", and the fields of its table."""

    name: str
    description: str
    siblings: list[str]


def _place(schema: type[BaseModel], location: Sequence[str | int]) -> _Place:
    """Convert a location of pydantic, without its names of kinds and unions."""
    name = ""
    description = ""
    models = [schema]
    siblings = list[str]()
    for part in location:
        of_kind = [model for model in models if part in _kinds(model)]
        if of_kind or (isinstance(part, str) and ("[" in part or part in _UNION_TAGS)):
            models = of_kind or models
            continue
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else part
        fields = models[0].model_fields if models else {}
        siblings = sorted(fields)
        if isinstance(part, str) and part in fields:
            models = list(models_of(fields[part].annotation))
            description = fields[part].description or (f"a table [{part}]" if models else "")
    return _Place(name, description, siblings)


_UNION_TAGS: Final = {"none", "str", "list", "float", "constrained-int"}


def _kinds(model: type[BaseModel]) -> tuple[object, ...]:
    return get_args(model.model_fields["kind"].annotation) if "kind" in model.model_fields else ()


def models_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in an annotation, such as a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_of(part)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


UNKNOWN: Final = "?"

WHERE: Final[Mapping[str, str]] = {
    "cell.mesh_folders": "for package://NAME/... the folder that contains NAME. Without the meshes "
    "write []: only a design with collision = false in its [constraints] works then",
    "limits.lower_deg": "data sheet, or the controller's stroke ends ($STRK_END_N)",
    "limits.upper_deg": "data sheet, or the controller's stroke ends ($STRK_END_P)",
    "limits.velocity_deg": "data sheet, largest joint speeds",
    "limits.acceleration_deg": "data sheet or manufacturer; rarely published. Else assume full "
    "speed in 0.3 s, and list the field in cell.assumed",
    "limits.jerk_deg": "manufacturer; rarely published. Else assume full acceleration in 0.1 s, "
    "and list the field in cell.assumed",
    "nominal.rotor_inertia": "data sheet of the motors, times the square of the gear ratio",
    "nominal.coulomb": "manufacturer. Else assume 5 to 10 % of the largest torque of the joint, "
    "and list the field in cell.assumed",
    "nominal.viscous": "manufacturer. Else assume a value that equals Coulomb friction at full "
    "speed, and list the field in cell.assumed",
    "drive_train.gear_ratio": "the controller's init packet (hil new --from-controller)",
    "drive_train.calibration": "the controller's init packet (hil new --from-controller)",
    **dict.fromkeys(
        ("drive_train.k54", "drive_train.k64", "drive_train.k65"),
        "the controller's init packet; 0.0 without wrist coupling",
    ),
    "drive_train.joint_sign": "jog each joint by a few degrees: 1 if the angle of the pendant "
    "increases for a positive rotation about the axis of the URDF, else -1. With a wrong sign "
    "the arm moves in the opposite direction, and no check applies to its motion",
    "drive_train.joint_offset_deg": "reading of the pendant with all URDF angles at zero",
    "drive_train.torque_constant": "plates or data sheets of the motors, or hil torque-constants "
    "with a known payload",
    "drive_train.current_limit": "the controller's init packet (hil new --from-controller)",
    "drive_train.following_error": "the controller's init packet (hil new --from-controller)",
    "drive_train.encoder_counts_per_revolution": "data sheets of the motors",
    "controller.cycle_ms": "setting of the Open option of the controller",
    "controller.host": "address of the sending board of the controller, by default 10.2.12.150",
    "workspace.floor": "height of the floor above the base frame, negative on a pedestal",
    "workspace.walls": "measure all obstacles in reach; [] if there are none",
    "campaign.home_deg": "a posture with clearance in all directions",
}
"""Source of the value of each field."""
_AT_REST: Final = (
    "the arm: hil new --controller ur, while it rests in a posture in which gravity loads every "
    "joint but the first"
)
_WHERE_OF_UR: Final = {
    "drive_train.torque_constant": f"{_AT_REST}; or hil torque-constants with a known payload",
    "drive_train.current_limit": f"{_AT_REST}: largest torques of its type by torque constants",
}
"""The same of an arm of Universal Robots, where it differs."""


class UnknownFieldsError(CellError):
    """The cell file contains unknown values in `fields`, their dotted names."""

    def __init__(self, path: Path, fields: Mapping[str, str]) -> None:
        self.fields = tuple(fields)
        lines = "".join(f"\n  {name}: {text}" for name, text in fields.items())
        count = f"{len(fields)} fields" if len(fields) > 1 else "one field"
        super().__init__(path, "", None, f'{count} unknown ("{UNKNOWN}")', f"fill in:{lines}")


def require_known(path: Path, raw: Mapping[str, Any], schema: type[BaseModel]) -> None:
    """Refuse a file with unknown values (`"?"`): UnknownFieldsError with all of them."""
    fields: dict[str, str] = {}
    controller = raw.get("controller")
    is_ur = isinstance(controller, Mapping) and controller.get("transport") == "rtde"
    sources = {**WHERE, **(_WHERE_OF_UR if is_ur else {})}
    for location, places in _unknown(raw, ()):
        name = ".".join(location)
        which = f" (entry {', '.join(map(str, places))})" if places else ""
        where = f"; {sources[name]}" if name in sources else ""
        fields[name + which] = _place(schema, location).description + where
    if fields:
        raise UnknownFieldsError(path, fields)


def _unknown(
    table: Mapping[str, Any], above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], list[int]]]:
    """Yield unknown fields with the unknown entries of a list, from 1; [] for all."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _unknown(value, (*above, key))
        elif value == UNKNOWN:
            yield (*above, key), []
        elif isinstance(value, list):
            places = [place for place, entry in enumerate(value, 1) if entry == UNKNOWN]
            if places:
                yield (*above, key), [] if len(places) == len(value) else places
