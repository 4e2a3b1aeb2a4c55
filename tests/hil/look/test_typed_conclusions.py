"""Conclusions are values: their sentences are made at the edge and read by nobody."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.cli import app
from hil.importers import messages as import_messages
from hil.importers.conclusions import Certainty, Conclusion
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import Look, Row, look_at
from hil.look import messages as look_messages
from hil.look.readings import Channels, Decider, Evidence, NextBest, Reading, Setting
from hil.look.result import Aspect
from hil.pipeline import note_messages, summary
from identification.validation import verdict
from identification.validation.finding_messages import WordedFinding, worded
from tests.hil.importers.moving_log import URDF
from tests.hil.importers.several_arms import robot_of_arms
from tests.hil.simulated_logs import write_log, write_moving_log

Floats = NDArray[np.float64]
NAMES = ["t", "q{}", "v{}", "tau{}"]


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "three.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="module")
def columns(urdf: Path) -> tuple[Floats, ...]:
    """Time, positions, velocities and torques of three joints."""
    path = write_moving_log(urdf.with_name("moving.csv"), URDF)
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return values[:, 0], values[:, 1:4], values[:, 4:7], values[:, 7:]


def hil(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def look(urdf: Path, log: Path) -> Look:
    return look_at(log, lambda _: Robot.from_urdf(urdf), ImportOptions())


def row_of(looked: Look, aspect: str) -> Row:
    (row,) = [row for row in looked.rows if row.aspect == aspect]
    return row


class TestNamesOfChannels:
    """A channel may be called what it likes: only its meaning counts."""

    def test_a_target_beside_the_positions_leaves_their_unit_open(
        self, tmp_path: Path, urdf: Path, columns: tuple[Floats, ...]
    ) -> None:
        alone = write_log(tmp_path / "a.csv", NAMES, *columns)
        target = columns[1] + 0.01
        path = write_log(tmp_path / "b.csv", [*NAMES, "target_position{}"], *columns, target)
        row = row_of(look(urdf, path), "angle unit")
        assert row == row_of(look(urdf, alone), "angle unit")
        assert row.certainty is Certainty.CERTAIN
        (nearest,) = row.evidence
        assert isinstance(nearest, NextBest)
        assert nearest.ratio > 3.0
        result = hil("look", path, "--urdf", urdf, "-v")
        assert re.search(r"next best \d+\.\d+ × error: \w+", result.output)

    @pytest.mark.long
    def test_the_recorded_arm_has_a_row_of_its_own(self, tmp_path: Path) -> None:
        urdf = robot_of_arms(tmp_path, ("left", 3), ("head", 1))
        time = np.arange(400) * 0.01
        phases = np.array([0.0, 1.0, 2.0])
        q = np.sin(3.0 * time[:, None] + phases)
        path = write_log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], time, q, np.cos(q))
        looked = look(urdf, path)
        row = row_of(looked, "recorded arm")
        assert row.reading == Channels("left_j1 .. left_j3")
        assert {row.aspect for row in looked.rows} <= ASPECTS

    @pytest.mark.parametrize("name", ["q: left{}", "joint: q{}"])
    def test_a_colon_in_a_name_stays(
        self, tmp_path: Path, urdf: Path, columns: tuple[Floats, ...], name: str
    ) -> None:
        path = write_log(tmp_path / "a.csv", ["t", "v{}", name, "tau{}"], columns[0],
                         columns[2], columns[1], columns[3])  # fmt: skip
        chosen = ImportOptions(chosen={"position": name})
        looked = look_at(path, lambda _: Robot.from_urdf(urdf), chosen)
        assert row_of(looked, "position").reading == Channels(name)
        text = look_messages.row_text(row_of(looked, "position"))
        assert text[:2] == (name, "as given with --columns")


@pytest.mark.parametrize("kind", get_args(Reading | Evidence | Decider | Setting))
def test_what_a_row_of_a_look_may_have_has_words(kind: type) -> None:
    words = look_messages._worded.dispatch
    assert words(kind) is not words(object)


ASPECTS = frozenset(get_args(Aspect))


def exchanged(columns: tuple[Floats, ...]) -> tuple[Floats, ...]:
    return (*columns[:3], columns[3][:, [1, 0, 2]])


def in_degrees_and_milliseconds(columns: tuple[Floats, ...]) -> tuple[Floats, ...]:
    return (1e3 * columns[0], np.degrees(columns[1]), np.degrees(columns[2]), columns[3])


def of_motors(columns: tuple[Floats, ...]) -> tuple[Floats, ...]:
    return (*columns[:3], columns[3] / 100.0)


LOGS: Mapping[str, Callable[[tuple[Floats, ...]], tuple[Floats, ...]]] = {
    "exchanged torques": exchanged,
    "degrees and milliseconds": in_degrees_and_milliseconds,
    "motor side": of_motors,
}


def _by_key(finding: WordedFinding) -> WordedFinding:
    step = f"{finding.key}, step" if finding.next_step else ""
    reservation = finding.key if finding.reservation else ""
    return replace(finding, words=finding.key, next_step=step, reservation=reservation)


def say_keys(patch: pytest.MonkeyPatch) -> None:
    """Replace all sentences of importers, looks, notes, settings and findings by their keys."""

    def key(value: object) -> str:
        return type(value).__name__

    patch.setattr(import_messages, "worded", key)
    patch.setattr(look_messages, "_worded", key)
    for name in ("described", "sentences", "fit_alike", "problem_of", "remedy_of"):
        for module in (import_messages, look_messages):
            if hasattr(module, name):
                patch.setattr(module, name, key)
    patch.setattr(note_messages, "_line", key)
    patch.setattr(summary, "candidate_words", lambda candidates: [*map(key, candidates)])
    patch.setattr(verdict, "worded", lambda *arguments: _by_key(worded(*arguments)))


MESSAGES = frozenset(
    {
        *("words", "next_step", "next_steps", "reservation", "line", "reasons", "warnings"),
        *("content", "changes", "channels", "notes", "candidates"),
        *("findings", "reading", "reason", "decide", "options", "identified_at"),
    }
)
"""Keys whose values are sentences, and that of the time of day."""


def without_messages(value: Any) -> Any:
    """Return JSON without messages; findings by key, level and role."""
    if isinstance(value, list):
        return [without_messages(item) for item in value]
    if not isinstance(value, dict):
        return value
    kept = {k: without_messages(v) for k, v in value.items() if k not in MESSAGES}
    if isinstance(findings := value.get("findings"), list):
        kept["findings"] = [(each["key"], each["level"], each["role"]) for each in findings]
    return kept


@pytest.mark.long
@pytest.mark.parametrize("log", ["exchanged torques", "degrees and milliseconds", "motor side"])
def test_sentences_decide_nothing(
    tmp_path: Path, urdf: Path, columns: tuple[Floats, ...], log: str
) -> None:
    """With its key in place of every sentence all statuses, results and choices are the same."""
    path = write_log(tmp_path / "a.csv", NAMES, *LOGS[log](columns))

    def played(name: str) -> dict[str, Any]:
        folder = tmp_path / name
        looked = hil("look", path, "--urdf", urdf, "--json")
        done = hil("identify", path, "--urdf", urdf, "--output", folder)
        files = [folder / name for name in ("results.json", "map.toml")]
        results, columns = (path.read_text() if path.exists() else "{}" for path in files)
        return {
            "statuses": (looked.exit_code, done.exit_code),
            "look": without_messages(json.loads(looked.stdout)),
            "map": columns,
            "results": without_messages(json.loads(results)),
            "said": looked.stdout + done.output,
        }

    in_words = played("words")
    with pytest.MonkeyPatch.context() as patch:
        say_keys(patch)
        by_keys = played("keys")
    assert by_keys.pop("said") != in_words.pop("said")
    assert by_keys == in_words


def leaves(kind: type) -> set[type]:
    """All types of conclusions without types of their own."""
    below = kind.__subclasses__()
    return set().union(*map(leaves, below)) if below else {kind}


def test_every_conclusion_has_words() -> None:
    """So that the base case, which only raises, is never reached."""
    base = import_messages.worded.dispatch(Conclusion)
    assert not [
        kind.__name__
        for kind in leaves(Conclusion)
        if import_messages.worded.dispatch(kind) is base
    ]
