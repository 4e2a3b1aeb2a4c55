"""Damaged archives: all that is whole is read and repaired, and what is lost is stated."""

from __future__ import annotations

import json
import os
import random
import stat
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import DataEnd, Metadata
from mcap.writer import CompressionType, IndexType
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from drivers.cycle_records import cycle_dtype
from hil.archive import (
    Archive,
    ImportedSamples,
    header,
    open_archive,
    schema,
    verified_records,
    write_samples,
)
from hil.archive import repair as repairing
from hil.archive.check import check_archive
from hil.archive.repair import Repair, repair
from hil.archive.verified_records import encode
from hil.base.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from hil.cli import app
from tests.hil import mcap_bytes
from tests.hil.archive.conftest import FIRST, NAME, Written, write
from tests.hil.mcap_bytes import Content, chunks


def recorded(path: Path, first: int = FIRST, missed: int = 0) -> bytes:
    """Return an archive with the same header as the small one and other cycles and positions.

    Packets are missed between its chunks.
    """
    rows = np.zeros(43, cycle_dtype(2))
    rows["cycle"] = first + np.arange(43) + missed * (np.arange(43) // 10)
    rows["number"] = np.arange(43)
    rows["position"] = np.random.default_rng(2).normal(size=(43, 2))
    return write(path, rows)


def moved(data: bytes, *order: int) -> bytes:
    """Return the file with its chunks, each with its message indexes, in another order."""
    starts = [begin for begin, _ in chunks(data)]
    end = data.index(b"\x0b\x00\x00\x00hil.outcome") - verified_records.RECORD.size
    parts = [data[begin:stop] for begin, stop in zip(starts, [*starts[1:], end], strict=True)]
    return data[: starts[0]] + b"".join(parts[k] for k in order) + data[end:]


def flipped(data: bytes, at: int, mask: int = 0xFF) -> bytes:
    return data[:at] + bytes([data[at] ^ mask]) + data[at + 1 :]


def repaired_twice(path: Path, data: bytes) -> tuple[Repair, bytes]:
    """Repair bytes, and repair the result."""
    output = path.with_name("once.mcap")
    again = path.with_name("twice.mcap")
    for earlier in (output, again):
        earlier.unlink(missing_ok=True)
    path.write_bytes(data)
    done = repair(path, output)
    assert path.read_bytes() == data, "the original is unchanged"
    assert repair(output, again).intact, "a repaired archive has no fault"
    assert again.read_bytes() == output.read_bytes(), "repairing twice changes nothing"
    return done, output.read_bytes()


def assert_valid(done: Repair, written: Written) -> Archive:
    """Check that the repaired file is complete, correct, and states its losses."""
    archive = open_archive(done.output)
    assert archive.complete, archive.missing
    written.assert_true(archive)
    entries = archive.outcome.entries
    if done.losses:
        assert archive.outcome.repaired
        assert json.loads(entries["repaired.losses"]) == list(done.losses)
        lost = "unknown" if done.samples_lost is None else str(done.samples_lost)
        assert entries["repaired.samples_lost"] == lost
        assert entries["samples"] == str(done.samples) == str(archive.n_samples)
    else:
        assert (archive.n_samples, len(archive.events), done.samples_lost) == (43, 3, 0)
        assert not archive.outcome.repaired
    return archive


def assert_others_read(path: Path, archive: Archive) -> None:
    """The mcap library reads the repaired file."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        topics = ["/hil/cycle"]
        messages = reader.iter_decoded_messages(topics=topics, log_time_order=False)
        decoded = [message for *_, message in messages]
        statistics = reader.get_summary().statistics
    for name in archive.columns.keys() - {"stamp"}:
        column = archive.columns[name]
        values = np.array([getattr(message, name) for message in decoded], column.dtype)
        assert values.tobytes() == column.tobytes(), name
    shown = statistics.channel_message_counts.get(5, 0)  # of the description
    assert statistics.message_count == 3 * len(decoded) + len(archive.events) + shown


@dataclass(frozen=True)
class Loss:
    """A damage of the small archive, and what is left of it.

    `reason` is a part of the message, `lost` has the numbers of the chunks that are lost,
    `outcome` is that of a repair: unknown where it is lost.
    """

    data: Callable[[Written, Path], bytes]
    reason: str
    lost: tuple[int, ...]
    outcome: str = "completed"

    @property
    def cycles(self) -> list[int]:
        """The cycles of the other chunks."""
        return [FIRST + k for k in range(43) if k // 10 not in self.lost]


def zeroed(data: bytes, begin: int, end: int) -> bytes:
    return data[:begin] + bytes(end - begin) + data[end:]


LOSSES = {
    "cut in a chunk": Loss(
        lambda w, _: w.data[: w.chunks[2].end - 17], "its length is corrupt", (2, 3, 4), "unknown"
    ),
    "cut behind a chunk": Loss(
        lambda w, _: w.data[: w.chunks[2].end], "ends before its footer", (3, 4), "unknown"
    ),
    **{f"bit {bit} of the length of chunk {k}": Loss(
        lambda w, _, k=k, bit=bit:
            flipped(w.data, w.chunks[k].offset + 1 + bit // 8, 1 << bit % 8), "length", ()
    ) for k in range(5) for bit in (3, 11, 40)},
    "length of a message index": Loss(
        lambda w, _: flipped(w.data, w.chunks[1].end + 3), "length", ()
    ),
    "length of an attachment": Loss(
        lambda w, _: flipped(w.data, w.first(verified_records.ATTACHMENT).offset + 2), "length", ()
    ),
    "length of a chunk, and cut": Loss(
        lambda w, _: flipped(w.data, w.chunks[1].offset + 6)[: w.chunks[4].offset + 50],
        "length is corrupt", (1, 2, 3, 4), "unknown"
    ),
    "a chunk, and cut": Loss(
        lambda w, _: w.changed(w.chunks[1], -5)[: w.chunks[4].offset + 50],
        "(chunk)", (1, 4), "unknown"
    ),
    "the first chunk, and cut": Loss(  # it defines the channels, and so does the summary
        lambda w, _: w.changed(w.chunks[0], -5)[: w.chunks[4].offset + 50],
        "(chunk)", (0, 1, 2, 3, 4), "unknown"
    ),
    "zeros": Loss(
        lambda w, _: zeroed(w.data, w.chunks[1].end - 40, w.chunks[2].offset + 40),
        "(chunk)", (1, 2)
    ),
    "zeros in place of a length": Loss(
        lambda w, _: zeroed(w.data, w.chunks[1].end - 40, w.chunks[2].offset + 9), "(chunk)", (1,)
    ),
    "zeros, and cut": Loss(
        lambda w, _: zeroed(w.data, w.chunks[1].end - 40, w.chunks[2].offset + 40)[
            : w.chunks[4].offset + 50
        ],
        "(chunk)", (1, 2, 3, 4), "unknown"
    ),
    "zeros in a chunk": Loss(
        lambda w, _: zeroed(w.data, w.chunks[3].offset + 99, w.chunks[3].end - 99), "(chunk)", (3,)
    ),
    "attachment": Loss(
        lambda w, _: w.changed(w.first(verified_records.ATTACHMENT), -8), "'cell.toml') fails", ()
    ),
    **{
        f"content of chunk {k}": Loss(lambda w, _, k=k: w.changed(w.chunks[k], -5), "(chunk)", (k,))
        for k in range(5)
    },
    "swapped": Loss(lambda w, _: moved(w.data, 0, 2, 1, 3, 4), "does not continue", (1,)),
    "doubled": Loss(lambda w, _: moved(w.data, 0, 1, 1, 2, 3, 4), "repeats messages", ()),
    **{f"without chunk {k}": Loss(
        lambda w, _, k=k: moved(w.data, *[i for i in range(5) if i != k]),
        "does not continue" if k < 4 else "43 samples were written, 40 are there", (k,),
    ) for k in range(5)},
}  # fmt: skip


class TestLosses:
    @pytest.mark.parametrize("what", LOSSES)
    def test_what_is_whole_is_read_and_repaired(self, what, written, path):
        case = LOSSES[what]
        data = case.data(written, path)
        path.write_bytes(data)
        archive = open_archive(path)
        check = check_archive(path)
        sentence = str(archive.missing)
        assert sentence.startswith(str(path))
        assert case.reason in sentence
        assert f"{archive.n_samples} samples could be read" in sentence
        assert not check.conforms
        assert case.reason in " ".join(check.faults)
        part = open_archive(path, start=50.1, stop=50.3)
        assert part.n_samples == 20 or not part.complete
        for opened in (archive, part):
            written.assert_true(opened)
        assert archive.columns["stamp"].tolist() == [10**7 * k for k in case.cycles]
        assert check.samples == archive.n_samples
        done, output = repaired_twice(path, data)
        saved = assert_valid(done, written)
        assert {*done.losses} in ({*check.faults}, set())
        assert np.array_equal(saved.columns["stamp"], archive.columns["stamp"])
        assert saved.attachments == archive.attachments
        assert saved.attachments.keys() >= {"robot.urdf"}
        assert saved.outcome.outcome == case.outcome
        lost = 43 - len(case.cycles)
        assert done.samples_lost == (lost if case.outcome == "completed" else None)
        assert_others_read(done.output, saved)
        path.write_bytes(output)
        check = check_archive(path)
        assert check.conforms, check.faults
        assert check.repaired == bool(done.losses)

    def test_range_of_the_bytes_left_out_is_stated(self, written, path):
        begin = written.chunks[1].offset
        end = written.chunks[2].offset
        path.write_bytes(written.changed(written.chunks[1], -5))
        assert f"(bytes {begin} to {end} are skipped)" in repair(path).losses[0]

    def test_losses_of_several_repairs_add_up(self, path, written):
        _, first = repaired_twice(path, written.changed(written.chunks[3], -5))
        done, _ = repaired_twice(path, flipped(first, chunks(first)[1][1] - 5))
        entries = open_archive(done.output).outcome.entries
        assert (entries["samples"], entries["repaired.samples_lost"]) == ("23", "20")
        assert len(json.loads(entries["repaired.losses"])) > len(done.losses)

    def test_begin_and_end_of_two_recordings_are_refused(self, written, path):
        """Every checksum, count and cycle is right."""
        other = recorded(path.with_name("validation_004_a1.mcap"))
        path.write_bytes(written.data[: chunks(written.data)[0][0]] + other[chunks(other)[0][0] :])
        archive = open_archive(path)
        assert "another recording" in str(archive.missing)
        assert archive.n_samples == 0
        assert "another recording" in " ".join(check_archive(path).faults)
        with pytest.raises(ArchiveError, match=r"different recordings.*copy"):
            repair(path)

    def test_imported_recording(self, tmp_path):
        position = np.random.default_rng(1).normal(size=(3500, 2))
        samples = ImportedSamples(np.arange(3500, dtype=np.int64) * 1_000_000, position)
        path = tmp_path / "x.mcap"
        write_samples(path, samples, joint_names=("a", "b"), metadata={})
        assert check_archive(path).conforms
        data = path.read_bytes()
        path.write_bytes(flipped(data, chunks(data)[1][1] - 5))
        done = repair(path)
        assert (done.samples, done.samples_lost) == (2500, 1000)
        saved = np.delete(position, np.s_[1000:2000], axis=0)
        assert np.array_equal(open_archive(done.output).columns["position"], saved)


def flips(rng: random.Random, data: bytes, _: float) -> bytes:
    return flipped(data, rng.randrange(len(data)), 1 << rng.randrange(8))


def bursts(rng: random.Random, data: bytes, _: float) -> bytes:
    at = rng.randrange(len(data))
    length = rng.randrange(1, 600)
    return data[:at] + rng.randbytes(min(length, len(data) - at)) + data[at + length :]


def cuts(_: random.Random, data: bytes, share: float) -> bytes:
    return data[: int(len(data) * share)]


@pytest.mark.safety
class TestAnyDamage:
    """No wrong sample is read or repaired, no whole chunk is lost, and losses are reported."""

    @pytest.mark.parametrize(
        ("kind", "count", "whole", "lost"),
        [
            pytest.param(flips, 200, 20, 20, marks=pytest.mark.safety),
            (bursts, 60, 0, 10),
            (cuts, 80, 1, 5),
            pytest.param(flips, 10_000, 1000, 1000, marks=pytest.mark.slow),
            pytest.param(cuts, 14_000, 1, 5, marks=pytest.mark.slow),
        ],
    )
    def test_is_detected(self, written, path, monkeypatch, kind, count, whole, lost):
        monkeypatch.setattr("os.fsync", lambda descriptor: None)
        rng = random.Random(20261120)
        variants = (kind(rng, written.data, k / count) for k in range(count))
        counts = Counter(self.outcome_of(written, path, data) for data in variants)
        assert counts["whole"] >= whole
        assert counts["lost"] >= lost
        assert counts["refused"] < 0.6 * count

    def outcome_of(self, written: Written, path: Path, data: bytes) -> str:
        path.write_bytes(data)
        try:
            archive = open_archive(path)
        except ArchiveError as error:
            assert str(path) in str(error)
            return "refused"
        self.assert_true(written, archive)
        part = open_archive(path, start=50.1, stop=50.3)
        written.assert_true(part)
        assert part.n_samples == 20 or not part.complete
        same = [data[chunk.offset : chunk.end] == written.data[chunk.offset : chunk.end]
                for chunk in written.chunks]  # fmt: skip
        if same[0] or data.endswith(written.data[written.records[-1].end :]):  # definitions
            whole = {10**7 * (FIRST + k) for k in range(43) if same[k // 10]}
            assert whole <= {*archive.columns["stamp"].tolist()}
        done, _ = repaired_twice(path, data)
        saved = assert_valid(done, written)
        assert np.array_equal(saved.columns["stamp"], archive.columns["stamp"])
        return "lost" if done.losses else "whole"

    @staticmethod
    def assert_true(written: Written, archive: Archive) -> None:
        """What was read is what was written, all of it if the archive is complete."""
        written.assert_true(archive)
        starts = [event.data["start"] for event in archive.events]
        assert starts == sorted(set(starts))
        assert (archive.period, archive.kind) == (0.01, "validation")
        if archive.complete:
            assert (archive.n_samples, len(starts)) == (43, 3)
            assert dict(archive.attachments) == written.attachments
            assert archive.outcome.outcome == "completed"

    def test_changed_opcode_of_any_record_is_detected(self, written, path):
        """Readers skip records of unknown kind; the missing content must be detected."""
        matters = (
            verified_records.CHUNK,
            verified_records.METADATA,
            verified_records.ATTACHMENT,
            verified_records.DATA_END,
        )
        for record in written.records:
            path.write_bytes(flipped(written.data, record.offset, 0x80))
            try:
                archive = open_archive(path)
            except NotAnArchiveError:
                assert record.opcode == verified_records.METADATA
                continue
            self.assert_true(written, archive)
            assert archive.complete == (record.opcode not in matters)

    def test_changed_metadata_fail_their_checksum(self, written, path):
        """MCAP has no checksum for metadata, and a wrong period makes wrong times."""
        assert written.data.count(b"0.01") == 1
        path.write_bytes(written.data.replace(b"0.01", b"0.02"))
        for read in (open_archive, check_archive, repair):
            with pytest.raises(NotAnArchiveError, match="fails its checksum"):
                read(path)


@pytest.mark.safety
class TestNothingLost:
    def test_damaged_index_is_restored_to_the_byte(self, path, written):
        data = written.data
        index = written.changed(written.first(verified_records.MESSAGE_INDEX), 20)
        variants = [data, index, written.changed(written.chunks[2], 3), data + b"tail"]
        lengths = range(written.records[-1].offset, len(data), 97)
        for variant in [*variants, *(data[:length] for length in lengths)]:
            done, output = repaired_twice(path, variant)
            assert output == data
            assert done.intact == (variant == data) == check_archive(path).conforms
            assert_valid(done, written)
        path.write_bytes(data)
        assert repair(path).output is None, "an intact archive is not rewritten"

    def test_archive_of_an_earlier_version_with_list_of_chunks(self, written, path):
        content = Content.of(written.path)
        content.outcome[header.CHUNKS] = "0123abcd" * 5
        archive = open_archive(content.write(path))
        assert archive.complete, archive.missing
        assert archive.n_samples == 43
        assert header.CHUNKS not in archive.outcome.entries
        assert check_archive(path).conforms

    def test_copy_with_other_chunks_by_another_program_is_read(self, written, path):
        content = Content.of(written.path)
        replace(content, library="mcap", cycles_per_chunk=7).write(path)
        assert open_archive(path).complete
        assert not check_archive(path).conforms
        assert_valid(repair(path), written)

    @pytest.mark.parametrize("compression", [*CompressionType])
    def test_copy_of_any_compression_is_intact(self, written, path, compression):
        """Earlier versions wrote Zstandard."""
        replace(Content.of(written.path), compression=compression).write(path)
        assert check_archive(path).conforms
        assert repair(path).output is None

    def test_messages_metadata_and_attachments_are_all_repaired(self, written, path):
        """Of an archive of an earlier version without index, with channels of others."""
        content = Content.of(written.path)
        first = content.messages[0]
        others = [
            replace(first, topic="/other", publish_time=first.log_time + 7, sequence=k, data=b"ab")
            for k in range(3)
        ]
        content.messages[5:5] = others
        data = replace(content, compression=CompressionType.ZSTD).write(path).read_bytes()
        end = data.rindex(encode(DataEnd(0)))
        path.write_bytes(data[:end] + mcap_bytes.metadata("note", {"by": "others"}))
        done = repair(path)
        assert_valid(done, written)
        saved = Content.of(done.output)
        assert saved.messages == content.messages
        assert saved.attachments == content.attachments
        with done.output.open("rb") as stream:
            notes = [*make_reader(stream).iter_metadata()]
        assert Metadata("note", {"by": "others"}) in notes

    @pytest.mark.parametrize("missed", [0, 20, 100])
    def test_chunks_behind_missed_packets_are_whole(self, path, missed):
        """Seed 200168 of the simulation: the end is torn, and the PC had stalled before it."""
        data = recorded(path, missed=missed)
        torn = data[: chunks(data)[4][0] + 60]
        path.write_bytes(torn)
        assert open_archive(path).n_samples == 40

    def test_archive_repaired_by_an_earlier_version_is_read(self, written, path):
        """It continued behind damage: the numbers of its messages show the gap."""
        content = Content.of(written.path)
        gap = range(FIRST + 10, FIRST + 20)
        content.messages = [m for m in content.messages if m.log_time // 10_000_000 not in gap]
        content.outcome |= {"samples": "33", "events": "2"}
        content.write(path)
        assert "a chunk is missing" in str(open_archive(path).missing)
        content.outcome["repaired"] = "yes"
        archive = open_archive(content.write(path))
        assert archive.complete, archive.missing
        written.assert_true(archive)
        assert archive.n_samples == 33


def change_message(content: Content, topic: str, nth: int, **changes: Any) -> None:
    """Change the nth message of a topic."""
    place = [i for i, message in enumerate(content.messages) if message.topic == topic][nth]
    content.messages[place] = replace(content.messages[place], **changes)


def longer(content: Content) -> None:
    data = [m for m in content.messages if m.topic == schema.COMMANDED][3].data
    change_message(content, schema.COMMANDED, 3, data=data + bytes(8))


def no_events(content: Content) -> None:
    content.messages = [message for message in content.messages if message.topic != schema.EVENTS]


FAULTS: dict[str, tuple[Callable[[Content], object], str]] = {
    "nothing": (lambda c: None, ""),
    "a kind that the name denies": (lambda c: c.metadata.update(kind="excitation"), "kind"),
    "a joint twice": (lambda c: c.metadata.update(joint_names='["a", "a"]'), "joint_names"),
    "no period": (lambda c: c.metadata.pop("period"), "period"),
    "an attachment too few": (lambda c: c.attachments.pop("cell.toml"), "cell.toml"),
    "no events": (no_events, "3 events"),
    "a longer message": (longer, "messages that differ"),
    "a number skipped": (lambda c: change_message(c, schema.EVENTS, 2, sequence=7), "continue"),
    "an unknown outcome": (lambda c: c.outcome.update(outcome="splendid"), "splendid"),
    "a sample counted too many": (lambda c: c.outcome.update(samples="44"), "44 samples"),
    "no message index": (lambda c: setattr(c, "indexes", IndexType.CHUNK), "indexes"),
    "another profile": (lambda c: setattr(c, "profile", "ros1"), "summary"),
}


@pytest.mark.parametrize("what", FAULTS)
def test_fault_of_a_file_by_another_writer_is_named(what, written, tmp_path):
    content = Content.of(written.path)
    (change, named) = FAULTS[what]
    change(content)
    check = check_archive(content.write(tmp_path / written.path.name))
    assert check.conforms == (what == "nothing"), check.faults
    assert named in " ".join(check.faults)
    assert (check.samples == 43) or not check.conforms


class TestRefused:
    """No file is left."""

    @pytest.fixture(autouse=True)
    def truncated(self, path: Path, written) -> Iterator[None]:
        path.write_bytes(written.data[:-100])
        yield
        assert [entry.name for entry in path.parent.iterdir() if entry.name != "x.mcap"] == [
            path.name
        ]

    def test_an_existing_file_is_never_overwritten(self, path):
        (path.parent / "x.mcap").write_bytes(b"precious")
        with pytest.raises(ArchiveWriteError, match="exists already"):
            repair(path, path.parent / "x.mcap")
        assert (path.parent / "x.mcap").read_bytes() == b"precious"

    @pytest.mark.parametrize("read", [check_archive, open_archive, repair])
    def test_other_files_are_refused(self, path, read):
        other = mcap_bytes.record(
            verified_records.HEADER, mcap_bytes.text("ros1") + mcap_bytes.text("x")
        )
        end = mcap_bytes.record(verified_records.DATA_END, bytes(4))
        end += mcap_bytes.record(verified_records.FOOTER, bytes(20)) + verified_records.MAGIC
        for data, reason in (
            (b"hello" * 9, "is not an MCAP file"),
            (b"", "is not an MCAP file"),
            (verified_records.MAGIC + other + end, "is an MCAP file, but not an archive"),
        ):
            path.write_bytes(data)
            with pytest.raises(NotAnArchiveError, match=reason):
                read(path)
        with pytest.raises(ArchiveError, match="No such file or directory; check whether"):
            read(path.with_name("nowhere.mcap"))

    def test_output_that_cannot_be_read_back_is_removed(self, path, monkeypatch):
        damaged = open_archive(path)
        monkeypatch.setattr(repairing, "open_archive", lambda *_, **__: damaged)
        with pytest.raises(ArchiveError, match=r"cannot be rewritten.*restore it from a copy"):
            repair(path)

    def test_full_disk_is_an_archive_write_error(self, path, monkeypatch):
        def full(descriptor: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", full)
        with pytest.raises(ArchiveWriteError, match="No space left on device"):
            repair(path)


class TestFiles:
    """Names, links and modes of repaired files, of an archive without footer."""

    @pytest.fixture(autouse=True)
    def truncated(self, path: Path, written) -> None:
        path.write_bytes(written.data[:-100])

    def test_is_on_the_disk_before_it_has_its_name(self, path, monkeypatch):
        steps: list[str] = []
        sync = os.fsync
        rename = Path.replace

        def synced(descriptor: int) -> None:
            mode = os.fstat(descriptor).st_mode
            steps.append("folder" if stat.S_ISDIR(mode) else "file")
            sync(descriptor)

        def renamed(path: Path, target: Path) -> Path:
            steps.append("name")
            return rename(path, target)

        monkeypatch.setattr("os.fsync", synced)
        monkeypatch.setattr(Path, "replace", renamed)
        repair(path)
        assert steps == ["file", "name", "folder"]

    @pytest.mark.parametrize("name", [NAME, "link.mcap"])
    def test_in_place_replaces_the_archive_and_leaves_a_link(self, path, written, name):
        """And its mode."""
        path.chmod(0o600)
        link = path.with_name("link.mcap")
        link.symlink_to(path)
        done = repair(path.with_name(name), in_place=True)
        assert done.output == path.resolve()
        assert link.is_symlink()
        assert path.read_bytes() == written.data
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert {entry.name for entry in path.parent.iterdir()} == {path.name, link.name}


def run(*arguments: str | Path):
    return CliRunner().invoke(app, ["archive", *map(str, arguments)])


class TestCommands:
    @pytest.fixture
    def truncated(self, path, written) -> Path:
        path.write_bytes(written.data[: written.chunks[2].end])
        return path

    @pytest.fixture
    def text_file(self, tmp_path) -> Path:
        (tmp_path / "x.txt").write_text("hello, world")
        return tmp_path / "x.txt"

    def test_check(self, written, truncated, text_file):
        files = written.path, truncated, text_file
        done = run("check", *files)
        assert "conforms to profile 1, 43 samples" in done.stdout
        assert "ends before its footer" in done.stdout
        assert f"hil archive repair {truncated}" in done.stdout
        assert f"{text_file}: is not an MCAP file" in done.stderr
        assert [run("check", path).exit_code for path in files] == [0, 5, 2]
        done = run("check", "--json", *files)
        assert done.exit_code == 2
        intact, cut, other = (json.loads(line) for line in done.stdout.splitlines())
        assert (intact["keeps"], intact["faults"]) == (True, [])
        assert (cut["keeps"], len(cut["faults"])) == (False, 2)
        assert other["archive"] is False

    def test_repair(self, written, truncated, text_file, tmp_path):
        output = tmp_path / "out.mcap"
        done = run("repair", truncated, "-o", output)
        assert done.exit_code == 3
        assert "lost: the outcome is missing" in done.stderr
        assert open_archive(output).n_samples == 30
        assert run("repair", truncated, "--in-place").exit_code == 3
        assert open_archive(truncated).complete
        truncated.write_bytes(written.data[:-50])
        done = run("repair", truncated)
        assert done.exit_code == 0
        repaired = tmp_path / "validation_003_a1_repaired.mcap"
        assert f"wrote {repaired}: 43 samples, none lost" in done.stdout
        assert repaired.read_bytes() == written.data
        done = run("repair", written.path)
        assert done.exit_code == 0
        assert "nothing to repair" in done.stdout
        done = run("repair", text_file)
        assert done.exit_code == 1
        assert "is not an MCAP file" in done.stderr

    def test_info(self, written, truncated, text_file):
        done = run("info", "-v", written.path)
        assert done.exit_code == 0
        for line in ("validation 4, attempt 1", "completed", "samples      43", "tick  text"):
            assert line in done.stdout
        done = run("info", truncated)
        assert done.exit_code == 0
        assert "samples      30" in done.stdout
        assert "hil archive repair" in done.stdout
        assert run("info", text_file).exit_code == 2
        printed = json.loads(run("info", "--json", written.path).stdout)
        assert (printed["samples"], printed["joint_names"]) == (43, ["a", "b"])
        assert ["/hil/cycle", "hil_msgs/msg/Cycle2", 43] in printed["channels"]
        sizes = {name: len(data) for name, data in written.attachments.items()}
        assert printed["attachments"] == sizes
