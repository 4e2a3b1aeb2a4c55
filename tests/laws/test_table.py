"""One list of laws judges every run with faults; each law finds what breaks it."""

from __future__ import annotations

import ast
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest

from hil.base.errors import OutputError
from tests.laws.evidence import ArchiveFile, Evidence, Rest
from tests.laws.manifests import Entry
from tests.laws.second_reader import Archived, cycle_layout
from tests.laws.table import LAWS, UNDOCUMENTED, Scenario, applying, broken, judged

pytestmark = pytest.mark.safety

TESTS: Final = Path(__file__).parents[1]
SOURCES: Final = ("simulate", "process_death", "disk", "fault_matrix", "endurance")
"""Folders of scenarios."""
CONTEXT: Final = {"period", "folder"}
"""What laws of other parts need, and no part of its own."""


def cycles(numbers: list[int], gaps: list[int] | None = None) -> np.ndarray:
    rows = np.zeros(len(numbers), cycle_layout(1))
    rows["cycle"], rows["gap"] = numbers, gaps or [0] * len(numbers)
    return rows


def file(**changes: Any) -> ArchiveFile:
    rows = changes.pop("cycles", cycles([3, 4, 5]))
    archived = Archived(Path("excitation_000_a1.mcap"), whole=True, cycles=rows)
    return ArchiveFile(archived, **{"complete": True} | changes)


def entry(index: int = 0, attempt: int = 1, outcome: str = "completed") -> Entry:
    return Entry(f"excitation_{index:03d}_a{attempt}.mcap", outcome, "", "", True)


BREAKS: Final[dict[str, Evidence]] = {
    "archives are complete": Evidence(files=(file(complete=False, missing="its end"),)),
    "archives have no gaps": Evidence(files=(file(cycles=cycles([3, 5])),)),
    "archives are readable": Evidence(period=0.1, files=(file(cycles=cycles([5, 4])),)),
    "no record is lost": Evidence(files=(file(records_lost=2),)),
    "files can be opened": Evidence(unreadable=("a.mcap: it is no archive",)),
    "entries stay": Evidence(folder=Path(), manifests=((entry(),), (entry(1),))),
    "motions are entered once": Evidence(folder=Path(), manifests=((entry(), entry(attempt=2)),)),
    "files are as entered": Evidence(folder=Path("nowhere"), manifests=((entry(),),)),
    "no motion is missing": Evidence(folder=Path(), manifests=((entry(),),), counts=(0, 2, 0)),
    "the arm is at rest": Evidence(rests=(Rest("at the end", [0.0, 0.2], 0.1),)),
    "a refusal of the disk is reported": Evidence(folder=Path(), disk=(("write a.mcap",), None)),
    "estimates agree": Evidence(
        estimates=tuple(SimpleNamespace(names=(name,)) for name in "ab")  # type: ignore[arg-type]
    ),
    "the session obeys its judge": Evidence(session=("a stale packet was answered",)),
}
"""Evidence that breaks each law of any run. Laws of one source are broken in its own tests."""


@pytest.mark.parametrize("law", BREAKS)
def test_each_law_finds_what_breaks_it(law: str) -> None:
    assert law in applying(BREAKS[law])
    assert law in {violation.law for violation in broken(BREAKS[law])}


def test_a_motion_that_counts_was_executed_as_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path("excitation_000_a1.mcap")
    monkeypatch.setattr("tests.laws.table.read", lambda _: Archived(path, whole=True))
    motions: Any = {("excitation", 0): "of the plan"}
    evidence = Evidence(folder=Path("nowhere"), manifests=((entry(),),), motions=motions)
    texts = [text for law, text in broken(evidence) if law == "motions are as planned"]
    assert texts == [f"{path} counts, and it ended ''"]


def test_every_part_of_the_evidence_has_a_law() -> None:
    parts = {field.name for field in fields(Evidence)} - CONTEXT
    assert {law.part for law in LAWS.values()} - {"entries"} == parts
    assert applying(Evidence()) == []


def test_a_disk_that_refused_nothing_raises_nothing() -> None:
    error = OutputError(Path("nowhere/a.json"), "No space left on device")
    evidence = Evidence(folder=Path("nowhere"), disk=((), None))
    law = "a refusal of the disk is reported"
    assert broken(evidence) == []
    assert [name for name, _ in broken(replace(evidence, disk=((), error)))] == [law]
    other = replace(evidence, disk=(("write a.json",), OutputError(Path("a.json"), "it failed")))
    assert {name for name, _ in broken(other)} == {law}


def test_open_axes_are_no_rest() -> None:
    rest = Rest("at the end", [0.0], 0.1, "OPEN", any_open=True)
    assert ["axes are open" in text for _, text in broken(Evidence(rests=(rest,)))] == [True]


def test_a_law_that_fails_and_a_run_that_fails_are_violations() -> None:
    (violation,) = broken(Evidence(disk=("no", "disk", "at all")))  # type: ignore[arg-type]
    assert violation.law == "a refusal of the disk is reported (exception)"

    def play() -> Evidence:
        raise ZeroDivisionError("planted")

    (violation,) = judged(Scenario("none", (), play))
    assert violation == (UNDOCUMENTED, "ZeroDivisionError: planted")


def test_sources_of_scenarios_apply_no_law_themselves() -> None:
    """They import laws in their `laws` only, where the laws of what they alone observe are."""
    laws = law_functions()
    assert {"readable", "entered_once", "as_planned", "stands", "of_disk", "alike"} <= laws
    of_laws = {"laws", "laws.py", "readers.py", "piece.py"}
    for path in (path for source in SOURCES for path in (TESTS / source).rglob("*.py")):
        if of_laws & set(path.relative_to(TESTS).parts):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests.laws."):
                names = {name.name for name in node.names}
                assert not names & laws, f"{path}: {', '.join(names & laws)}"


def law_functions() -> set[str]:
    """Return the names of functions in `tests.laws` that yield sentences."""
    names = set()
    for path in (TESTS / "laws").glob("*.py"):
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.returns is not None:
                names |= {node.name} if ast.unparse(node.returns) == "Iterator[str]" else set()
    return names
