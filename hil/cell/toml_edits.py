"""Changes of entries in the text of a TOML file, and limits in a URDF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array as List
from tomlkit.items import Item, Table

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import inline
from identification.model.urdf_text import urdf_tree


def with_values(text: str, values: Mapping[str, Any]) -> str:
    """Set values in a TOML text, such as ``{"campaign.repetitions": 3}``; None changes nothing.

    Comments, order and layout of all else are preserved, in a list of the same length also those
    between its entries; missing tables and entries are added.

    Raises:
        TypeError: a value is of a type that TOML does not have.
        InputError: the layout of the text is one that tomlkit does not preserve.
    """
    given = {name: inline(value) for name, value in values.items() if value is not None}
    try:
        changed = _edited(text, given)
        preserved = _others(changed, given) == _others(text, given)  # an arm's limits among them
    except (TOMLKitError, ValueError):
        preserved = False
    if not preserved:
        raise InputError(
            None,
            f"{', '.join(given)} cannot be changed in this text without changing other entries",
            remedy="write each table once, below a header line [table] of its own",
        )
    return changed


def _edited(text: str, values: Mapping[str, Item]) -> str:
    document = tomlkit.parse(text)
    for name, value in values.items():
        *path, key = name.split(".")
        table: Any = document
        for part in path:
            if part not in table:
                table[part] = tomlkit.table()
            table = table[part]
        _set(table, key, value)
    return tomlkit.dumps(document)


def _set(table: Any, key: str, value: Item) -> None:
    """Set an entry of a table of a parsed text."""
    if key not in table:
        _append(table, key, value)
        return
    present = table[key]
    if isinstance(present, List) and isinstance(value, List) and len(present) == len(value):
        for index, entry in enumerate(value):
            present[index] = inline(entry)
    else:
        table[key] = value


def _append(table: Any, key: str, value: Item) -> None:
    """Add an entry in front of the comments at the end of a table: they belong to what follows."""
    end = []
    if isinstance(table, Table):
        body = table.value.body
        while body and body[-1][0] is None:
            end.append(body.pop()[1])
    table[key] = value
    for item in reversed(end):
        table.value.add(item)


def _others(text: str, changed: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of a text by dotted name, except below a changed name."""
    return {
        name: entry
        for name, entry in _entries(parse_toml(text), "")
        if not any(f"{name}.".startswith(f"{other}.") for other in changed)
    }


def _entries(table: Mapping[str, Any], path: str) -> Iterator[tuple[str, str]]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", repr(value)


_MIN_ABSENT_LIMIT: Final = 1e4  # some URDFs have larger figures for "none"


class UrdfLimits(NamedTuple):
    """Limits per joint (n,): rad or m, per second, and N·m or N; infinite if not stated."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array


def urdf_limits(urdf: str, joint_names: Sequence[str]) -> UrdfLimits:
    """Read the limits of joints.

    A range is not stated where it is absent or empty: lower and upper both 0, or exchanged. A speed
    or effort is not stated where it is absent, 0, negative, or above 1e4.
    """
    joints = {joint.get("name"): joint for joint in urdf_tree(urdf).findall("joint")}
    rows = []
    for name in joint_names:
        limit = joints[name].find("limit")
        stated = {} if limit is None else limit.attrib
        turns = joints[name].get("type") == "continuous"
        lower, upper, velocity, effort = (
            float(stated.get(key, 0.0)) for key in ("lower", "upper", "velocity", "effort")
        )
        if turns or not lower < upper:
            lower = -math.inf
            upper = math.inf
        rows.append((lower, upper, _stated(velocity), _stated(effort)))
    return UrdfLimits(*np.array(rows, dtype=np.float64).reshape(-1, 4).T)


def _stated(figure: float) -> float:
    """Return a limit of speed or effort, infinite if the figure is none."""
    return figure if 0.0 < figure < _MIN_ABSENT_LIMIT else math.inf
