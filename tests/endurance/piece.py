"""One piece of a long run: campaigns on one link to a simulated controller."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from drivers.transports.udp import UdpSpec
from hil.archive import ArchiveOutcome, open_archive
from hil.archive.check import check_archive
from hil.campaign import Campaign, CampaignPlan, Stop
from hil.campaign.live_link import LiveLink
from hil.campaign.plan import design
from hil.cell import Cell
from hil.demo_link import LOOPBACK, SimulatorProcess, free_port
from hil.errors import HilError
from hil.progress import Reporter, Silent, Task
from tests.endurance.stalls import so_far, watched
from tests.hil.fast_cell import fast_cell
from tests.journal import Journal

REPETITIONS: Final = 20  # Of the excitation in a campaign, which so takes about half a minute
MISSED: Final = 3  # Answers in a row that the controller misses until it ends open mode
TRIES: Final = 5
"""Resumptions of a campaign until it is abandoned: after pauses repetitions differ."""
NEWEST: Final = 3  # Campaign folders that stay on the disk
SAMPLED_EVERY: Final = 5.0  # s between two looks at everything
PRIORITY: Final = 60
"""Real-time priority of the controller: its clock has to be better than what is measured by it."""
COUNTERS: Final = (
    "answered", "missed", "late", "answered_late", "not_accepted", "refused", "duplicates", "stale",
    "malformed", "foreign", "overflow", "ended_count", "worst_turnaround_us",
)  # fmt: skip


def run_piece(
    folder: Path, journal_path: Path, seconds: float, rate: int, stop: Stop, reporter: Reporter
) -> None:
    """Run for some seconds at a rate [Hz], with campaigns in `folder`; append to the journal."""
    work = folder / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{os.getpid()}"
    work.mkdir(parents=True)
    cell = fast_cell(work, repetitions=REPETITIONS).with_values(
        {"controller.cycle_ms": 1000 // rate}
    )
    cell = cell.with_link(transport="udp", host=LOOPBACK, bind=LOOPBACK, port=free_port())
    plan = design(cell, Silent())
    options = ["--udp", f"{LOOPBACK}:{cell.controller.port}", "--missed", str(MISSED)]
    if os.geteuid() == 0:
        options += ["--priority", str(PRIORITY)]
    with (
        Journal(journal_path, sync_every=60.0) as journal,
        reporter.task("enduring (s)", seconds) as task,
    ):
        journal.add(kind="begin", rate=rate, folder=str(work))
        (work / "cell.toml").write_text(cell.text)
        simulator = SimulatorProcess.start(work / "cell.toml", *options)
        spec, reason = UdpSpec(LOOPBACK, cell.controller.port or 0, LOOPBACK), ""
        try:
            with (
                watched(work),
                LiveLink.open(cell, transport=spec, finish=simulator.finish) as link,
            ):
                journal.add(kind="link", scheduling=link.exchange.realtime.scheduling)
                piece = _Piece(work, journal, task, seconds, stop, link, simulator)
                with piece.sampled():
                    piece.run(cell, plan)
                reason = "interrupted" if piece.at < seconds else ""
        except HilError as error:
            reason = f"{type(error).__name__}: {error}"
        finally:
            simulator.end()
            journal.add(kind="end", reason=reason)


@dataclass(eq=False)
class _Piece:
    folder: Path
    journal: Journal
    task: Task
    seconds: float
    stop: Stop
    link: LiveLink
    simulator: SimulatorProcess
    began: float = field(default_factory=time.monotonic)
    _newest: list[Path] = field(default_factory=list)

    @property
    def at(self) -> float:
        """Since the piece began [s]."""
        return time.monotonic() - self.began

    @property
    def pids(self) -> Mapping[str, int]:
        """Of every process that has a part in it."""
        return {
            "supervisor": os.getpid(),
            "exchange": self.link.exchange.pid,
            "archive": self.link.archive.process.pid,
            "controller": self.simulator.process.pid,
        }

    @contextmanager
    def sampled(self) -> Iterator[None]:
        """Sample everything periodically in a thread; stop when the time is over."""
        over = threading.Event()

        def look() -> None:
            while not over.wait(SAMPLED_EVERY):
                self._sample()
                self.stop.requested = self.stop.requested or self.at >= self.seconds

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            self._sample()

    def _sample(self) -> None:
        status, (stalls, stood) = self.link.exchange.status(), so_far(self.folder)
        used = {}
        for name, pid in self.pids.items():
            with suppress(OSError):
                used[name] = {"own": own_memory(pid), "threads": count(f"/proc/{pid}/task")}
        self.journal.add(
            kind="sample",
            t=self.at,
            load=os.getloadavg()[0],
            processes=used,
            counters={name: getattr(status, name) for name in COUNTERS},
            latencies=list(status.latencies),
            stalls=stalls,
            stood=stood,
        )
        self.task.advance(SAMPLED_EVERY, f"{status.ended_count} motions")

    def run(self, cell: Cell, plan: CampaignPlan) -> None:
        """Run campaigns until the time is over or a stop is requested."""
        number = 0
        while not self.stop.requested:
            before = self.link.exchange.status().ended_count
            campaign = Campaign.create(self.folder / f"campaign_{number:05d}", cell, plan)
            errors: list[str] = []
            complete = self._completed(campaign, errors)
            whole = checked(campaign.folder.archives)
            self.journal.add(
                kind="campaign",
                number=number,
                t=self.at,
                complete=complete,
                stopped=not complete and self.stop.requested,
                restarts=errors,
                motions=self.link.exchange.status().ended_count - before,
                descriptors={name: count(f"/proc/{pid}/fd") for name, pid in self.pids.items()},
                **whole,
            )
            if not whole["faulty"]:  # what is faulty is to be looked at
                self._newest.append(campaign.folder.root)
            while len(self._newest) > NEWEST:
                shutil.rmtree(self._newest.pop(0))
            number += 1

    def _completed(self, campaign: Campaign, errors: list[str]) -> bool:
        """Run and resume a campaign until it is complete; False if it was stopped or abandoned."""
        link: Any = _Lasting(self.link)
        while not self.stop.requested and len(errors) < TRIES:
            try:
                campaign.run(link, self.stop, unrehearsed=True)
                return True
            except HilError as error:
                if self.stop.requested:
                    break
                errors.append(f"{type(error).__name__}: {error}")
                if not self.link.exchange.alive or not self.link.archive.alive:
                    raise
                self.simulator.process.send_signal(signal.SIGUSR1)  # drive-on
                campaign = Campaign.open(campaign.folder.root)
        return False


@dataclass(eq=False)
class _Lasting:
    """A link that campaigns use one after another: none of them ends it."""

    link: LiveLink

    def __getattr__(self, name: str) -> Any:
        return getattr(self.link, name)

    def close(self) -> None:
        """Stay open for the next campaign."""


def checked(folder: Path) -> dict[str, Any]:
    """What the archives of a campaign hold, and what is wrong with them."""
    outcomes: dict[str, int] = {}
    faulty: list[str] = []
    records = lost = 0
    paths = sorted(folder.glob("*.mcap"))
    for path in paths:
        try:
            check, archive = check_archive(path), open_archive(path, fields=())
        except HilError as error:
            faulty.append(str(error))
            continue
        outcome = archive.outcome or ArchiveOutcome(outcome="none")
        outcomes[outcome.outcome] = outcomes.get(outcome.outcome, 0) + 1
        lost += outcome.records_lost or 0
        records += check.samples
        if not check.conforms:
            faulty.append(f"{path.name}: {[*check.faults]}")
    return {
        "archives": len(paths), "outcomes": outcomes, "faulty": faulty, "records": records,
        "records_lost": lost,
    }  # fmt: skip


def count(folder: str) -> int:
    return sum(1 for _ in Path(folder).iterdir())


def own_memory(pid: int) -> int:
    """Bytes in anonymous pages of a process, swapped ones too.

    The unique set size also grows when another process with the same libraries ends.
    """
    text = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
    kilobytes = {name: value for name, _, value in (row.partition(":") for row in text.split("\n"))}
    return 1024 * sum(int(kilobytes[name].split()[0]) for name in ("Anonymous", "Swap"))
