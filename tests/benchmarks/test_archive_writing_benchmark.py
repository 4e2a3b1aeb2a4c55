from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_writing_costs_a_fraction_of_a_core() -> None:
    """Run as a person does, for a few seconds; it fails where a cycle is not archived."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.archive_writing", "--json", "--seconds", "2"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    figures = json.loads(done.stdout)
    assert figures["records_lost"] == 0
    assert 0.0 < figures["writing_share_of_core"] < 0.2
    assert figures["writing_share_of_core"] < figures["writing_share_of_core_with_packets"] < 0.2
    assert figures["megabytes_per_minute"] < figures["megabytes_per_minute_with_packets"]
