"""The data of a plan file as TOML for people: angles in degrees, one line per list."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

from planner.decimals import radians_in, without_decimals
from planner.degrees import degrees_text
from planner.errors import InvalidPlanFile
from planner.plain import DAMAGED, table
from planner.toml_value import toml_value

_HEAD = """\
# A motion of joint moves. Names that end in _deg hold degrees, degrees/s, degrees/s^2,
# degrees/s^3; shares of speed and acceleration lie in (0, 1]; a move without fly_percent
# (0 to 100) or fly_distance_deg stops at its target.
"""
_MOTION = """\
# What the moves above were planned to, to the last bit: per joint the times of its knots [s] and
# position, velocity, acceleration, jerk at each (rad, s). After a change above, delete this table.
"""
# Which fields of each table are angles or their rates.
_ANGLES: Mapping[str, frozenset[str]] = {
    "": frozenset({"start"}),
    "limits": frozenset({"lower", "upper", "velocity", "acceleration", "jerk"}),
    "moves": frozenset({"target", "fly_distance"}),
}
_SUFFIX = "_deg"


def to_toml(data: Mapping[str, Any]) -> str:
    """Return the data of a plan file as TOML."""
    parts = [_HEAD + _fields("", {k: v for k, v in data.items() if not _is_table(v)})]
    for name, value in data.items():
        if name == "motion":
            parts.append(f"{_MOTION}[motion]\n{_motion(value)}")
        elif isinstance(value, Mapping):
            parts.append(f"[{name}]\n{_fields(name, value)}")
        elif _is_table(value):
            parts += [f"[[{name}]]\n{_fields(name, row)}" for row in value]
    return "\n".join(parts)


def from_toml(text: str) -> dict[str, Any]:
    """Return the data of a plan file, in SI units, from TOML.

    Raises:
        InvalidPlanFile: the text is not TOML, or an angle is not a number.
    """
    try:
        return _data(tomllib.loads(text, parse_float=Decimal))
    except tomllib.TOMLDecodeError as error:
        raise InvalidPlanFile(f"not TOML: {error}") from error
    except InvalidPlanFile:
        raise
    except DAMAGED as error:
        raise InvalidPlanFile(f"not a plan: {error!r:.200}") from error


def _data(raw: Mapping[str, Any]) -> dict[str, Any]:
    data = _in_si("", {name: value for name, value in raw.items() if not _is_table(value)})
    for name, value in raw.items():
        if isinstance(value, Mapping):
            data[name] = _in_si(name, value)
        elif _is_table(value):
            data[name] = [_in_si(name, table(row)) for row in value]
    return data


def _is_table(value: Any) -> bool:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return len(value) > 0 and isinstance(value[0], Mapping)
    return isinstance(value, Mapping)


def _fields(name_of_table: str, fields: Mapping[str, Any]) -> str:
    angles = _ANGLES.get(name_of_table, frozenset())
    return "".join(
        f"{name}{_SUFFIX} = {_in_degrees(value)}\n"
        if name in angles
        else f"{name} = {toml_value(value)}\n"
        for name, value in fields.items()
    )


def _in_degrees(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(degrees_text(angle) for angle in value)}]"
    return degrees_text(value)


def _motion(data: Mapping[str, Any]) -> str:
    def lines(rows: Sequence[Any], indent: str) -> str:
        return "".join(f"{indent}{toml_value(row)},\n" for row in rows)

    joints = "".join(f"  [\n{lines(rows, '    ')}  ],\n" for rows in data["coefficients"])
    return (
        f"type = {toml_value(data['type'])}\n"
        f"knots = [\n{lines(data['knots'], '  ')}]\n"
        f"coefficients = [\n{joints}]\n"
    )


def _in_si(name_of_table: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    angles = _ANGLES.get(name_of_table, frozenset())
    data: dict[str, Any] = {}
    for name, value in fields.items():
        stem = name.removesuffix(_SUFFIX)
        if stem != name and stem in angles:
            if stem in fields:
                raise InvalidPlanFile(f"both {stem!r} and {name!r} are given")
            try:
                data[stem] = radians_in(name, value)
            except ValueError as error:
                raise InvalidPlanFile(str(error)) from error
        else:
            data[name] = without_decimals(value)
    return data
