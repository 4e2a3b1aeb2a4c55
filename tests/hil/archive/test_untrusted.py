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

import numpy as np
import pytest
import zstandard
from mcap.records import Attachment, Channel, Metadata
from typer.testing import CliRunner

import hil
from hil.archive import (
    ImportedSamples,
    header,
    open_archive,
    schema,
    verified_records,
    write_samples,
    writer,
)
from hil.archive.cdr import LayoutError, fixed_layout
from hil.archive.check import check_archive, read_overview
from hil.archive.header import ArchiveHeader, HeaderError
from hil.archive.repair import repair
from hil.archive.verified_records import Record
from hil.base.errors import ArchiveError
from hil.base.one_screen import SCREEN_COLUMNS, SCREEN_LINES
from hil.cli import app
from hil.pipeline.sources import cell_of, gather_sources
from tests.fuzz.mutate_mcap import Record as FileRecord
from tests.fuzz.mutate_mcap import body_of, entries_of, join_file, split_file, split_records
from tests.hil import mcap_bytes
from tests.hil.archive.conftest import NAME, peak, records_of

MEMORY = 60_000_000  # bytes; the small archive needs one million
READERS: dict[str, Callable[[Path], object]] = {
    "open_archive": open_archive,
    "a range": lambda path: open_archive(path, start=50.0, stop=50.2),
    "open_recording": hil.open_recording,
    "check": check_archive,
    "info": read_overview,
    "repair": lambda path: repair(path, path.with_name("repaired.mcap")),
}


def forged(
    data: bytes,
    path: Path,
    *,
    metadata: Mapping[str, str] | None = None,
    outcome: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    chunk: Callable[[bytes], bytes] = bytes,
) -> Path:
    """Write an archive with other content, valid checksums and index."""
    given = {"hil": metadata or {}, "hil.outcome": outcome or {}}
    records = split_file(data)
    assert records is not None
    for record in records:
        if record.opcode == verified_records.METADATA:
            name, entries = entries_of(record)
            record.body = body_of(Metadata(name, {**entries, **given[name]}))
        elif record.opcode == verified_records.CHUNK:
            record.inside = [FileRecord(*part) for part in split_records(chunk(record.content))]
        elif record.opcode == verified_records.ATTACHMENT:
            attachment = verified_records.parse(Attachment, Record(0, record.opcode, record.body))
            attachment.data = (attachments or {}).get(attachment.name, attachment.data)
            record.body = body_of(attachment)
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


DEEP = "[" * 100_000
INVALID = {
    "joint_names": ["", "null", "[]", "[1, 2]", '["a"', '["a", "a"]', DEEP, '["\\ud800", "b"]',
                    '["a\\u001b[31m", "b"]', json.dumps([str(i) for i in range(300)])],
    "attachments": ["[3]", "{}", '["\\ud800"]'],
    "period": ["", "true", "NaN", "1e999", "-0.001", "1e-300", "9" * 400],
    "held_joints": ["[1]"],
    "motor_from_joint": ["[[1, 0]]", "[[NaN, 0], [0, 1]]"],
}  # fmt: skip


