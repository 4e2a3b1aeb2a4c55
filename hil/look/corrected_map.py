"""A column map, corrected by what was found in the recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from identification.hypotheses.joint_changes import Axes

_COMMENT = "Proposed by hil from names, units, the URDF and the motion of the recording"


def with_entries(text: str, entries: Mapping[str, Any]) -> str:
    """Return a map with entries replaced, by dotted key."""
    table: dict[str, Any] = dict(parse_toml(text))
    for key, value in entries.items():
        place = table
        *tables, name = key.split(".")
        for part in tables:
            place = place.setdefault(part, {})
        place[name] = value
    return to_text(table, {"": _COMMENT})


def entries_of(
    axes: Axes, text: str, channels: Collection[str], joints: Sequence[str]
) -> dict[str, Any]:
    """Return the entries of a map with which an import reads the recording as `axes` describe it.

    Angles of `zero` are in the unit of the map, before its scale and coupling.

    Args:
        axes: where the joints are in what was recorded.
        text: of the map as it is.
        channels: of the log.
        joints: names in the order of the URDF.
    """
    table = parse_toml(text)
    same = bool(np.array_equal(axes.position_order, axes.torque_order))
    count = np.arange(len(joints))
    entries: dict[str, Any] = {}
    scale = np.round(axes.torque_sign / axes.torque_scale, 4)
    quantities = {
        "position": (axes.position_order, axes.position_sign),
        "velocity": (axes.position_order, axes.position_sign),
        "torque": (axes.torque_order, scale),
        "motor_current": (axes.torque_order, scale),
    }
    place = np.argsort(axes.position_order)
    columns = place if same else count
    drives = _terms(axes.drives, columns)
    angles = axes.coupling @ np.linalg.inv(axes.drives)  # that no drive contains
    if drives:
        stated = table.get("drive", {}).get("gear_ratio")
        of_motors = all(table[name].get("side") == "motor" for name in quantities if name in table)
        ratios = stated if stated and of_motors else [1.0] * len(joints)
        entries["drive.gear_ratio"] = ratios
        entries["drive.coupling"] = [[j, k, each * ratios[j - 1]] for j, k, each in drives]
    if same and not np.array_equal(axes.position_order, count):
        entries["joints"] = [joints[int(joint)] for joint in place]
    for name, (order, sign) in quantities.items():
        if name not in table:
            continue
        if not same and not np.array_equal(order, count):
            names = _names(table[name].get("columns"), channels, joints)
            if names is not None:
                entries[f"{name}.columns"] = [names[int(column)] for column in order]
        by_column = sign[place] if same else sign
        if np.any(sign != 1.0):
            entries[f"{name}.scale"] = by_column.tolist()
        if name in ("position", "velocity") and (terms := _terms(angles, columns)):
            entries[f"{name}.coupled"] = terms
        if drives:
            entries[f"{name}.side"] = "motor"
    if axes.factor < 1.0:
        entries["position.unit"] = "deg"
    if axes.factor > 1.0:
        entries["position.unit"] = "rad"
    if axes.zero.any():
        factor = axes.factor if axes.factor < 1.0 else 1.0
        offset = axes.zero / (axes.position_sign * factor)
        entries["position.offset"] = np.round(offset[place] if same else offset, 4).tolist()
    return entries


def _terms(coupling: Array, columns: NDArray[np.intp]) -> list[tuple[int, int, float]]:
    """Return the angles that contain others: column and joint, from 1, and the factor.

    Args:
        coupling: recorded angles per joint angle (n, n).
        columns: joints of the log's columns.
    """
    matrix = coupling[np.ix_(columns, columns)]
    others = np.argwhere(matrix - np.diag(np.diag(matrix)))
    return [(int(j) + 1, int(k) + 1, float(matrix[j, k])) for j, k in others]


def _names(columns: Any, channels: Collection[str], joints: Sequence[str]) -> list[Any] | None:
    """Return the columns of a quantity one by one; None where they belong to one array."""
    if isinstance(columns, list):
        return list(columns)
    if not isinstance(columns, str) or "{}" not in columns:
        return None
    numbers = range(len(joints) + 1)
    for parts in ([str(k) for k in numbers[1:]], [str(k) for k in numbers[:-1]], joints):
        series = [columns.replace("{}", part) for part in parts]
        if {*channels}.issuperset(series):
            return series
    return None
