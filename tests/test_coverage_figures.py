"""Lines and branches have a bound each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.coverage_figures import figures, main


def report(branches: int) -> dict:
    summary = {
        "covered_lines": 960, "num_statements": 1000,
        "covered_branches": branches, "num_branches": 200,
    }  # fmt: skip
    return {"files": {"drivers/guard.py": {"summary": summary}}}


@pytest.mark.parametrize(("branches", "status"), [(180, 0), (179, 1), (160, 1)])
def test_many_lines_do_not_hide_few_branches(
    tmp_path: Path, branches: int, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "coverage.json"
    path.write_text(json.dumps(report(branches)))
    assert main([str(path), "drivers"]) == status
    assert "96.0 % of lines" in capsys.readouterr().out


def test_a_package_that_was_not_measured_is_named() -> None:
    with pytest.raises(ValueError, match="no file of planner"):
        figures(report(200), "planner")


def test_other_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("[1]")
    for name in ("notes.txt", "nowhere.json"):
        with pytest.raises(SystemExit) as ended:
            main([str(tmp_path / name), "drivers"])
        assert ended.value.code == 2
        assert f"{name} cannot be used" in capsys.readouterr().err
