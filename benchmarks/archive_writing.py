"""What writing an archive costs: processor time of the real archive process at 1 kHz.

Run with ``python -m benchmarks.archive_writing [--json] [--seconds S]``. This program is the
exchange: it fills the shared memory with a cycle of six joints every millisecond, the values of a
recorded excitation (`benchmarks.archive_files`). The archive process drains, encodes, compresses
and writes it to the disk of the present folder with fdatasync, as on a real link. Its processor
time, that of both its threads, from the opening of the archive to its closing is set against the
time it took: ``writing_share_of_core``.

``encode_us_per_cycle`` is the processor time for one such archive that is given in batches of a
chunk: messages, compression and the calls that write them. The median of several.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show, timed
from benchmarks.archive_files import JOINTS, PERIOD, drive_train, records
from drivers.cycle_records import CycleRing
from drivers.exchange import control as control_memory
from drivers.exchange import event_log
from drivers.exchange.control import SharedState
from drivers.exchange.event_log import EventWriter
from hil.archive import ArchiveSpec, open_archive
from hil.archive.process_handle import ArchiveProcessHandle, Close, Closed, Open, Opened
from hil.archive.schema import Batch, cycle_messages
from hil.archive.writer import ArchiveFile

Array = NDArray[np.float64]

SECONDS = 60.0
NAMES = tuple(f"joint_{number + 1}" for number in range(JOINTS))
ANSWER = 30.0  # s
ROUNDS = 5
CHUNK = 100  # cycles, those of 100 ms


class Exchange:
    """The memory of an exchange, and its descriptors."""

    def __init__(self) -> None:
        self.ring = CycleRing.shared(JOINTS, 20_000)
        self.ring_fd = self.ring.fd
        self.event_fd = event_log.create()
        self.control_fd = control_memory.create()
        self.events, self.control = EventWriter(self.event_fd), SharedState(self.control_fd)
        self.pid = os.getpid()
        self._rows = records(0)

    def run(self, seconds: float) -> None:
        """A cycle every millisecond."""
        started = time.monotonic()
        count = round(seconds / PERIOD)
        while self.ring.written < count:
            due = min(count, int((time.monotonic() - started) / PERIOD))
            while self.ring.written < due:
                self._commit(self.ring.written)
            time.sleep(PERIOD / 2)

    def _commit(self, cycle: int) -> None:
        slot = self.ring.slot
        self.ring.rows[slot] = self._rows[cycle % len(self._rows)]
        self.ring.cycle[slot] = cycle
        self.ring.commit()

    def close(self) -> None:
        """Give the memory up."""
        for fd in (self.ring_fd, self.event_fd, self.control_fd):
            os.close(fd)


def measure(folder: Path, seconds: float) -> dict[str, Any]:
    """Share of one core and size, of one archive of so many seconds."""
    exchange = Exchange()
    process = ArchiveProcessHandle.start(exchange, JOINTS)
    path = folder / "excitation_000_a1.mcap"
    try:
        spec = ArchiveSpec(path, NAMES, PERIOD, metadata={})
        process.send(Open(1, spec, drive_train(), from_now=True, until_ended=False))
        _require(process.answer(ANSWER, 1), Opened)
        used = _processor_time(process.process.pid)
        started = time.monotonic()
        exchange.run(seconds)
        elapsed = time.monotonic() - started
        process.send(Close(1, "completed", "as long as was asked for"))
        closed = _require(process.answer(ANSWER, 1), Closed).recorded
        used = _processor_time(process.process.pid) - used
    finally:
        process.end()
        exchange.close()
    archive = open_archive(path, fields=["cycle"])
    assert archive.complete, archive.missing
    assert archive.n_samples == closed.records == round(seconds / PERIOD)
    return {
        "share": used / elapsed,
        "megabytes_per_minute": path.stat().st_size / seconds * 60.0 / 1e6,
        "records_lost": closed.records_lost,
    }


def _require(answer: Any, kind: type) -> Any:
    if not isinstance(answer, kind):
        raise SystemExit(f"the archive process answered {answer}")
    return answer


def _processor_time(pid: int) -> float:
    """User and system time of a process so far [s]; of its threads, to the nanosecond."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((thread / "schedstat").read_text().split()[0]) for thread in threads) * 1e-9


def writing(folder: Path, rounds: int) -> float:
    """Return the processor time of a cycle [us]."""
    rows = records(0)
    torque = drive_train().joint_torque(rows["target_current"])
    batches = [
        cycle_messages(NAMES, PERIOD, rows[at : at + CHUNK], torque[at : at + CHUNK])
        for at in range(0, len(rows), CHUNK)
    ]
    path = folder / "excitation_000_a1.mcap"
    times = []
    for _ in range(rounds):
        times.append(timed(partial(write, path, batches)) / len(rows) * 1e6)
        path.unlink()
    return float(np.median(times))


def write(path: Path, batches: Sequence[Batch]) -> None:
    """Write an archive of these batches, one chunk each, which the disk gets in its own time."""
    file = ArchiveFile(
        path,
        joint_names=NAMES,
        topics=[*batches[0].messages],
        metadata={},
        period=PERIOD,
        attachments={},
        durable=False,
    )
    for batch in batches:
        file.add(batch)
        file.flush()
    file.finish({})


def main() -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="length of each archive")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        encode = writing(Path(folder), ROUNDS)
        measured = measure(Path(folder), arguments.seconds)
    result = {
        "writing_share_of_core": round(measured["share"], 4),
        "megabytes_per_minute": round(measured["megabytes_per_minute"], 1),
        "records_lost": measured["records_lost"],
        "encode_us_per_cycle": round(encode, 1),
        "seconds": arguments.seconds,
        "cycles_per_second": round(1.0 / PERIOD),
    }
    show(result, only_json=arguments.json)


if __name__ == "__main__":
    main()
