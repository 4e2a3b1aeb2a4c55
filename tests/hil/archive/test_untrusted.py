"""Invalid or hostile archives with valid checksums.

Opening one raises an `ArchiveError` with file and field, or reports what is lost, in bounded
memory.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import zstandard
from mcap.records import Attachment, Channel, Metadata
from typer.testing import CliRunner

import hil
from hil.archive import container, header, open_archive, schema
from hil.archive.cdr import LayoutError, fixed_layout
from hil.archive.check import check_archive, read_overview
from hil.archive.container import Record
from hil.archive.header import ArchiveHeader, HeaderError
from hil.archive.repair import repair
from hil.archive.schema import sample_messages
from hil.archive.writer import ArchiveFile
from hil.cli import app
from hil.errors import ArchiveError
from hil.identify.sources import cell_of, gather_sources
from tests.fuzz.mutate_mcap import Record as FileRecord
from tests.fuzz.mutate_mcap import body_of, entries_of, join_file, split_file, split_records
from tests.hil import mcap_bytes
from tests.hil.archive.conftest import NAME, peak, records_of

MEMORY = 60_000_000  # bytes; the small archive needs one million
IMPORTED = "imported.mcap"
READERS: dict[str, Callable[[Path], object]] = {
    "open_archive": open_archive,
    "a range": lambda path: open_archive(path, start=50.0, stop=50.2),
    "open_recording": hil.open_recording,
    "check": check_archive,
    "info": read_overview,
    "repair": lambda path: repair(path, path.with_name("repaired.mcap")),
}


def forged(
    written,
    path: Path,
    *,
    metadata: Mapping[str, str] | None = None,
    outcome: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    chunk: Callable[[bytes], bytes] = bytes,
) -> Path:
    """Write the small archive with other content, valid checksums and index."""
    given = {"hil": metadata or {}, "hil.outcome": outcome or {}}
    records = split_file(written.data)
    assert records is not None
    for one in records:
        if one.opcode == container.METADATA:
            name, entries = entries_of(one)
            one.body = body_of(Metadata(name, {**entries, **given[name]}))
        elif one.opcode == container.CHUNK:
            one.inside = [FileRecord(*part) for part in split_records(chunk(one.content))]
        elif one.opcode == container.ATTACHMENT:
            found = container.parse(Attachment, Record(0, one.opcode, one.body))
            found.data = (attachments or {}).get(found.name, found.data)
            one.body = body_of(found)
    path.write_bytes(join_file(records, index=True))
    return path


def in_turn(*changes: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return a change for each of the first chunks, none of the others."""
    left = iter(changes)
    return lambda chunk: next(left, bytes)(chunk)


def outcomes(path: Path) -> dict[str, str]:
    """Return the error text of each reader, "" without error; other exceptions are raised."""
    messages = {}
    for name, read in READERS.items():
        try:
            read(path)
        except ArchiveError as error:
            assert error.path is not None
            messages[name] = str(error)
        else:
            messages[name] = ""
        path.with_name("repaired.mcap").unlink(missing_ok=True)
    return messages


def test_same_content_of_another_writer_is_valid(written, path):
    path = forged(written, path)
    assert check_archive(path).conforms
    assert set(outcomes(path).values()) == {""}


DEEP = "[" * 100_000
INVALID = {
    "joint_names": ["", "null", "[]", "[1, 2]", '["a"', '["a", "a"]', DEEP, '["\\ud800", "b"]',
                    '["a\\u001b[31m", "b"]', json.dumps([str(i) for i in range(300)])],
    "attachments": ["[3]", "{}", '["\\ud800"]'],
    "period": ["", "true", "NaN", "1e999", "-0.001", "1e-300", "9" * 400],
    "held_joints": ["[1]"],
    "motor_from_joint": ["[[1, 0]]", "[[NaN, 0], [0, 1]]"],
}  # fmt: skip