class TestEntries:
    @pytest.mark.parametrize(
        ("field", "text"), [(field, text) for field, texts in INVALID.items() for text in texts]
    )
    def test_invalid_entry_is_named(self, field, text, written, tmp_path):
        path = forged(written.data, tmp_path / NAME, metadata={field: text})
        messages = outcomes(path)
        for reader in READERS.keys() - {"check"}:
            assert f"{NAME}: {field}: " in messages[reader], reader
        faults = check_archive(path).faults
        assert len(faults) == 1
        assert faults[0].startswith(f"{field} ")
        assert [file.name for file in tmp_path.iterdir()] == [NAME]

    def test_period_may_be_missing_but_not_invalid(self):
        entries = {"kind": "imported", "joint_names": '["a"]', "attachments": "[]"}
        assert ArchiveHeader.of(entries).period is None
        with pytest.raises(HeaderError, match="period cannot be used"):
            ArchiveHeader.of({**entries, "period": "soon"})

    @pytest.mark.parametrize("text", ["9" * 5000, "\N{SUPERSCRIPT TWO}", "-1", "1e3", "", DEEP])
    def test_invalid_counts_do_not_stop_readers(self, text, written, path):
        numbers = ("first_cycle", "late_answers", "repaired.losses", "repaired.samples_lost")
        entries = dict.fromkeys(("index", "attempt"), text)
        forged(written.data, path, metadata=entries, outcome=dict.fromkeys(numbers, text))
        assert set(outcomes(path).values()) == {""}
        assert "validation" in read_overview(path).title
        forged(written.data, path, outcome={"samples": text, **dict.fromkeys(numbers, text)})
        assert not check_archive(path).conforms
        done = repair(path)
        assert (done.samples, done.samples_lost) == (43, None)
        assert repair(done.output).intact

    @pytest.mark.parametrize("name", ["cell.toml", "robot.urdf"])
    def test_cell_that_is_not_text_is_named(self, name, written, tmp_path):
        path = forged(written.data, tmp_path / NAME, attachments={name: b"\xff\xfe"})
        with pytest.raises(ArchiveError, match=f"{name}: is not UTF-8 text"):
            cell_of(open_archive(path))
        arguments = ["identify", str(path), "--fit-all", "-o", str(tmp_path)]
        assert isinstance(CliRunner().invoke(app, arguments).exception, ArchiveError)
        with pytest.raises(ArchiveError, match=name):
            gather_sources([path], 0.3, in_sample=True)

    def test_second_header_is_damage(self, written, path):
        entries = {
            "kind": "move", "joint_names": '["x"]', "attachments": "[]", "format_version": "1"
        }  # fmt: skip
        second = mcap_bytes.metadata("hil", header.with_checksum(entries))
        end = written.records[-1].offset
        path.write_bytes(written.data[:end] + second + written.data[end:])
        archive = open_archive(path)
        assert archive.joint_names == ("a", "b")
        assert "occurs twice" in str(archive.damage)

    def test_texts_are_escaped_and_nested_data_stay_text(self, written, path):
        def nested(chunk: bytes) -> bytes:
            return chunk.replace(b'{"start": 0}', b"[" * len('{"start": 0}'))

        assert open_archive(forged(written.data, path, chunk=nested)).events[0].data == {}
        forged(
            written.data,
            path,
            metadata={"campaign": "\x1b]0;owned\x07\r<b>"},
            chunk=lambda chunk: chunk.replace(b"text\n", b"\x1b[2J\n"),
        )
        shown = CliRunner().invoke(app, ["archive", "info", "-v", str(path)]).output
        assert "owned" in shown
        assert not {"\x1b", "\x07", "\r"} & set(shown)

    def test_a_long_overview_is_cut_to_one_screen(self, written, path):
        rows = {f"entry_{number}": "word " * 40 for number in range(30)}
        forged(written.data, path, metadata=rows)
        shown = CliRunner().invoke(app, ["archive", "info", str(path)]).output.splitlines()
        assert len(shown) == SCREEN_LINES
        assert max(map(len, shown)) <= SCREEN_COLUMNS
        assert any(line.endswith("more lines: -v") for line in shown)
        whole = CliRunner().invoke(app, ["archive", "info", "-v", str(path)]).output
        assert all(f"{name} " in whole and text.strip() in whole for name, text in rows.items())

    def test_an_attachment_is_no_path(self, written, tmp_path):
        """No command writes attachments under names that the archive chooses."""
        folder = tmp_path / "folder"
        folder.mkdir()
        name = "../../etc/evil.toml"
        names = json.dumps([*sorted(written.attachments), name])
        path = forged(written.data, folder / NAME, metadata={"attachments": names})
        data = path.read_bytes()
        end = records_of(path)[-1].offset
        path.write_bytes(data[:end] + mcap_bytes.attachment(name, b"x") + data[end:])
        assert open_archive(path).attachments[name] == b"x"
        assert repair(path).samples == 43
        assert "evil.toml" in CliRunner().invoke(app, ["archive", "info", str(path)]).output
        assert {file.name for file in tmp_path.rglob("*")} == {
            "folder", NAME, NAME.replace(".mcap", "_repaired.mcap")
        }  # fmt: skip


CYCLE, ELSEWHERE = 1, 9  # numbers of channels; the second is unused


def channel(number: int, topic: str, *, schema_id: int = 1) -> bytes:
    return verified_records.encode(Channel(number, topic, "cdr", {}, schema_id))


def another_schema(chunk: bytes) -> bytes:
    texts = map(mcap_bytes.text, ("x", "ros2msg", "bool x"))
    return (
        mcap_bytes.record(verified_records.SCHEMA, struct.pack("<H", 1) + b"".join(texts)) + chunk
    )


