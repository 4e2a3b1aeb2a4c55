"""Which cell a motion was designed for: a short fingerprint of each part of its description."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from hil.cell import Cell
from hil.io.digest import json_digest

_DIGITS = 16
# What a motion and its criteria are made from. A change of the rest (walls, motors, home) leaves
# them what they are: whether the motion may be sent is checked before it is, in the cell as it is
# then.
DECISIVE = ("urdf", "robot", "limits")


def fingerprint(cell: Cell) -> dict[str, str]:
    """Return a digest of each part of a cell that a design may depend on, by the part's name.

    Tables are taken as read, so that comments, order and spelling of numbers do not count. The
    limits are those in URDF angles.
    """
    limits = cell.joint_limits
    home = cell.file.campaign
    parts: dict[str, Any] = {
        "urdf": cell.urdf,
        "robot": _plain(cell.file.robot),
        "limits": {
            name: getattr(limits, name).tolist()
            for name in ("lower", "upper", "velocity", "acceleration", "jerk")
        },
        "torque_limit": None if cell.torque_limit is None else cell.torque_limit.tolist(),
        "drive_train": _plain(cell.file.drive_train),
        "nominal": _plain(cell.file.nominal),
        "workspace": _plain(cell.file.workspace),
        "home": None if home is None else home.home_deg,
    }
    return {name: json_digest(part)[:_DIGITS] for name, part in parts.items()}


def _plain(table: BaseModel | None) -> Any:
    return None if table is None else table.model_dump(mode="json")
