"""Archives that were cut off or damaged: what is read is what was written, or it is said."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from hil.archive import Archive, container, header, open_archive, schema
from hil.errors import ArchiveError


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


def flipped(data: bytes, rng: random.Random) -> bytes:
    """The same with another bit somewhere."""
    changed = bytearray(data)
    changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


class TestDamage:
    @pytest.mark.slow
    def test_cut_off_anywhere_it_opens_up_to_its_last_whole_chunk(self, written, path):
        ends = [chunk.end for chunk in written.chunks]
        refused = 0
        for length in range(len(written.data) - 1, -1, -1):
            archive = read(written, path, written.data[:length])
            if archive is None:
                refused += 1
                continue
            assert refused == 0, "a longer piece was refused, a shorter one is not"
            assert archive.n_samples == min(10 * sum(end <= length for end in ends), 43)
            assert archive.damage is not None
            assert archive.damage.offset + archive.damage.bytes_dropped == length
            assert archive.damage.samples == archive.n_samples
            assert archive.damage.outcome_missing == (archive.outcome is None)
        assert 0 < refused < ends[0]

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

    def test_a_flipped_bit_never_gives_a_wrong_sample(self, written, path):
        rng = random.Random(20261120)
        found = [read(written, path, flipped(written.data, rng)) for _ in range(800)]
        # Nothing is lost with a message index, the time span of a chunk, the library's name.
        whole = sum(archive is not None and archive.complete for archive in found)
        assert 100 < whole < 600

    def test_burst_damage_never_gives_a_wrong_sample(self, written, path):
        rng = random.Random(7)
        for _ in range(300):
            changed = bytearray(written.data)
            at, length = rng.randrange(len(changed)), rng.randrange(1, 600)
            changed[at : at + length] = rng.randbytes(min(length, len(changed) - at))
            read(written, path, bytes(changed))

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

    @pytest.mark.slow
    def test_ten_thousand_flipped_bits_never_give_a_wrong_sample(self, written, path):
        """Read whole, and by index: a range of times and a channel."""
        rng = random.Random(10_000)
        for _ in range(10_000):
            read(written, path, flipped(written.data, rng))
            try:
                part = open_archive(path, start=50.1, stop=50.3)
                alone = open_archive(path, topics=[schema.MEASURED])
            except ArchiveError:
                continue
            if part.n_samples:
                cycle = part.columns["cycle"] - 5000
                assert np.array_equal(cycle, np.arange(10, 10 + len(cycle)))
                assert np.array_equal(part.columns["position"], written.rows["position"][cycle])
            assert len(part.columns["stamp"]) == 20 or not part.complete
            count = alone.n_samples
            assert count == 43 or not alone.complete
            if count:
                position = written.rows["position"][:count]
                assert np.array_equal(alone.columns["position"], position)

    def test_metadata_are_guarded_by_their_own_checksum(self, written, path):
        """MCAP has no checksum for metadata, and a wrong period makes wrong times."""
        assert written.data.count(b"0.01") == 1
        assert read(written, path, written.data.replace(b"0.01", b"0.02")) is None
        assert header.checksum({"a": "1", "b": "2"}) == header.checksum({"b": "2", "a": "1"})
        assert header.checksum({"a": "1"}) != header.checksum({"a": "2"})
