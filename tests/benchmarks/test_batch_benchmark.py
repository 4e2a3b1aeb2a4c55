from __future__ import annotations

import hashlib
from pathlib import Path

from benchmarks.archive_files import repetitions


def test_no_two_archives_hold_the_same(tmp_path: Path) -> None:
    paths = repetitions(tmp_path / "a", 2, cycles=500)
    paths += repetitions(tmp_path / "b", 2, first=2, cycles=500, recorded_at="2026-01-05T08:00Z")
    assert len({hashlib.sha256(path.read_bytes()).digest() for path in paths}) == 4
