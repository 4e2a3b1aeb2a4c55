"""A small archive as a recording leaves it, and what was written into it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.record import cycle_dtype
from hil.archive import Archive, ArchiveWriter, container, open_archive
from hil.archive.container import Record


@dataclass(frozen=True, repr=False)
class Written:
    """An archive of 43 cycles in five chunks, with three events.

    Attributes:
        path: the file.
        data: its bytes.
        rows: the cycles; the first has number `first`.
        torque: joint torques of the cycles.
        attachments: content by name.
    """

    path: Path
    data: bytes
    rows: NDArray[np.void]
    torque: NDArray[np.float64]
    attachments: dict[str, bytes]
    first: int = 5000

    def __repr__(self) -> str:
        return "the small archive"

    @property
    def records(self) -> list[Record]:
        """Its records up to DataEnd."""
        with self.path.open("rb") as stream:
            return list(container.records(stream, len(self.data)))

    @property
    def chunks(self) -> list[Record]:
        """Its chunks."""
        return [record for record in self.records if record.opcode == container.CHUNK]

    def changed(self, record: Record, at: int, mask: int = 0xFF) -> bytes:
        """The file with one byte of a record's body changed; `at` may count from its end."""
        data = bytearray(self.data)
        begin = record.end if at < 0 else record.offset + container.RECORD.size
        data[begin + at] ^= mask
        return bytes(data)

    def assert_true(self, archive: Archive) -> None:
        """Each sample in an archive is one that was written, and they are in order."""
        if archive.n_samples:
            cycles = archive.cycles()
            index = cycles["cycle"] - self.first
            assert (np.diff(index) > 0).all()
            for name in self.rows.dtype.names or ():
                assert cycles[name].tobytes() == self.rows[name][index].tobytes(), name
            assert archive.columns["torque"].tobytes() == self.torque[index].tobytes()
            assert np.array_equal(archive.columns["stamp"], cycles["cycle"] * 10_000_000)
        assert {event.data["start"] for event in archive.events} <= {0, 15, 30}
        assert self.attachments.items() >= archive.attachments.items()
        assert archive.joint_names == ("a", "b")


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    random = np.random.default_rng(1)
    rows = np.zeros(43, cycle_dtype(2))
    cycle = np.arange(43)
    rows["cycle"] = 5000 + cycle
    rows["number"] = cycle
    rows["position"] = np.round(np.sin(0.01 * cycle[:, None] + [0.0, 1.0]), 4)
    rows["target_current"] = np.round(random.normal(size=(43, 2)), 2)
    rows["commanded_position"] = rows["position"] + 0.001
    torque = 80.0 * rows["target_current"]
    attachments = {"robot.urdf": b"<robot name='x'/>", "cell.toml": b"[cell]\nname = 'x'\n"}
    path = tmp_path_factory.mktemp("written") / "validation_003_a1.mcap"
    with ArchiveWriter(
        path,
        joint_names=("a", "b"),
        period=0.01,  # ten cycles in a chunk keep the file small
        metadata={"campaign": "c"},
        attachments=attachments,
        durable=False,
    ) as archive:
        for start in range(0, 43, 15):
            archive.event(5000 + start, "tick", "text", data={"start": start})
            archive.write(rows[start : start + 15], torque[start : start + 15])
        archive.close("completed")
    assert open_archive(path).complete
    return Written(path, path.read_bytes(), rows, torque, attachments)