@pytest.mark.parametrize(("field", "text"), [(f, t) for f, texts in INVALID.items() for t in texts])
def test_invalid_entry_is_named(field, text, written, tmp_path):
    path = forged(written, tmp_path / NAME, metadata={field: text})
    messages = outcomes(path)
    for reader in READERS.keys() - {"check"}:
        assert f"{NAME}: {field}: " in messages[reader], reader
    faults = check_archive(path).faults
    assert len(faults) == 1
    assert faults[0].startswith(f"{field} ")
    assert [file.name for file in tmp_path.iterdir()] == [NAME]


def test_a_missing_period_is_a_fault_of_a_recorded_archive_alone():
    entries = {"kind": "imported", "joint_names": '["a"]', "attachments": "[]"}
    assert ArchiveHeader.of(entries).period is None
    with pytest.raises(HeaderError, match="period cannot be used"):
        ArchiveHeader.of({**entries, "period": "soon"})


@pytest.mark.parametrize("number", ["9" * 5000, "\N{SUPERSCRIPT TWO}", "-1", "1e3", ""])
def test_invalid_counts_do_not_stop_readers(number, written, path):
    path = forged(
        written,
        path,
        metadata=dict.fromkeys(("index", "attempt"), number),
        outcome=dict.fromkeys(("first_cycle", "last_cycle", "late_answers"), number),
    )
    messages = outcomes(path)
    assert set(messages.values()) == {""}, messages
    assert "validation" in read_overview(path).title


def test_invalid_count_is_a_fault(written, path):
    for count in ("samples", "events"):
        assert not check_archive(forged(written, path, outcome={count: "many"})).conforms


@pytest.mark.parametrize("name", ["cell.toml", "robot.urdf"])
def test_cell_that_is_not_text_is_named(name, written, tmp_path):
    path = forged(written, tmp_path / NAME, attachments={name: b"\xff\xfe"})
    with pytest.raises(ArchiveError, match=f"{name}: is not UTF-8 text"):
        cell_of(open_archive(path))
    result = CliRunner().invoke(app, ["identify", str(path), "--in-sample", "-o", str(tmp_path)])
    assert isinstance(result.exception, ArchiveError)
    with pytest.raises(ArchiveError, match=name):
        gather_sources([path], 0.3, in_sample=True)


def test_wrong_joints_or_a_second_header_are_damage(written, path):
    path = forged(written, path, metadata={"joint_names": '["a", "b", "c"]'})
    assert "not that of 3 joints" in str(open_archive(path).damage)
    assert "has no sample" in outcomes(path)["open_recording"]
    assert not check_archive(path).conforms
    entries = {"kind": "move", "joint_names": '["x"]', "attachments": "[]", "format_version": "1"}
    second = mcap_bytes.metadata("hil", {**entries, "checksum": header.checksum(entries)})
    end = written.records[-1]
    path.write_bytes(written.data[: end.offset] + second + written.data[end.offset :])
    archive = open_archive(path)
    assert archive.joint_names == ("a", "b")
    assert "second time" in str(archive.damage)


@pytest.mark.parametrize("losses", ["no", "[1]", DEEP])
def test_invalid_counts_and_losses_do_not_stop_repairs(losses, written, path):
    path = forged(
        written,
        path,
        outcome={"samples": "9" * 5000, "repaired.losses": losses, "repaired.samples_lost": "٣"},
    )
    done = repair(path)
    assert done.samples == 43
    assert done.samples_lost is None
    again = repair(done.output, done.output.with_name("again.mcap"))
    assert again.intact
    assert again.output.read_bytes() == done.output.read_bytes()
    assert read_overview(path).samples == 43


class TestEvents:
    def test_texts_are_escaped_and_nested_data_stay_text(self, written, path):
        """Deeply nested data stay text; control characters are not printed."""

        def nested(chunk: bytes) -> bytes:
            return chunk.replace(b'{"start": 0}', b"[" * len('{"start": 0}'))

        assert open_archive(forged(written, path, chunk=nested)).events[0].data == {}
        path = forged(
            written,
            path,
            metadata={"campaign": "\x1b]0;owned\x07\r<b>"},
            chunk=lambda chunk: chunk.replace(b"text\n", b"\x1b[2J\n"),
        )
        shown = CliRunner().invoke(app, ["archive", "info", str(path)]).output
        assert "owned" in shown
        assert not {"\x1b", "\x07", "\r"} & set(shown)


