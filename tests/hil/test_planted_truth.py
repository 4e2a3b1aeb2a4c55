"""The planted truth of a simulated cell: its friction laws, and what the URDF is wrong by."""

from __future__ import annotations

import numpy as np
import pytest

from hil.cell import Cell, CellError
from hil.simulation import planted_truth, planted_values, simulated_controller
from sim_fixtures.ns16 import CELL_PATH, base_from_standard, standard_parameters


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


def cell_scaled(scale: list[float]) -> Cell:
    """The NS 16 whose links are so many times those of its URDF."""
    return Cell.load(CELL_PATH).with_values({"simulation.inertia_scale": scale})


class TestInertiaScale:
    """Law: the arm has the scaled links, the PC knows those of the URDF; the first are true."""

    def test_the_demo_has_table_2_and_knows_it_wrongly(self) -> None:
        cell = Cell.load(CELL_PATH)
        table = base_from_standard(standard_parameters())
        planted, known = planted_values(cell), cell.nominal_values()
        b = cell.model.base.rank
        large = np.abs(planted) > 1e-6
        # Table 2 turns the signs of some and orders them otherwise.
        found, printed = np.sort(np.abs(planted[:b])), np.sort(np.abs(table))
        np.testing.assert_allclose(found, printed, rtol=1e-9, atol=1e-12)
        errors = np.abs(known[large] / planted[large] - 1.0)
        assert errors.max() < 0.25
        assert np.median(errors) > 0.1

    def test_the_controller_moves_what_is_planted(self) -> None:
        moved = simulated_controller(Cell.load(CELL_PATH)).standard_parameters()
        for name, value in standard_parameters().items():
            assert moved[name] == pytest.approx(value, rel=1e-11, abs=1e-11), name

    def test_without_it_the_urdf_is_right(self) -> None:
        cell = cell_scaled([])
        b = cell.model.base.rank
        np.testing.assert_array_equal(planted_truth(cell).inertia_scale, np.ones(6))
        rotors = np.array(cell.simulation.rotor_inertia)
        standard = cell.model.nominal
        standard[cell.model.layout.rotors] = rotors
        np.testing.assert_allclose(planted_values(cell)[:b], cell.model.base.grouping @ standard)

    @pytest.mark.parametrize("scale", [[1.1], [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]])
    def test_one_positive_factor_per_joint_is_needed(self, scale: list[float]) -> None:
        with pytest.raises(CellError, match=r"simulation\.inertia_scale"):
            cell_scaled(scale)
