"""Benchmarks run as a person runs them: their line of JSON agrees with itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]


def run(name: str, *arguments: str) -> dict:
    """What a benchmark prints; a warning is an error."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", "--json", *arguments],
        cwd=ROOT, env=os.environ | {"PYTHONWARNINGS": "error"},
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    (line,) = done.stdout.splitlines()
    return json.loads(line)


@pytest.mark.slow
class TestArchive:
    @pytest.fixture(scope="class")
    @classmethod
    def figures(cls) -> dict:
        return run("archive", "--sizes", "--repetitions", "1", "--rounds", "1")

    def test_ratios_are_those_of_the_times(self, figures: dict) -> None:
        """And large, even on a busy machine."""
        fastest = min(figures["mcap_seeking_s"], figures["mcap_streaming_s"])
        for name, theirs, least in (("mcap", fastest, 4.0), ("typed", figures["typed_s"], 20.0)):
            ratio = figures[f"decode_ratio_to_{name}"]
            assert ratio == pytest.approx(theirs / figures["ours_s"], rel=0.1)
            assert ratio > least
        assert figures["cycles"] == 16_000

    def test_writing_costs_a_fraction_of_a_core(self) -> None:
        """It fails where a cycle is not archived."""
        figures = run("archive_writing", "--seconds", "2")
        assert figures["records_lost"] == 0
        assert 0.0 < figures["writing_share_of_core"] < 0.2
        assert figures["encode_us_per_cycle"] < 200.0


class TestDesign:
    @pytest.fixture(scope="class")
    @classmethod
    def figures(cls) -> dict:
        return run("design", "--repetitions", "1", "--individuals", "6")

    def test_both_sides_find_the_same_criteria(self, figures: dict) -> None:
        """On the columns that both have; 8 ms find what 1 kHz finds, or ratios mean nothing."""
        assert abs(figures["log10_det_difference"]) < 1e-8
        assert abs(figures["coupling_index_difference"]) < 1e-8
        assert abs(figures["log10_det_difference_to_1_khz"]) < 0.05
        assert abs(figures["coupling_index_difference_to_1_khz"]) < 0.5

    @pytest.mark.slow
    def test_a_small_search_by_one_worker_and_by_two(self) -> None:
        """It fails where they find different motions."""
        figures = run(
            "design", "--repetitions", "1", "--individuals", "2",
            "--search", "--population", "8", "--generations", "2",
        )  # fmt: skip
        assert figures["ga_individuals"] == 16
        assert min(figures["ga_one_worker_s"], figures["ga_two_workers_s"]) > 0.0


class TestIdentification:
    @pytest.fixture(scope="class")
    @classmethod
    def figures(cls) -> dict:
        return run("identification", "--repetitions", "1", "--only", "fits", "models")

    def test_it_times_the_sizes_that_it_states(self, figures: dict) -> None:
        assert figures["samples"] == 16_000
        assert figures["parameters"] == 58
        assert figures["large_parameters"] >= 80
        # The ranks are those of the literature's arms.
        assert figures["base_ns16_rank"] == figures["base_ur10_rank"] == 40

    def test_there_is_no_ratio_without_the_rival(self, figures: dict) -> None:
        if "figaroh_pivoting_ms" not in figures:
            assert figures["ratio_to_figaroh"] is None
            assert figures["torque_difference"] is None
            return
        ratio = figures["figaroh_pivoting_ms"] / figures["fit_ms"]
        assert figures["ratio_to_figaroh"] == pytest.approx(ratio, rel=0.01)
        # Both have fitted the same: what remains is how either counts degrees of freedom.
        assert figures["torque_difference"] < 1e-6