CYCLE, ELSEWHERE = 1, 9  # numbers of channels; the second is unused


def channel(number: int, topic: str, *, schema_id: int = 1) -> bytes:
    return container.encode(Channel(number, topic, "cdr", {}, schema_id))


def another_schema(chunk: bytes) -> bytes:
    body = (
        struct.pack("<H", 1)
        + mcap_bytes.text("x")
        + mcap_bytes.text("ros2msg")
        + mcap_bytes.text("bool x")
    )
    return mcap_bytes.record(container.SCHEMA, body) + chunk


def without_cycles(chunk: bytes) -> bytes:
    """Return a chunk whose cycles are of an unknown topic."""
    defined = channel(CYCLE, schema.CYCLE)
    assert defined in chunk
    return chunk.replace(defined, channel(CYCLE, "/elsewhere"))


def with_cycles(chunk: bytes) -> bytes:
    """Return a chunk whose cycles are of another channel, defined only here, numbered from 0."""
    changed, number = bytearray(chunk), 0
    for message in mcap_bytes.heads(chunk):
        if message.channel == CYCLE:
            struct.pack_into("<HI", changed, message.start + 9, ELSEWHERE, number)
            number += 1
    return channel(ELSEWHERE, schema.CYCLE) + changed


class TestDefinitions:
    """A number or topic that is redefined would mix samples of two channels."""

    @pytest.mark.parametrize(
        ("second", "why"),
        [
            (lambda chunk: channel(CYCLE, "/elsewhere") + chunk, "channel 1 a second time"),
            (lambda chunk: channel(ELSEWHERE, schema.CYCLE) + chunk, "channel 9 a second time"),
            (another_schema, "schema 1 a second time"),
        ],
    )
    def test_defined_again_as_something_else(self, second, why, written, tmp_path):
        # With cycle numbers a gap is visible, and what follows is saved.
        self.assert_first_alone(written, tmp_path, [bytes, second], why, repaired=33)

    def test_defined_again_as_it_was(self, written, path):
        again = channel(CYCLE, schema.CYCLE)
        path = forged(written, path, chunk=lambda chunk: again + chunk)
        assert check_archive(path).conforms

    def test_cycles_that_begin_behind_other_samples(self, written, tmp_path):
        chunks, why = [without_cycles, with_cycles], "other channels than those before"
        self.assert_first_alone(written, tmp_path, chunks, why, repaired=10)

    @staticmethod
    def assert_first_alone(
        written, folder: Path, changes: list[Callable[[bytes], bytes]], why: str, *, repaired: int
    ) -> None:
        """Check that nothing behind the first chunk is read, and columns have equal length."""
        path = forged(written, folder / NAME, chunk=in_turn(*changes))
        archive = open_archive(path)
        assert why in str(archive.damage)
        assert {len(column) for column in archive.columns.values()} == {10}
        assert not check_archive(path).conforms
        done = repair(path)
        assert done.samples == repaired
        assert done.losses
        again = open_archive(done.output)
        assert again.damage is None
        assert {len(column) for column in again.columns.values()} == {repaired}


@pytest.fixture
def imported(tmp_path) -> Imported:
    """An imported recording of 60 samples in three chunks: joints and currents, no cycles."""
    path = tmp_path / IMPORTED
    file = ArchiveFile(
        path,
        joint_names=["a", "b"],
        topics=(schema.MEASURED, schema.MOTOR_CURRENT, schema.EVENTS),
        metadata={"kind": "imported"},
        period=None,
        attachments={},
        durable=False,
    )
    for start in range(0, 60, 20):
        stamps = np.arange(start, start + 20, dtype=np.int64) * 10**9
        values = np.arange(2.0 * start, 2.0 * start + 40).reshape(20, 2)
        file.add(sample_messages(["a", "b"], stamps, {"position": values}, -values))
        file.flush()
    file.finish({"outcome": "completed", "reason": "", "samples": "60", "events": "0"})
    return Imported(path.read_bytes())


