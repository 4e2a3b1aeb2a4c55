"""Archives that were cut off or damaged: what is read is what was written, or it is said.

Or that hold whole chunks of another archive, each sound by itself: never read, and repaired around.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from drivers.record import cycle_dtype
from hil.archive import Archive, ArchiveWriter, container, header, open_archive, schema
from hil.archive.check import check_archive
from hil.archive.repair import amend_outcome, repair
from hil.errors import ArchiveError
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
