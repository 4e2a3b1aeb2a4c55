"""What the paper prints: its Table 1, and the columns of its Table 2 by our parameters' names."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Final, NamedTuple

from hil.cell import Cell
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, URDF_PATH


class PrintedMotion(NamedTuple):
    """A row of Table 1; its log det is in units that the paper does not name."""

    method: str
    n_samples: int
    log10_det: float
    coupling_index: float
    notes: str


TABLE1: Final = (
    PrintedMotion("a", 2000, 90.5, 127.9, "W = 3, own frequencies; 100 individuals"),
    PrintedMotion("b", 15996, 30.9, 101.2, "K = 6, λ1 = 0.7, λ2 = 0.3; 150 individuals"),
)


@dataclass(frozen=True)
class PrintedParameter:
    """A row of Table 2.

    Attributes:
        id: 1 to 58.
        symbol: as printed, of rows 41 to 52 as they are read (the print interleaves them).
        factor: what our value in SI units is multiplied with to compare it with the print.
        pi_a, pi_b: the paper's estimates.
        pi_c: the manufacturer's value; None where there is none.
    """

    id: int
    symbol: str
    factor: float
    pi_a: float
    pi_b: float
    pi_c: float | None


def printed_parameters(cell: Cell) -> dict[str, PrintedParameter]:
    """Rows of Table 2 by the name of our parameter; empty for another arm than the NS 16.

    The print's viscous and third terms are read as per degree and per degree², an assumption: per
    radian the viscous friction would be negligible.
    """
    if cell.urdf != URDF_PATH.read_text(encoding="utf-8"):
        return {}
    return {
        row.pivot or row.parameter: PrintedParameter(
            row.id,
            row.parameter,
            row.sign * _degrees(row.id, row.parameter),
            row.pi_a,
            row.pi_b,
            row.pi_c,
        )
        for row in TABLE2
    }


def _degrees(row_id: int, parameter: str) -> float:
    order = {"f1": 1, "f2": 2}.get(parameter[:2], 0) if row_id > N_ESSENTIAL else 0
    return (pi / 180.0) ** order