class Imported(NamedTuple):
    data: bytes


class TestImported:
    """Samples of two channels must have the same times."""

    def test_as_it_was(self, imported, tmp_path):
        path = forged(imported, tmp_path / IMPORTED)
        assert check_archive(path).conforms
        assert open_archive(path).n_samples == 60

    def test_currents_of_other_times_than_the_positions(self, imported, tmp_path):
        change = in_turn(bytes, self.later_currents)
        path = forged(imported, tmp_path / IMPORTED, chunk=change)
        assert "channels of different times" in str(open_archive(path).damage)
        self.assert_equally_long(path, 20)

    def test_channel_of_cycles_without_cycles(self, imported, tmp_path):
        change = in_turn(bytes, lambda chunk: channel(ELSEWHERE, schema.CYCLE) + chunk)
        outcome = {"samples": "20"}
        path = forged(imported, tmp_path / IMPORTED, chunk=change, outcome=outcome)
        assert "other channels than those before" in str(open_archive(path).damage)
        self.assert_equally_long(path, 20)

    @staticmethod
    def later_currents(chunk: bytes) -> bytes:
        """A chunk whose currents are half a second later, their log times with them."""
        changed = bytearray(chunk)
        for message in mcap_bytes.heads(chunk):
            if message.channel == 2:
                time = message.log_time + 5 * 10**8
                struct.pack_into("<QQ", changed, message.start + 15, time, time)
                struct.pack_into("<iI", changed, message.data + 4, *divmod(time, 10**9))
        return bytes(changed)

    @staticmethod
    def assert_equally_long(path: Path, sound: int) -> None:
        """What is read, whole or in part, is of one length, and no more than what is sound."""
        for part in (open_archive(path), open_archive(path, start=0.0, stop=1e3)):
            assert {len(column) for column in part.columns.values()} == {sound}
            assert part.damage is not None
        assert not check_archive(path).conforms


class TestNames:
    def test_an_attachment_is_no_path(self, written, tmp_path):
        """No command writes attachments under names that the archive chooses."""
        folder = tmp_path / "folder"
        folder.mkdir()
        name = "../../etc/evil.toml"
        names = json.dumps([*sorted(written.attachments), name])
        path = forged(written, folder / NAME, metadata={"attachments": names})
        data, end = path.read_bytes(), records_of(path)[-1].offset
        path.write_bytes(data[:end] + mcap_bytes.attachment(name, b"x") + data[end:])
        assert open_archive(path).attachments[name] == b"x"
        assert repair(path).samples == 43
        assert "evil.toml" in CliRunner().invoke(app, ["archive", "info", str(path)]).output
        assert {file.name for file in tmp_path.rglob("*")} == {
            "folder", NAME, NAME.replace(".mcap", "_repaired.mcap")
        }  # fmt: skip


