"""Archives that were cut off or damaged: what is read is what was written, or it is said.

Or that hold whole chunks of another archive, each sound by itself: never read, and repaired around.
A repair invents nothing and names what is lost.
"""

from __future__ import annotations

import json
import os
import random
import stat
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

from drivers.record import cycle_dtype
from hil.archive import (
    Archive,
    ArchiveWriter,
    Samples,
    container,
    header,
    open_archive,
    schema,
    write_samples,
)
from hil.archive import repair as repairing
from hil.archive.check import check_archive
from hil.archive.repair import Repair, amend_outcome, repair
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from tests.hil import mcap_bytes


@pytest.fixture
def path(tmp_path: Path, written) -> Path:
    return tmp_path / written.path.name


def read(written, path: Path, data: bytes) -> Archive | None:
    """Damaged bytes: None when they are refused, else the beginning of what was written."""
    path.write_bytes(data)
    try:
        archive = open_archive(path)
    except ArchiveError as error:
        assert str(path) in str(error)
        return None
    written.assert_true(archive)
    assert archive.n_samples == 0 or archive.columns["cycle"][-1] == 4999 + archive.n_samples
    starts = [event.data["start"] for event in archive.events]
    assert starts == [0, 15, 30][: len(starts)]
    assert (archive.period, archive.kind) == (0.01, "validation")
    if archive.complete:
        assert (archive.n_samples, len(starts)) == (43, 3)
        assert dict(archive.attachments) == written.attachments
        assert archive.outcome is not None
        assert archive.outcome.outcome == "completed"
    return archive


class TestDamage:
    def test_what_is_missing_is_said_in_a_sentence(self, written, path):
        path.write_bytes(written.data[: written.chunks[2].end - 17])
        archive = open_archive(path)
        sentence = str(archive.missing)
        assert not archive.complete
        assert sentence.startswith(str(path))
        assert "is cut off, or its length is corrupt" in sentence
        assert "20 samples (0.19 s) could be read; the outcome is missing" in sentence
        # Where no column was asked for, nobody has counted them.
        uncounted = str(open_archive(path, fields=()).damage)
        assert "samples" not in uncounted
        assert uncounted.endswith("are unused); the outcome is missing")

    def test_an_empty_file_is_refused_with_the_reason(self, path):
        path.write_bytes(b"")
        with pytest.raises(ArchiveError, match="is empty: the recording ended before anything"):
            open_archive(path)

    def test_the_opcode_of_every_record_is_guarded(self, written, path):
        """A reader passes over records of unknown kind; what it then misses must be noticed."""
        matters = (container.CHUNK, container.METADATA, container.ATTACHMENT, container.DATA_END)
        for record in written.records:
            changed = bytearray(written.data)
            changed[record.offset] = 0x80
            archive = read(written, path, bytes(changed))
            whole = archive is not None and archive.complete
            assert whole == (record.opcode not in matters)

    @pytest.mark.parametrize("place", range(5))
    def test_a_chunk_that_was_cut_out_is_noticed(self, written, path, place):
        chunk = written.chunks[place]
        archive = read(written, path, written.data[: chunk.offset] + written.data[chunk.end :])
        assert archive is not None
        assert archive.n_samples == 10 * place
        assert not archive.complete

    def test_a_chunk_without_checksum_is_not_believed(self, written, path):
        changed = bytearray(written.data)
        at = written.chunks[0].offset + container.RECORD.size + 24
        changed[at : at + 4] = bytes(4)
        archive = read(written, path, bytes(changed))
        assert archive is not None
        assert archive.n_samples == 0
        assert "(chunk) has no checksum" in str(archive.missing)

    def test_metadata_are_guarded_by_their_own_checksum(self, written, path):
        """MCAP has no checksum for metadata, and a wrong period makes wrong times."""
        assert written.data.count(b"0.01") == 1
        assert read(written, path, written.data.replace(b"0.01", b"0.02")) is None
        assert header.checksum({"a": "1", "b": "2"}) == header.checksum({"b": "2", "a": "1"})
        assert header.checksum({"a": "1"}) != header.checksum({"a": "2"})


