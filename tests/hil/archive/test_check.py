"""Conformance check, each rule of docs/archive-format.md violated once; commands `hil archive`.

The files are written by the mcap library, not by the own writer.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from hil.archive import Samples, container, header, open_archive, schema, write_samples
from hil.archive.check import ASPECTS, check_archive
from hil.archive.repair import repair
from hil.cli import app
from hil.errors import ArchiveError, NotAnArchiveError
from tests.hil.mcap_bytes import Content


@pytest.fixture
def content(written) -> Content:
    found = Content.of(written.path)
    del found.outcome[header.CHUNKS]  # of chunks that are changed here
    return found


def changed(content: Content, topic: str, nth: int, **changes: Any) -> None:
    """Change the nth message of a topic."""
    places = [i for i, message in enumerate(content.messages) if message.topic == topic]
    place = places[nth]
    content.messages[place] = replace(content.messages[place], **changes)


def every(content: Content, topic: str, **changes: Any) -> None:
    content.messages = [
        replace(message, **changes) if message.topic == topic else message
        for message in content.messages
    ]


def data_of(content: Content, topic: str, nth: int) -> bytearray:
    return bytearray([m for m in content.messages if m.topic == topic][nth].data)


def test_file_written_by_the_library_conforms(content, written, tmp_path):
    path = content.write(tmp_path / written.path.name)
    check = check_archive(path)
    assert check.conforms, check.faults
    assert check.samples == 43
    assert not check.repaired


def another_position(content: Content) -> None:
    data = data_of(content, schema.MEASURED, 5)
    data[-8] ^= 1  # of the last effort
    changed(content, schema.MEASURED, 5, data=bytes(data))


def another_stamp(content: Content) -> None:
    """In stamp and log time alike, but not cycle times period."""
    data = data_of(content, schema.CYCLE, 7)
    (nanoseconds,) = struct.unpack_from("<I", data, 8)
    struct.pack_into("<I", data, 8, nanoseconds + 1)
    time = [m for m in content.messages if m.topic == schema.CYCLE][7].log_time + 1
    changed(content, schema.CYCLE, 7, data=bytes(data), log_time=time, publish_time=time)


def longer(content: Content) -> None:
    data = bytes(data_of(content, schema.COMMANDED, 3)) + bytes(8)
    changed(content, schema.COMMANDED, 3, data=data)


def without(topic: str) -> Callable[[Content], None]:
    def change(content: Content) -> None:
        content.messages = [message for message in content.messages if message.topic != topic]

    return change


def entry(key: str, value: str) -> Callable[[Content], None]:
    return lambda content: content.metadata.update({key: value})


def outcome(key: str, value: str) -> Callable[[Content], None]:
    return lambda content: content.outcome.update({key: value})


def other_text(content: Content) -> None:
    (text,) = {m.text for m in content.messages if m.topic == schema.MEASURED}
    every(content, schema.MEASURED, text=text.replace("rad/s", "deg/s"))


BROKEN = {
    "another profile": (lambda c: setattr(c, "profile", "ros1"), "container"),
    "another library": (lambda c: setattr(c, "library", "mcap 1.6"), "container"),
    "a kind that the name denies": (entry("kind", "excitation"), "metadata"),
    "a joint twice": (entry("joint_names", '["a", "a"]'), "metadata"),
    "no period": (lambda c: c.metadata.pop("period"), "metadata"),
    "an attachment too few": (lambda c: c.attachments.pop("cell.toml"), "attachments"),
    "another text": (other_text, "schemas"),
    "another encoding": (lambda c: setattr(c, "encoding", "cdr2"), "channels"),
    "another type": (lambda c: every(c, schema.CYCLE, schema="x_msgs/msg/Cycle2"), "channels"),
    "no joint states": (without(schema.MEASURED), "channels"),
    "no events": (without(schema.EVENTS), "channels"),
    "lz4": (lambda c: setattr(c, "compression", CompressionType.LZ4), "chunks"),
    "long chunks": (lambda c: setattr(c, "cycles_per_chunk", 11), "chunks"),
    "a longer message": (longer, "sizes"),
    "a number skipped": (lambda c: changed(c, schema.EVENTS, 2, sequence=7), "sequence"),
    "another log time": (lambda c: changed(c, schema.MEASURED, 4, log_time=1), "times"),
    "another publish time": (lambda c: changed(c, schema.EVENTS, 1, publish_time=1), "times"),
    "a stamp beside the cycle": (another_stamp, "times"),
    "a joint state beside the cycle": (another_position, "joint_states"),
    "an unknown outcome": (outcome("outcome", "splendid"), "outcome"),
    "a sample counted too many": (outcome("samples", "44"), "outcome"),
    "lost packets that no gap shows": (outcome("lost_packets", "2"), "outcome"),
    "no message index": (lambda c: setattr(c, "indexes", IndexType.CHUNK), "index"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_violated_rule_is_named(what, content, written, tmp_path):
    """Each aspect by one at least."""
    change, aspect = BROKEN[what]
    change(content)
    check = check_archive(content.write(tmp_path / written.path.name))
    assert not check.conforms
    assert check.faults.get(aspect), check.faults
    assert set(check.faults) <= set(ASPECTS) == {one for _, one in BROKEN.values()}
    if change is another_position:
        assert list(check.faults) == ["joint_states"]
        assert "/joint_states unlike its cycles" in check.faults["joint_states"][0]


def test_imported_recording_conforms(tmp_path):
    position = np.random.default_rng(1).normal(size=(2500, 2))
    stamp = 7 + np.arange(2500, dtype=np.int64) * 8_000_000
    samples = Samples(stamp, position, motor_current=position)
    path = write_samples(tmp_path / "x.mcap", samples, joint_names=("a", "b"), metadata={})
    check = check_archive(path)
    assert check.conforms, check.faults


def test_damaged_description_is_a_fault(written, tmp_path):
    description = next(r for r in written.records if r.opcode == container.METADATA)
    path = tmp_path / written.path.name
    path.write_bytes(written.changed(description, -3, mask=1))
    assert "metadata" in check_archive(path).faults


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
        assert all([intact["keeps"], *(one["keeps"] for one in intact["aspects"].values())])
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
