from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def figures() -> dict:
    """Run the benchmark as a person does; it pins threads before it imports anything."""
    environment = os.environ | {"PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.identification", "--json", "--repetitions", "1"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    return json.loads(line)


def test_it_times_the_sizes_that_it_tells(figures: dict) -> None:
    assert figures["samples"] == 16_000
    assert figures["parameters"] == 58
    assert figures["large_parameters"] >= 80
    # Panda has seven axes and two fingers; the ranks are those of the literature's arms.
    assert figures["base_ns16_rank"] == 40
    assert figures["base_ur10_rank"] == 40


@pytest.mark.parametrize(
    "task", ["fit", "large_fit", "prepared_fit", "base_ns16", "base_ur10", "consistent"]
)
def test_the_median_lies_between_the_least_and_the_most(figures: dict, task: str) -> None:
    least, median, most = (figures[f"{task}_{kind}ms"] for kind in ("least_", "", "most_"))
    assert 0.0 < least <= median <= most


def test_smoothing_costs_time_on_top_of_the_fit(figures: dict) -> None:
    assert figures["prepared_fit_ms"] > figures["fit_ms"]


def test_no_ratio_is_told_without_the_rival(figures: dict) -> None:
    if "figaroh_pivoting_ms" not in figures:
        assert figures["ratio_to_figaroh"] is None
        assert figures["torque_difference"] is None
        return
    assert figures["ratio_to_figaroh"] == pytest.approx(
        figures["figaroh_pivoting_ms"] / figures["fit_ms"], rel=0.01
    )
    # Both have fitted the same: what remains is how either counts degrees of freedom.
    assert figures["torque_difference"] < 1e-6
