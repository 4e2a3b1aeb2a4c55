"""The value of a default that the other robots would choose."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.leave_one_out import ALTERNATIVES, PRESENT, chosen_without, main, modules_of

pytestmark = pytest.mark.long


def test_every_default_is_there_and_has_other_values() -> None:
    for name, values in ALTERNATIVES.items():
        assert modules_of(name)
        assert all(getattr(module, name) not in values for module in modules_of(name))


def test_a_robot_is_judged_by_what_the_others_prefer() -> None:
    """Two prefer 3 folds, at which the third is worse than at the present number."""
    present = (PRESENT, "")
    few = ("FOLDS", "3")
    many = ("FOLDS", "8")
    robots = {
        "a": {present: 1.0, few: 0.8, many: 1.0},
        "b": {present: 1.0, few: 0.7, many: 0.9},
        "c": {present: 1.0, few: 2.0, many: 0.9},
    }
    chosen = chosen_without(robots, "FOLDS")
    assert chosen["c"] == {"value": "3", "ratio": 2.0}
    assert chosen["a"] == {"value": "8", "ratio": 1.0}


def test_a_single_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--data", str(tmp_path), "--only", "gen3"])
    assert "--only needs at least two recordings" in capsys.readouterr().err
