"""One piece of a long run: a controller, a supervisor with its processes, and who watches them."""

from __future__ import annotations

import json
import os
import platform
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Final

import psutil

from hil.archive import ArchiveOutcome, open_archive
from hil.archive.check import check_archive
from hil.campaign import Stop
from hil.campaign.quick_design import design
from hil.cell import Cell
from hil.demo_link import LOOPBACK, SIMULATE, free_port
from hil.errors import HilError
from hil.progress import Reporter, Silent, Task
from tests.endurance.journal import SYNC_EVERY, Ran, Use
from tests.endurance.stalls import watched
from tests.hil.fast_cell import fast_cell
from tests.journal import Journal

REPETITIONS: Final = 20
"""Of the excitation in a campaign, which so takes about half a minute."""
MISSED: Final = 3
"""Answers in a row that the controller misses until it ends open mode."""
NEWEST: Final = 3
"""Campaign folders that stay on the disk."""
QUIET: Final = 60.0
"""s without a word from the supervisor after which it is taken for hung."""
LEAVING: Final = 60.0
"""s that everything may take to come to rest and end."""
PRIORITY: Final = 60
"""Real-time priority of the controller: its clock has to be better than what is measured by it."""


def prepare(folder: Path, rate: int) -> None:
    """Put the cell and the plan of all campaigns into a new folder."""
    folder.mkdir(parents=True)
    text = fast_cell(folder, repetitions=REPETITIONS).text
    link = (
        f'"udp"\nhost = "{LOOPBACK}"\nbind = "{LOOPBACK}"\nport = 2001\ncycle_ms = {1000 // rate}'
    )
    (folder / "cell.toml").write_text(text.replace('"simulated"\ncycle_ms = 2', link))
    cell = Cell.load(folder / "cell.toml")
    if round(1.0 / cell.period) != rate:
        raise ValueError(f"the cell runs at {1.0 / cell.period:g} Hz, not {rate}")
    (folder / "plan.json").write_text(design(cell, Silent()).to_text())


@dataclass(eq=False)
class Watched:
    """A piece while it runs."""

    folder: Path
    journal: Journal
    task: Task
    seconds: float
    supervisor: subprocess.Popen[bytes]
    controller: subprocess.Popen[bytes]
    began: float = field(default_factory=time.monotonic)
    error: str = ""
    _processes: dict[str, psutil.Process] = field(default_factory=dict)
    _told: float = 0.0
    _kept: list[Path] = field(default_factory=list)

    def watch(self, stop: Stop) -> str:
        """Take down what is told until the time is over; why it ended."""
        for line in self._lines(stop):
            told = json.loads(line)
            getattr(self, "_" + told.pop("kind"))(**told)
        if self.error:
            return self.error
        if stop.requested:
            return "interrupted"
        return "" if self._at >= self.seconds else "the supervisor ended early"

    @property
    def _at(self) -> float:
        return time.monotonic() - self.began

    def _lines(self, stop: Stop) -> Iterator[bytes]:
        """What the supervisor says, line by line, until it ends; it is told to when it is time."""
        assert self.supervisor.stdout is not None
        out, rest, heard, asked = self.supervisor.stdout.fileno(), b"", time.monotonic(), 0.0
        while True:
            now = time.monotonic()
            if not asked and (stop.requested or self._at >= self.seconds):
                self.supervisor.send_signal(signal.SIGTERM)
                asked = now
            if now - heard > QUIET or (asked and now - asked > LEAVING):
                self.error = f"the supervisor said nothing for {now - heard:.0f} s"
                return
            if not select.select([out], [], [], 0.5)[0]:
                continue
            heard, block = time.monotonic(), os.read(out, 65536)
            if not block:
                return
            *lines, rest = (rest + block).split(b"\n")
            yield from lines

    def _link(self, pids: Mapping[str, int], scheduling: str, notes: list[str]) -> None:
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self.journal.add(kind="link", scheduling=scheduling, notes=notes, t=self._at)

    def _status(
        self, counters: Mapping[str, float], latencies: list[int], stalls: int, stood: float
    ) -> None:
        used = {}
        for name, process in self._processes.items():
            with suppress(psutil.Error):
                used[name] = asdict(_use(process))
        self.journal.add(
            kind="sample",
            t=self._at,
            load=os.getloadavg()[0],
            processes=used,
            shared=sum(1 for _ in Path("/dev/shm").iterdir()),
            counters=counters,
            latencies=latencies,
            stalls=stalls,
            stood=stood,
        )
        now = min(self._at, self.seconds)
        self.task.advance(now - self._told, f"{counters['ended_count']:.0f} motions")
        self._told = now

    def _campaign(self, number: int, folder: str, **told: Any) -> None:
        archives = sorted((Path(folder) / "archives").glob("*.mcap"))
        outcomes: dict[str, int] = {}
        faulty: list[str] = []
        records = lost = 0
        for path in archives:
            try:
                check, archive = check_archive(path), open_archive(path, fields=())
            except HilError as error:
                faulty.append(str(error))
                continue
            outcome = archive.outcome or ArchiveOutcome(outcome="none")
            word = outcome.outcome
            outcomes[word] = outcomes.get(word, 0) + 1
            lost += outcome.records_lost or 0
            records += check.samples
            if not check.keeps:
                faulty.append(f"{path.name}: {dict(check.faults)}")
        ran = Ran(
            number=number,
            t=self._at,
            archives=len(archives),
            faulty=faulty,
            outcomes=outcomes,
            records=records,
            records_lost=lost,
            **told,
        )
        self.journal.add(kind="campaign", **asdict(ran))
        if not faulty:  # what is faulty is to be looked at
            self._kept.append(Path(folder))
        while len(self._kept) > NEWEST:
            shutil.rmtree(self._kept.pop(0))

    def _error(self, text: str) -> None:
        self.error = text


