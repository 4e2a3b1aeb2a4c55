"""The board: the same rows for both, its line of JSON, and what counts as a right verdict."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import board
from benchmarks.joint_log import JointLog
from benchmarks.published import Published, Split, known
from tests.benchmarks.two_joint_log import two_joint_log


@pytest.fixture(scope="module")
def logs() -> dict[str, JointLog]:
    return {name: two_joint_log(seed) for name, seed in (("one", 1), ("other", 2))}


@pytest.fixture(scope="module")
def archives(
    logs: dict[str, JointLog], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("archives")
    return {name: log.imported(folder / f"{name}.mcap") for name, log in logs.items()}


class TestLog:
    def test_a_log_comes_back_from_its_archive(
        self, logs: dict[str, JointLog], archives: dict[str, Path]
    ) -> None:
        written, read = logs["one"], JointLog.read(archives["one"], 5.0)
        assert read.time == pytest.approx(written.time, abs=1e-9)
        for name in ("position", "velocity", "torque"):
            assert np.array_equal(getattr(read, name), getattr(written, name))


class TestSplit:
    @pytest.mark.parametrize(("part", "fitted"), [("first", (0, 700)), ("last", (300, 1000))])
    def test_a_part_is_fitted_and_the_rest_predicted(
        self, logs: dict[str, JointLog], part: str, fitted: tuple[int, int]
    ) -> None:
        parts = board.cut(Split(fitted="one", part=part), logs)
        whole = logs["one"].time
        assert np.array_equal(parts.fitted.time, whole[slice(*fitted)])
        assert np.array_equal(
            np.sort(np.concatenate([parts.fitted.time, parts.predicted.time])), whole
        )

    def test_the_split_of_an_archive_is_that_of_its_log(
        self, logs: dict[str, JointLog], archives: dict[str, Path], tmp_path: Path
    ) -> None:
        """`Options.split` on the archive, and two files cut beforehand, are near each other.

        Apart from what the filters know beyond the cut: a tenth of so short a log.
        """
        split = Split(fitted="one", part="first")
        parts = board.cut(split, logs)
        by_files = board.identified_parts(parts, tmp_path)
        by_option = board.identified_split(split, archives, parts)
        assert by_files.error == pytest.approx(by_option.error, rel=0.1)


class TestRow:
    @pytest.mark.parametrize(
        "split", [Split(fitted="one", predicted="other"), Split(fitted="one", part="all")], ids=str
    )
    def test_both_are_near_the_noise(
        self, split: Split, logs: dict[str, JointLog], archives: dict[str, Path]
    ) -> None:
        found = board.row("arm", split, archives, logs)
        torque = board.cut(split, logs).predicted.torque
        floor = 0.3 * np.sqrt(torque.size) / np.linalg.norm(torque)
        for name in ("hil", "plain"):
            error, joints = found[name], found[f"{name}_joints"]
            assert 0.9 * floor < error < 1.5 * floor
            squares = np.square(joints) @ np.square(np.linalg.norm(torque, axis=0))
            assert error == pytest.approx(np.sqrt(squares) / np.linalg.norm(torque))
        assert found["ratio"] == found["hil"] / found["plain"]
        assert (found["inside"] is None) == split.in_sample
        assert found["inside"] is None or found["inside"] > 0.9

    def test_the_line_of_json(self, logs: dict[str, JointLog], archives: dict[str, Path]) -> None:
        split = Split(fitted="one", predicted="other")
        rows = [board.row("arm", split, archives, logs)] * 2
        found = json.loads(json.dumps(board.summary(rows, [])))
        assert found.keys() == {"rows", "worst_ratio", "mean_ratio"}
        assert found["rows"][0].keys() == {
            "data", "split", "hil", "plain", "ratio", "hil_joints", "plain_joints", "seconds",
            "inside", "white_inside",
        }  # fmt: skip
        assert found["worst_ratio"] == pytest.approx(found["mean_ratio"])


class TestDegradedRow:
    def test_its_fields(
        self, logs: dict[str, JointLog], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        some = {name: board.DEGRADATIONS[name] for name in ("lost rows", "payload in half")}
        monkeypatch.setattr(board, "DEGRADATIONS", some)
        split = Split(fitted="one", predicted="other")
        lost, loaded = board.degraded_rows("arm", split, logs)
        assert lost.keys() == {
            "data", "case", "hil", "undegraded", "ratio", "named", "words", "expected", "right",
        }  # fmt: skip
        assert lost["ratio"] < 1.05 < loaded["ratio"]
        assert lost["right"]
        assert board.summary([], [])["rows"] == []

    def test_a_refused_recording_is_wrong(self, logs: dict[str, JointLog], tmp_path: Path) -> None:
        whole = board.identified_parts(board.Parts(logs["one"], logs["other"]), tmp_path)
        found = board.degraded_row("arm", "lost rows", whole, "refused: the clock repeats")
        assert (found["hil"], found["ratio"], found["right"]) == (None, None, False)
        assert found["words"] == ["refused: the clock repeats"]


class TestRight:
    @pytest.mark.parametrize(
        ("case", "ratio", "named", "right"),
        [
            ("delayed torque", 2.0, ["delay", "error on unseen motion"], True),
            ("delayed torque", 2.0, ["delay", "direction of axes"], False),
            ("delayed torque", 1.0, [], False),
            ("12 bits", 1.02, [], True),
            ("12 bits", 1.5, [], False),
            ("12 bits", 1.02, ["position jumps"], False),
        ],
    )
    def test_the_cause_is_named_and_no_other(
        self, case: str, ratio: float, named: list[str], right: bool
    ) -> None:
        assert board.is_right(case, ratio, named) == right


class TestConfiguration:
    @pytest.mark.parametrize("name", known())
    def test_its_splits_are_of_its_logs(self, name: str) -> None:
        published = Published.named(name)
        for split in published.splits:
            assert {split.fitted, split.predicted or split.fitted} <= published.logs.keys()
        assert any(not split.in_sample for split in published.splits)

    def test_published_recordings_are_there(self, shared_data: Path) -> None:
        for name in known():
            published = Published.named(name)
            for file in published.logs.values():
                assert (shared_data / (published.folder or name) / file).is_file()

    def test_a_folder_that_is_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(SystemExit, match="name the folder of all with --data"):
            board.main(["--data", str(tmp_path), "--only", "kr300"])
