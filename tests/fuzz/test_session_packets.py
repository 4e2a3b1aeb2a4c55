from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from drivers import Guard, Session, State
from tests.fuzz import session_packets
from tests.fuzz.record_laws import Violation, check_records


def test_twenty_thousand_packets_do_nothing_that_must_not_be() -> None:
    report = session_packets.fuzz(20_000, seed=7)
    assert report["violations"] == 0
    # And they do get deep into the session.
    for name in ("answered", "duplicates", "malformed", "stale", "missed", "refused", "moving"):
        assert report[name] > 0, name
    states = {name for name in report if name.startswith("state ")}
    assert {"state open", "state faulted", "state closed", "state exiting"} <= states
    assert report["set-points"] > 2000


def test_a_piece_is_the_same_whenever_it_is_run() -> None:
    def piece(start: int) -> dict[str, float]:
        report = session_packets.fuzz(2_000, seed=3, start=start)
        return {name: value for name, value in report.items() if name != "seconds"}

    assert piece(30_000) == piece(30_000) != piece(40_000)
    with pytest.raises(ValueError, match="multiple"):
        piece(5)


def test_reports_of_pieces_add_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, report in (("a", {"packets": 3, "stale": 1}), ("b", {"packets": 4, "refused": 2})):
        (tmp_path / name).write_text(json.dumps({**report, "seconds": 1.0}))
    paths = [str(tmp_path / "a"), str(tmp_path / "b")]
    assert session_packets.main(["--json", "--merge", *paths]) == 0
    total = json.loads(capsys.readouterr().out)
    assert (total["packets"], total["stale"], total["refused"]) == (7, 1, 2)
    assert total["packets_per_s"] == 3.5


class TestTheFuzzFindsWhatIsBroken:
    def test_an_exception(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(Session, "_cyclic", lambda *_: 1 // 0)
        with pytest.raises(Violation, match="ZeroDivisionError"):
            session_packets.fuzz(1_000, seed=1)

    def test_a_guard_that_lets_everything_pass(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(Guard, "check_set_point", lambda *_: None)
        with pytest.raises(Violation):
            session_packets.fuzz(100_000, seed=1)

    @pytest.mark.parametrize("column", ["state", "mode"])
    def test_a_set_point_outside_of_open_mode(self, column: str) -> None:
        story = session_packets.Fuzz(1, 0, Counter())
        story.ring.rows[:] = np.zeros((), story.ring.rows.dtype)
        rows = story.ring.rows[:3].copy()
        rows["state"] = State.CLOSED if column == "state" else State.OPEN
        with pytest.raises(Violation):
            check_records(rows, 4, True, Counter())
