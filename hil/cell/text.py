"""Changes of values in the text of a TOML file, and limits in a URDF."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.errors import InputError
from hil.reading import parse_toml
from identification.model.urdf_text import urdf_tree
from planner.toml_text import toml_value


class NoTableError(InputError, ValueError):
    """A table to change has no header line."""

    def __init__(self, table: str) -> None:
        super().__init__(
            None,
            f"the cell file has no header line [{table}]",
            remedy=f"write [{table}] on a line of its own, and its entries below",
        )


def replaced_value(text: str, table: str, key: str, value: float | str) -> str:
    """Set `key` of `[table]` to `value` in a TOML text; comments and order are preserved.

    Raises:
        NoTableError: there is no header line of the table.
    """
    header = rf"^[ \t]*\[[ \t]*{re.escape(table)}[ \t]*\][ \t]*(?:#[^\n]*)?$"
    found = re.search(header, text, re.MULTILINE)
    if found is None:
        raise NoTableError(table)
    start = found.end()
    following = re.search(r"^[ \t]*\[", text[start:], re.MULTILINE)
    end = start + following.start() if following else len(text)
    # A list may span several lines, and contain lists.
    a_list = r"\[(?:[^\[\]]|\[[^\[\]]*\])*\]"
    setting = rf"(?m)^([ \t]*{key}[ \t]*=[ \t]*)(?:\"[^\"\n]*\"|{a_list}|[^\n#]*)"
    body, count = re.subn(setting, lambda match: f"{match[1]}{value}", text[start:end], count=1)
    if not count:
        body = f"\n{key} = {value}{text[start:end]}"
    return text[:start] + body + text[end:]


def with_values(text: str, values: Mapping[str, Any]) -> str:
    """Set values in a TOML text, such as ``{"campaign.repetitions": 3}``; None changes nothing.

    Comments and order are preserved; missing tables are added (NoTableError without a header line).
    """
    for name, value in values.items():
        table, _, key = name.rpartition(".")
        if value is None:
            continue
        there: Any = parse_toml(text)
        for part in table.split("."):
            there = there.get(part, {})
        if not there and f"[{table}]" not in text:
            text += f"\n[{table}]\n"
        text = replaced_value(text, table, key, toml_value(value))
    return text


Array = NDArray[np.float64]


class UrdfLimits(NamedTuple):
    """Limits per joint (n,), rad, rad/s and N·m; infinite if not stated."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array


def urdf_limits(urdf: str, joint_names: Sequence[str]) -> UrdfLimits:
    """Read the limits of joints; a speed or effort of 0 means not stated."""
    joints = {joint.get("name"): joint for joint in urdf_tree(urdf).findall("joint")}
    rows = []
    for name in joint_names:
        limit = joints[name].find("limit")
        stated = {} if limit is None else limit.attrib
        turns = joints[name].get("type") == "continuous" or limit is None
        rows.append(
            (
                -math.inf if turns else float(stated.get("lower", 0.0)),
                math.inf if turns else float(stated.get("upper", 0.0)),
                float(stated.get("velocity", 0.0)) or math.inf,
                float(stated.get("effort", 0.0)) or math.inf,
            )
        )
    lower, upper, velocity, effort = np.array(rows, dtype=np.float64).T
    return UrdfLimits(lower, upper, velocity, effort)
