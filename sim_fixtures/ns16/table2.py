"""Table 2 of Villagrossi et al. (2014): 40 essential and 18 friction parameters of the NS 16.

Each essential parameter is a sum of standard parameters. The print rounds the factors to three
digits; here they are the exact products of the link lengths. Row 31 is the one whose beginning the
print lost; it is completed with the only sign that a rigid body can have.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sim_fixtures.ns16 import geometry

Array = NDArray[np.float64]
Terms = dict[str, float]

TABLE2_PATH = Path(__file__).with_name("table2.csv")
N_ESSENTIAL = 40

_A1, _A2, _A3 = geometry.A[:3]
_D4 = -geometry.D[3]


@dataclass(frozen=True)
class Table2Row:
    """One row of Table 2, SI units.

    Attributes:
        id: 1 ... 58 as printed.
        printed_symbol: the symbol in the print.
        parameter: how it is read; rows 41 ... 52 are interleaved in print.
        pivot: standard parameter whose regressor column is this row's column ("" for friction).
        sign: +1 or -1, the factor of that column.
        terms: standard parameters grouped in this row with their factors, pivot included.
        pi_a, pi_b, pi_c: estimates of methods A and B, and the manufacturer's value (None where
            the table has none). Rows f1 are printed in an unstated unit.
    """

    id: int
    printed_symbol: str
    parameter: str
    pivot: str
    sign: int
    terms: Mapping[str, float]
    pi_a: float
    pi_b: float
    pi_c: float | None


def _masses(first: int, factor: float) -> Terms:
    """Return `factor` times the mass of every link from `first` to the last."""
    return {f"m{i}": factor for i in range(first, 7)}


# Rows 23-40; the first term of each is the pivot.
_GROUPED: dict[int, Terms] = {
    23: {
        "I1yy": 1.0, "I1m": 1.0, "m2": _A1**2, "I2yy": 1.0, "m3": _A1**2 + _A2**2, "I3zz": 1.0,
        **_masses(4, _A1**2 + _A2**2 + _A3**2),
    },
    24: {"mc2x": 1.0, **_masses(3, _A2)},
    25: {"I2xx": 1.0, "I2yy": -1.0, **_masses(3, -(_A2**2))},
    26: {"I2xz": 1.0, "mc3y": _A2},
    27: {"I2zz": 1.0, "I2m": 1.0, **_masses(3, _A2**2)},
    28: {"mc3x": 1.0, **_masses(4, _A3)},
    29: {"mc3z": -1.0, "mc4y": 1.0, **_masses(5, _D4)},
    30: {
        "I3xx": 1.0, "I3zz": -1.0, "m4": -(_A3**2), "I4zz": 1.0,
        **_masses(5, _D4**2 - _A3**2),
    },
    31: {"I3xz": -1.0, "mc4y": -_A3, **_masses(5, -_A3 * _D4)},
    32: {"I3yy": 1.0, "m4": _A3**2, "I4zz": 1.0, **_masses(5, _A3**2 + _D4**2)},
    33: {"mc4z": 1.0, "mc5y": -1.0},
    34: {"I4xx": 1.0, "I4zz": -1.0, "I5zz": 1.0},
    35: {"I4yy": 1.0, "I5zz": 1.0},
    36: {"I4yz": 1.0, "mc5y": _D4},
    37: {"mc5z": 1.0, "mc6z": 1.0},
    38: {"I5xx": 1.0, "I5zz": -1.0, "I6yy": 1.0},
    39: {"I5yy": 1.0, "I6yy": 1.0},
    40: {"I6xx": 1.0, "I6yy": -1.0},
}  # fmt: skip


@cache
def table2() -> tuple[Table2Row, ...]:
    """Return the 58 rows in the order of the table."""
    rows = []
    with TABLE2_PATH.open(encoding="utf-8", newline="") as stream:
        for record in csv.DictReader(stream):
            row_id = int(record["id"])
            terms: Terms = {}
            if row_id <= N_ESSENTIAL:
                terms = _GROUPED.get(row_id, {record["parameter"]: 1.0})
            pivot = next(iter(terms), "")
            rows.append(
                Table2Row(
                    id=row_id,
                    printed_symbol=record["printed_symbol"],
                    parameter=record["parameter"],
                    pivot=pivot,
                    sign=int(terms.get(pivot, 1.0)),
                    terms=MappingProxyType(terms),
                    pi_a=float(record["pi_a"]),
                    pi_b=float(record["pi_b"]),
                    pi_c=float(record["pi_c"]) if record["pi_c"] else None,
                )
            )
    return tuple(rows)


def base_from_standard(standard: Mapping[str, float]) -> Array:
    """Return the 40 essential parameters of Table 2 (rows 1 ... 40) from standard parameters."""
    rows = table2()[:N_ESSENTIAL]
    return np.array([sum(f * standard[name] for name, f in row.terms.items()) for row in rows])
