"""Truncated and damaged archives, and archives with intact chunks of another one.

Only what was written is read, and a repair reports what is lost.
"""

from __future__ import annotations

import json
import os
import random
import re
import stat
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from drivers.record import cycle_dtype
from hil.archive import Archive, Samples, container, header, open_archive, write_samples
from hil.archive import repair as repairing
from hil.archive.check import check_archive
from hil.archive.repair import Repair, amend_outcome, repair
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from tests.hil import mcap_bytes
from tests.hil.archive.conftest import FIRST, NAME, Written, write
from tests.hil.mcap_bytes import chunks


def read(written: Written, path: Path, data: bytes) -> Archive | None:
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
        assert archive.outcome.outcome == "completed"
    return archive


class TestDamage:
    def test_message_states_what_is_missing(self, written, path):
        path.write_bytes(written.data[: written.chunks[2].end - 17])
        sentence = str(open_archive(path).missing)
        assert sentence.startswith(str(path))
        assert "is cut off, or its length is corrupt" in sentence
        assert "20 samples could be read; the outcome is missing" in sentence

    def test_changed_opcode_of_any_record_is_detected(self, written, path):
        """Readers skip records of unknown kind; the missing content must be detected."""
        matters = (container.CHUNK, container.METADATA, container.ATTACHMENT, container.DATA_END)
        for record in written.records:
            changed = bytearray(written.data)
            changed[record.offset] = 0x80
            archive = read(written, path, bytes(changed))
            whole = archive is not None and archive.complete
            assert whole == (record.opcode not in matters)
            if archive is not None:
                part = open_archive(path, start=50.1, stop=50.3)
                assert part.n_samples == 20 or not part.complete

    @pytest.mark.parametrize("place", range(5))
    def test_removed_chunk_is_detected(self, written, path, place):
        chunk = written.chunks[place]
        archive = read(written, path, written.data[: chunk.offset] + written.data[chunk.end :])
        assert archive.n_samples == 10 * place
        assert not archive.complete

    def test_changed_metadata_fail_their_checksum(self, written, path):
        """MCAP has no checksum for metadata, and a wrong period makes wrong times."""
        assert written.data.count(b"0.01") == 1
        assert read(written, path, written.data.replace(b"0.01", b"0.02")) is None
        assert header.checksum({"a": "1", "b": "2"}) == header.checksum({"b": "2", "a": "1"})
        assert header.checksum({"a": "1"}) != header.checksum({"a": "2"})


# Intact chunks of another archive: detected by the checksums in the outcome, or else by the cycles


def recorded(path: Path, first: int = FIRST) -> bytes:
    """Return an archive with the same header as the small one and other cycles and positions."""
    rows = np.zeros(43, cycle_dtype(2))
    rows["cycle"] = first + np.arange(43)
    rows["number"] = np.arange(43)
    rows["position"] = np.random.default_rng(2).normal(size=(43, 2))
    return write(path, rows)


def mixed(data: bytes, other: bytes, place: int) -> bytes:
    """Return the file with one chunk replaced by that of the other."""
    begin, end = chunks(data)[place]
    return data[:begin] + other[slice(*chunks(other)[place])] + data[end:]


def earlier(data: bytes, path: Path) -> bytes:
    """Return the archive as older versions wrote it, without list of chunks."""
    at = data.index(b"\x0b\x00\x00\x00hil.outcome") - container.RECORD.size
    _, end = container.record_bounds(data, at, 0)
    record = container.Record(at, container.METADATA, data[at + container.RECORD.size : end])
    name, entries = container.parse_metadata(record)
    for key in (header.CHUNKS, header.DESCRIPTION, "checksum"):
        del entries[key]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data[:at] + mcap_bytes.metadata(name, header.with_checksum(entries)))
    done = repair(path, in_place=True)  # regenerates the index
    assert done.losses == ()
    assert header.CHUNKS.encode() + b"\x28" not in path.read_bytes()
    return path.read_bytes()


def assert_saved(path: Path, written: Written, sound: list[int]) -> None:
    """Check and repair find exactly these chunks."""
    cycles = [FIRST + c for k in sound for c in range(10 * k, min(10 * k + 10, 43))]
    check = check_archive(path)
    assert not check.conforms
    assert check.samples == len(cycles)
    done, _ = repaired_twice(path, path.read_bytes())
    assert done.losses
    assert assert_valid(done, written).columns["cycle"].tolist() == cycles
    assert check_archive(done.output).conforms