def _use(process: psutil.Process) -> Use:
    with process.oneshot():
        times = process.cpu_times()
        return Use(
            rss=process.memory_info().rss,
            own=_own(process.pid),
            fds=process.num_fds(),
            threads=process.num_threads(),
            cpu=times.user + times.system,
        )


def _own(pid: int) -> int:
    """Bytes in pages that no file is behind, swapped ones too.

    The unique set size that is usually asked for grows when any other process ends that had the
    same libraries mapped.
    """
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
    except OSError as error:
        raise psutil.NoSuchProcess(pid) from error
    kilobytes = {name: value for name, _, value in (row.partition(":") for row in text.split("\n"))}
    return 1024 * sum(int(kilobytes[name].split()[0]) for name in ("Anonymous", "Swap"))


def run_piece(
    folder: Path, journal_path: Path, seconds: float, rate: int, stop: Stop, reporter: Reporter
) -> str:
    """Run for that long, and append to the journal; why it ended early, "" if it did not.

    Args:
        folder: where campaigns are made; the newest stay there.
        journal_path: a file of JSON lines.
        seconds: of the piece.
        rate: of the exchange, Hz: 500 or 1000.
        stop: ends the piece before its time.
        reporter: told of the progress.
    """
    work = folder / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{os.getpid()}"
    prepare(work, rate)
    with (
        Journal(journal_path, SYNC_EVERY) as journal,
        reporter.task("enduring (s)", seconds) as task,
    ):
        journal.add(
            kind="begin",
            at=datetime.now(UTC).isoformat(timespec="seconds"),
            rate=rate,
            seconds=seconds,
            folder=str(work),
            machine=f"{os.cpu_count()} cores, {platform.system()} {platform.release()}",
        )
        with (
            watched(work),
            _processes(work, seconds) as (controller, supervisor, summary),
        ):
            piece = Watched(work, journal, task, seconds, supervisor, controller)
            reason = piece.watch(stop)
            with suppress(subprocess.TimeoutExpired):
                supervisor.wait(LEAVING)
                controller.wait(LEAVING)
            summary.seek(0)
            said = summary.read().decode().strip().splitlines()
            journal.add(
                kind="end",
                reason=reason,
                supervisor=supervisor.poll(),
                controller=json.loads(said[-1]) if said else None,
            )
    return reason


@contextmanager
def _processes(
    work: Path, seconds: float
) -> Iterator[tuple[subprocess.Popen[bytes], subprocess.Popen[bytes], IO[bytes]]]:
    """Controller and supervisor; killed at the end if they have not ended by themselves."""
    port = free_port()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    options = ["--udp", f"{LOOPBACK}:{port}", "--missed", str(MISSED), "--json"]
    if os.geteuid() == 0:
        options += ["--priority", str(PRIORITY)]
    # Should this process be killed, the controller ends some time later by itself.
    options += ["--duration", str(seconds + 2.0 * LEAVING)]
    with ExitStack() as undo:
        summary = undo.enter_context((work / "controller.json").open("w+b"))
        words = undo.enter_context((work / "supervisor.log").open("wb"))
        controller = subprocess.Popen(
            [*SIMULATE, str(work / "cell.toml"), *options],
            stdin=subprocess.DEVNULL,
            stdout=summary,
            stderr=words,
            env=environment,
            start_new_session=True,
        )
        undo.callback(_end, controller)
        supervisor = subprocess.Popen(
            [sys.executable, "-m", "tests.endurance.supervisor", str(work), str(port),
             str(controller.pid)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=words,
            env=environment,
            start_new_session=True,
            cwd=Path(__file__).parents[2],
        )  # fmt: skip
        undo.callback(_end, supervisor)
        yield controller, supervisor, summary


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()
