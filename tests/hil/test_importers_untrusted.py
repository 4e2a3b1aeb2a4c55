"""Foreign recordings that are damaged or hostile: one sentence, in bounded memory and time."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from hil.archive import container
from hil.archive.cdr import ENCAPSULATION, LayoutError, layout_of
from hil.errors import SourceError
from hil.importers import Robot, arrays, import_rosbag2, rosbag2
from hil.importers.arrays import read_mcap
from identification import FrictionLaw
from tests.hil import mcap_bytes
from tests.hil.test_importers_rosbag2 import STATE, URDF, bag, states

TOPIC = "/joint_states"


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path, friction=FrictionLaw(third=None, offset=True))


def refused(source: Path, robot: Robot, match: str) -> None:
    with pytest.raises(SourceError, match=match):
        import_rosbag2(source, source.with_name("out.mcap"), robot=robot)
    assert not source.with_name("out.mcap").exists()


class TestSqlite:
    def test_pages_damaged_behind_a_sound_beginning(self, tmp_path: Path, robot: Robot) -> None:
        path = bag(tmp_path / "x.db3", {TOPIC: (STATE, states(400))})
        data = bytearray(path.read_bytes())
        data[4 * 4096 :] = b"\xa5" * (len(data) - 4 * 4096)
        path.write_bytes(data)
        refused(path, robot, "damaged")

    @pytest.mark.parametrize("column", ["timestamp", "data"])
    def test_a_row_without_time_or_data(self, column: str, tmp_path: Path, robot: Robot) -> None:
        path = bag(tmp_path / "x.db3", {TOPIC: (STATE, states())})
        with closing(sqlite3.connect(path)) as database:
            database.execute("CREATE TABLE loose AS SELECT * FROM messages")
            database.execute("DROP TABLE messages")
            database.execute("ALTER TABLE loose RENAME TO messages")
            database.execute(f"UPDATE messages SET {column} = NULL WHERE id = 3")
            database.commit()
        refused(path, robot, f"{TOPIC}: message . has no time or no data")

    def test_a_view_that_makes_rows_without_end(self, tmp_path: Path, robot: Robot) -> None:
        path = bag(tmp_path / "x.db3", {TOPIC: (STATE, states())})
        with closing(sqlite3.connect(path)) as database:
            database.execute("DROP TABLE messages")
            database.execute(
                "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1"
                " FROM n) SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
            )
            database.commit()
        refused(path, robot, "no table messages")


class TestCompressedMessages:
    def test_one_that_cannot_be_decompressed(self, tmp_path: Path, robot: Robot) -> None:
        torn = [(time, zstandard.compress(data)[:-5]) for time, data in states()]
        path = bag(tmp_path / "x.db3", {TOPIC: (STATE, torn)})
        refused(path, robot, "cannot be decompressed")

    def test_one_that_becomes_gigabytes(self, tmp_path: Path, robot: Robot) -> None:
        bomb = zstandard.compress(bytes(1 << 27))
        path = bag(tmp_path / "x.db3", {TOPIC: (STATE, [(1, bomb)])})
        refused(path, robot, "has a message of 134217728 bytes")

    def test_a_file_that_becomes_a_disk(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(rosbag2, "_SLACK", 1000)
        path = tmp_path / "x.db3.zstd"
        path.write_bytes(zstandard.compress(bytes(1 << 26)))
        with pytest.raises(SourceError, match="1000 times"), rosbag2.unpacked([path]):
            pass


class TestTypes:
    """Definitions of ros2msg that lead nowhere."""

    @pytest.mark.parametrize(
        "definition",
        [
            "pkg/A again",
            "pkg/B b\n===\nMSG: pkg/B\npkg/A a",
            "pkg/Empty[] many\n===\nMSG: pkg/Empty\n",
            "pkg/Empty[4294967296] many\n===\nMSG: pkg/Empty\n",
            "\n".join(["pkg/T0 x", *(f"===\nMSG: pkg/T{i}\npkg/T{i + 1} a\npkg/T{i + 1} b"
                                     for i in range(30)), "===\nMSG: pkg/T30\n"]),
        ],
    )  # fmt: skip
    def test_one_that_holds_itself_or_nothing(self, definition: str) -> None:
        message = ENCAPSULATION + b"\xff\xff\xff\xff" * 100
        with pytest.raises(LayoutError, match="nests pkg/"):
            layout_of("pkg/A", definition, message)

    def test_the_rest_of_the_file_is_read_all_the_same(self, tmp_path: Path) -> None:
        path = tmp_path / "x.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start("ros2")
            for topic, text in {"/odd": "pkg/A again", "/good": "float64 x"}.items():
                kind = writer.register_schema("pkg/A", "ros2msg", text.encode())
                channel = writer.register_channel(topic, "cdr", kind)
                writer.add_message(channel, 1, ENCAPSULATION + struct.pack("<d", 2.5), 1)
            writer.finish()
        assert read_mcap(path)["/good/x"].tolist() == [2.5]


def chunked(path: Path, compression: CompressionType) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start("ros2")
        kind = writer.register_schema("pkg/A", "ros2msg", b"float64 x")
        channel = writer.register_channel("/a", "cdr", kind)
        for stamp in range(100):
            writer.add_message(channel, stamp, ENCAPSULATION + struct.pack("<d", stamp), stamp)
        writer.finish()
    return path


def with_chunk(path: Path, body: bytes) -> None:
    """Put another chunk before the first one, whose index is gone then."""
    data = path.read_bytes()
    with path.open("rb") as stream:
        records = list(container.records(stream, len(data)))
    first = next(record for record in records if record.opcode == container.CHUNK)
    path.write_bytes(
        data[: first.offset] + mcap_bytes.record(container.CHUNK, body) + data[first.offset :]
    )


class TestMcap:
    @pytest.mark.parametrize("compression", list(CompressionType))
    def test_a_sound_file_passes(self, compression: CompressionType, tmp_path: Path) -> None:
        path = chunked(tmp_path / "x.mcap", compression)
        assert read_mcap(path)["/a/x"].tolist() == list(range(100))

    @pytest.mark.parametrize(
        ("name", "packed", "claimed"),
        [
            ("zstd", zstandard.compress(bytes(1 << 26)), 1 << 26),
            ("zstd", zstandard.compress(bytes(1 << 26)), 1000),
            ("zstd", b"no frame", 1000),
            ("lz4", lz4.frame.compress(bytes(1 << 24)), 1000),
            ("lz4", lz4.frame.compress(bytes(10)), 4 << 30),
            ("", bytes(10), 4 << 30),
        ],
    )
    def test_a_chunk_that_is_not_what_it_claims(
        self, name: str, packed: bytes, claimed: int, tmp_path: Path
    ) -> None:
        path = chunked(tmp_path / "x.mcap", CompressionType.ZSTD)
        head = struct.pack("<QQQI", 0, 0, claimed, 0) + mcap_bytes.text(name)
        with_chunk(path, head + struct.pack("<Q", len(packed)) + packed)
        with pytest.raises(SourceError, match=r"claims|cannot be decompressed"):
            read_mcap(path)

    def test_more_numbers_than_fit_into_memory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(arrays, "MOST_BYTES", 600)
        path = chunked(tmp_path / "x.mcap", CompressionType.ZSTD)
        with pytest.raises(SourceError, match="too large to be read at once"):
            read_mcap(path)

    def test_an_index_that_points_elsewhere(self, tmp_path: Path) -> None:
        path = chunked(tmp_path / "x.mcap", CompressionType.ZSTD)
        data = path.read_bytes()
        with path.open("rb") as stream:
            records = list(container.records(stream, len(data)))
        first = next(record for record in records if record.opcode == container.CHUNK)
        entry = data.rindex(struct.pack("<Q", first.offset))
        path.write_bytes(data[:entry] + struct.pack("<Q", 17) + data[entry + 8 :])
        with pytest.raises(SourceError, match="index does not fit"):
            read_mcap(path)
