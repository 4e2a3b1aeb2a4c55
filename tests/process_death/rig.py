"""The real campaign of a round: controller, supervisor, and the processes that it starts.

Controller and supervisor are forked from a process with all imports. All processes are observed
from outside: by their memory, their files, and the controller's account.
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from drivers import cycle_records
from drivers.cycle_records import RingReader, cycle_dtype
from drivers.exchange.control import SharedState
from drivers.states import State
from hil.base.errors import HilError
from hil.base.progress import Silent
from hil.campaign import Campaign, stop_on_interrupt
from tests.faults import StrikeKind, Strikes, Trigger, Victim
from tests.laws.manifests import Entry, manifest_of
from tests.process_death.ends import ENDS
from tests.process_death.page import Page, Rows, at_rest, forked
from tests.process_death.rounds import Round

EXCHANGE: Final = "drivers.exchange"
ARCHIVE: Final = "hil.archive.process"
MODULES: Final[dict[Victim, str]] = {"exchange": EXCHANGE, "archive": ARCHIVE}
_RING, _CONTROL = 2, 4  # places in the exchange's command line, behind the module's name


def started_by(supervisor: int, module: str) -> int:
    """Process id of a supervisor's child that runs a module, 0 if there is none."""
    with suppress(OSError):
        children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text()
        for pid in map(int, children.split()):
            if module in _words(pid):
                return pid
    return 0


def marked(name: str, value: str) -> list[int]:
    """Processes that were started with a variable in their environment, zombies left out."""
    mark = f"{name}={value}".encode()
    pids = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    pids.append(int(entry.name))
    return pids


def _words(pid: int) -> list[str]:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    return []


def _descriptor(exchange: int, place: int) -> int:
    """One of the exchange's descriptors, opened here; OSError if it is gone."""
    arguments = _words(exchange)
    if EXCHANGE not in arguments:
        raise ProcessLookupError(f"{exchange} is no exchange process any more")
    number = arguments[arguments.index(EXCHANGE) + 1 + place]
    return os.open(f"/proc/{exchange}/fd/{number}", os.O_RDWR)


class Memory:
    """Shared memory of an exchange, also after its death; OSError if it is gone."""

    def __init__(self, exchange: int, joints: int) -> None:
        self._joints = joints
        self._ring = _descriptor(exchange, _RING)
        descriptor = _descriptor(exchange, _CONTROL)
        self.control = SharedState(descriptor)
        os.close(descriptor)
        self._words = memoryview(mmap.mmap(self._ring, 4096)).cast("B").cast("q")

    @property
    def written(self) -> int:
        return int(self._words[cycle_records._WRITTEN_WORD])

    @property
    def behind(self) -> int:
        """Records written that the archive process has not read; 0 before it began."""
        read = int(self._words[cycle_records._READ_WORD])
        return self.written - read if read else 0

    def records(self) -> NDArray[np.void]:
        """All records of the session; none was overwritten."""
        return RingReader(self._ring, self._joints, acknowledge=False).drain()

    def close(self) -> None:
        os.close(self._ring)


MARK: Final = "HIL_PROCESS_DEATH"
"""Variable in the environment of every process that a supervisor starts."""


PATIENCE: Final = 90.0
"""s for anything that has to happen, on a machine that does other things as well."""
LOOK: Final = 0.001  # s between two looks
NOTICED: Final = 100  # Cycles within which an exchange has noticed the death of its supervisor
MAY_MOVE: Final = (State.OPENING, State.OPEN, State.EXITING)


SIGNALS: Final[Mapping[StrikeKind, signal.Signals]] = {
    "kill": signal.SIGKILL,
    "freeze": signal.SIGSTOP,
    "interrupt": signal.SIGINT,
    "hangup": signal.SIGHUP,
}


class NeverHappenedError(AssertionError):
    """Something that has to happen did not."""


@dataclass(eq=False)
class Death:
    """One kill."""

    victim: Victim  # who died
    written: int  # records that the exchange had written just before
    behind: int = 0  # of them those not archived yet at some moment of the last second, at most


@dataclass(eq=False)
class Seen:
    """What was seen of one run of a campaign."""

    deaths: list[Death]  # in order
    status: int | None  # exit status of the supervisor, None if it was killed
    report: dict[str, Any]  # its report, see `supervise`
    rows: Rows  # the controller's account up to when everything else had ended
    records: NDArray[np.void]  # the exchange's, from its memory
    entered: list[Entry]  # manifest as it was before the first kill
    left: list[int] = field(default_factory=list)  # processes that should have ended
    port_in_use: bool = False  # whether the port was still in use afterwards

    @property
    def killed(self) -> tuple[Victim, ...]:
        return tuple(death.victim for death in self.deaths)