def without_cycles(chunk: bytes) -> bytes:
    """Return a chunk whose cycles are of an unknown topic."""
    defined = channel(CYCLE, schema.CYCLE)
    assert defined in chunk
    return chunk.replace(defined, channel(CYCLE, "/elsewhere"))


def with_cycles(chunk: bytes) -> bytes:
    """Return a chunk whose cycles are of another channel, defined only here, numbered from 0."""
    changed = bytearray(chunk)
    number = 0
    for message in mcap_bytes.heads(chunk):
        if message.channel == CYCLE:
            struct.pack_into("<HI", changed, message.start + 9, ELSEWHERE, number)
            number += 1
    return channel(ELSEWHERE, schema.CYCLE) + changed


def later_currents(chunk: bytes) -> bytes:
    """Return a chunk whose currents are half a second later, their log times with them."""
    changed = bytearray(chunk)
    for message in mcap_bytes.heads(chunk):
        if message.channel == 2:
            time = message.log_time + 5 * 10**8
            struct.pack_into("<QQ", changed, message.start + 15, time, time)
            struct.pack_into("<iI", changed, message.data + 4, *divmod(time, 10**9))
    return bytes(changed)


def second_cycles(chunk: bytes) -> bytes:
    return channel(ELSEWHERE, schema.CYCLE) + chunk


CONTENTS = {
    "channel number": (
        [bytes, lambda chunk: channel(CYCLE, "/elsewhere") + chunk], "channel 1 a second time", 33
    ),
    "channel topic": ([bytes, second_cycles], "channel 9 a second time", 33),
    "schema": ([bytes, another_schema], "schema 1 a second time", 33),
    "cycles begin later": ([without_cycles, with_cycles], "channels than the previous chunks", 33),
    "imported: other times": ([bytes, later_currents], "channels of different times", 40),
    "imported: cycles": ([bytes, second_cycles], "channels than the previous chunks", 40),
}  # fmt: skip


class TestContents:
    """Samples of two channels must not be mixed, and have the same times."""

    @pytest.fixture
    def imported(self, tmp_path, monkeypatch) -> bytes:
        """An imported recording of 60 samples in three chunks: joints and currents, no cycles."""
        monkeypatch.setattr(writer, "_SAMPLES_PER_CHUNK", 20)
        values = np.arange(120.0).reshape(60, 2)
        samples = ImportedSamples(np.arange(60) * 10**9, values, motor_current=-values)
        path = tmp_path / "original.mcap"
        write_samples(path, samples, joint_names=["a", "b"], metadata={}, durable=False)
        return path.read_bytes()

    @pytest.mark.parametrize("what", CONTENTS)
    def test_such_a_chunk_is_left_out(self, what, written, imported, tmp_path):
        changes, why, sound = CONTENTS[what]
        data = imported if "imported" in what else written.data
        path = forged(data, tmp_path / "x.mcap", chunk=in_turn(*changes))
        for part in (open_archive(path), open_archive(path, start=0.0, stop=1e3)):
            assert {len(column) for column in part.columns.values()} == {sound}
            assert part.damage is not None
        assert why in str(open_archive(path).damage)
        assert not check_archive(path).conforms
        done = repair(path)
        assert done.samples == sound
        assert done.losses
        again = open_archive(done.output)
        assert again.complete
        assert {len(column) for column in again.columns.values()} == {sound}

    def test_as_it_was(self, written, imported, path):
        def again(chunk: bytes) -> bytes:
            return channel(CYCLE, schema.CYCLE) + chunk

        for data, change, count in ((written.data, again, 43), (imported, bytes, 60)):
            forged(data, path, chunk=change)
            assert check_archive(path).samples == count
            assert open_archive(path).complete
            assert open_archive(path).n_samples == count
        assert set(outcomes(forged(written.data, path)).values()) == {""}
        assert check_archive(path).conforms

    def test_other_number_of_joints(self, written, path):
        forged(written.data, path, metadata={"joint_names": '["a", "b", "c"]'})
        assert "does not fit 3 joints" in str(open_archive(path).damage)
        assert "has no sample" in outcomes(path)["open_recording"]
        assert not check_archive(path).conforms


def four_gigabytes(data: bytes, at: int) -> bytes:
    size = at + verified_records.RECORD.size + 16
    return data[:size] + struct.pack("<Q", 4 << 30) + data[size + 8 :]


