"""Recordings collected by their digests, and the page of all real arms."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest

from benchmarks import board, board_page, fetch
from benchmarks.averaging import ALL, COLUMNS
from benchmarks.board_page import Line
from benchmarks.choices import CHOICES
from benchmarks.published import Published, Source, known

pytestmark = pytest.mark.long


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder with the three files of a robot, the second under another name."""
    folder = tmp_path / "downloads" / "deep"
    folder.mkdir(parents=True)
    digests = {}
    for name, other in (("a.csv", "a.csv"), ("b.csv", "b (1).csv"), ("r.urdf", "r.urdf")):
        (folder / other).write_text(f"content of {name}")
        digests[name] = fetch._digest(folder / other)
    source = Source(arm="arm", repository="somebody/arm", licence="MIT", sha256=digests)
    published = Published(
        urdf="r.urdf", logs={"a": "a.csv", "b": "b.csv"}, rated_payload=1.0, splits=(),
        source=source,
    )  # fmt: skip
    monkeypatch.setattr(Published, "named", classmethod(lambda _, name: published))
    return folder.parent


class TestFetch:
    def test_files_are_known_by_their_digests(self, robot: Path, tmp_path: Path) -> None:
        files = fetch.fetch(["arm"], [robot], tmp_path / "data")
        assert [file.file for file in files if file.found] == ["a.csv", "b.csv", "r.urdf"]
        assert (tmp_path / "data" / "arm" / "b.csv").read_text() == "content of b.csv"

    def test_a_second_time_they_are_there(self, robot: Path, tmp_path: Path) -> None:
        fetch.fetch(["arm"], [robot], tmp_path / "data")
        files = fetch.fetch(["arm"], [], tmp_path / "data")
        assert all(file.found for file in files)

    def test_a_changed_file_is_not_taken(
        self, robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """What is missing is said with the repository that publishes it; exit 1."""
        (robot / "deep" / "a.csv").write_text("changed")
        files = fetch.fetch(["arm"], [robot], tmp_path / "data")
        assert not (tmp_path / "data" / "arm" / "a.csv").exists()
        with pytest.raises(SystemExit, match="1"):
            fetch.show_fetched(files, only_json=False)
        *lines, last = capsys.readouterr().out.splitlines()
        assert "not here: from https://github.com/somebody/arm (MIT), sha256" in lines[0]
        assert json.loads(last)["found"] == 2

    def test_a_folder_that_is_not_there(self, robot: Path, tmp_path: Path) -> None:
        with pytest.raises(SystemExit, match="is not a folder"):
            fetch.fetch(["arm"], [tmp_path / "none"], tmp_path / "data")

    @pytest.mark.parametrize(("content", "state"), [("content of r.urdf", "index"), ("x", None)])
    def test_a_urdf_of_a_package_is_taken_from_the_index(
        self,
        robot: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        content: str,
        state: str | None,
    ) -> None:
        """A wheel stands for what pip downloads; another content is not taken."""
        packaged = Published.named("arm").model_copy(update={"urdf_package": "no-such-robots"})
        monkeypatch.setattr(Published, "named", classmethod(lambda _, name: packaged))
        (robot / "deep" / "r.urdf").unlink()

        def download(command: list[str], **_: object) -> None:
            assert command[-1] == "no-such-robots"
            place = Path(command[command.index("--dest") + 1]) / "robots-1.whl"
            with zipfile.ZipFile(place, "w") as wheel:
                wheel.writestr("share/robots/r.urdf", content)

        monkeypatch.setattr(fetch.subprocess, "run", download)
        origin = fetch.fetch(["arm"], [robot], tmp_path / "data")[-1].found
        assert (origin and "package index: robots-1.whl") == origin
        assert (origin is None) == (state is None)
        assert (tmp_path / "data" / "arm" / "r.urdf").exists() == (state is not None)

    @pytest.mark.parametrize("name", known())
    def test_every_robot_names_source_and_digests(self, name: str) -> None:
        published = Published.named(name)
        assert {*published.logs.values(), published.urdf} <= published.source.sha256.keys()
        assert all(
            re.fullmatch("[0-9a-f]{64}", digest) for digest in published.source.sha256.values()
        )

    def test_the_recordings_here_have_these_digests(self, tmp_path: Path) -> None:
        if not board.DATA.is_dir():
            pytest.skip(f"there are no recordings in {board.DATA}")
        assert all(file.found for file in fetch.fetch(known(), [board.DATA], tmp_path))
        for name in known():
            published = Published.named(name)
            folder = tmp_path / (published.folder or name)
            assert all((folder / log).is_file() for log in published.logs.values())


def row(hil: float, **others: Any) -> dict[str, Any]:
    nominal = dict.fromkeys(board.NEED_MASSES)
    measured = {"plain": 0.1, **nominal, "inside": 0.95}
    seconds = {"seconds": {"hil": 4.2, "plain": 1.0}}
    return {"data": "gen3", "split": "a to b", "hil": hil, **measured, **seconds, **others}


class TestPage:
    def test_losses_are_first_and_the_worst_of_them_at_the_top(self) -> None:
        rows = [row(0.05), row(0.12), row(0.09, nominal=0.08)]
        text = board_page.page_text(rows, "abc")
        behind, others = text.split("## Worse")[1].split("## At least as good")
        assert re.findall(r"\| a to b \| 10 % \| \S+ ?%? \| (\S+) %", behind) == ["12", "9"]
        assert re.findall(r"\| a to b \| 10 % \| \S+ ?%? \| (\S+) %", others) == ["5"]
        ratios = [float(ratio) for ratio in re.findall(r"% \| (\d+\.\d\d) \|", behind)]
        assert ratios == sorted(ratios, reverse=True)

    def test_what_was_measured_elsewhere_says_so(self) -> None:
        lines = board_page.elsewhere()
        text = board_page.page_text([row(0.05)], "abc")
        (commit,) = {line.commit for line in lines}
        assert text.count(f"(measured elsewhere, {commit})") == len(lines) > 20
        assert "wissem01chiha/dynamic-identification" in text
        assert "| a to b | 10 % | - | 5 % | 0.50 | 95 % | 4 |" in text

    def test_choices_are_shown_where_they_change_a_row(self) -> None:
        rows = [
            row(0.05, without=dict.fromkeys(CHOICES, 1.0) | {"rows": 1.2, "velocity": 0.9}),
            row(0.06, without=dict.fromkeys(CHOICES, 1.001) | {"rows": 1.1}),
        ]
        section = board_page.page_text(rows, "abc").split("## Without each choice")[1]
        assert "| row | rows | velocity |" in section
        assert "| gen3, a to b | 1.20 | 0.90 |" in section
        assert "| gen3, a to b | 1.10 |  |" in section
        assert "bandwidth" in section.split("No effect on any row:")[1]

    def test_averaged_answers_are_shown_where_they_change_a_row(self) -> None:
        rows = [row(0.05, averaged=dict.fromkeys(COLUMNS, 1.0) | {"rows": 1.2, ALL: 0.9})]
        section = board_page.page_text(rows, "abc").split("## With averaged answers")[1]
        assert "| row | rows | all but the prior |" in section
        assert "| gen3, a to b | 1.20 | 0.90 |" in section
        assert "bandwidth" in section.split("No effect on any row:")[1]

    def test_without_choices_there_is_no_such_section(self) -> None:
        assert "Without each choice" not in board_page.page_text([row(0.05)], "abc")

    @pytest.mark.parametrize(
        ("hil", "nominal", "with_friction", "with_scale", "loss"),
        [(0.1, None, None, None, False), (0.101, None, None, None, True),
         (0.05, 0.04, None, None, True), (0.05, 0.2, 0.04, None, True),
         (0.05, 0.2, 0.06, 0.04, True), (0.05, 0.06, 0.06, 0.06, False)],
    )  # fmt: skip
    def test_a_loss_is_against_any_of_them(
        self,
        hil: float,
        nominal: float | None,
        with_friction: float | None,
        with_scale: float | None,
        loss: bool,
    ) -> None:
        line = Line(arm="", source="", split="", plain=0.1, hil=hil, nominal=nominal,
                    nominal_friction=with_friction, nominal_scale=with_scale)  # fmt: skip
        assert line.is_loss == loss

    def test_it_is_written_again_from_saved_rows(self, tmp_path: Path) -> None:
        saved = tmp_path / "board.json"
        page = tmp_path / "board.md"
        saved.write_text(json.dumps({"rows": [row(0.05)], "commit": "1234abcd"}))
        board.main(["--rows", str(saved), "--page", str(page)])
        text = page.read_text("utf-8")
        assert text.startswith("# All real arms")
        assert "Measured at 1234abcd on 1 splits of real arms (1 arms)" in " ".join(text.split())

    def test_the_page_of_the_docs_has_every_split_of_every_robot(self) -> None:
        text = (Path(__file__).parents[2] / "docs" / "board.md").read_text("utf-8")
        for name in known():
            published = Published.named(name)
            for split in published.splits:
                assert f"| {split} |" in text
            assert published.source.arm in text