# Whole chunks of another archive, by the list of checksums in the outcome; of archives that earlier
# versions wrote, by the cycles

NAME = "validation_003_a1.mcap"


def recorded(path: Path, cycles: list[int], seed: int = 2) -> bytes:
    """An archive of the same description as the small one, of other cycles and positions."""
    rows = np.zeros(len(cycles), cycle_dtype(2))
    rows["cycle"] = cycles
    rows["number"] = np.arange(len(cycles))
    rows["position"] = np.random.default_rng(seed).normal(size=(len(cycles), 2))
    attachments = {"robot.urdf": b"<robot name='x'/>", "cell.toml": b"[cell]\nname = 'x'\n"}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    with ArchiveWriter(
        path,
        joint_names=("a", "b"),
        period=0.01,
        metadata={"campaign": "c"},
        attachments=attachments,
        durable=False,
    ) as archive:
        archive.write(rows)
        archive.close("completed")
    return path.read_bytes()


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where each chunk begins and ends."""
    found, at = [], len(container.MAGIC)
    while data[at] != container.DATA_END:
        opcode, length = container.RECORD.unpack_from(data, at)
        end = at + container.RECORD.size + length
        if opcode == container.CHUNK:
            found.append((at, end))
        at = end
    return found


def mixed(data: bytes, other: bytes, place: int, came: int | None = None) -> bytes:
    """The file with a chunk of the other in the place of one of its own."""
    begin, end = chunks(data)[place]
    return data[:begin] + other[slice(*chunks(other)[place if came is None else came])] + data[end:]


def earlier(data: bytes, path: Path) -> bytes:
    """The archive as versions wrote it that listed no chunks."""
    at = data.index(b"\x0b\x00\x00\x00hil.outcome") - container.RECORD.size
    opcode, length = container.RECORD.unpack_from(data, at)
    body = data[at + container.RECORD.size : at + container.RECORD.size + length]
    name, entries = container.metadata(container.Record(at, opcode, body))
    for key in (header.CHUNKS, header.DESCRIPTION, "checksum"):
        del entries[key]
    path.parent.mkdir(parents=True, exist_ok=True)
    entries["checksum"] = header.checksum(entries)
    path.write_bytes(data[:at] + mcap_bytes.metadata(name, entries))
    done = repair(path, in_place=True)  # makes the index anew
    assert done.losses == ()
    assert header.CHUNKS.encode() + b"\x28" not in path.read_bytes()
    return path.read_bytes()


@pytest.fixture(params=["listed", "of an earlier version"])
def ours(request: pytest.FixtureRequest, written, tmp_path: Path) -> bytes:
    if request.param == "listed":
        return written.data
    return earlier(written.data, tmp_path / "earlier" / NAME)


def assert_saved(path: Path, written, kept: list[int]) -> None:
    """A repair saves these chunks; the check counts the same samples, and so does the reader."""
    cycles = [5000 + c for k in kept for c in range(10 * k, min(10 * k + 10, 43))]
    check = check_archive(path)
    assert not check.keeps
    assert check.samples == len(cycles)
    done = repair(path)
    assert done.losses
    back = open_archive(done.output)
    assert back.complete, back.missing
    written.assert_true(back)
    assert back.columns["cycle"].tolist() == cycles
    assert repair(done.output).whole
    assert check_archive(done.output).keeps


def test_an_archive_of_an_earlier_version_opens_as_before(ours, written, path):
    path.write_bytes(ours)
    archive = open_archive(path)
    assert archive.complete
    assert archive.n_samples == 43
    assert archive.outcome is not None
    assert header.CHUNKS not in archive.outcome.entries
    assert check_archive(path).keeps
    assert repair(path).whole


@pytest.mark.parametrize("place", [0, 1, 4])
def test_a_chunk_with_cycles_of_another_time_costs_itself(ours, written, path, place):
    other = recorded(path, [9000 + c for c in range(43)])
    path.write_bytes(mixed(ours, other, place))
    archive = open_archive(path)
    assert not archive.complete
    written.assert_true(archive)
    assert archive.n_samples == 10 * place
    assert_saved(path, written, [k for k in range(5) if k != place])


def test_cycles_that_do_not_follow_those_before_are_damage(written, path):
    """5013 to 5022 between 5009 and 5020: where nothing lists the chunks, what follows is lost."""
    other = recorded(path, [5003 + c for c in range(43)])
    for ours, read in ((written.data, 10), (earlier(written.data, path), 20)):
        path.write_bytes(mixed(ours, other, 1))
        archive = open_archive(path)
        assert not archive.complete
        assert archive.n_samples == read
        assert not check_archive(path).keeps
    path.write_bytes(mixed(written.data, other, 1))
    part = open_archive(path, start=50.1, stop=50.3)
    assert part.n_samples == 0
    assert not part.complete
    assert_saved(path, written, [0, 2, 3, 4])


@pytest.mark.parametrize("place", range(5))
def test_a_chunk_with_the_same_cycles_is_known_by_its_checksum(written, path, place):
    other = recorded(path, [5000 + c for c in range(43)])
    path.write_bytes(mixed(written.data, other, place))
    archive = open_archive(path)
    assert "is of another recording" in str(archive.missing)
    written.assert_true(archive)
    assert archive.n_samples == 10 * place
    for topic in (schema.MEASURED, schema.COMMANDED):
        alone = open_archive(path, topics=[topic])
        assert not alone.complete
        assert alone.n_samples == 10 * place
    time = 50.0 + 0.1 * place
    part = open_archive(path, start=time, stop=time + 0.02)
    assert not part.complete
    assert part.n_samples == 0
    assert_saved(path, written, [k for k in range(5) if k != place])


@pytest.mark.parametrize("cut", [9, 60])
def test_the_list_is_found_where_the_file_has_lost_its_end(written, path, cut):
    other = recorded(path, [5000 + c for c in range(43)])
    data = mixed(written.data, other, 2)
    end = data.index(b"\x0b\x00\x00\x00hil.outcome")
    _, length = container.RECORD.unpack_from(data, end - container.RECORD.size)
    path.write_bytes(data[: end + length + cut])
    archive = open_archive(path)
    written.assert_true(archive)
    assert archive.n_samples == 20


def test_damage_behind_it_hides_no_strange_chunk(written, path):
    other = recorded(path, [5000 + c for c in range(43)])
    data = bytearray(mixed(written.data, other, 1))
    data[chunks(bytes(data))[3][1] - 5] ^= 0xFF
    path.write_bytes(data)
    archive = open_archive(path)
    assert archive.n_samples == 10
    assert_saved(path, written, [0, 2, 4])


def amended(path: Path) -> Path:
    amend_outcome(path, "rejected", "of no use")
    return path


def repaired(path: Path) -> Path:
    data = bytearray(path.read_bytes())
    data[chunks(bytes(data))[1][1] - 5] ^= 0xFF
    path.write_bytes(data)
    repair(path, in_place=True)
    return path


@pytest.mark.parametrize("change", [amended, repaired])
def test_what_was_written_anew_knows_its_chunks_as_well(
    written, path, change: Callable[[Path], Path]
):
    other = change(Path(recorded(path, [5000 + c for c in range(43)]) and path)).read_bytes()
    path.write_bytes(written.data)
    ours = change(path).read_bytes()
    assert open_archive(path).complete
    path.write_bytes(mixed(ours, other, 2))
    archive = open_archive(path)
    assert "is of another recording" in str(archive.missing)
    written.assert_true(archive)


def test_another_program_may_cut_the_chunks_anew(written, path):
    """It names itself in the header; a repair makes the file ours again, list and all."""
    with written.path.open("rb") as stream, path.open("wb") as target:
        reader = make_reader(stream)
        writer = Writer(target, chunk_size=1 << 30, compression=CompressionType.ZSTD)
        writer.start("ros2")
        first, last = reader.iter_metadata()
        writer.add_metadata(first.name, first.metadata)
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, "x/y", attachment.data)
        channels: dict[str, int] = {}
        for kind, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in channels:
                number = writer.register_schema(kind.name, kind.encoding, kind.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            if channel.topic == schema.CYCLE and message.sequence % 7 == 0:
                writer.flush()
            times = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(channels[channel.topic], *times)
        writer.add_metadata(last.name, last.metadata)
        writer.finish()
    assert open_archive(path).complete
    done = repair(path)
    assert done.losses == ()
    archive = open_archive(done.output)
    assert archive.complete
    written.assert_true(archive)
    assert archive.n_samples == 43


def mended(path: Path, data: bytes) -> tuple[Repair, bytes]:
    """Repair bytes, and once more what comes of it."""
    output, again = path.with_name("once.mcap"), path.with_name("twice.mcap")
    for one in (output, again):
        one.unlink(missing_ok=True)
    path.write_bytes(data)
    done = repair(path, output)
    second = repair(output, again)
    assert path.read_bytes() == data, "the original is kept"
    assert second.whole, "a repaired archive has no fault"
    assert again.read_bytes() == output.read_bytes(), "repairing twice changes nothing"
    return done, output.read_bytes()


def assert_sound(done: Repair, written) -> None:
    """The repaired file is complete, true, keeps the profile and says what it lost."""
    assert done.output is not None
    archive = open_archive(done.output)
    assert archive.complete, archive.missing
    written.assert_true(archive)
    assert archive.outcome is not None
    if done.losses:
        assert archive.outcome.entries["repaired"] == "yes"
        assert json.loads(archive.outcome.entries["repaired.losses"]) == list(done.losses)
        lost = "unknown" if done.samples_lost is None else str(done.samples_lost)
        assert archive.outcome.entries["repaired.samples_lost"] == lost
    else:
        assert archive.n_samples == 43
        assert len(archive.events) == 3
        assert not archive.outcome.repaired


def flips(data: bytes, count: int) -> Iterator[bytes]:
    rng = random.Random(20261120)
    for _ in range(count):
        changed = bytearray(data)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        yield bytes(changed)


def bursts(data: bytes, count: int) -> Iterator[bytes]:
    rng = random.Random(7)
    for _ in range(count):
        changed = bytearray(data)
        at, length = rng.randrange(len(changed)), rng.randrange(1, 600)
        changed[at : at + length] = rng.randbytes(min(length, len(changed) - at))
        yield bytes(changed)


def cuts(data: bytes, count: int) -> Iterator[bytes]:
    yield from (data[: len(data) * k // count] for k in range(count))


class TestAnyDamage:
    """No wrong sample is read, in whole or in part, and a repair is true and says what is lost."""

    @pytest.mark.parametrize(
        ("kind", "count", "whole", "lost"),
        [
            (flips, 200, 20, 20),
            (bursts, 60, 0, 10),
            (cuts, 80, 1, 5),
            pytest.param(flips, 10_000, 1000, 1000, marks=pytest.mark.slow),
            pytest.param(cuts, 14_000, 1, 5, marks=pytest.mark.slow),
        ],
    )
    def test_is_noticed(self, written, path, monkeypatch, kind, count, whole, lost):
        monkeypatch.setattr("os.fsync", lambda descriptor: None)
        ends = [chunk.end for chunk in written.chunks]
        variants = kind(written.data, count)
        counts = Counter(self.judged(written, path, data, ends) for data in variants)
        assert counts["whole"] >= whole
        assert counts["lost"] >= lost
        assert counts["refused"] < 0.6 * count

    @staticmethod
    def judged(written, path: Path, data: bytes, ends: list[int]) -> str:
        archive = read(written, path, data)
        if archive is not None:
            if archive.damage is not None:
                assert archive.damage.offset + archive.damage.bytes_dropped == len(data)
            if written.data.startswith(data):
                assert archive.n_samples == min(10 * sum(c <= len(data) for c in ends), 43)
            part = open_archive(path, start=50.1, stop=50.3)
            if part.n_samples:
                cycle = part.columns["cycle"] - 5000
                assert np.array_equal(cycle, np.arange(10, 10 + len(cycle)))
                assert np.array_equal(part.columns["position"], written.rows["position"][cycle])
            assert part.n_samples == 20 or not part.complete
            alone = open_archive(path, topics=[schema.MEASURED])
            assert alone.n_samples == 43 or not alone.complete
            position = alone.columns.get("position", np.zeros((0, 2)))
            assert np.array_equal(position, written.rows["position"][: len(position)])
        try:
            done, _ = mended(path, data)
        except ArchiveError:
            return "refused"
        assert_sound(done, written)
        return "lost" if done.losses else "whole"


class TestNothingLost:
    def test_a_file_that_lost_its_index_becomes_what_it_was(self, path, written):
        """Cut anywhere behind the outcome: what follows from the rest is made anew."""
        end_of_data = written.records[-1].offset
        for length in range(end_of_data, len(written.data), 97):
            done, output = mended(path, written.data[:length])
            assert output == written.data
            assert done.losses == ()
            assert done.samples_lost == 0

    def test_message_indexes_are_made_anew(self, path, written):
        index = next(r for r in written.records if r.opcode == container.MESSAGE_INDEX)
        done, output = mended(path, written.changed(index, 20))
        assert not done.whole
        assert output == written.data

    def test_a_chunk_that_states_other_times_is_set_right(self, path, written):
        done, output = mended(path, written.changed(written.chunks[2], 3))
        assert not done.losses
        assert output == written.data

    def test_a_whole_archive_is_left_alone(self, path, written):
        path.write_bytes(written.data)
        done = repair(path)
        assert done.whole
        assert done.output is None
        assert [path.name for path in path.parent.iterdir()] == [path.name]

    def test_a_whole_archive_is_copied_where_an_output_is_named(self, path, written):
        _, output = mended(path, written.data)
        assert output == written.data


class TestLoss:
    def test_a_torn_file_keeps_its_whole_chunks(self, path, written):
        done, _ = mended(path, written.data[: written.chunks[2].end - 17])
        assert_sound(done, written)
        assert done.samples == 20
        assert done.samples_lost is None
        outcome = open_archive(done.output).outcome.entries
        assert outcome["outcome"] == "unknown"
        assert outcome["samples"] == "20"

    def test_what_stands_behind_a_damaged_chunk_is_kept(self, path, written):
        """Its cycles show the hole as they show lost packets."""
        done, _ = mended(path, written.changed(written.chunks[1], -5))
        assert_sound(done, written)
        archive = open_archive(done.output)
        kept = [*range(10), *range(20, 43)]
        assert archive.columns["cycle"].tolist() == [5000 + index for index in kept]
        assert done.samples_lost == 10
        assert archive.outcome.entries["outcome"] == "completed"

    def test_channels_are_found_in_the_index_where_the_first_chunk_is_lost(self, path, written):
        done, _ = mended(path, written.changed(written.chunks[0], -5))
        assert_sound(done, written)
        assert open_archive(done.output).columns["cycle"][0] == 5010

    def test_a_path_length_is_bridged_by_the_index(self, path, written):
        data = bytearray(written.data)
        data[written.chunks[1].offset + 6] ^= 0x40
        done, _ = mended(path, bytes(data))
        assert_sound(done, written)
        assert done.samples == 33

    def test_samples_of_a_foreign_recording_end_at_the_first_hole(self, tmp_path):
        """Nothing in them would show it."""
        position = np.random.default_rng(1).normal(size=(3500, 2))
        stamp = np.arange(3500, dtype=np.int64) * 1_000_000
        path = write_samples(
            tmp_path / "x.mcap", Samples(stamp, position), joint_names=("a", "b"), metadata={}
        )
        with path.open("rb") as stream:
            walked = list(container.records(stream, path.stat().st_size))
        second = [record for record in walked if record.opcode == container.CHUNK][1]
        data = bytearray(path.read_bytes())
        data[second.end - 5] ^= 0xFF
        path.write_bytes(data)
        done = repair(path)
        assert done.samples == 1000
        assert done.samples_lost == 2500
        assert np.array_equal(open_archive(done.output).columns["position"], position[:1000])

    def test_a_lost_attachment_is_no_longer_announced(self, path, written):
        attachment = next(r for r in written.records if r.opcode == container.ATTACHMENT)
        done, _ = mended(path, written.changed(attachment, -8))
        assert_sound(done, written)
        archive = open_archive(done.output)
        assert list(archive.attachments) == ["robot.urdf"]
        assert "cell.toml" in archive.outcome.entries["repaired.losses"]

    def test_damage_after_a_repair_adds_to_what_was_lost(self, path, written):
        _, first = mended(path, written.changed(written.chunks[1], -5))
        path.write_bytes(first)
        with path.open("rb") as stream:
            walked = list(container.records(stream, len(first)))
        chunk = [record for record in walked if record.opcode == container.CHUNK][1]
        data = bytearray(first)
        data[chunk.end - 5] ^= 0xFF
        done, _ = mended(path, bytes(data))
        outcome = open_archive(done.output).outcome.entries
        assert outcome["samples"] == "23"
        assert outcome["repaired.samples_lost"] == "20"
        assert len(json.loads(outcome["repaired.losses"])) > len(done.losses)


class TestOtherReaders:
    """mcap reads a repaired file as it reads a whole one."""

    @pytest.fixture(params=["torn", "hole", "first chunk lost"])
    def output(self, request, path, written) -> Path:
        data = {
            "torn": written.data[: written.chunks[3].end + 40],
            "hole": written.changed(written.chunks[1], -5),
            "first chunk lost": written.changed(written.chunks[0], -5),
        }[request.param]
        done, _ = mended(path, data)
        return done.output

    def assert_same(self, messages: list[Any], path: Path) -> None:
        archive = open_archive(path)
        for name, column in archive.columns.items():
            if name != "stamp":
                values = np.array([getattr(message, name) for message in messages], column.dtype)
                assert values.tobytes() == column.tobytes(), name

    def test_mcap_reads_the_same_values(self, output):
        with output.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
            found = [
                message
                for *_, message in reader.iter_decoded_messages(
                    topics=["/hil/cycle"], log_time_order=False
                )
            ]
            statistics = reader.get_summary().statistics
        self.assert_same(found, output)
        assert statistics.message_count == 3 * len(found) + len(open_archive(output).events)


class TestRefused:
    def test_an_existing_file_is_never_overwritten(self, path, written):
        path.write_bytes(written.data[:-100])
        (path.parent / "x.mcap").write_bytes(b"precious")
        with pytest.raises(ArchiveWriteError, match="exists already"):
            repair(path, path.parent / "x.mcap")
        assert (path.parent / "x.mcap").read_bytes() == b"precious"

    def test_a_file_without_its_description_cannot_be_repaired(self, path, written):
        description = next(r for r in written.records if r.opcode == container.METADATA)
        path.write_bytes(written.changed(description, -3, mask=1))
        with pytest.raises(NotAnArchiveError, match="fails its checksum"):
            repair(path)
        assert [path.name for path in path.parent.iterdir()] == [path.name]

    def test_another_file_is_refused(self, path):
        path.write_bytes(b"hello" * 100)
        with pytest.raises(NotAnArchiveError, match="is not an MCAP file"):
            repair(path)

    def test_a_link_that_waits_under_a_name_of_ours_is_not_followed(self, path, written):
        victim = path.parent / "victim"
        victim.write_bytes(b"precious")
        for name in (path.name, f"{path.stem}_repaired.mcap"):
            (path.parent / f".{name}.part").symlink_to(victim)
        path.write_bytes(written.data[:-100])
        repair(path)
        assert victim.read_bytes() == b"precious"

    def test_what_does_not_read_back_is_thrown_away_with_a_remedy(self, path, written, monkeypatch):
        path.write_bytes(written.data[:-100])
        torn = open_archive(path)
        monkeypatch.setattr(repairing, "open_archive", lambda *_, **__: torn)
        with pytest.raises(ArchiveError, match=r"cannot be written anew.*restore it from a copy"):
            repair(path)
        assert [path.name for path in path.parent.iterdir()] == [path.name]

    def test_a_full_disk_is_our_error_and_leaves_nothing(self, path, written, monkeypatch):
        path.write_bytes(written.data[:-100])

        def full(descriptor: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", full)
        with pytest.raises(ArchiveWriteError, match="No space left on device"):
            repair(path)
        assert [path.name for path in path.parent.iterdir()] == [path.name]


def test_a_repair_is_on_the_disk_before_it_has_its_name_and_the_name_after(
    path: Path, written, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    sync, replace = os.fsync, Path.replace

    def synced(descriptor: int) -> None:
        mode = os.fstat(descriptor).st_mode
        steps.append("folder" if stat.S_ISDIR(mode) else "file")
        sync(descriptor)

    def renamed(path: Path, target: Path) -> Path:
        steps.append("name")
        return replace(path, target)

    monkeypatch.setattr("os.fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    path.write_bytes(written.data[:-100])
    repair(path)
    assert steps == ["file", "name", "folder"]


def test_repairs_of_one_archive_at_once_do_not_meet(path: Path, written, monkeypatch) -> None:
    """The second runs from beginning to end while the first reads back what it wrote."""
    path.write_bytes(written.data[:-100])
    second: list[Repair] = []

    def meanwhile(path: object, **options: Any) -> Any:
        monkeypatch.setattr(repairing, "open_archive", open_archive)
        second.append(repair(path, in_place=True))
        return open_archive(path, **options)

    monkeypatch.setattr(repairing, "open_archive", meanwhile)
    first = repair(path, in_place=True)
    assert path.read_bytes() == written.data
    assert first.samples == second[0].samples == 43
    assert [path.name for path in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_a_repaired_archive_is_as_open_to_others_as_it_was(path: Path, written, mode) -> None:
    path.write_bytes(written.data[:-100])
    path.chmod(mode)
    output = repair(path).output
    assert output is not None
    assert stat.S_IMODE(output.stat().st_mode) == mode


def test_in_place_through_a_link_leaves_the_link(path: Path, written) -> None:
    path.write_bytes(written.data[:-100])
    link = path.with_name("link.mcap")
    link.symlink_to(path)
    repair(link, in_place=True)
    assert link.is_symlink()
    assert path.read_bytes() == written.data


def test_in_place_replaces_the_archive_when_all_is_done(path: Path, written) -> None:
    path.write_bytes(written.data[: written.records[-1].offset])
    done = repair(path, in_place=True)
    assert done.output == path
    assert path.read_bytes() == written.data
    assert [path.name for path in path.parent.iterdir()] == [path.name]


def test_a_repaired_archive_keeps_the_profile(path: Path, written) -> None:
    for data in (
        written.data[: written.chunks[2].end],
        written.changed(written.chunks[1], -5),
        written.changed(written.chunks[0], -5),
    ):
        _, output = mended(path, data)
        path.write_bytes(output)
        check = check_archive(path)
        assert check.keeps, check.faults
        assert check.repaired