class TestChunksOfAnotherArchive:
    @pytest.mark.parametrize("has_list", [True, False])
    def test_archive_opens_with_and_without_list_of_chunks(self, has_list, written, path):
        path.write_bytes(written.data if has_list else earlier(written.data, path))
        archive = open_archive(path)
        assert archive.complete
        assert archive.n_samples == 43
        assert header.CHUNKS not in archive.outcome.entries
        assert check_archive(path).conforms
        assert repair(path).intact

    def test_cycles_that_do_not_follow_those_before_are_damage(self, written, path):
        """5013 to 5022 between 5009 and 5020: without a list of chunks the next chunk is lost."""
        other = recorded(path, 5003)
        for ours, n_read in ((earlier(written.data, path), 20), (written.data, 10)):
            path.write_bytes(mixed(ours, other, 1))
            archive = open_archive(path)
            assert not archive.complete
            assert archive.n_samples == n_read
            assert not check_archive(path).conforms
        part = open_archive(path, start=50.1, stop=50.3)
        assert part.n_samples == 0
        assert not part.complete
        assert_saved(path, written, [0, 2, 3, 4])

    @pytest.mark.parametrize("place", range(5))
    @pytest.mark.parametrize("first", [FIRST, 9000], ids=["same cycles", "other cycles"])
    def test_chunk_of_another_archive_is_left_out(self, written, path, first, place):
        path.write_bytes(mixed(written.data, recorded(path, first), place))
        archive = open_archive(path)
        assert "is of another recording" in str(archive.missing)
        written.assert_true(archive)
        assert archive.n_samples == 10 * place
        time = 50.0 + 0.1 * place
        part = open_archive(path, start=time, stop=time + 0.02)
        assert not part.complete
        assert part.n_samples == 0
        assert_saved(path, written, [k for k in range(5) if k != place])

    def test_begin_and_end_of_two_recordings_are_refused(self, written, path):
        """Every checksum, count and cycle is right."""
        other = recorded(path.with_name("validation_004_a1.mcap"))
        path.write_bytes(written.data[: chunks(written.data)[0][0]] + other[chunks(other)[0][0] :])
        archive = open_archive(path)
        assert "another recording" in str(archive.missing)
        assert archive.n_samples == 0
        assert "the outcome is that of another recording" in check_archive(path).faults
        with pytest.raises(ArchiveError, match=r"two recordings.*copy"):
            repair(path)

    @pytest.mark.parametrize("change", ["amended", "repaired"])
    def test_rewritten_archive_lists_its_chunks(self, written, path, change):
        made = []
        for data in (recorded(path), written.data):
            path.write_bytes(data)
            if change == "amended":
                amend_outcome(path, "rejected", "of no use")
            else:
                damaged = bytearray(data)
                damaged[chunks(data)[1][1] - 5] ^= 0xFF
                path.write_bytes(damaged)
                repair(path, in_place=True)
            assert open_archive(path).complete
            made.append(path.read_bytes())
        path.write_bytes(mixed(made[1], made[0], 2))
        archive = open_archive(path)
        assert "is of another recording" in str(archive.missing)
        written.assert_true(archive)

    def test_copy_with_other_chunks_by_another_program_is_read(self, written, path):
        """Its name is in the header; a repair regenerates the list of chunks."""
        content = mcap_bytes.Content.of(written.path)
        replace(content, library="mcap", cycles_per_chunk=7).write(path)
        assert open_archive(path).complete
        done = repair(path)
        assert done.losses == ()
        archive = open_archive(done.output)
        assert archive.complete
        written.assert_true(archive)
        assert archive.n_samples == 43


def repaired_twice(path: Path, data: bytes) -> tuple[Repair, bytes]:
    """Repair bytes, and repair the result."""
    output, again = path.with_name("once.mcap"), path.with_name("twice.mcap")
    for one in (output, again):
        one.unlink(missing_ok=True)
    path.write_bytes(data)
    done = repair(path, output)
    second = repair(output, again)
    assert path.read_bytes() == data, "the original is unchanged"
    assert second.intact, "a repaired archive has no fault"
    assert again.read_bytes() == output.read_bytes(), "repairing twice changes nothing"
    return done, output.read_bytes()


