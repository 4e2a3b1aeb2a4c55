"""`hil archive` at the command line: words, JSON and exit statuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.cli import app


def run(*arguments: str | Path):
    return CliRunner().invoke(app, ["archive", *map(str, arguments)])


@pytest.fixture
def torn(tmp_path, written) -> Path:
    path = tmp_path / written.path.name
    path.write_bytes(written.data[: written.chunks[2].end])
    return path


@pytest.fixture
def text_file(tmp_path) -> Path:
    (tmp_path / "x.txt").write_text("hello, world")
    return tmp_path / "x.txt"


class TestCheck:
    def test_an_archive_that_keeps_the_profile(self, written):
        done = run("check", written.path)
        assert done.exit_code == 0
        assert "keeps profile 1, 43 samples" in done.stdout

    def test_one_that_does_not_names_the_repair(self, torn):
        done = run("check", torn)
        assert done.exit_code == 5
        assert "the outcome is missing" in done.stdout
        assert f"hil archive repair {torn}" in done.stdout

    def test_what_is_no_archive_weighs_most(self, written, torn, text_file):
        done = run("check", written.path, torn, text_file)
        assert done.exit_code == 2
        assert f"{text_file}: is not an MCAP file" in done.stderr

    def test_json_has_a_line_per_file(self, written, torn, text_file):
        done = run("check", "--json", written.path, torn, text_file)
        assert done.exit_code == 2
        whole, cut, other = (json.loads(line) for line in done.stdout.splitlines())
        assert whole["keeps"]
        assert all(aspect["keeps"] for aspect in whole["aspects"].values())
        assert not cut["keeps"]
        assert cut["aspects"]["outcome"]["faults"] == ["the outcome is missing"]
        assert other["archive"] is False


class TestRepair:
    def test_nothing_lost(self, written, tmp_path):
        path = tmp_path / written.path.name
        path.write_bytes(written.data[:-50])
        done = run("repair", path)
        assert done.exit_code == 0
        repaired = tmp_path / "validation_003_a1_repaired.mcap"
        assert f"wrote {repaired}: 43 samples, none lost" in done.stdout
        assert repaired.read_bytes() == written.data

    def test_loss_is_told_and_is_the_exit_status(self, torn, tmp_path):
        output = tmp_path / "out.mcap"
        done = run("repair", torn, "-o", output)
        assert done.exit_code == 3
        assert "lost: the outcome is missing" in done.stderr
        assert open_archive(output).n_samples == 30

    def test_nothing_to_repair(self, written):
        done = run("repair", written.path)
        assert done.exit_code == 0
        assert "nothing to repair" in done.stdout

    def test_nothing_to_save_fails(self, text_file):
        done = run("repair", text_file)
        assert done.exit_code == 1
        assert "is not an MCAP file" in done.stderr

    def test_in_place_only_when_asked(self, torn):
        before = torn.read_bytes()
        run("repair", torn)
        assert torn.read_bytes() == before
        assert run("repair", torn, "--in-place").exit_code == 3
        assert open_archive(torn).complete


class TestInfo:
    def test_says_what_a_person_wants(self, written):
        done = run("info", written.path)
        assert done.exit_code == 0
        for words in (
            "validation 4, attempt 1",
            "completed",
            "43 samples, 0.420 s at 100 Hz",
            "a, b",
            "/hil/cycle",
            "hil_msgs/msg/Cycle2",
            "robot.urdf",
            "tick: text",
        ):
            assert words in done.stdout

    def test_of_a_torn_file_too(self, torn):
        done = run("info", torn)
        assert done.exit_code == 0
        assert "30 samples" in done.stdout
        assert "hil archive repair" in done.stdout

    def test_as_json(self, written):
        found = json.loads(run("info", "--json", written.path).stdout)
        assert found["samples"] == 43
        assert found["joint_names"] == ["a", "b"]
        assert ["/hil/cycle", "hil_msgs/msg/Cycle2", 43] in found["channels"]
        assert found["attachments"] == {
            name: len(data) for name, data in written.attachments.items()
        }

    def test_another_file_is_refused(self, text_file):
        assert run("info", text_file).exit_code == 2
