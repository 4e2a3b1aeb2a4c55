"""The benchmark of batches: its archives are all different, and its calculation is arithmetic."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from benchmarks.archive_files import repetitions
from benchmarks.batch import million_on_100_machines


def step(archives: int, parent_ms: float, megabytes: float) -> dict[str, float]:
    return {
        "archives": archives,
        "workers": 2,
        "first_processor_ms_per_archive": 120.0 + parent_ms,
        "first_parent_ms_per_archive": parent_ms,
        "largest_parent_MB": megabytes,
    }


def test_a_million_archives_take_what_each_takes_shared_out_and_what_one_process_does() -> None:
    found = million_on_100_machines(step(100, 4.0, 200.0), step(1000, 1.3, 209.0))
    assert found["factors_min"] == pytest.approx(120e-3 * 1e6 / 200 / 60)
    assert found["client_min"] == pytest.approx((1.3 - 0.4) / 900 * 1000 * 1e6 / 60e3, abs=0.05)
    assert found["client_GB"] == pytest.approx(10.0)


def test_no_two_archives_hold_the_same(tmp_path: Path) -> None:
    paths = repetitions(tmp_path / "a", 2, cycles=500)
    paths += repetitions(tmp_path / "b", 2, first=2, cycles=500, recorded_at="2026-01-05T08:00Z")
    assert len({hashlib.sha256(path.read_bytes()).digest() for path in paths}) == 4