class Watched:
    """The processes of one run; they end with the block."""

    def __init__(
        self, campaign: Campaign, played: Round, report: Path, planted: Path | None
    ) -> None:
        self.campaign = campaign
        self.played = played
        self.ends = ends = ENDS[played.link]
        self.page = Page(ends.joints)
        controller = forked(lambda: ends.serve(campaign.cell, played, self.page))
        deadline = time.monotonic() + PATIENCE
        while not self.page.serving and time.monotonic() < deadline:
            time.sleep(LOOK)
        supervisor = forked(lambda: supervise(campaign.folder.root, report, planted))
        self.pids: dict[Victim, int] = {"supervisor": supervisor, "controller": controller}
        self.status: dict[Victim, int] = {}
        self.memory: Memory | None = None
        self._ends: dict[Victim, int] = {}
        self._leaving: int | None = None
        self._behind: deque[int] = deque(maxlen=round(1.0 / LOOK))
        for victim in ("supervisor", "controller"):
            self._watch(victim)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for victim, pid in self.pids.items():
            if not self.over(victim):
                _kill(pid)
        for victim in ("supervisor", "controller"):
            self._reap(victim)
        for end in self._ends.values():
            os.close(end)
        if self.memory is not None:
            self.memory.close()
        for pid in marked(MARK, str(self.campaign.folder.root)):
            _kill(pid)

    def _watch(self, victim: Victim) -> None:
        with suppress(ProcessLookupError):
            self._ends[victim] = os.pidfd_open(self.pids[victim])

    def _reap(self, victim: Victim) -> None:
        if victim in ("supervisor", "controller") and victim not in self.status:
            status = os.waitpid(self.pids[victim], 0)[1]
            self.status[victim] = os.waitstatus_to_exitcode(status)

    def over(self, victim: Victim) -> bool:
        """Whether a process has ended; one that never began counts as ended."""
        if victim not in self._ends:
            return True
        if not select.select([self._ends[victim]], [], [], 0.0)[0]:
            return False
        self._reap(victim)
        return True

    def look(self) -> None:
        """Find processes and memory that the supervisor has created meanwhile."""
        for victim, module in MODULES.items():
            if victim not in self.pids and (pid := started_by(self.pids["supervisor"], module)):
                self.pids[victim] = pid
                self._watch(victim)
                self.page.exchange = self.pids.get("exchange", 0)
        if self.memory is None and "exchange" in self.pids:
            with suppress(OSError):
                self.memory = Memory(self.pids["exchange"], self.ends.joints)
        if self.memory is not None:
            self._behind.append(self.memory.behind)
        if not self.played.loops and self._left_alone():
            self.page.finished = 1  # as whoever stands at the cabinet would

    def _left_alone(self) -> bool:
        """Return whether nothing moves and nothing will be requested any more.

        An exchange may begin a motion within some cycles after its supervisor died; targets rest
        then, so that a controller that is to end would close its axes.
        """
        control = None if self.memory is None else self.memory.control
        if not (self.over("supervisor") or (control is not None and control.finish)):
            return False
        if self._leaving is None:
            self._leaving = self.page.count
        moves = control is not None and control.state in MAY_MOVE and not self.over("exchange")
        return not moves and self.page.count - self._leaving > NOTICED

    def until(self, done: Callable[[], bool], what: str, every: float = LOOK) -> None:
        """Poll until `done()`; NeverHappenedError after `PATIENCE` s."""
        deadline = time.monotonic() + PATIENCE
        while not done():
            self.look()
            if time.monotonic() > deadline:
                raise NeverHappenedError(f"{what} never happened")
            time.sleep(every)

    def wait(self, *victims: Victim) -> None:
        """Until they have ended."""
        for victim in victims:
            self.until(partial(self.over, victim), f"the end of the {victim}", 5 * LOOK)

    def struck(self, strikes: Strikes | None) -> tuple[list[Death], list[Entry]]:
        """Wait for the moment and strike; return the deaths, and the manifest before them."""
        due = None if strikes is None else _Due(self, strikes.trigger)
        deaths = list[Death]()
        self.until(
            lambda: self.over("supervisor") or (due is not None and due.now()),
            "neither the campaign's end nor the kill",
        )
        if strikes is None or self.over("supervisor"):
            return deaths, self._entries()
        entered = self._entries()
        until = time.monotonic() + strikes.trigger.delay
        while (left := until - time.monotonic()) > 0.0:
            self.look()
            time.sleep(min(left, LOOK))
        for place, victim in enumerate(strikes.victims):
            if place:
                time.sleep(strikes.apart)
            while victim not in self.pids and not self.over("supervisor"):
                self.look()
                time.sleep(LOOK)
            if victim in self.pids and not self.over(victim):
                written = 0 if self.memory is None else self.memory.written
                self._strike(victim, strikes.kind)
                if strikes.kind not in ("interrupt", "hangup"):  # which end no process
                    deaths.append(Death(victim, written, max(self._behind, default=0)))
        return deaths, entered

    def _entries(self) -> list[Entry]:
        return manifest_of(self.campaign.folder.root)[1]

    def _strike(self, victim: Victim, kind: StrikeKind) -> None:
        pid = self.pids[victim]
        with suppress(ProcessLookupError):
            if kind == "disk-full":
                archives = self.campaign.folder.archives.iterdir()
                newest = max(archives, key=lambda path: path.stat().st_mtime_ns)
                most = newest.stat().st_size + 1000
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (most, most))
            elif kind in ("interrupt", "hangup"):  # as a terminal sends them
                os.killpg(pid, SIGNALS[kind])
            else:
                os.kill(pid, SIGNALS[kind])

    def rest(self) -> Rows:
        """Return the account up to where the controller alone has its arm at rest.

        Not later: some open their axes again and again.
        """
        deadline = time.monotonic() + PATIENCE  # after which the laws will say so
        while True:
            # Without any reply it has not begun; with an ended session it is done.
            done = self.over("controller") or time.monotonic() > deadline
            rows = self.page.rows()
            if done or not len(rows) or at_rest(rows):
                return rows
            time.sleep(5 * LOOK)

    def left(self) -> list[int]:
        """Processes that should have ended; a child that plans a motion may take some seconds."""
        deadline = time.monotonic() + 10.0
        while left := marked(MARK, str(self.campaign.folder.root)):
            if time.monotonic() > deadline:
                break
            time.sleep(20 * LOOK)
        return left


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def supervise(campaign: Path, report: Path, planted: Path | None) -> int:
    """Run what is missing; return the exit status, and write the result to `report`."""
    os.setsid()
    log = os.open(report.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for ours, standard in ((nothing, 0), (log, 1), (log, 2)):
        os.dup2(ours, standard)
    os.environ[MARK] = str(campaign)
    if planted is not None:  # what this process can import, those that it starts can
        sys.path.insert(0, str(planted))
    outcome: dict[str, object]
    try:
        with stop_on_interrupt() as stop:
            result = Campaign.open(campaign).run(None, stop, Silent(), unrehearsed=True)
        outcome = {"complete": result.complete, "rejected": len(result.rejected)}
        status = 0
    except HilError as error:
        outcome = {"error": type(error).__name__, "text": str(error)}
        status = error.exit_code
    report.write_text(json.dumps(outcome))
    return status


class _Due:
    """Whether the moment of a trigger has come."""

    def __init__(self, watched: Watched, trigger: Trigger) -> None:
        self._watched = watched
        self._trigger = trigger
        self._folder = watched.campaign.folder
        self._begun = self._modified()
        self._entered = 0
        self._state = -1
        self._times = 0

    def _modified(self) -> int:
        return (self._folder.root / "manifest.json").stat().st_mtime_ns

    def now(self) -> bool:
        trigger = self._trigger
        match trigger.moment:
            case "start":
                return True
            case "cycle":
                return bool(self._watched.page.count >= trigger.count)
            case "archive":
                return sum(1 for _ in self._folder.archives.iterdir()) >= trigger.count
            case "entered":
                modified = self._modified()
                self._entered += modified != self._begun
                self._begun = modified
                return self._entered >= trigger.count
        if self._watched.memory is None:
            return False
        control = self._watched.memory.control
        if trigger.moment == "motion":
            ended = control.ended_count
            going_on = control.program_accepted
            on_the_way = going_on == trigger.count and control.motion_time >= trigger.way
            return on_the_way or ended >= trigger.count
        state = control.state
        self._times += state == trigger.state and state != self._state
        self._state = state
        return self._times >= trigger.count


def run(
    campaign: Campaign,
    played: Round,
    strikes: Strikes | None,
    report: Path,
    planted: Path | None = None,
) -> Seen:
    """Run a campaign with a new controller, and strike its processes, or none."""
    with Watched(campaign, played, report, planted) as watched:
        deaths, entered = watched.struck(strikes)
        watched.wait("supervisor", "exchange", "archive")
        rows = watched.rest()
        memory = watched.memory
        nothing = np.zeros(0, cycle_dtype(watched.ends.joints))
        records = nothing if memory is None else memory.records()
        watched.page.abandoned = 1
        watched.wait("controller")
        killed = "supervisor" in {death_of.victim for death_of in deaths}
        return Seen(
            deaths,
            None if killed else watched.status["supervisor"],
            json.loads(report.read_text()) if report.exists() else {},
            rows,
            records,
            entered,
            left=watched.left(),
            port_in_use=watched.ends.port_in_use(campaign.cell),
        )
