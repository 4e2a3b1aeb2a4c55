"""What a cell states of a recording and archives of one arm may differ in: delay and payload.

Both are known and taken off, so the parameters of an arm stay comparable; but archives of which
they are different are not of one campaign.
"""

from __future__ import annotations

from collections.abc import Iterable

from hil.cell import Cell
from hil.cell.schema import PayloadTable
from hil.identify.settings import stated_delay


def setup_of(cell: Cell) -> str:
    """Delay of the torque and payload of a cell in words, with every digit; "" for neither."""
    return ", ".join(filter(None, (_lag(stated_delay(cell)), _load(cell.file.robot.payload))))


def _lag(delay: float) -> str:
    return f"torque lags by {1e3 * delay:.12g} ms" if delay else ""


def _load(payload: PayloadTable | None) -> str:
    if payload is None or not (payload.mass or any(payload.inertia)):
        return ""
    frame = f" in {payload.frame}" if payload.frame else ""
    words = f"carries {payload.mass:.12g} kg at {_row(payload.centre)} m{frame}"
    return words + (f", {_row(payload.inertia)} kg·m²" if any(payload.inertia) else "")


def _row(figures: Iterable[float]) -> str:
    return f"({', '.join(f'{figure:.12g}' for figure in figures)})"
