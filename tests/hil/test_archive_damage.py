"""Archives that were cut off or damaged: what is read is what was written, or it is said."""

from __future__ import annotations

import random
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from drivers.record import cycle_dtype
from hil.archive import Archive, ArchiveWriter, container, header, open_archive, schema
from hil.errors import ArchiveError

JOINTS = ("a", "b")
NAME = "validation_003_a1.mcap"
PERIOD = 0.01  # ten cycles in a chunk keep the file small
CYCLES = 43
EVENTS = 3
ATTACHMENTS = {"robot.urdf": b"<robot name='x'/>", "cell.toml": b"[cell]\nname = 'x'\n"}


def records() -> NDArray[np.void]:
    """Cycles with the smooth positions and quantised currents of a real arm."""
    rows = np.zeros(CYCLES, cycle_dtype(len(JOINTS)))
    cycle = np.arange(CYCLES)
    rows["cycle"] = 5000 + cycle
    rows["number"] = cycle
    rows["position"] = np.round(np.sin(0.01 * cycle[:, None] + [0.0, 1.0]), 4)
    noise = np.random.default_rng(1).normal(size=(CYCLES, 2))
    rows["target_current"] = np.round(noise, 2)
    return rows


ROWS = records()
TORQUE = 80.0 * ROWS["target_current"]


@pytest.fixture(scope="module")
def archive_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("damage") / NAME
    with ArchiveWriter(
        path,
        joint_names=JOINTS,
        period=PERIOD,
        metadata={"campaign": "c"},
        attachments=ATTACHMENTS,
        durable=False,
    ) as archive:
        for start in range(0, CYCLES, 15):
            stop = start + 15
            archive.event(5000 + start, "tick", "text", data={"start": start})
            archive.write(ROWS[start:stop], TORQUE[start:stop])
        archive.close("completed")
    return path.read_bytes()


def assert_prefix(archive: Archive) -> None:
    """Whatever was read is the beginning of what was written, to the bit."""
    count = archive.n_samples
    if count:
        cycles = archive.cycles()
        for name in ROWS.dtype.names or ():
            assert cycles[name].tobytes() == ROWS[name][:count].tobytes()
        assert np.array_equal(archive.columns["torque"], TORQUE[:count])
        assert np.array_equal(archive.columns["stamp"], ROWS["cycle"][:count] * 10_000_000)
    starts = [event.data["start"] for event in archive.events]
    assert starts == [15 * i for i in range(len(starts))]
    assert ATTACHMENTS.items() >= archive.attachments.items()
    assert archive.joint_names == JOINTS
    assert archive.period == PERIOD
    assert archive.kind == "validation"


def assert_nothing_lost(archive: Archive) -> None:
    assert archive.n_samples == CYCLES
    assert len(archive.events) == EVENTS
    assert dict(archive.attachments) == ATTACHMENTS
    assert archive.outcome is not None
    assert archive.outcome.entries["outcome"] == "completed"


def chunk_ends(data: bytes, path: Path) -> list[int]:
    """Where each chunk ends in the file."""
    path.write_bytes(data)
    with path.open("rb") as stream:
        walked = list(container.records(stream, len(data)))
    return [r.offset + 9 + len(r.body) for r in walked if r.opcode == container.CHUNK]


