"""Torn and damaged archives made whole: nothing invented, nothing kept silent."""

from __future__ import annotations

import json
import os
import random
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hil.archive import Samples, container, open_archive, write_samples
from hil.archive import repair as repairing
from hil.archive.check import check_archive
from hil.archive.repair import Repair, repair
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError


@pytest.fixture
def broken(tmp_path: Path, written) -> Path:
    return tmp_path / written.path.name


def mended(broken: Path, data: bytes) -> tuple[Repair, bytes]:
    """Repair bytes, and once more what comes of it."""
    output, again = broken.with_name("once.mcap"), broken.with_name("twice.mcap")
    for path in (output, again):
        path.unlink(missing_ok=True)
    broken.write_bytes(data)
    done = repair(broken, output)
    second = repair(output, again)
    assert broken.read_bytes() == data, "the original is kept"
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


def sweep(broken: Path, variants: Any, written) -> dict[str, int]:
    """Repair each; only our own errors may come of it."""
    counts = {"nothing lost": 0, "lost": 0, "failed": 0}
    for data in variants:
        try:
            done, _ = mended(broken, data)
        except ArchiveError:
            counts["failed"] += 1
        else:
            assert_sound(done, written)
            counts["lost" if done.losses else "nothing lost"] += 1
    return counts


def flips(written, count: int, seed: int) -> Any:
    rng = random.Random(seed)
    for _ in range(count):
        changed = bytearray(written.data)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        yield bytes(changed)


class TestNothingLost:
    def test_a_file_that_lost_its_index_becomes_what_it_was(self, broken, written):
        """Cut anywhere behind the outcome: what follows from the rest is made anew."""
        end_of_data = written.records[-1].offset
        for length in range(end_of_data, len(written.data), 97):
            done, output = mended(broken, written.data[:length])
            assert output == written.data
            assert done.losses == ()
            assert done.samples_lost == 0

    def test_message_indexes_are_made_anew(self, broken, written):
        index = next(r for r in written.records if r.opcode == container.MESSAGE_INDEX)
        done, output = mended(broken, written.changed(index, 20))
        assert not done.whole
        assert output == written.data

    def test_a_chunk_that_states_other_times_is_set_right(self, broken, written):
        done, output = mended(broken, written.changed(written.chunks[2], 3))
        assert not done.losses
        assert output == written.data

    def test_a_whole_archive_is_left_alone(self, broken, written):
        broken.write_bytes(written.data)
        done = repair(broken)
        assert done.whole
        assert done.output is None
        assert [path.name for path in broken.parent.iterdir()] == [broken.name]

    def test_a_whole_archive_is_copied_where_an_output_is_named(self, broken, written):
        _, output = mended(broken, written.data)
        assert output == written.data


