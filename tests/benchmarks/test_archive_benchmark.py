from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Run the benchmark as a person does, with one archive; it fails where values differ."""
    arguments = ["--json", "--sizes", "--repetitions", "1", "--rounds", "1"]
    folder = tmp_path_factory.mktemp("archives")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.archive", *arguments, "--folder", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    return json.loads(line)


def test_ratios_are_those_of_the_times_told(figures: dict) -> None:
    fastest = min(figures["mcap_seeking_s"], figures["mcap_streaming_s"])
    assert figures["decode_ratio_to_mcap"] == pytest.approx(fastest / figures["ours_s"], rel=0.1)
    assert figures["decode_ratio_to_typed"] == pytest.approx(
        figures["typed_s"] / figures["ours_s"], rel=0.1
    )
    assert figures["cycles"] == 16_000


def test_it_is_much_faster_even_on_a_busy_machine(figures: dict) -> None:
    assert figures["decode_ratio_to_mcap"] > 4.0
    assert figures["decode_ratio_to_typed"] > 20.0


def test_sizes_are_told_for_each_compression(figures: dict) -> None:
    sizes = {row["compression"]: row["megabytes_per_minute"] for row in figures["sizes"]}
    assert sizes["zstd 3"] < sizes["zstd -1"] < sizes["lz4"] < sizes["none"]
