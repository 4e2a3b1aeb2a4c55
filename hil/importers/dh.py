"""URDF without masses from a table of Denavit-Hartenberg parameters."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from html import escape
from os import PathLike
from pathlib import Path
from typing import Final, Literal, NamedTuple, cast, get_args

from hil.base.errors import InputError
from hil.base.safe_input import read_input

Convention = Literal["standard", "modified"]

_NAMES: Final = ("joint", "type", "a", "alpha", "d", "theta_offset")
_OTHER: Final = {
    "a": ("a_mm", 1e-3),
    "d": ("d_mm", 1e-3),
    "alpha": ("alpha_deg", math.pi / 180.0),
    "theta_offset": ("theta_offset_deg", math.pi / 180.0),
}
"""Names of columns in another unit, and that unit in m or rad."""
_TYPES: Final = {"revolute": "continuous", "prismatic": "prismatic"}
_LARGEST: Final = {"a": 20.0, "alpha": 2.0 * math.pi, "d": 20.0, "theta_offset": 2.0 * math.pi}
"""m and rad; larger numbers are in mm or degrees."""


class _Row(NamedTuple):
    """A joint and its link, in m and rad."""

    joint: str
    type: str
    a: float
    alpha: float
    d: float
    theta_offset: float


def urdf_of_dh(path: str | PathLike[str], convention: Convention) -> str:
    r"""Return the URDF of a table of Denavit-Hartenberg parameters, without masses and limits.

    The table is text with commas or semicolons, a header and a row per joint, base to flange:
    ``joint,type,a,alpha,d,theta_offset``. `type` is revolute or prismatic. Lengths are in m,
    angles in rad; columns ``a_mm``, ``d_mm``, ``alpha_deg``, ``theta_offset_deg`` are in mm and
    degrees. With the angle :math:`\theta = q + \theta_0` of a revolute joint (the length
    :math:`d + q` of a prismatic one) a row is the transform

    - standard: :math:`R_z(\theta)\, T_z(d)\, T_x(a)\, R_x(\alpha)`, joint k moves about the z axis
      of frame k-1;
    - modified (Craig): :math:`R_x(\alpha)\, T_x(a)\, R_z(\theta)\, T_z(d)`, joint k moves about the
      z axis of frame k.

    Link k is called ``link_k``, the base ``base_link``, the last frame ``flange``.

    Raises:
        InputError: the table cannot be read, or a line of it is invalid.
    """
    path = Path(path)
    return _urdf(path.stem or "robot", _rows(path), convention)


def urdf_of_parameters(
    name: str, joints: Sequence[str], parameters: Mapping[str, Sequence[float]]
) -> str:
    """Return the URDF of revolute joints with parameters ``a, alpha, d, theta_offset`` [m, rad].

    The convention is standard; see :func:`urdf_of_dh`.
    """
    columns = zip(*(parameters[column] for column in _NAMES[2:]), strict=True)
    rows = [
        _Row(joint, _TYPES["revolute"], *values)
        for joint, values in zip(joints, columns, strict=True)
    ]
    return _urdf(name, rows, "standard")


def _urdf(name: str, rows: Sequence[_Row], convention: Convention) -> str:
    parts = [f'<robot name="{escape(name)}">', _link("base_link")]
    parent = "base_link"
    # The fixed transform follows a joint (standard) or precedes the next one (modified).
    for number, row in enumerate(rows, 1):
        if convention == "modified":
            before = f"before_{number}"
            parts += _fixed(parent, before, (row.a, 0.0, 0.0), row.alpha)
            parent = before
        lift = row.d if convention == "modified" else 0.0
        parts += _moving(row, parent, f"link_{number}", lift)
        parent = f"link_{number}"
        if convention == "standard":
            end = "flange" if number == len(rows) else f"end_{number}"
            parts += _fixed(parent, end, (row.a, 0.0, row.d), row.alpha)
            parent = end
    if convention == "modified":
        parts += _fixed(parent, "flange", (0.0, 0.0, 0.0), 0.0)
    return "\n".join(['<?xml version="1.0"?>', *parts, "</robot>"]) + "\n"


def convention_of(text: str | None) -> Convention:
    """Return the convention of a name.

    Raises:
        InputError: there is no such convention, or no name: a table does not show it.
    """
    if text in get_args(Convention):
        return cast(Convention, text)
    raise InputError(
        None,
        "is not given" if text is None else f"{text!r} is unknown",
        field="--convention",
        remedy="--dh needs standard (the frame of a row is at the distal end of its link) or "
        "modified (Craig: at the proximal end)",
    )


def _link(name: str) -> str:
    return f'<link name="{escape(name)}"/>'


def _fixed(
    parent: str, child: str, position: tuple[float, float, float], roll: float
) -> tuple[str, str]:
    """Return a link fixed to another, translated and then rotated about x."""
    xyz = " ".join(map(repr, position))
    joint = (
        f'<joint name="fixed_{child}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{xyz}" rpy="{roll!r} 0 0"/></joint>'
    )
    return _link(child), joint


def _moving(row: _Row, parent: str, child: str, lift: float) -> tuple[str, str]:
    """Return a link that rotates about, or slides along, the z axis of another."""
    limit = (
        "" if row.type == "continuous" else '<limit lower="0" upper="0" effort="0" velocity="0"/>'
    )
    joint = (
        f'<joint name="{escape(row.joint)}" type="{row.type}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="0 0 {lift!r}" rpy="0 0 {row.theta_offset!r}"/>'
        f'<axis xyz="0 0 1"/>{limit}</joint>'
    )
    return _link(child), joint


def _rows(path: Path) -> list[_Row]:
    lines = read_input(path, "give a table of DH parameters").removeprefix("\ufeff").splitlines()
    filled = [
        (number, line)
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(filled) < 2:
        raise InputError(path, "has no row of a joint", remedy=f"write {','.join(_NAMES)} and rows")
    delimiter = ";" if ";" in filled[0][1] else ","
    header, *table = (
        [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
        for _, line in filled
    )
    columns = _columns(path, header)
    rows: list[_Row] = []
    for (number, _), cells in zip(filled[1:], table, strict=True):
        texts = {name: cells[k] if k < len(cells) else "" for name, (k, _) in columns.items()}
        rows.append(_row(path, number, texts, columns, [row.joint for row in rows]))
    return rows


def _columns(path: Path, header: list[str]) -> dict[str, tuple[int, float]]:
    """Return column and unit of each quantity."""
    columns = {}
    for name in _NAMES:
        other, unit = _OTHER.get(name, (name, 1.0))
        spellings = [spelling for spelling in dict.fromkeys((name, other)) if spelling in header]
        if len(spellings) != 1:
            problem = (
                f"has columns {' and '.join(spellings)}" if spellings else f"has no column {name}"
            )
            remedy = (
                f"its columns are {','.join(_NAMES)}; lengths in m (a_mm, d_mm: in mm), angles in "
                "rad (alpha_deg, theta_offset_deg: in degrees)"
            )
            raise InputError(path, problem, field="header", remedy=remedy)
        columns[name] = header.index(spellings[0]), 1.0 if spellings[0] == name else unit
    return columns


def _row(
    path: Path,
    line: int,
    texts: dict[str, str],
    columns: dict[str, tuple[int, float]],
    earlier: list[str],
) -> _Row:
    def check(valid: bool, field: str, remedy: str) -> None:
        if not valid:
            problem = f"line {line} has {repr(texts[field]) if texts[field] else 'nothing'}"
            raise InputError(path, problem, field=field, remedy=remedy)

    kind = _TYPES.get(texts["type"].lower(), "")
    joint = texts["joint"]
    check(kind != "", "type", f"write {' or '.join(_TYPES)}")
    check(joint not in ("", *earlier), "joint", "give each joint a name of its own")
    values = {}
    for name, largest in _LARGEST.items():
        try:
            values[name] = float(texts[name]) * columns[name][1]
        except ValueError:
            values[name] = math.nan
        limit = f"{largest:.3g} {'m' if name in 'ad' else 'rad'}"
        remedy = f"write a number of at most {limit}, or call the column {_OTHER[name][0]}"
        check(abs(values[name]) <= largest, name, remedy)
    return _Row(joint, kind, **values)