class TestLoss:
    def test_a_torn_file_keeps_its_whole_chunks(self, broken, written):
        done, _ = mended(broken, written.data[: written.chunks[2].end - 17])
        assert_sound(done, written)
        assert done.samples == 20
        assert done.samples_lost is None
        outcome = open_archive(done.output).outcome.entries
        assert outcome["outcome"] == "unknown"
        assert outcome["samples"] == "20"

    def test_what_stands_behind_a_damaged_chunk_is_kept(self, broken, written):
        """Its cycles show the hole as they show lost packets."""
        done, _ = mended(broken, written.changed(written.chunks[1], -5))
        assert_sound(done, written)
        archive = open_archive(done.output)
        kept = [*range(10), *range(20, 43)]
        assert archive.columns["cycle"].tolist() == [5000 + index for index in kept]
        assert done.samples_lost == 10
        assert archive.outcome.entries["outcome"] == "completed"

    def test_channels_are_found_in_the_index_where_the_first_chunk_is_lost(self, broken, written):
        done, _ = mended(broken, written.changed(written.chunks[0], -5))
        assert_sound(done, written)
        assert open_archive(done.output).columns["cycle"][0] == 5010

    def test_a_broken_length_is_bridged_by_the_index(self, broken, written):
        data = bytearray(written.data)
        data[written.chunks[1].offset + 6] ^= 0x40
        done, _ = mended(broken, bytes(data))
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

    def test_a_lost_attachment_is_no_longer_announced(self, broken, written):
        attachment = next(r for r in written.records if r.opcode == container.ATTACHMENT)
        done, _ = mended(broken, written.changed(attachment, -8))
        assert_sound(done, written)
        archive = open_archive(done.output)
        assert list(archive.attachments) == ["robot.urdf"]
        assert "cell.toml" in archive.outcome.entries["repaired.losses"]

    def test_damage_after_a_repair_adds_to_what_was_lost(self, broken, written):
        _, first = mended(broken, written.changed(written.chunks[1], -5))
        broken.write_bytes(first)
        with broken.open("rb") as stream:
            walked = list(container.records(stream, len(first)))
        chunk = [record for record in walked if record.opcode == container.CHUNK][1]
        data = bytearray(first)
        data[chunk.end - 5] ^= 0xFF
        done, _ = mended(broken, bytes(data))
        outcome = open_archive(done.output).outcome.entries
        assert outcome["samples"] == "23"
        assert outcome["repaired.samples_lost"] == "20"
        assert len(json.loads(outcome["repaired.losses"])) > len(done.losses)


