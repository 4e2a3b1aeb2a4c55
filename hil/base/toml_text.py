"""TOML text of data, and data of such a text, with angles in degrees that restore the same bits.

A field of `Angles` has a name that ends in `_deg` in the text. tomlkit writes the text; the
standard library, which only reads, reads it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Context, Decimal, InvalidOperation, localcontext
from math import degrees, pi
from typing import Any

import tomlkit
from tomlkit.container import Container
from tomlkit.items import AoT, Comment, Item, Table, Trivia

_DECIMAL_CONTEXT = Context(prec=60)
_PI = Decimal("3.14159265358979323846264338327950288419716939937510")
_SHORT_DIGITS = 15
_MAX_DIGITS = 20
_SUFFIX = "_deg"


@dataclass(frozen=True)
class Angles:
    """Angles or their rates in rad: a number or nested lists, written in degrees."""

    values: Any


def to_text(data: Mapping[str, Any], comments: Mapping[str, str] | None = None) -> str:
    """Return tables, lists of tables, lists, numbers and texts as TOML; None is left out.

    `comments` are lines below the header of each (dotted) table; "" for the top of the text.

    Raises:
        TypeError: a value is of a type that TOML does not have.
    """
    document = tomlkit.document()
    _fill(document, "", data, comments or {})
    return tomlkit.dumps(document)


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


def inline(value: Any) -> Item:
    """Return a value as TOML without header lines: a table is written between braces."""
    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        table.update({name: inline(entry) for name, entry in value.items()})
        return table
    if isinstance(value, Sequence) and not isinstance(value, str):
        array = tomlkit.array()
        array.extend(inline(entry) for entry in value)
        return array
    item: Item = tomlkit.item(value)
    return item


def comment_lines(text: str) -> list[Comment]:
    """Return the lines of a text as comments."""
    return [
        Comment(Trivia(comment_ws="", comment=f"# {line}".rstrip())) for line in text.splitlines()
    ]


def _fill(
    container: Container | Table, path: str, data: Mapping[str, Any], comments: Mapping[str, str]
) -> None:
    """Add comments and entries of a table, then the tables in it."""
    for line in comment_lines(comments.get(path, "")):
        container.add(line)
    stated = {name: value for name, value in data.items() if value is not None}
    tables = {name: value for name, value in stated.items() if _is_table(value)}
    for name, value in stated.items():
        if isinstance(value, Angles):
            container.append(name + _SUFFIX, tomlkit.value(_degrees(value.values)))
        elif name not in tables:
            container.append(name, inline(value))
    for name, value in tables.items():
        below = f"{path}.{name}" if path else name
        if isinstance(value, Mapping):
            container.append(name, _table(below, value, comments))
        else:
            container.append(name, AoT([_table(below, row, {}) for row in value]))


def _table(path: str, data: Mapping[str, Any], comments: Mapping[str, str]) -> Table:
    table = tomlkit.table()
    _fill(table, path, data, comments)
    return table


def _is_table(value: Any) -> bool:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return len(value) > 0 and all(isinstance(row, Mapping) for row in value)
    return isinstance(value, Mapping)


def _degrees(values: Any) -> str:
    if isinstance(values, Sequence):
        return f"[{', '.join(_degrees(entry) for entry in values)}]"
    return degrees_text(values)


def _read(value: Any) -> Any:
    if isinstance(value, list):
        return [_read(entry) for entry in value]
    if not isinstance(value, Mapping):
        return float(value) if isinstance(value, Decimal) else value
    table: dict[str, Any] = {}
    for name, entry in value.items():
        stem = name.removesuffix(_SUFFIX)
        if stem != name and stem in value:
            raise ValueError(f"both {stem!r} and {name!r} are given")
        table[stem] = _read(entry) if stem == name else _radians(name, entry)
    return table


def radians_of(angle: Decimal | int) -> float:
    """Return an angle in rad from degrees as written."""
    angle = Decimal(angle)
    if len(angle.as_tuple().digits) <= _SHORT_DIGITS or not angle.is_finite():
        return float(angle) * (pi / 180.0)
    with localcontext(_DECIMAL_CONTEXT):
        return float(angle * _PI / 180)


def degrees_text(angle: float) -> str:
    """Return the shortest degrees from which `radians_of` restores this angle [rad]."""
    rounded = repr(float(f"{degrees(angle):.{_SHORT_DIGITS}g}"))
    if _same(radians_of(Decimal(rounded)), angle):
        return rounded
    with localcontext(_DECIMAL_CONTEXT):
        exact = Decimal(angle) * 180 / _PI
    for digits in range(_SHORT_DIGITS + 1, _MAX_DIGITS):
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
