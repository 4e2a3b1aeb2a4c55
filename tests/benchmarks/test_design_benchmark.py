from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def run(*arguments: str) -> dict:
    """Run the benchmark as a person does; it pins threads before it imports anything."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.design", "--json", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    return json.loads(line)


@pytest.fixture(scope="module")
def figures() -> dict:
    return run("--repetitions", "1", "--individuals", "6")


def test_both_sides_find_the_same_criteria_on_the_columns_that_both_have(figures: dict) -> None:
    assert abs(figures["log10_det_difference"]) < 1e-8
    assert abs(figures["coupling_index_difference"]) < 1e-8
    # ... and 8 ms say what 1 kHz says, or the ratio of their times would mean nothing.
    assert abs(figures["log10_det_difference_to_1_khz"]) < 0.05
    assert abs(figures["coupling_index_difference_to_1_khz"]) < 0.5


def test_ratios_are_those_of_the_times_told(figures: dict) -> None:
    ours = figures["ours_ms"]
    assert figures["ratio_to_pinocchio"] == pytest.approx(
        figures["pinocchio_1_khz_ms"] / ours, rel=0.01
    )
    assert figures["ratio_same_rate"] == pytest.approx(
        figures["pinocchio_same_rate_ms"] / ours, rel=0.01
    )


@pytest.mark.parametrize("search", ["", "_front"])
def test_the_slowest_individual_is_no_faster_than_their_mean(figures: dict, search: str) -> None:
    assert 0.0 < figures[f"individual{search}_ms"] <= figures[f"individual{search}_worst_ms"]
    assert figures[f"scoring{search}_ms"] <= figures[f"scoring{search}_worst_ms"]
    assert figures[f"individual{search}_ms"] < figures[f"scoring{search}_ms"]
    assert figures[f"individuals{search}"] == 6
    assert figures["individual_20_s_ms"] > 0.0


@pytest.mark.slow
def test_a_small_search_finds_the_same_with_one_worker_and_with_two() -> None:
    figures = run(
        "--repetitions", "1", "--individuals", "2",
        "--search", "--population", "8", "--generations", "2",
    )  # fmt: skip
    assert figures["ga_individuals"] == 16
    assert figures["ga_one_worker_s"] > 0.0
    assert figures["ga_two_workers_s"] > 0.0