class TestOtherReaders:
    """mcap reads a repaired file as it reads a whole one."""

    @pytest.fixture(params=["torn", "hole", "first chunk lost"])
    def output(self, request, broken, written) -> Path:
        data = {
            "torn": written.data[: written.chunks[3].end + 40],
            "hole": written.changed(written.chunks[1], -5),
            "first chunk lost": written.changed(written.chunks[0], -5),
        }[request.param]
        done, _ = mended(broken, data)
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
    def test_an_existing_file_is_never_overwritten(self, broken, written):
        broken.write_bytes(written.data[:-100])
        (broken.parent / "x.mcap").write_bytes(b"precious")
        with pytest.raises(ArchiveWriteError, match="exists already"):
            repair(broken, broken.parent / "x.mcap")
        assert (broken.parent / "x.mcap").read_bytes() == b"precious"

    def test_a_file_without_its_description_cannot_be_repaired(self, broken, written):
        description = next(r for r in written.records if r.opcode == container.METADATA)
        broken.write_bytes(written.changed(description, -3, mask=1))
        with pytest.raises(NotAnArchiveError, match="fails its checksum"):
            repair(broken)
        assert [path.name for path in broken.parent.iterdir()] == [broken.name]

    def test_another_file_is_refused(self, broken):
        broken.write_bytes(b"hello" * 100)
        with pytest.raises(NotAnArchiveError, match="is not an MCAP file"):
            repair(broken)

    def test_a_link_that_waits_under_a_name_of_ours_is_not_followed(self, broken, written):
        victim = broken.parent / "victim"
        victim.write_bytes(b"precious")
        for name in (broken.name, f"{broken.stem}_repaired.mcap"):
            (broken.parent / f".{name}.part").symlink_to(victim)
        broken.write_bytes(written.data[:-100])
        repair(broken)
        assert victim.read_bytes() == b"precious"

    def test_what_does_not_read_back_is_thrown_away_with_a_remedy(
        self, broken, written, monkeypatch
    ):
        broken.write_bytes(written.data[:-100])
        torn = open_archive(broken)
        monkeypatch.setattr(repairing, "open_archive", lambda *_, **__: torn)
        with pytest.raises(ArchiveError, match=r"cannot be written anew.*restore it from a copy"):
            repair(broken)
        assert [path.name for path in broken.parent.iterdir()] == [broken.name]

    def test_a_full_disk_is_our_error_and_leaves_nothing(self, broken, written, monkeypatch):
        broken.write_bytes(written.data[:-100])

        def full(descriptor: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", full)
        with pytest.raises(ArchiveWriteError, match="No space left on device"):
            repair(broken)
        assert [path.name for path in broken.parent.iterdir()] == [broken.name]


def test_a_repair_is_on_the_disk_before_it_has_its_name_and_the_name_after(
    broken: Path, written, monkeypatch: pytest.MonkeyPatch
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
    broken.write_bytes(written.data[:-100])
    repair(broken)
    assert steps == ["file", "name", "folder"]


def test_repairs_of_one_archive_at_once_do_not_meet(broken: Path, written, monkeypatch) -> None:
    """The second runs from beginning to end while the first reads back what it wrote."""
    broken.write_bytes(written.data[:-100])
    second: list[Repair] = []

    def meanwhile(path: object, **options: Any) -> Any:
        monkeypatch.setattr(repairing, "open_archive", open_archive)
        second.append(repair(broken, in_place=True))
        return open_archive(path, **options)

    monkeypatch.setattr(repairing, "open_archive", meanwhile)
    first = repair(broken, in_place=True)
    assert broken.read_bytes() == written.data
    assert first.samples == second[0].samples == 43
    assert [path.name for path in broken.parent.iterdir()] == [broken.name]


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_a_repaired_archive_is_as_open_to_others_as_it_was(broken: Path, written, mode) -> None:
    broken.write_bytes(written.data[:-100])
    broken.chmod(mode)
    output = repair(broken).output
    assert output is not None
    assert stat.S_IMODE(output.stat().st_mode) == mode


def test_in_place_through_a_link_leaves_the_link(broken: Path, written) -> None:
    broken.write_bytes(written.data[:-100])
    link = broken.with_name("link.mcap")
    link.symlink_to(broken)
    repair(link, in_place=True)
    assert link.is_symlink()
    assert broken.read_bytes() == written.data


def test_in_place_replaces_the_archive_when_all_is_done(broken: Path, written) -> None:
    broken.write_bytes(written.data[: written.records[-1].offset])
    done = repair(broken, in_place=True)
    assert done.output == broken
    assert broken.read_bytes() == written.data
    assert [path.name for path in broken.parent.iterdir()] == [broken.name]


class TestAnyDamage:
    def test_cut_off_anywhere(self, broken, written):
        cuts = range(0, len(written.data), 151)
        counts = sweep(broken, (written.data[:length] for length in cuts), written)
        assert min(counts.values()) > 0

    def test_a_flipped_bit(self, broken, written):
        counts = sweep(broken, flips(written, 200, seed=3), written)
        assert counts["lost"] > 20
        assert counts["nothing lost"] > 20

    def test_a_burst(self, broken, written):
        def variants() -> Any:
            rng = random.Random(7)
            for _ in range(60):
                changed = bytearray(written.data)
                at, length = rng.randrange(len(changed)), rng.randrange(1, 600)
                changed[at : at + length] = rng.randbytes(min(length, len(changed) - at))
                yield bytes(changed)

        assert sweep(broken, variants(), written)["lost"] > 10

    @pytest.mark.slow
    def test_cut_off_at_every_byte(self, broken, written, monkeypatch):
        monkeypatch.setattr("os.fsync", lambda descriptor: None)
        cuts = range(len(written.data))
        counts = sweep(broken, (written.data[:length] for length in cuts), written)
        assert sum(counts.values()) == len(written.data)

    @pytest.mark.slow
    def test_ten_thousand_flipped_bits(self, broken, written, monkeypatch):
        monkeypatch.setattr("os.fsync", lambda descriptor: None)
        counts = sweep(broken, flips(written, 10_000, seed=20261120), written)
        assert sum(counts.values()) == 10_000
        assert counts["failed"] < 500


def test_a_repaired_archive_keeps_the_profile(broken: Path, written) -> None:
    for data in (
        written.data[: written.chunks[2].end],
        written.changed(written.chunks[1], -5),
        written.changed(written.chunks[0], -5),
    ):
        _, output = mended(broken, data)
        broken.write_bytes(output)
        check = check_archive(broken)
        assert check.keeps, check.faults
        assert check.repaired
