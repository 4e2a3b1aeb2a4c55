"""What every study is told with and leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.files import write_together
from hil.progress import Reporter

from .folder import REPORT, RESULTS
from .page import study_page
from .printed import TABLE1, printed_parameters
from .results import MotionRow, StudyParameter, StudyResults

Array = NDArray[np.float64]


def write_outcome(root: Path, results: StudyResults, reporter: Reporter) -> None:
    """Write `results.json` and `report.html` together, and say where they are.

    Raises:
        OutputError: the folder does not take them.
    """
    write_together(root, {RESULTS: results.to_json(), REPORT: study_page(results)})
    reporter.say(f"report: {root / REPORT}")


def printed_rows(cell: Cell) -> list[MotionRow]:
    """The paper's own rows of Table 1; none for another arm than its NS 16."""
    if not printed_parameters(cell):
        return []
    return [
        MotionRow(
            key=one.method,
            words=one.notes,
            n_samples=one.n_samples,
            log10_det=one.log10_det,
            coupling_index=one.coupling_index,
            printed=True,
        )
        for one in TABLE1
    ]


def parameters_of(cell: Cell, truth: Array | None) -> list[StudyParameter]:
    """The model's parameters with what is known of them beforehand; `truth` (p,) is planted."""
    model, printed = cell.model, printed_parameters(cell)
    found = []
    for k, name in enumerate(model.parameter_names):
        row, known = printed.get(name), dict[str, Any]()
        if row is not None:
            known = {
                "printed_id": row.id,
                "printed_symbol": row.symbol,
                "printed_factor": row.factor,
                "printed_a": row.pi_a,
                "printed_b": row.pi_b,
                "printed_c": row.pi_c,
            }
        own = None if truth is None else float(truth[k])
        found.append(StudyParameter(name=name, unit=model.units[k], truth=own, **known))
    return found
