"""Checks of archives that the mcap library has written; commands `hil archive`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import IndexType, Writer
from typer.testing import CliRunner

from hil.archive import Samples, container, header, open_archive, schema, write_samples
from hil.archive.check import check_archive
from hil.archive.repair import repair
from hil.cli import app
from hil.errors import ArchiveError, NotAnArchiveError
from tests.hil.mcap_bytes import Content


@pytest.fixture
def content(written) -> Content:
    found = Content.of(written.path)
    del found.outcome[header.CHUNKS]  # of chunks that are changed here
    return found


def change_message(content: Content, topic: str, nth: int, **changes: Any) -> None:
    """Change the nth message of a topic."""
    place = [i for i, message in enumerate(content.messages) if message.topic == topic][nth]
    content.messages[place] = replace(content.messages[place], **changes)


def longer(content: Content) -> None:
    data = [m for m in content.messages if m.topic == schema.COMMANDED][3].data
    change_message(content, schema.COMMANDED, 3, data=data + bytes(8))


def no_events(content: Content) -> None:
    content.messages = [one for one in content.messages if one.topic != schema.EVENTS]


def entry(key: str, value: str) -> Callable[[Content], None]:
    return lambda content: content.metadata.update({key: value})


def outcome(key: str, value: str) -> Callable[[Content], None]:
    return lambda content: content.outcome.update({key: value})


BROKEN = {
    "another profile": (lambda c: setattr(c, "profile", "ros1"), "header"),
    "another library": (lambda c: setattr(c, "library", "mcap 1.6"), "header"),
    "a kind that the name denies": (entry("kind", "excitation"), "kind"),
    "a joint twice": (entry("joint_names", '["a", "a"]'), "joint_names"),
    "no period": (lambda c: c.metadata.pop("period"), "period"),
    "an attachment too few": (lambda c: c.attachments.pop("cell.toml"), "cell.toml"),
    "no events": (no_events, "3 events"),
    "a longer message": (longer, "messages that differ"),
    "a number skipped": (lambda c: change_message(c, schema.EVENTS, 2, sequence=7), "continue"),
    "an unknown outcome": (outcome("outcome", "splendid"), "splendid"),
    "a sample counted too many": (outcome("samples", "44"), "44 samples"),
    "no message index": (lambda c: setattr(c, "indexes", IndexType.CHUNK), "indexes"),
}


class TestCheckOfContent:
    """Files that the mcap library has written."""

    def test_file_written_by_the_library_conforms(self, content, written, tmp_path):
        check = check_archive(content.write(tmp_path / written.path.name))
        assert check.conforms, check.faults
        assert (check.samples, check.repaired) == (43, False)

    @pytest.mark.parametrize("what", BROKEN)
    def test_fault_is_named(self, what, content, written, tmp_path):
        change, named = BROKEN[what]
        change(content)
        check = check_archive(content.write(tmp_path / written.path.name))
        assert not check.conforms
        assert named in " ".join(check.faults)


def test_imported_recording_conforms(tmp_path):
    position = np.random.default_rng(1).normal(size=(2500, 2))
    stamp = 7 + np.arange(2500, dtype=np.int64) * 8_000_000
    samples = Samples(stamp, position, motor_current=position)
    path = write_samples(tmp_path / "x.mcap", samples, joint_names=("a", "b"), metadata={})
    check = check_archive(path)
    assert check.conforms, check.faults


class TestAnotherFile:
    def test_other_mcap_file_is_refused(self, tmp_path):
        path = tmp_path / "x.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start("ros1", "some recorder")
            writer.finish()
        with pytest.raises(NotAnArchiveError, match="is an MCAP file, but not an archive"):
            check_archive(path)

    @pytest.mark.parametrize("data", [b"hello" * 9, b""])
    def test_other_file_is_refused(self, tmp_path, data):
        (tmp_path / "x").write_bytes(data)
        for read in (check_archive, open_archive):
            with pytest.raises(NotAnArchiveError, match="is not an MCAP file"):
                read(tmp_path / "x")

    def test_damaged_description_is_refused(self, written, tmp_path):
        description = next(r for r in written.records if r.opcode == container.METADATA)
        path = tmp_path / written.path.name
        path.write_bytes(written.changed(description, -3, mask=1))
        with pytest.raises(NotAnArchiveError, match="fails its checksum"):
            check_archive(path)

    def test_missing_file_is_refused_with_a_remedy(self, tmp_path):
        for read in (check_archive, open_archive, repair):
            with pytest.raises(ArchiveError, match="No such file or directory; check whether"):
                read(tmp_path / "nowhere.mcap")


def run(*arguments: str | Path):
    return CliRunner().invoke(app, ["archive", *map(str, arguments)])


@pytest.fixture
def truncated(tmp_path, written) -> Path:
    path = tmp_path / written.path.name
    path.write_bytes(written.data[: written.chunks[2].end])
    return path


@pytest.fixture
def text_file(tmp_path) -> Path:
    (tmp_path / "x.txt").write_text("hello, world")
    return tmp_path / "x.txt"


class TestCheck:
    def test_text_names_faults_and_repair(self, written, truncated, text_file):
        done = run("check", written.path, truncated, text_file)
        assert done.exit_code == 2
        assert "conforms to profile 1, 43 samples" in done.stdout
        assert "the outcome is missing" in done.stdout
        assert f"hil archive repair {truncated}" in done.stdout
        assert f"{text_file}: is not an MCAP file" in done.stderr
        assert [run("check", path).exit_code for path in (written.path, truncated)] == [0, 5]

    def test_json_has_a_line_per_file(self, written, truncated, text_file):
        done = run("check", "--json", written.path, truncated, text_file)
        assert done.exit_code == 2
        intact, cut, other = (json.loads(line) for line in done.stdout.splitlines())
        assert intact["keeps"] and intact["faults"] == []
        assert not cut["keeps"]
        assert "the outcome is missing" in cut["faults"]
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

    def test_loss_is_printed_and_sets_the_exit_status(self, truncated, tmp_path):
        output = tmp_path / "out.mcap"
        done = run("repair", truncated, "-o", output)
        assert done.exit_code == 3
        assert "lost: the outcome is missing" in done.stderr
        assert open_archive(output).n_samples == 30
        before = truncated.read_bytes()
        run("repair", truncated)
        assert truncated.read_bytes() == before
        assert run("repair", truncated, "--in-place").exit_code == 3
        assert open_archive(truncated).complete

    def test_nothing_to_repair_or_to_save(self, written, text_file):
        done = run("repair", written.path)
        assert done.exit_code == 0
        assert "nothing to repair" in done.stdout
        done = run("repair", text_file)
        assert done.exit_code == 1
        assert "is not an MCAP file" in done.stderr


class TestInfo:
    def test_prints_the_content(self, written, truncated, text_file):
        done = run("info", written.path)
        assert done.exit_code == 0
        for words in (
            "validation 4, attempt 1",
            "completed",
            "samples      43",
            "a, b",
            "/hil/cycle",
            "hil_msgs/msg/Cycle2",
            "robot.urdf",
            "tick  text",
        ):
            assert words in done.stdout
        done = run("info", truncated)
        assert done.exit_code == 0
        assert "samples      30" in done.stdout
        assert "hil archive repair" in done.stdout
        assert run("info", text_file).exit_code == 2

    def test_as_json(self, written):
        found = json.loads(run("info", "--json", written.path).stdout)
        assert found["samples"] == 43
        assert found["joint_names"] == ["a", "b"]
        assert ["/hil/cycle", "hil_msgs/msg/Cycle2", 43] in found["channels"]
        assert found["attachments"] == {
            name: len(data) for name, data in written.attachments.items()
        }
