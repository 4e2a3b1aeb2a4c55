"""The COMAU SMART NS 16-1.65: geometry, planted truth, the paper's Table 2, URDF and cell file."""

from __future__ import annotations

from pathlib import Path

from sim_fixtures.ns16.table2 import (
    N_ESSENTIAL,
    TABLE2_PATH,
    Table2Row,
    base_from_standard,
    table2,
)
from sim_fixtures.ns16.truth import (
    TRUTH_PATH,
    LinkInertia,
    Ns16Truth,
    load_truth,
    standard_parameters,
)

FOLDER = Path(__file__).parent
URDF_PATH = FOLDER / "ns16.urdf"
CELL_PATH = FOLDER / "cell.toml"

TABLE2 = table2()


def urdf_text() -> str:
    """Return the URDF of the arm with its planted inertias; those of ns16.urdf are nominal."""
    from sim_fixtures.ns16.build_urdf import build_urdf  # which `python -m` runs, and imports this

    return build_urdf()


__all__ = [
    "FOLDER",
    "URDF_PATH",
    "CELL_PATH",
    "TRUTH_PATH",
    "TABLE2_PATH",
    "TABLE2",
    "N_ESSENTIAL",
    "Table2Row",
    "table2",
    "base_from_standard",
    "LinkInertia",
    "Ns16Truth",
    "load_truth",
    "standard_parameters",
    "urdf_text",
]
