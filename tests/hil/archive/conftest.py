"""A small archive as a recording leaves it, and what was written into it."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cycle_records import cycle_dtype
from hil.archive import Archive, ArchiveWriter, open_archive, verified_records
from hil.archive.verified_records import Record

NAME = "validation_003_a1.mcap"
ATTACHMENTS = {"robot.urdf": b"<robot name='x'/>", "cell.toml": b"[cell]\nname = 'x'\n"}
FIRST = 5000
"""Number of the first cycle."""


@dataclass(frozen=True, repr=False)
class Written:
    """An archive of 43 cycles in five chunks, with three events.

    Attributes:
        path: the file.
        data: its bytes.
        rows: the cycles; the first has number `FIRST`.
        torque: joint torques of the cycles.
        attachments: content by name.
    """

    path: Path
    data: bytes
    rows: NDArray[np.void]
    torque: NDArray[np.float64]
    attachments: dict[str, bytes]

    def __repr__(self) -> str:
        return "the small archive"

    @property
    def records(self) -> list[Record]:
        """Its records up to DataEnd."""
        return records_of(self.path)

    @property
    def chunks(self) -> list[Record]:
        """Its chunks."""
        return [record for record in self.records if record.opcode == verified_records.CHUNK]

    def first(self, opcode: int) -> Record:
        """The first record of a kind."""
        return next(record for record in self.records if record.opcode == opcode)

    def changed(self, record: Record, at: int, mask: int = 0xFF) -> bytes:
        """The file with one byte of a record's body changed; `at` may count from its end."""
        data = bytearray(self.data)
        begin = record.end if at < 0 else record.offset + verified_records.RECORD.size
        data[begin + at] ^= mask
        return bytes(data)

    def assert_true(self, archive: Archive) -> None:
        """Each sample in an archive is one that was written, and they are in order."""
        if archive.n_samples:
            cycles = archive.cycles()
            index = cycles["cycle"] - FIRST
            assert (np.diff(index) > 0).all()
            for name in self.rows.dtype.names or ():
                assert cycles[name].tobytes() == self.rows[name][index].tobytes(), name
            assert archive.columns["torque"].tobytes() == self.torque[index].tobytes()
            assert np.array_equal(archive.columns["stamp"], cycles["cycle"] * 10_000_000)
        assert {event.data["start"] for event in archive.events} <= {0, 15, 30}
        assert self.attachments.items() >= archive.attachments.items()
        assert archive.joint_names == ("a", "b")


def records_of(path: Path) -> list[Record]:
    """The records of a file up to DataEnd."""
    with path.open("rb") as stream:
        return list(verified_records.records(stream, path.stat().st_size, only=range(256)))


def write(
    path: Path, rows: NDArray[np.void], torque: NDArray[np.float64] | None = None, events: int = 0
) -> bytes:
    """An archive of two joints, ten cycles in a chunk; with `events` one before so many cycles."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    step = events or len(rows)
    with ArchiveWriter(
        path,
        joint_names=("a", "b"),
        period=0.01,
        metadata={"campaign": "c"},
        attachments=ATTACHMENTS,
        durable=False,
    ) as archive:
        for start in range(0, len(rows), step):
            part = slice(start, start + step)
            if events:
                archive.event(FIRST + start, "tick", "text", data={"start": start})
            archive.write(rows[part], None if torque is None else torque[part])
        archive.close("completed")
    return path.read_bytes()


def peak(action: Callable[[], object]) -> int:
    """Most bytes that an action had allocated at a time."""
    tracemalloc.start()
    try:
        held = action()
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    del held
    return most


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    random = np.random.default_rng(1)
    rows = np.zeros(43, cycle_dtype(2))
    cycle = np.arange(43)
    rows["cycle"] = FIRST + cycle
    rows["number"] = cycle
    rows["position"] = np.round(np.sin(0.01 * cycle[:, None] + [0.0, 1.0]), 4)
    rows["target_current"] = np.round(random.normal(size=(43, 2)), 2)
    rows["commanded_position"] = rows["position"] + 0.001
    torque = 80.0 * rows["target_current"]
    path = tmp_path_factory.mktemp("written") / NAME
    data = write(path, rows, torque, events=15)
    assert open_archive(path).complete
    return Written(path, data, rows, torque, ATTACHMENTS)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / NAME
