"""Numbers, choices, checks and exit status stay as they were (see `tests/golden/cases.py`)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.golden.cases import CASES, HERE, PUBLISHED, RECORDINGS

# Rounding of the processor's linear algebra, which the condition of an estimate enlarges: relative
# for plain numbers, in standard errors for estimates.
SAME = 1e-9
SAME_ESTIMATE = 1e-6
LONG = ("batch",)  # cases that take many seconds


def assert_same(result: Any, golden: Any, place: str) -> None:
    """Words alike, numbers to rounding of the largest of their list."""
    if isinstance(golden, dict):
        assert result.keys() == golden.keys(), place
        estimates = {"values", "std"} & golden.keys() if "std" in golden else set()
        for key in estimates:
            change = np.abs(np.subtract(result[key], golden[key]))
            assert np.all(change <= SAME_ESTIMATE * np.array(golden["std"])), f"{place}.{key}"
        for key in golden.keys() - estimates:
            assert_same(result[key], golden[key], f"{place}.{key}")
    elif isinstance(golden, list) and golden and isinstance(golden[0], float):
        scale = max(map(abs, golden))
        assert result == pytest.approx(golden, rel=SAME, abs=SAME * scale), place
    elif isinstance(golden, float):
        assert result == pytest.approx(golden, rel=SAME), place
    else:
        assert result == golden, place


class TestGoldenResults:
    @pytest.mark.parametrize(
        "name",
        [pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in CASES],
    )
    def test_they_stay(self, name: str, tmp_path: Path) -> None:
        golden = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
        assert_same(CASES[name](tmp_path), golden, name)

    @pytest.mark.parametrize(
        "name",
        # The heavy arm asks most of the consistent estimate.
        [
            pytest.param(robot, marks=pytest.mark.long if robot == "kr300" else pytest.mark.slow)
            for robot in PUBLISHED
        ],
    )
    def test_those_of_published_recordings_stay(self, name: str, tmp_path: Path) -> None:
        if not RECORDINGS.is_dir():
            pytest.skip(f"there are no recordings below {RECORDINGS}")
        golden = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
        assert_same(PUBLISHED[name](tmp_path), golden, name)