def zeros(data: bytes, at: int) -> bytes:
    bomb = mcap_bytes.chunk(bytes(1 << 26), level=19)
    assert len(bomb) < 10_000
    return data[:at] + bomb * 50 + data[at:]


def larger_frame(data: bytes, at: int, *, stated: bool = False) -> bytes:
    """A frame that is larger than its chunk claims, with or without its size."""
    frame = zstandard.ZstdCompressor(write_content_size=stated).compress(bytes(1 << 27))
    head = struct.pack("<QQQI", 0, 0, 1000, 0) + mcap_bytes.text("zstd")
    bomb = mcap_bytes.record(verified_records.CHUNK, head + struct.pack("<Q", len(frame)) + frame)
    return data[:at] + bomb + data[at:]


class TestSizes:
    """Claims of gigabytes in a file of a few thousand bytes."""

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (four_gigabytes, "claims 4294967296 bytes"),
            (zeros, "claims 67108864 bytes"),
            (larger_frame, "decompressed"),
            (lambda data, at: larger_frame(data, at, stated=True), "another length than it claims"),
            (
                lambda data, at: (
                    data[:at] + verified_records.RECORD.pack(verified_records.CHUNK, 1 << 40)
                ),
                "claims 1099511627776 bytes",
            ),
        ],
    )
    def test_a_chunk_that_claims_too_much(self, change, reason, written, path):
        at = written.chunks[0].offset
        path.write_bytes(change(written.data, at))
        if "1099" in reason:  # a record as long as a sparse file
            os.truncate(path, (1 << 40) + at + verified_records.RECORD.size)
        assert peak(lambda: outcomes(path)) < MEMORY
        assert any(reason in fault for fault in check_archive(path).faults)

    def test_a_tail_as_long_as_a_sparse_file(self, written, path):
        path.write_bytes(written.data)
        os.truncate(path, 1 << 26)
        assert open_archive(path).n_samples == 43
        assert not open_archive(path).complete

    @pytest.mark.safety
    @pytest.mark.parametrize("what", ["over and over", "behind the file", "truncated", "farthest"])
    def test_an_index_of_chunks_that_does_not_fit(self, what, written, path):
        """The first chunk is always read."""

        def change(entry: bytes) -> bytes:
            if what == "over and over":
                return entry * 1000
            if what == "truncated":
                return verified_records.RECORD.pack(verified_records.CHUNK_INDEX, 3) + b"abc"
            place = {"behind the file": (8, 1 << 62), "farthest": ((1 << 64) - 1, 9)}[what]
            at = verified_records.RECORD.size + 16
            return entry[:at] + struct.pack("<QQ", *place) + entry[at + 16 :]

        self.with_entries(written.data, path, change)
        assert peak(lambda: outcomes(path)) < MEMORY
        assert set(outcomes(path).values()) == {""}
        opened = open_archive(path, start=50.0, stop=50.2)
        assert opened.columns["cycle"].tolist() == [*range(5000, 5020)]

    @staticmethod
    def with_entries(data: bytes, path: Path, change: Callable[[bytes], bytes]) -> None:
        """Write the archive, each entry of its index of chunks changed, with a valid checksum."""
        start = struct.unpack_from("<Q", data, len(data) - len(verified_records.MAGIC) - 20)[0]
        body = data[start : -verified_records.FOOTER_SIZE - len(verified_records.MAGIC)]
        summary = b""
        for item_record in verified_records.split_records(body, 0):
            record = mcap_bytes.record(item_record.opcode, item_record.body)
            if item_record.opcode != verified_records.SUMMARY_OFFSET:
                summary += (
                    change(record) if item_record.opcode == verified_records.CHUNK_INDEX else record
                )
        summary += struct.pack("<BQQQ", verified_records.FOOTER, 20, start, 0)
        crc = struct.pack("<I", zlib.crc32(summary))
        path.write_bytes(data[:start] + summary + crc + verified_records.MAGIC)

    @pytest.mark.parametrize("line", ["float64[999999999] x", "uint8[99999999999999999999] x",
                                      "float64 x\nfloat64 x"])  # fmt: skip
    def test_a_message_that_is_too_large(self, line):
        with pytest.raises(LayoutError):
            assert peak(lambda: fixed_layout(line)) < MEMORY
