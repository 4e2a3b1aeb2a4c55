"""The simulation itself: reproducible seeds, scripts and their reduction, journals."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest

from tests.faults import kind_of, parse_script
from tests.simulate import world
from tests.simulate.__main__ import main
from tests.simulate.draws import DRAWS, Story, draw_script
from tests.simulate.many import stage_folder
from tests.simulate.scenes import NEIGHBOURS, scene_of
from tests.simulate.verdicts import Stage, Verdict, broken_by, shrunk, summary
from tests.simulate.world import SceneError, _twin, twin_of

pytestmark = pytest.mark.safety

STORY = Story(900, tuple(range(100, 800)), 3, 120, 40, 6, 6)


class TestScript:
    def test_random_scripts_are_valid_and_of_all_kinds(self) -> None:
        kinds = {
            kind_of(line)
            for seed in range(600)
            for line in parse_script(draw_script(random.Random(seed), STORY)).lines
        }
        assert kinds >= set(DRAWS) - {"stalls"}

    def test_a_line_is_read_with_its_options(self) -> None:
        script = parse_script(["# a note", "", "stall@1200:12ms:answering", "lose@3x2"])
        (stall,) = script.events
        assert (stall.at, stall.word) == (1200, "answering")
        assert stall.value == pytest.approx(0.012)
        assert [line for line, _ in script.faults] == ["lose@3x2"]

    @pytest.mark.parametrize("line", ["stall@x", "kill@3:softly", "lose@", "nothing", "kill 3"])
    def test_an_invalid_line_is_refused_with_the_grammar(self, line: str) -> None:
        with pytest.raises(ValueError, match="lines are"):
            parse_script([line])


class TestShrinking:
    def test_two_lines_that_fail_only_together_remain(self) -> None:
        lines = tuple(f"kill@{at}" for at in range(100, 900, 100))
        both = {"kill@200", "kill@700"}
        assert set(shrunk(lines, lambda candidate: both <= set(candidate))) == both


def verdict(seed: int, *broken: tuple[str, str]) -> Verdict:
    met = ("the process died",)
    return Verdict(seed, "an arm", ("kill@3",), ("kill",), met, ("Killed", "complete"), 900, broken)


class TestJournal:
    def test_a_summary_counts_kinds_ends_and_failures(self) -> None:
        figures = summary([verdict(1), verdict(2, ("guard", "a"), ("guard", "b"), ("rest", "c"))])
        assert (figures["ran"], figures["failed"], figures["seeds_failed"]) == (2, 1, [2])
        assert figures["laws_broken"] == {"guard": 1, "rest": 1}
        assert figures["struck"] == {"kill": 2}
        assert "push" in figures["never_struck"]
        assert "kill" not in figures["never_struck"]
        assert figures["met"] == {"the process died": 2}
        assert "motion lost" in figures["never_met"]
        assert figures["campaigns_ended"] == {"complete": 2}


def test_a_seed_is_reproducible_to_the_last_byte() -> None:
    """On the wire and in the folder, independent of the clock of the host."""
    played = []
    for _ in range(2):
        with stage_folder() as root:
            played.append(Stage(root).observed(1))
    first, second = played
    assert first.schedule == second.schedule
    assert first.arm.sent == second.arm.sent
    for life, other in zip(first.runs, second.runs, strict=True):
        assert life.exchanged == other.exchanged
        assert life.after == other.after
    assert np.ptp(first.arm.position) > 0.0


class TestCommand:
    def test_one_seed_prints_its_script_and_result(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["--seed", "4", "--json"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert (printed["ran"], printed["failed"], printed["seeds_failed"]) == (1, 0, [])
        assert set(printed["struck"]) <= set(printed["script"])

    def test_another_script_replaces_the_random_one(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "script"
        path.write_text("kill@300\n")
        assert main(["--seed", "4", "--script", str(path)]) == 0
        out = capsys.readouterr().out
        assert "  kill@300\n" in out
        assert "run 1, cycles 0..300: Killed: kill@300" in out
        assert "run 2" in out
        assert "complete" in out

    def test_many_are_run_once_and_then_read_from_the_journal(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        journal = str(tmp_path / "seeds.jsonl")
        for _ in range(2):
            assert main(["--seeds", "2", "--start", "6", "--journal", journal, "--json"]) == 0
            printed = json.loads(capsys.readouterr().out.splitlines()[-1])
            assert (printed["ran"], printed["failed"], printed["seeds_failed"]) == (2, 0, [])
        assert len(Path(journal).read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("seed", "script"),
    [
        # The residual is correlated over much of a short motion.
        (1227, ["restart@580:cold", "clock@900:+3600s"]),
        (1791, ["drive-drop@400"]),
        # The resting arm trembles, so that two motions in a row are not started.
        (3121, ["hurry@0", "lurch@700x1:-0.3", "axis-leaves@372:axis=1"]),
        # Standard deviations from few blocks of residuals: 6.5 of them are no finding.
        (3886, ["e-stop@460"]),
        # Joint angles of an arm whose calibration is fifteen revolutions of its motor.
        (4536, ["lose@500"]),
        # A target velocity corrupted to 1e37, converted within rounding.
        (7339, ["corrupt@900x2:offset=23:mask=0x40:to_controller"]),
        # Records refused by the disk are not lost by a later kill.
        (4789, ["kill-at-save@1:left", "save-full@2", "kill@1100", "disk-error@10x1:keep=0.481"]),
    ],
)
def test_laws_allow_what_they_once_did_not(seed: int, script: list[str], tmp_path: Path) -> None:
    assert broken_by(Stage(tmp_path).observed(seed, script)) == []


def test_a_campaign_that_does_not_end_is_a_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path)
    assert broken_by(stage.observed(4, [])) == []
    monkeypatch.setattr(world, "MOST_CYCLES", 500)
    broken = broken_by(stage.observed(4, ["drive-drop@300"]))
    assert any("EndlessError" in violation.text for violation in broken)


def test_a_scene_with_a_trembling_arm_is_replaced(tmp_path: Path) -> None:
    """Seed 128: whether a motion can start depends on chance."""
    group = 128 // NEIGHBOURS
    with pytest.raises(SceneError, match="at rest it moves at"):
        _twin(scene_of(group), tmp_path / "trembling")
    assert twin_of(group, tmp_path).scene.words != scene_of(group).words