def test_the_archive_itself_is_whole(archive_bytes: bytes, tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(archive_bytes)
    archive = open_archive(tmp_path / NAME)
    assert archive.complete
    assert_prefix(archive)
    assert_nothing_lost(archive)


@pytest.mark.slow
def test_cut_off_at_every_byte_it_opens_up_to_its_last_whole_chunk(
    archive_bytes: bytes, tmp_path: Path
) -> None:
    path = tmp_path / NAME
    ends = chunk_ends(archive_bytes, path)
    refused = 0
    with path.open("r+b") as file:  # shortened byte by byte, from the end
        for length in range(len(archive_bytes) - 1, -1, -1):
            file.truncate(length)
            try:
                archive = open_archive(path)
            except ArchiveError as error:
                refused += 1
                assert str(path) in str(error)
                continue
            assert refused == 0, "a longer piece was refused, a shorter one is not"
            assert_prefix(archive)
            whole = sum(end <= length for end in ends)
            assert archive.n_samples == min(10 * whole, CYCLES)
            assert archive.damage is not None
            assert archive.damage.offset + archive.damage.bytes_dropped == length
            assert archive.damage.samples == archive.n_samples
            assert archive.damage.outcome_missing == (archive.outcome is None)
    assert 0 < refused < ends[0]


def test_what_is_missing_is_said_in_a_sentence(archive_bytes: bytes, tmp_path: Path) -> None:
    path = tmp_path / NAME
    ends = chunk_ends(archive_bytes, path)
    path.write_bytes(archive_bytes[: ends[2] - 17])
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


def test_an_empty_file_is_refused_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(b"")
    with pytest.raises(ArchiveError, match="is empty: the recording ended before anything"):
        open_archive(tmp_path / NAME)


def read_changed(data: bytes, path: Path) -> Archive | None:
    """Read damaged bytes; None when they are refused."""
    path.write_bytes(data)
    try:
        archive = open_archive(path)
    except ArchiveError:
        return None
    assert_prefix(archive)
    return archive


def test_a_flipped_bit_never_gives_a_wrong_sample(archive_bytes: bytes, tmp_path: Path) -> None:
    rng = random.Random(20261120)
    harmless = noticed = 0
    for _ in range(800):
        changed = bytearray(archive_bytes)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        archive = read_changed(bytes(changed), tmp_path / NAME)
        if archive is not None and archive.complete:
            harmless += 1  # in a message index, the time span of a chunk, the library's name
            assert_nothing_lost(archive)
        else:
            noticed += 1
    assert harmless > 100
    assert noticed > 200


def test_burst_damage_never_gives_a_wrong_sample(archive_bytes: bytes, tmp_path: Path) -> None:
    rng = random.Random(7)
    for _ in range(300):
        changed = bytearray(archive_bytes)
        at, length = rng.randrange(len(changed)), rng.randrange(1, 600)
        changed[at : at + length] = rng.randbytes(min(length, len(changed) - at))
        archive = read_changed(bytes(changed), tmp_path / NAME)
        if archive is not None and archive.complete:
            assert_nothing_lost(archive)


def test_the_opcode_of_every_record_is_guarded(archive_bytes: bytes, tmp_path: Path) -> None:
    """A reader passes over records of unknown kind; what it then misses must be noticed."""
    path = tmp_path / NAME
    path.write_bytes(archive_bytes)
    with path.open("rb") as stream:
        walked = list(container.records(stream, len(archive_bytes)))
    matters = (container.CHUNK, container.METADATA, container.ATTACHMENT, container.DATA_END)
    for record in walked:
        changed = bytearray(archive_bytes)
        changed[record.offset] = 0x80
        archive = read_changed(bytes(changed), path)
        if record.opcode in matters:
            assert archive is None or not archive.complete
        else:
            assert archive is not None
            assert_nothing_lost(archive)


@pytest.mark.parametrize("chunk", range(5))
def test_a_chunk_that_was_cut_out_is_noticed(
    archive_bytes: bytes, tmp_path: Path, chunk: int
) -> None:
    path = tmp_path / NAME
    path.write_bytes(archive_bytes)
    with path.open("rb") as stream:
        found = [
            record
            for record in container.records(stream, len(archive_bytes))
            if record.opcode == container.CHUNK
        ]
    start, end = found[chunk].offset, found[chunk].offset + 9 + len(found[chunk].body)
    archive = read_changed(archive_bytes[:start] + archive_bytes[end:], path)
    assert archive is not None
    assert archive.n_samples == 10 * chunk
    assert not archive.complete


def test_a_corrupt_size_fills_no_memory(archive_bytes: bytes, tmp_path: Path) -> None:
    path = tmp_path / NAME
    path.write_bytes(archive_bytes)
    with path.open("rb") as stream:
        offset = next(
            record.offset
            for record in container.records(stream, len(archive_bytes))
            if record.opcode == container.CHUNK
        )
    for claimed in (2**62, 2**29):
        changed = bytearray(archive_bytes)
        changed[offset + 9 + 16 : offset + 9 + 24] = claimed.to_bytes(8, "little")
        archive = read_changed(bytes(changed), path)
        assert archive is not None
        assert archive.n_samples == 0


def with_chunk(data: bytes, path: Path, body: bytes) -> bytes:
    """The archive with its first chunk replaced."""
    path.write_bytes(data)
    with path.open("rb") as stream:
        first = next(
            record
            for record in container.records(stream, len(data))
            if record.opcode == container.CHUNK
        )
    record = container.RECORD.pack(container.CHUNK, len(body)) + body
    return data[: first.offset] + record + data[first.end :]


def chunk_body(
    content: bytes, *, size: int, crc: int, compressor: zstandard.ZstdCompressor
) -> bytes:
    packed = compressor.compress(content)
    head = struct.pack("<QQQI", 0, 0, size, crc) + struct.pack("<I", 4) + b"zstd"
    return head + struct.pack("<Q", len(packed)) + packed


@pytest.mark.parametrize("content_size", [True, False])
@pytest.mark.parametrize("claimed", [1000, 1 << 26, 1 << 28])
def test_a_chunk_that_swells_is_refused(
    archive_bytes: bytes, tmp_path: Path, claimed: int, content_size: bool
) -> None:
    """256 MB of zeros in 8 kB, with an honest size or a false one: not decompressed, or not far."""
    compressor = zstandard.ZstdCompressor(write_content_size=content_size)
    body = chunk_body(bytes(1 << 28), size=claimed, crc=1, compressor=compressor)
    assert len(body) < 40_000
    changed = with_chunk(archive_bytes, tmp_path / NAME, body)
    tracemalloc.start()
    archive = read_changed(changed, tmp_path / NAME)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert archive is not None
    assert archive.n_samples == 0
    assert not archive.complete
    assert peak < 1 << 27


def test_a_chunk_without_checksum_is_not_believed(archive_bytes: bytes, tmp_path: Path) -> None:
    path = tmp_path / NAME
    path.write_bytes(archive_bytes)
    with path.open("rb") as stream:
        first = next(
            record
            for record in container.records(stream, len(archive_bytes))
            if record.opcode == container.CHUNK
        )
    changed = bytearray(archive_bytes)
    changed[first.offset + 9 + 24 : first.offset + 9 + 28] = bytes(4)
    archive = read_changed(bytes(changed), path)
    assert archive is not None
    assert archive.n_samples == 0
    assert "(chunk) has no checksum" in str(archive.missing)


@pytest.mark.slow
def test_ten_thousand_flipped_bits_never_give_a_wrong_sample(
    archive_bytes: bytes, tmp_path: Path
) -> None:
    """Read whole, and by index: a range of times and a channel."""
    rng = random.Random(10_000)
    for _ in range(10_000):
        changed = bytearray(archive_bytes)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        archive = read_changed(bytes(changed), tmp_path / NAME)
        if archive is not None and archive.complete:
            assert_nothing_lost(archive)
        try:
            part = open_archive(tmp_path / NAME, start=50.1, stop=50.3)
            alone = open_archive(tmp_path / NAME, topics=[schema.MEASURED])
        except ArchiveError:
            continue
        if part.n_samples:
            cycle = part.columns["cycle"] - 5000
            assert np.array_equal(cycle, np.arange(10, 10 + len(cycle)))
            assert np.array_equal(part.columns["position"], ROWS["position"][cycle])
        assert len(part.columns["stamp"]) == 20 or not part.complete
        count = alone.n_samples
        assert count == CYCLES or not alone.complete
        if count:
            assert np.array_equal(alone.columns["position"], ROWS["position"][:count])


def test_metadata_are_guarded_by_their_own_checksum(archive_bytes: bytes, tmp_path: Path) -> None:
    """MCAP has no checksum for metadata, and a wrong period makes wrong times."""
    assert archive_bytes.count(b"0.01") == 1
    changed = archive_bytes.replace(b"0.01", b"0.02")
    assert read_changed(changed, tmp_path / NAME) is None
    assert header.checksum({"a": "1", "b": "2"}) == header.checksum({"b": "2", "a": "1"})
    assert header.checksum({"a": "1"}) != header.checksum({"a": "2"})
