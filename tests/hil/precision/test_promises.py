"""Promised and reached intervals of campaigns, and what the simulated arms really are."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pytest

from benchmarks.precision import campaigns_of
from benchmarks.simulated_cells import simulated_cell
from hil.cell import Cell
from sim_fixtures.ns16 import CELL_PATH

TWO_JOINTS = Path(__file__).parents[3] / "examples" / "two_joints" / "cell.toml"

_ONE: Final = 1.6
"""Bound of promise over reached with one or two campaigns: the goal of 1.25 holds for the median of
more, as single ones were measured at 0.88 to 1.32 (two joints) and 0.64 to 1.31 (UR5)."""


def kept(cell: Cell, required: str, seeds: range, within: float = 1.25) -> dict:
    """Run campaigns of the arm as it is modelled; require that they end, met, as promised.

    In the median: a single interval is itself estimated, to a tenth or two.
    """
    figures = campaigns_of(cell, required, seeds, effects=False)
    assert figures["outcomes"] == {"met": len(seeds)}
    ratio = 1.0 / np.array(figures["reached_over_promised"])[:, 1]
    assert np.all((ratio > 1.0 / within) & (ratio < within)), ratio
    assert figures["errors_within_required"] == 1.0
    return figures


@pytest.mark.long
def test_a_promise_that_is_kept_asks_for_no_other_motion() -> None:
    """Two joints in cycles of 2 ms: intervals of the delay were ten times its error."""
    cell = Cell.load(TWO_JOINTS)
    figures = kept(cell, "parameters 5 %, torque 0.5, friction 2 %", range(1, 2), _ONE)
    assert figures["repetitions"] == 2


@pytest.mark.long
def test_recordings_show_what_an_arm_has_that_its_model_lacks() -> None:
    """Two joints with ripple, warmth and delay: before, thirty times their error was promised."""
    cell = Cell.load(TWO_JOINTS)
    required = "parameters 5 %, torque 0.5, friction 2 %"
    figures = campaigns_of(cell, required, range(1, 3), effects=True)
    assumed, shown = (
        1.0 / np.array(figures[name])[:, 1]
        for name in ("reached_over_promised", "reached_over_promised_by_recordings")
    )
    assert np.all(shown < assumed)
    assert np.all((shown > 1.0 / _ONE) & (shown < _ONE)), shown


@pytest.mark.long
class TestOtherArms:
    def test_two_joints(self) -> None:
        """Of nine, most intervals hold: a share of 0.95 has a standard error of 0.07."""
        figures = kept(
            Cell.load(TWO_JOINTS), "parameters 5 %, torque 0.5, friction 2 %", range(1, 10)
        )
        assert np.mean(figures["quantities_inside"]) > 0.88

    def test_the_ns16(self) -> None:
        kept(Cell.load(CELL_PATH), "parameters 20 %, torque 12, friction 3 %", range(1, 3), _ONE)

    @pytest.mark.parametrize("arm", ["ur5", "panda"])
    def test_arms_of_other_makers(self, arm: str, tmp_path: Path) -> None:
        required = "parameters 5 %, torque 1, friction 3 %"
        kept(simulated_cell(arm, tmp_path), required, range(1, 2), _ONE)
