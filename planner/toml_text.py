"""TOML text from data and back, with angles in degrees that restore the same bits.

A field of `Angles` has a name that ends in `_deg` in the text. (The standard library reads TOML and
does not write it.)
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, time
from decimal import Context, Decimal, InvalidOperation, localcontext
from math import degrees, pi
from typing import Any

_EXACT = Context(prec=60)
_PI = Decimal("3.14159265358979323846264338327950288419716939937510")
_SHORT_DIGITS = 15
_MOST_DIGITS = 20
_SUFFIX = "_deg"


@dataclass(frozen=True)
class Angles:
    """Angles or their rates in rad: a number or nested lists, written in degrees."""

    values: Any


def to_text(data: Mapping[str, Any], comments: Mapping[str, str]) -> str:
    """Return tables, lists of tables, lists, numbers and texts as TOML; None is left out.

    `comments` are lines before the table of each (dotted) name; "" for the first table.
    """
    return "\n".join(_table("", data, comments))


def from_text(text: str) -> dict[str, Any]:
    """Return the data of a TOML text, fields `NAME_deg` as NAME in rad.

    Raises:
        ValueError: the text is not TOML, or an angle is not a number or given twice.
    """
    try:
        data: dict[str, Any] = _read(tomllib.loads(text, parse_float=Decimal))
        return data
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    except InvalidOperation as error:
        raise ValueError("a number is out of range") from error


def _table(path: str, data: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Return the blocks of a table: its fields, then the tables in it."""
    own = {name: value for name, value in data.items() if not _is_table(value)}
    head = "".join(f"# {line}\n" for line in comments.get(path, "").splitlines())
    fields = "".join(_field(name, value) for name, value in own.items() if value is not None)
    blocks = []
    if fields or head or not data:
        blocks.append(f"{head}[{path}]\n{fields}" if path else head + fields)
    for name, value in data.items():
        below = f"{path}.{toml_key(name)}" if path else toml_key(name)
        if isinstance(value, Mapping):
            blocks += _table(below, value, comments)
        elif _is_table(value):
            blocks += [
                f"[[{below}]]\n{''.join(_field(*item) for item in row.items())}" for row in value
            ]
    return blocks


def _is_table(value: Any) -> bool:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return len(value) > 0 and isinstance(value[0], Mapping)
    return isinstance(value, Mapping)


def _field(name: str, value: Any) -> str:
    if isinstance(value, Angles):
        return f"{toml_key(name + _SUFFIX)} = {_degrees(value.values)}\n"
    return f"{toml_key(name)} = {toml_value(value)}\n"


def _degrees(values: Any) -> str:
    if isinstance(values, Sequence):
        return f"[{', '.join(_degrees(entry) for entry in values)}]"
    return degrees_text(values)


def _read(value: Any) -> Any:
    if isinstance(value, list):
        return [_read(entry) for entry in value]
    if not isinstance(value, Mapping):
        return float(value) if isinstance(value, Decimal) else value
    found: dict[str, Any] = {}
    for name, entry in value.items():
        stem = name.removesuffix(_SUFFIX)
        if stem != name and stem in value:
            raise ValueError(f"both {stem!r} and {name!r} are given")
        found[stem] = _read(entry) if stem == name else _radians(name, entry)
    return found


def toml_key(name: str) -> str:
    """Return a key, quoted if necessary."""
    bare = name and all(c.isascii() and (c.isalnum() or c in "_-") for c in name)
    return name if bare else toml_text(name)


def toml_text(value: str) -> str:
    """Return a quoted string."""
    # As in JSON, but without surrogate pairs and with DEL escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any) -> str:
    """Return a number, string, boolean, date, time, list or (inline) table of these.

    Raises:
        TypeError: it is of another type.
    """
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else str(float(value))  # inf, -inf, nan
    if isinstance(value, str):
        return toml_text(value)
    if isinstance(value, Mapping):
        entries = (f"{toml_key(name)} = {toml_value(entry)}" for name, entry in value.items())
        return f"{{ {', '.join(entries)} }}"
    if isinstance(value, Sequence):
        return f"[{', '.join(toml_value(entry) for entry in value)}]"
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, int):  # also bool
        return json.dumps(value)
    raise TypeError(f"TOML has no type for {value!r}")


def radians_of(angle: Decimal | int) -> float:
    """Return an angle in rad from degrees as written."""
    angle = Decimal(angle)
    if len(angle.as_tuple().digits) <= _SHORT_DIGITS or not angle.is_finite():
        return float(angle) * (pi / 180.0)
    with localcontext(_EXACT):
        return float(angle * _PI / 180)


def degrees_text(angle: float) -> str:
    """Return the shortest degrees from which `radians_of` restores this angle [rad]."""
    rounded = repr(float(f"{degrees(angle):.{_SHORT_DIGITS}g}"))
    if _same(radians_of(Decimal(rounded)), angle):
        return rounded
    with localcontext(_EXACT):
        exact = Decimal(angle) * 180 / _PI
    for digits in range(_SHORT_DIGITS + 1, _MOST_DIGITS):
        text = f"{exact:.{digits - 1}e}"
        if _same(radians_of(Decimal(text)), angle):
            return f"{Decimal(text):f}" if 1e-4 < abs(exact) < 1e15 else text
    raise AssertionError(f"{angle!r} rad has no degrees")  # 18 digits suffice for any float


def _same(a: float, b: float) -> bool:
    return a == b and str(a) == str(b)  # str distinguishes -0.0 from 0.0


def _radians(name: str, value: Any) -> Any:
    """Return a number or nested lists of degrees of the field `name` in rad."""
    if isinstance(value, list):
        return [_radians(name, entry) for entry in value]
    if isinstance(value, bool) or not isinstance(value, Decimal | int):
        raise ValueError(f"{name}: {value!r} is not a number of degrees")
    return radians_of(value)
