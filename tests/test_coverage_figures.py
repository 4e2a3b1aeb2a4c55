"""Lines and branches have a bound each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.coverage_figures import main


@pytest.mark.parametrize(("branches", "status"), [(180, 0), (179, 1), (160, 1)])
def test_many_lines_do_not_hide_few_branches(
    tmp_path: Path, branches: int, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = {
        "covered_lines": 960, "num_statements": 1000,
        "covered_branches": branches, "num_branches": 200,
    }  # fmt: skip
    path = tmp_path / "coverage.json"
    path.write_text(json.dumps({"files": {"drivers/guard.py": {"summary": summary}}}))
    assert main([str(path), "drivers"]) == status
    assert "96.0 % of lines" in capsys.readouterr().out
    with pytest.raises(ValueError, match="no file of planner"):
        main([str(path), "planner"])
