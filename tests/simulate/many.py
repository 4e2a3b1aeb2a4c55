"""Many seeds, in child processes, kept in a journal so that none is played twice."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import cache
from itertools import groupby
from multiprocessing.connection import wait
from pathlib import Path
from time import monotonic
from typing import Final

from planner.errors import PlannerCrashed, PlannerNotStarted, PlanningTimedOut
from planner.worker import WorkerProcess
from tests.journal import Journal, entries
from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.verdicts import Stage, Verdict

SEEDS_PER_CHILD: Final = 400  # After which it gives its memory back
LONGEST: Final = 1200.0  # s that a seed may take, made small included, on a busy machine
DIED: Final = "the process lives"
"""Name of the law that a seed breaks which takes its process with it, or never ends."""
_PREFIX: Final = "hil_simulate_"


class Known:
    """Verdicts by seed that a journal has, and those that are added to it; without a path none."""

    def __init__(self, path: Path | None) -> None:
        found = () if path is None else entries(path, Verdict.from_dict, "verdict on a seed")
        self.verdicts = {verdict.seed: verdict for verdict in found}
        self._journal = Journal(path, sync_every=60.0)  # s of which a loss of power costs

    def add(self, verdict: Verdict) -> None:
        self.verdicts[verdict.seed] = verdict
        self._journal.add(**asdict(verdict))


@contextmanager
def stage_folder() -> Iterator[Path]:
    """A folder in memory where there is one, removed afterwards, or by the next if it is killed."""
    shared = Path("/dev/shm")
    where = shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())
    for left in where.glob(f"{_PREFIX}*"):
        owner = left.name.removeprefix(_PREFIX).partition("_")[0]
        if owner.isdecimal() and not Path("/proc", owner).exists():
            shutil.rmtree(left, ignore_errors=True)
    root = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}_", dir=where))
    try:
        yield root
    finally:
        shutil.rmtree(root, ignore_errors=True)


def played(
    seeds: Sequence[int], known: Known, jobs: int, *, shrink: bool = True
) -> Iterator[Verdict]:
    """Verdicts as they come, those first that are known. Children end with this process."""
    yield from (known.verdicts[seed] for seed in seeds if seed in known.verdicts)
    missing = [seed for seed in seeds if seed not in known.verdicts]
    groups = deque(deque(group) for _, group in groupby(missing, lambda seed: seed // NEIGHBOURS))
    with stage_folder() as root, ExitStack() as children:
        desks = [_Desk(groups, str(root), shrink) for _ in range(min(jobs, len(groups)))]
        for desk in desks:
            children.callback(desk.child.close)
        busy = [desk for desk in desks if desk.begin()]
        while busy:
            left = min(desk.child.deadline for desk in busy) - monotonic()
            ready = wait([desk.child.connection for desk in busy], max(0.0, left))
            for desk in list(busy):
                if desk.child.connection in ready or desk.child.deadline <= monotonic():
                    if (verdict := desk.fetch()) is not None:
                        known.add(verdict)
                        yield verdict
                    if not desk.begin():
                        busy.remove(desk)


class _Desk:
    """One child process, and the seeds of one group that wait for it."""

    def __init__(self, groups: deque[deque[int]], root: str, shrink: bool) -> None:
        self._groups, self._root, self._shrink = groups, root, shrink
        self.child = WorkerProcess(timeout=LONGEST)
        self._seeds: deque[int] = deque()
        self._again: set[int] = set()
        self._seed = -1
        self._played = 0

    def begin(self) -> bool:
        """Give the child the next seed; whether there was one."""
        if not self._seeds:
            if not self._groups:
                return False
            self._seeds = self._groups.popleft()
        self._seed = self._seeds.popleft()
        self._played += 1
        if self._played % SEEDS_PER_CHILD == 0:
            self.child.close()
        self.child.send(play_one, self._seed, self._root, self._shrink)
        return True

    def fetch(self) -> Verdict | None:
        """The verdict; None where the child died, and the seed is tried once more."""
        try:
            found: Verdict = self.child.receive()
        except (PlannerCrashed, PlannerNotStarted, PlanningTimedOut) as error:
            if self._seed in self._again:
                return Verdict(self._seed, "", (), (), (), (), 0, ((DIED, str(error)),))
            self._again.add(self._seed)
            self._seeds.appendleft(self._seed)
            return None
        return found


@cache
def _stage(root: str) -> Stage:
    own = Path(root) / str(os.getpid())
    own.mkdir()
    return Stage(own)


def play_one(seed: int, root: str, shrink: bool) -> Verdict:
    """The verdict on a seed, in a child process."""
    return _stage(root).verdict(seed, shrink=shrink)
