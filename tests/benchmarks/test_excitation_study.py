from __future__ import annotations

import importlib.util
import io
import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "excitation_study.py"


def load():
    """Benchmarks are run, not installed: this one is loaded from where it stands."""
    spec = importlib.util.spec_from_file_location("excitation_study", PATH)
    module = sys.modules["excitation_study"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


study = load()


def motion(log10_det, coupling_index):
    return study.Motion(log10_det, coupling_index, 80.0, 12000, 12.0, 30.0)


def row(case, chosen, *others, seed=1, table="constraints", goal=None, infeasible=None):
    motions = [] if chosen is None else [chosen, *others]
    front = [(each.log10_det, each.coupling_index, 12.0) for each in motions]
    infeasible = {"duration": 25} if infeasible is None else infeasible
    return study.Row(case, table, seed, 60.0, chosen, goal, 100, infeasible, front)


def printed(*rows):
    console = Console(width=200, file=io.StringIO())
    study.report(console, rows)
    return console.file.getvalue()


def line(text, *words):
    (found,) = (each for each in text.splitlines() if all(word in each for word in words))
    return found


def cells(text, *words):
    return [cell.strip() for cell in line(text, *words).split("│")[1:-1]]


def test_a_constraint_costs_what_the_front_of_the_same_seed_lost_by_it():
    rows = (
        row("front", motion(105.0, 64.0), motion(106.0, 79.0), table="methods", seed=1),
        row("front", motion(106.0, 70.0), table="methods", seed=2),
        row("closed at home", motion(103.0, 61.0), motion(104.5, 66.5), seed=1),
        row("closed at home", motion(107.0, 69.0), motion(108.0, 80.1), seed=2),
        row("+ floor", motion(103.0, 61.0), seed=1),
    )
    text = printed(*rows)
    lower = text[text.index("Front under constraints") :]
    # The knee moved along the front: 2 less in log det for 3 in I_c is no price of a constraint.
    assert cells(lower, "closed", "66.5")[1:6] == ["1", "66.5", "+2.5", "104.5", "+1.5"]
    assert cells(lower, "closed", "69.0")[1:6] == ["2", "69.0", "-1.0", "107.0", "-1.0"]
    assert cells(lower, "+ floor")[1:6] == ["1", "-", "-", "103.0", "+1.5"]
    assert "25%" in line(lower, "closed", "107.0")


def test_a_search_that_found_nothing_says_why():
    text = printed(row("+ motor currents", None, infeasible="none of 100 motions is feasible"))
    assert "none of 100" in line(text, "+ motor currents")


def test_the_papers_figures_stand_beside_ours():
    text = printed(row("B (eq. 7)", motion(107.2, 111.0), table="methods"))
    assert "101.2" in line(text, "paper, B")
    assert "111.0" in line(text, "B (eq. 7)")


def test_every_case_has_settings_of_its_own_and_a_name_of_its_own():
    cases = list(study.cases())
    assert len({case.name for case in cases}) == len(cases)
    assert len({case.settings.model_dump_json() for case in cases}) == len(cases)


def test_an_unknown_case_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["excitation_study", "--only", "C"])
    with pytest.raises(SystemExit, match="front"):
        study.main()


@pytest.mark.slow
def test_a_quick_study_writes_its_figures(tmp_path, monkeypatch):
    path = tmp_path / "study.json"
    arguments = ["--quick", "--seeds", "1", "--only", "A with ramps", "front", "--json", str(path)]
    monkeypatch.setattr(sys, "argv", ["excitation_study", *arguments])
    study.main()
    rows = json.loads(path.read_text())["rows"]
    assert [each["case"] for each in rows] == ["A with ramps", "front"]
    assert all(each["evaluated"] >= 144 for each in rows)