def assert_valid(done: Repair, written: Written) -> Archive:
    """Check that the repaired file is complete, correct, and states its losses."""
    assert done.output is not None
    archive = open_archive(done.output)
    assert archive.complete, archive.missing
    written.assert_true(archive)
    if done.losses:
        assert archive.outcome.entries["repaired"] == "yes"
        assert json.loads(archive.outcome.entries["repaired.losses"]) == list(done.losses)
        lost = "unknown" if done.samples_lost is None else str(done.samples_lost)
        assert archive.outcome.entries["repaired.samples_lost"] == lost
    else:
        assert archive.n_samples == 43
        assert len(archive.events) == 3
        assert not archive.outcome.repaired
    return archive


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
    """No wrong sample is read or repaired, and losses are reported."""

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
    def test_is_detected(self, written, path, monkeypatch, kind, count, whole, lost):
        monkeypatch.setattr("os.fsync", lambda descriptor: None)
        ends = [chunk.end for chunk in written.chunks]
        variants = kind(written.data, count)
        counts = Counter(self.outcome_of(written, path, data, ends) for data in variants)
        assert counts["whole"] >= whole
        assert counts["lost"] >= lost
        assert counts["refused"] < 0.6 * count

    @staticmethod
    def outcome_of(written: Written, path: Path, data: bytes, ends: list[int]) -> str:
        archive = read(written, path, data)
        if archive is not None:
            if archive.damage is not None:
                offset, unused = re.findall(r"at byte (\d+) .*\((\d+) bytes from", archive.damage)[
                    0
                ]
                assert int(offset) + int(unused) == len(data)
            if written.data.startswith(data):
                assert archive.n_samples == min(10 * sum(c <= len(data) for c in ends), 43)
            part = open_archive(path, start=50.1, stop=50.3)
            if part.n_samples:
                cycle = part.columns["cycle"] - FIRST
                assert np.array_equal(cycle, np.arange(10, 10 + len(cycle)))
                assert np.array_equal(part.columns["position"], written.rows["position"][cycle])
            assert part.n_samples == 20 or not part.complete
        try:
            done, _ = repaired_twice(path, data)
        except ArchiveError:
            return "refused"
        assert_valid(done, written)
        return "lost" if done.losses else "whole"


class TestNothingLost:
    def test_lost_index_is_restored_to_the_byte(self, path, written):
        """Truncated anywhere behind the outcome."""
        for length in range(written.records[-1].offset, len(written.data), 97):
            done, output = repaired_twice(path, written.data[:length])
            assert output == written.data
            assert done.losses == ()
            assert done.samples_lost == 0

    @pytest.mark.parametrize("what", ["message indexes", "times of a chunk", "nothing"])
    def test_damaged_index_is_restored_to_the_byte(self, path, written, what):
        data = {
            "message indexes": written.changed(written.first(container.MESSAGE_INDEX), 20),
            "times of a chunk": written.changed(written.chunks[2], 3),
            "nothing": written.data,
        }[what]
        done, output = repaired_twice(path, data)
        assert done.intact == (what == "nothing")
        assert not done.losses
        assert output == written.data
        if done.intact:  # an intact archive is not rewritten
            again = repair(path)
            assert again.intact and again.output is None


