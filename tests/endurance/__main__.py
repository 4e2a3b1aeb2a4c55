"""Run the whole real path for hours and measure it: `python -m tests.endurance`.

A simulated controller sends a packet each millisecond over UDP on this computer, and campaigns of
short motions run on one link, about 26 archives in half a minute. Every 5 s memory and threads of
each process and the histogram of latencies go to the journal; each archive is checked, and removed
when there are three newer campaigns. Campaigns with faulty archives remain.

Each call is a piece and appends to the journal; --merge only prints the verdict over all pieces.
Ctrl-C ends a piece, SIGKILL costs the last 5 s. Exit status 1 for any fault, 2 if the journal is
not one of these.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from drivers.transports.udp import UdpSpec
from hil.archive import ArchiveOutcome, open_archive
from hil.archive.check import check_archive
from hil.base.errors import HilError
from hil.base.progress import Reporter, Silent, Task, reporter
from hil.campaign import Campaign, Stop, stop_on_interrupt
from hil.campaign.plan import design
from hil.control.live_link import LiveLink
from hil.control.simulator_process import LOOPBACK, SimulatorProcess, free_port
from tests.arguments import parser_of, time_above_0
from tests.endurance.verdict import Verdict, judge, read_journal
from tests.hil.fast_cell import fast_cell
from tests.hil.loopback import on_loopback
from tests.journal import Journal, JournalError

LONGEST: Final = 90.0  # min of a piece
REPETITIONS: Final = 20  # of the excitation in a campaign, which takes about half a minute
MISSED: Final = "3"  # replies in a row that the controller misses until it ends open mode
TRIES: Final = 5
"""Resumptions of a campaign until it is abandoned: after pauses repetitions differ."""
NEWEST: Final = 3  # campaign folders that stay on the disk
PERIOD: Final = 5.0  # s between two samples
COUNTERS: Final = (
    "replied", "missed", "late", "rejected", "refused", "duplicates", "malformed", "foreign",
    "overflow", "ended_count", "worst_turnaround_us",
)  # fmt: skip


def run_piece(
    folder: Path, path: Path, seconds: float, rate: int, stop: Stop, progress: Reporter
) -> None:
    """Run for some seconds at a rate [Hz], with campaigns in `folder`; append to the journal."""
    work = folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"
    work.mkdir(parents=True)
    cell = fast_cell(work, repetitions=REPETITIONS).with_values(
        {"controller.cycle_ms": 1000 // rate}
    )
    port = free_port()
    cell = on_loopback(cell, port)
    plan = design(cell, Silent())
    (work / "cell.toml").write_text(cell.text)
    options = ["--udp", f"{LOOPBACK}:{port}", "--missed", MISSED]
    # The clock of the controller has to be better than what is measured by it.
    options += ["--priority", "60"] if os.geteuid() == 0 else []
    with Journal(path, sync_every=60.0) as journal, progress.task("running (s)", seconds) as task:
        journal.add(kind="begin", rate=rate, folder=str(work))
        simulator = SimulatorProcess.start(work / "cell.toml", *options)
        reason = ""
        try:
            with LiveLink.open(
                cell, transport=UdpSpec(LOOPBACK, port, LOOPBACK), finish=simulator.finish
            ) as link:
                pids = {
                    "supervisor": os.getpid(),
                    "exchange": link.port.exchange.pid,
                    "archive": link.port.archive.process.pid,
                    "controller": simulator.process.pid,
                }
                with sampled(link, pids, journal, seconds, stop, task):
                    newest: list[Path] = []
                    number = 0
                    while not stop.requested:
                        campaign = Campaign.create(work / f"campaign_{number:05d}", cell, plan)
                        facts = run_campaign(campaign, link, simulator, stop)
                        used = {name: count(f"/proc/{pid}/fd") for name, pid in pids.items()}
                        journal.add(kind="campaign", number=number, descriptors=used, **facts)
                        newest += [] if facts["faulty"] else [campaign.folder.root]
                        while len(newest) > NEWEST:
                            shutil.rmtree(newest.pop(0))
                        number += 1
        except HilError as error:
            reason = f"{type(error).__name__}: {error}"
        finally:
            simulator.end()
            journal.add(kind="end", reason=reason)


@contextmanager
def sampled(
    link: LiveLink, pids: dict[str, int], journal: Journal, seconds: float, stop: Stop, task: Task
) -> Iterator[None]:
    """Sample memory, threads, counters and latencies in a thread; stop when the time is over."""
    over = threading.Event()
    began = time.monotonic()

    def sample() -> None:
        status = link.port.exchange.status()
        used = {
            name: {"memory": own_memory(pid), "threads": count(f"/proc/{pid}/task")}
            for name, pid in pids.items()
        }
        journal.add(
            kind="sample",
            t=time.monotonic() - began,
            processes=used,
            counters={name: getattr(status, name) for name in COUNTERS},
            latencies=list(status.latencies),
        )
        task.advance(PERIOD, f"{status.ended_count} motions")

    def look() -> None:
        while not over.wait(PERIOD):
            with suppress(OSError):  # a process ended
                sample()
            stop.requested = stop.requested or time.monotonic() - began >= seconds

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        with suppress(OSError):
            sample()


class Lasting:
    """A link that campaigns use one after another: none of them closes it."""

    def __init__(self, link: LiveLink) -> None:
        self._link = link

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def close(self) -> None:
        """Stay open for the next campaign."""


def run_campaign(
    campaign: Campaign, link: LiveLink, simulator: SimulatorProcess, stop: Stop
) -> dict[str, Any]:
    """Run and resume a campaign until it is complete; return the facts for the journal."""
    before = link.port.exchange.status().ended_count
    errors = list[str]()
    complete = False
    lasting: Any = Lasting(link)
    while not (complete or stop.requested or len(errors) == TRIES):
        try:
            campaign.run(lasting, stop, unrehearsed=True)
            complete = True
        except HilError as error:
            if stop.requested:
                break
            errors.append(f"{type(error).__name__}: {error}")
            if not (link.port.exchange.alive and link.port.archive.alive):
                raise
            simulator.process.send_signal(signal.SIGUSR1)  # drive-on
            campaign = Campaign.open(campaign.folder.root)
    return {
        "complete": complete,
        "stopped": not complete and stop.requested,
        "restarts": errors,
        "motions": link.port.exchange.status().ended_count - before,
        **archived(campaign.folder.archives),
    }


def archived(folder: Path) -> dict[str, Any]:
    """Return what the archives of a campaign hold, and their faults."""
    outcomes: Counter[str] = Counter()
    faulty: list[str] = []
    records = lost = 0
    paths = sorted(folder.glob("*.mcap"))
    for path in paths:
        try:
            check = check_archive(path)
            archive = open_archive(path, fields=())
        except HilError as error:
            faulty.append(str(error))
            continue
        outcome = archive.outcome or ArchiveOutcome(outcome="none")
        outcomes[outcome.outcome] += 1
        lost += outcome.records_lost or 0
        records += check.samples
        if not check.conforms:
            faulty.append(f"{path.name}: {[*check.faults]}")
    return {
        "archives": len(paths), "outcomes": dict(outcomes), "faulty": faulty, "records": records,
        "records_lost": lost,
    }  # fmt: skip


def count(folder: str) -> int:
    """Return the number of entries of a folder."""
    return sum(1 for _ in Path(folder).iterdir())


def own_memory(pid: int) -> int:
    """Return the bytes in anonymous pages of a process, swapped ones too.

    The unique set size also grows when another process with the same libraries ends.
    """
    text = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
    kilobytes = {name: value for name, _, value in (row.partition(":") for row in text.split("\n"))}
    return 1024 * sum(int(kilobytes[name].split()[0]) for name in ("Anonymous", "Swap"))


def main(arguments: list[str] | None = None) -> int:
    """Run a piece, or only merge; print the verdict over all pieces."""
    parser = parser_of("tests.endurance", __doc__)
    option = parser.add_argument
    option("--journal", type=Path, required=True, help="JSON lines; appended to")
    option("--minutes", type=time_above_0, help=f"duration of this piece, at most {LONGEST:g}")
    option("--folder", type=Path, help="folder of the campaigns")
    option("--rate", type=int, choices=(500, 1000), default=1000, help="packets per second")
    option("--merge", action="store_true", help="run nothing, print the verdict")
    option("--json", action="store_true", help="print one line of JSON")
    chosen = parser.parse_args(arguments)
    if not chosen.merge and (chosen.folder is None or chosen.minutes is None):
        parser.error("--minutes and --folder are needed to run a piece")
    if not chosen.merge and chosen.minutes > LONGEST:
        parser.error(f"--minutes must be at most {LONGEST:g}")
    try:
        pieces = read_journal(chosen.journal)  # before anything is appended to another file
        if not chosen.merge:
            with stop_on_interrupt() as stop:
                duration = 60.0 * chosen.minutes
                progress = reporter(quiet=chosen.json)
                run_piece(chosen.folder, chosen.journal, duration, chosen.rate, stop, progress)
            pieces = read_journal(chosen.journal)
    except JournalError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    if not pieces:
        sys.stderr.write(f"error: no piece is in {chosen.journal}; run one first\n")
        return 2
    _print(judge(pieces), chosen)
    return 1 if judge(pieces).faults else 0


def _print(verdict: Verdict, chosen: argparse.Namespace) -> None:
    if chosen.json:
        sys.stdout.write(json.dumps({"good": not verdict.faults, **asdict(verdict)}) + "\n")
        return
    for number, figures in enumerate(verdict.figures, 1):
        sys.stdout.write(f"piece {number}\n")
        sys.stdout.writelines(f"  {name:20} {value}\n" for name, value in figures.items())
    sys.stdout.writelines(f"warning: {text}\n" for text in verdict.warnings)
    sys.stdout.writelines(f"FAULT: {text}\n" for text in verdict.faults or ("none",))


if __name__ == "__main__":
    sys.exit(main())
