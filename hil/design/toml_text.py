"""Plain data as TOML for people, to the last bit: angles in degrees, one line per list.

A field of angles is an `Angles` in the data and a name that ends in `_deg` in the text.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any

from planner.decimals import degrees_text, radians_in, without_decimals
from planner.toml_value import toml_key, toml_value

_SUFFIX = "_deg"


@dataclass(frozen=True)
class Angles:
    """Angles or their rates in rad (s), a number or nested lists, which the text has in degrees."""

    values: Any


def to_text(data: Mapping[str, Any], comments: Mapping[str, str]) -> str:
    """Return data as TOML.

    Args:
        data: tables, lists of tables, lists, numbers, texts; None is left out.
        comments: a line that is to stand before the table of that (dotted) name.
    """
    return "\n".join(_table("", data, comments))


def from_text(text: str) -> dict[str, Any]:
    """Return the data of a TOML text, angles in rad under their name without `_deg`.

    Raises:
        ValueError: the text is not TOML, or an angle is no number.
    """
    try:
        return dict(_items(tomllib.loads(text, parse_float=Decimal)))
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    except InvalidOperation as error:
        raise ValueError("it has a number beyond all bounds") from error


def _table(path: str, data: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Return the blocks of a table: its own fields first, then those of the tables in it."""
    own = {name: value for name, value in data.items() if not _is_table(value)}
    head = f"# {comments[path]}\n" if path in comments else ""
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


def _items(table: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [
        (name.removesuffix(_SUFFIX), radians_in(name, value))
        if name.endswith(_SUFFIX)
        else (name, _below(value))
        for name, value in table.items()
    ]


def _below(value: Any) -> Any:
    """Return a value in which tables may be, and in them angles."""
    if isinstance(value, Mapping):
        return dict(_items(value))
    if isinstance(value, list):
        return [_below(entry) for entry in value]
    return without_decimals(value)
