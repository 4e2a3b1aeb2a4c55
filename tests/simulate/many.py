"""Many seeds in child processes, with a journal of the results."""

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

SEEDS_PER_CHILD: Final = 400  # after which a child is restarted, to release its memory
LONGEST: Final = 1200.0  # s for a seed with the reduction of its script, on a busy machine
DIED: Final = "the process lives"
"""Law that a seed breaks if its process crashes or does not end."""
_PREFIX: Final = "hil_simulate_"


class Known:
    """Verdicts by seed, read from and added to a journal; without a path in memory only."""

    def __init__(self, path: Path | None) -> None:
        found = () if path is None else entries(path, Verdict.from_dict, "verdict on a seed")
        self.verdicts = {verdict.seed: verdict for verdict in found}
        self._journal = Journal(path, sync_every=60.0)

    def add(self, verdict: Verdict) -> None:
        self.verdicts[verdict.seed] = verdict
        self._journal.add(**asdict(verdict))


@contextmanager
def stage_folder() -> Iterator[Path]:
    """Create a folder, in memory if possible; remove it afterwards, and leftover ones."""
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
    """Yield the verdicts on seeds in the order of completion, known ones first."""
    yield from (known.verdicts[seed] for seed in seeds if seed in known.verdicts)
    missing = [seed for seed in seeds if seed not in known.verdicts]
    groups = deque(deque(group) for _, group in groupby(missing, lambda seed: seed // NEIGHBOURS))
    with stage_folder() as root, ExitStack() as children:
        workers = [_Worker(groups, str(root), shrink) for _ in range(min(jobs, len(groups)))]
        for worker in workers:
            children.callback(worker.child.close)
        busy = [worker for worker in workers if worker.begin()]
        while busy:
            left = min(worker.child.deadline for worker in busy) - monotonic()
            ready = wait([worker.child.connection for worker in busy], max(0.0, left))
            for worker in list(busy):
                if worker.child.connection in ready or worker.child.deadline <= monotonic():
                    if (verdict := worker.fetch()) is not None:
                        known.add(verdict)
                        yield verdict
                    if not worker.begin():
                        busy.remove(worker)


class _Worker:
    """One child process and its queue of seeds of one group."""

    def __init__(self, groups: deque[deque[int]], root: str, shrink: bool) -> None:
        self._groups, self._root, self._shrink = groups, root, shrink
        self.child = WorkerProcess(timeout=LONGEST)
        self._seeds: deque[int] = deque()
        self._again: set[int] = set()
        self._seed = -1
        self._played = 0

    def begin(self) -> bool:
        """Start the next seed in the child; return False without one."""
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
        """Return the verdict; None if the child died and the seed is tried once more."""
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
    """Return the verdict on a seed, in a child process."""
    return _stage(root).verdict(seed, shrink=shrink)
