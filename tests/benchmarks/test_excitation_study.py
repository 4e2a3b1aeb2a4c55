from __future__ import annotations

import json

import pytest

from benchmarks import excitation_study


def test_an_unknown_case_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        excitation_study.main(["--only", "C"])
    assert "front" in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_study_prints_its_figures(capsys: pytest.CaptureFixture[str]) -> None:
    excitation_study.main(["--quick", "--seeds", "1", "--only", "B (eq. 7)", "front", "--json"])
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [each["case"] for each in rows] == ["B (eq. 7)", "front"]
    assert all(each["evaluated"] >= 144 for each in rows)
