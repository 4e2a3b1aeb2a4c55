"""The planted truth of a simulated cell follows its friction tables, or is refused."""

from __future__ import annotations

import pytest

from hil.cell import Cell, CellError
from hil.simulation import planted_truth
from sim_fixtures.ns16 import CELL_PATH


def cell_with(third: str, overrides: dict[str, str], planted: str) -> Cell:
    """The NS 16 with these third laws, and these planted coefficients of them."""
    text = CELL_PATH.read_text("utf-8")
    lines = []
    table = ""
    for line in text.splitlines():
        table = line.strip("[] ") if line.startswith("[") else table
        if table == "simulation" and line.startswith("third ="):
            line = f"third = {planted}"
        lines.append(line)
    lines += [f'[robot.friction.joints.{name}]\nthird = "{law}"' for name, law in overrides.items()]
    base = Cell.load(CELL_PATH)
    text = "\n".join(lines).replace('third = "quadratic"', f'third = "{third}"', 1)
    return Cell.from_texts(text, base.urdf, base.path)


@pytest.mark.parametrize("law", ["quadratic", "cubic"])
def test_the_law_is_that_of_the_joints_planted_with_a_third_term(law: str) -> None:
    cell = cell_with("none", {"joint_2": law}, "[0, 1.5, 0, 0, 0, 0]")
    assert planted_truth(cell).third_law == law


def test_joints_without_a_planted_term_do_not_count() -> None:
    cell = cell_with("none", {"joint_1": "quadratic", "joint_2": "cubic"}, "[0, 1.5, 0, 0, 0, 0]")
    assert planted_truth(cell).third_law == "cubic"


def test_two_laws_in_one_simulated_arm_are_refused() -> None:
    cell = cell_with("none", {"joint_1": "quadratic", "joint_2": "cubic"}, "[1, 1.5, 0, 0, 0, 0]")
    with pytest.raises(CellError, match=r"robot\.friction\.joints.*joint_1, joint_2.*same third"):
        planted_truth(cell)
