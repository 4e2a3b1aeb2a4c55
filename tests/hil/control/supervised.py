"""A supervised exchange."""

from __future__ import annotations

from pathlib import Path

from hil.archive import ArchiveSpec
from hil.cell import Cell


def spec(cell: Cell, path: Path) -> ArchiveSpec:
    return ArchiveSpec(
        path, cell.joint_names, cell.period, {"kind": "move"},
        {"drive_train.json": cell.drive_table.model_dump_json().encode()}, durable=False,
    )  # fmt: skip