class TestSizes:
    """Claims of gigabytes in a file of a few thousand bytes."""

    def test_a_chunk_that_claims_four_gigabytes(self, written, path):
        data = bytearray(written.data)
        struct.pack_into("<Q", data, written.chunks[0].offset + container.RECORD.size + 16, 4 << 30)
        path.write_bytes(data)
        self.assert_small(path, "claims 4294967296 bytes")

    def test_a_chunk_of_zeros_that_is_as_large_as_stated(self, written, path):
        bomb = mcap_bytes.chunk(bytes(1 << 26), level=19)
        assert len(bomb) < 10_000
        path.write_bytes(self.before_the_chunks(written, bomb * 50))
        self.assert_small(path, "claims 67108864 bytes")

    @pytest.mark.parametrize(
        ("stated", "reason"), [(True, "another length than it claims"), (False, "decompressed")]
    )
    def test_frame_larger_than_its_chunk_claims(self, stated, reason, written, path):
        """Whether the frame states its own size or not, it is not decompressed, or not far."""
        frame = zstandard.ZstdCompressor(write_content_size=stated).compress(bytes(1 << 27))
        head = struct.pack("<QQQI", 0, 0, 1000, 0) + mcap_bytes.text("zstd")
        bomb = mcap_bytes.record(container.CHUNK, head + struct.pack("<Q", len(frame)) + frame)
        path.write_bytes(self.before_the_chunks(written, bomb))
        self.assert_small(path, reason)

    def test_a_record_as_long_as_a_sparse_file(self, written, path):
        at = written.chunks[0].offset
        path.write_bytes(written.data[:at] + container.RECORD.pack(container.CHUNK, 1 << 40))
        os.truncate(path, (1 << 40) + at + container.RECORD.size)
        self.assert_small(path, "claims 1099511627776 bytes")

    def test_a_tail_as_long_as_a_sparse_file(self, written, path):
        path.write_bytes(written.data)
        os.truncate(path, 1 << 26)
        assert open_archive(path).n_samples == 43
        assert not open_archive(path).complete

    def test_an_index_that_lists_a_chunk_over_and_over(self, written, tmp_path):
        path = self.with_entries(written, tmp_path, lambda entry: [entry] * 1000)
        whole = open_archive(written.path, start=50.0, stop=50.2)
        found = open_archive(path, start=50.0, stop=50.2)
        assert found.columns["cycle"].tolist() == whole.columns["cycle"].tolist()
        assert set(outcomes(path).values()) == {""}

    @pytest.mark.parametrize("place", [(8, 1 << 62), (1 << 63, 100), ((1 << 64) - 1, 9)])
    def test_an_index_that_points_behind_the_file(self, place, written, tmp_path):
        def elsewhere(entry: bytes) -> list[bytes]:
            changed = bytearray(entry)
            struct.pack_into("<QQ", changed, container.RECORD.size + 16, *place)
            return [bytes(changed)]

        path = self.with_entries(written, tmp_path, elsewhere)
        assert peak(lambda: outcomes(path)) < MEMORY
        assert open_archive(path, start=50.0, stop=50.2).n_samples == 20

    @pytest.mark.parametrize("kind", [container.CHUNK_INDEX, container.METADATA_INDEX])
    def test_an_index_with_a_truncated_entry_is_not_used(self, kind, written, tmp_path):
        truncated = container.RECORD.pack(kind, 3) + b"abc"
        path = self.with_entries(written, tmp_path, lambda _: [truncated], kind)
        assert set(outcomes(path).values()) == {""}
        assert open_archive(path, start=50.0, stop=50.2).n_samples == 20

    @pytest.mark.parametrize("line", ["float64[999999999] x", "uint8[99999999999999999999] x",
                                      "float64 x\nfloat64 x"])  # fmt: skip
    def test_a_message_that_is_too_large(self, line):
        with pytest.raises(LayoutError):
            assert peak(lambda: fixed_layout(line)) < MEMORY

    @staticmethod
    def with_entries(
        written,
        folder: Path,
        change: Callable[[bytes], list[bytes]],
        kind: int = container.CHUNK_INDEX,
    ) -> Path:
        """The small archive, each entry of an index changed, with a valid checksum."""
        data = written.data
        start = struct.unpack_from("<Q", data, len(data) - len(container.MAGIC) - 20)[0]
        body = data[start : -container.FOOTER_SIZE - len(container.MAGIC)]
        summary = b""
        for record in (one.data for one in container.split_records(body, 0)):
            if record[0] == container.SUMMARY_OFFSET:
                continue
            summary += b"".join(change(record) if record[0] == kind else [record])
        summary += struct.pack("<BQQQ", container.FOOTER, 20, start, 0)
        path = folder / NAME
        crc = struct.pack("<I", zlib.crc32(summary))
        path.write_bytes(data[:start] + summary + crc + container.MAGIC)
        return path

    @staticmethod
    def before_the_chunks(written, record: bytes) -> bytes:
        at = written.chunks[0].offset
        return written.data[:at] + record + written.data[at:]

    @staticmethod
    def assert_small(path: Path, reason: str) -> None:
        messages: dict[str, str] = {}
        assert peak(lambda: messages.update(outcomes(path))) < MEMORY
        assert reason in messages["open_recording"]
        assert any(reason in fault for fault in check_archive(path).faults)