class TestLoss:
    @pytest.mark.parametrize(
        ("damage", "sound", "lost", "outcome"),
        [
            ("truncated", range(20), None, "unknown"),
            # Behind a damaged chunk, cycles show the gap as they show lost packets.
            ("hole", [*range(10), *range(20, 43)], 10, "completed"),
            # Channels are found in the index.
            ("first chunk lost", range(10, 43), 10, "completed"),
            ("length of a chunk", [*range(10), *range(20, 43)], 10, "completed"),
        ],
    )
    def test_intact_chunks_are_saved(self, path, written, damage, sound, lost, outcome):
        data = {
            "truncated": written.data[: written.chunks[2].end - 17],
            "hole": written.changed(written.chunks[1], -5),
            "first chunk lost": written.changed(written.chunks[0], -5),
            "length of a chunk": bytearray(written.data),
        }[damage]
        if damage == "length of a chunk":
            data[written.chunks[1].offset + 6] ^= 0x40
        done, output = repaired_twice(path, bytes(data))
        archive = assert_valid(done, written)
        assert archive.columns["cycle"].tolist() == [FIRST + index for index in sound]
        assert done.samples_lost == lost
        assert archive.outcome.entries["outcome"] == outcome
        assert archive.outcome.entries["samples"] == str(done.samples) == str(len(sound))
        path.write_bytes(output)
        check = check_archive(path)
        assert check.conforms, check.faults
        assert check.repaired
        self.assert_others_read(done.output, archive)

    @staticmethod
    def assert_others_read(path: Path, archive: Archive) -> None:
        """The mcap library reads the repaired file."""
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
            found = [
                message
                for *_, message in reader.iter_decoded_messages(
                    topics=["/hil/cycle"], log_time_order=False
                )
            ]
            statistics = reader.get_summary().statistics
        for name in archive.columns.keys() - {"stamp"}:
            column = archive.columns[name]
            values = np.array([getattr(message, name) for message in found], column.dtype)
            assert values.tobytes() == column.tobytes(), name
        shown = statistics.channel_message_counts.get(5, 0)  # of the description
        assert statistics.message_count == 3 * len(found) + len(archive.events) + shown

    def test_imported_recording_ends_at_the_first_gap(self, tmp_path):
        """It has no cycle numbers that show the gap."""
        position = np.random.default_rng(1).normal(size=(3500, 2))
        stamp = np.arange(3500, dtype=np.int64) * 1_000_000
        path = write_samples(
            tmp_path / "x.mcap", Samples(stamp, position), joint_names=("a", "b"), metadata={}
        )
        data = bytearray(path.read_bytes())
        data[chunks(bytes(data))[1][1] - 5] ^= 0xFF
        path.write_bytes(data)
        done = repair(path)
        assert done.samples == 1000
        assert done.samples_lost == 2500
        assert np.array_equal(open_archive(done.output).columns["position"], position[:1000])

    def test_lost_attachment_is_left_out_of_the_header(self, path, written):
        done, _ = repaired_twice(path, written.changed(written.first(container.ATTACHMENT), -8))
        archive = assert_valid(done, written)
        assert list(archive.attachments) == ["robot.urdf"]
        assert "cell.toml" in archive.outcome.entries["repaired.losses"]

    def test_losses_of_several_repairs_add_up(self, path, written):
        _, first = repaired_twice(path, written.changed(written.chunks[1], -5))
        data = bytearray(first)
        data[chunks(first)[1][1] - 5] ^= 0xFF
        done, _ = repaired_twice(path, bytes(data))
        outcome = open_archive(done.output).outcome.entries
        assert outcome["samples"] == "23"
        assert outcome["repaired.samples_lost"] == "20"
        assert len(json.loads(outcome["repaired.losses"])) > len(done.losses)


class TestRefused:
    """No file is left."""

    @pytest.fixture(autouse=True)
    def truncated(self, path: Path, written) -> Iterator[None]:
        path.write_bytes(written.data[:-100])
        yield
        assert [one.name for one in path.parent.iterdir() if one.name != "x.mcap"] == [path.name]

    def test_an_existing_file_is_never_overwritten(self, path):
        (path.parent / "x.mcap").write_bytes(b"precious")
        with pytest.raises(ArchiveWriteError, match="exists already"):
            repair(path, path.parent / "x.mcap")
        assert (path.parent / "x.mcap").read_bytes() == b"precious"

    @pytest.mark.parametrize("sentence", ["fails its checksum", "is not an MCAP file"])
    def test_file_without_header_cannot_be_repaired(self, path, written, sentence):
        damaged = written.changed(written.first(container.METADATA), -3, mask=1)
        path.write_bytes(damaged if "checksum" in sentence else b"hello" * 100)
        with pytest.raises(NotAnArchiveError, match=sentence):
            repair(path)

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
        repair(path)
        assert steps == ["file", "name", "folder"]

    def test_the_mode_is_that_of_the_source(self, path):
        path.chmod(0o600)
        assert stat.S_IMODE(repair(path).output.stat().st_mode) == 0o600

    @pytest.mark.parametrize("name", [NAME, "link.mcap"])
    def test_in_place_replaces_the_archive_and_leaves_a_link(self, path, written, name):
        link = path.with_name("link.mcap")
        link.symlink_to(path)
        done = repair(path.with_name(name), in_place=True)
        assert done.output == path.resolve()
        assert link.is_symlink()
        assert path.read_bytes() == written.data
        assert {one.name for one in path.parent.iterdir()} == {path.name, link.name}
