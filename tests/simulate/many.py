"""Many seeds in child processes, with a journal of the results."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Final

from planner.worker import WorkerProcess, stream_in_children
from tests.journal import Journal, entries
from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.verdicts import Stage, Verdict

GROUPS_PER_CHILD: Final = 50  # after which children are restarted, to release their memory
LONGEST: Final = 3600.0  # s for a group of seeds with the reduction of scripts, on a busy machine
DIED: Final = "the process lives"
"""Law that a seed breaks if its process crashes or does not end."""
_PREFIX: Final = "hil_simulate_"


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


def recorded(journal: Path | None) -> dict[int, Verdict]:
    """Return the verdicts of a journal by seed."""
    verdicts = () if journal is None else entries(journal, Verdict.from_dict, "verdict on a seed")
    return {verdict.seed: verdict for verdict in verdicts}


def played(
    seeds: Sequence[int], journal: Path | None, jobs: int, *, shrink: bool = True
) -> Iterator[Verdict]:
    """Yield the verdicts on seeds in the order of completion, those of the journal first."""
    verdict_of = recorded(journal)
    yield from (verdict_of[seed] for seed in seeds if seed in verdict_of)
    missing = [seed for seed in seeds if seed not in verdict_of]
    groups = [list(group) for _, group in groupby(missing, lambda seed: seed // NEIGHBOURS)]
    batch = jobs * GROUPS_PER_CHILD
    with stage_folder() as root, Journal(journal, sync_every=60.0) as lines:
        for first in range(0, len(groups), batch):
            for verdict in _in_children(groups[first : first + batch], jobs, str(root), shrink):
                lines.add(**asdict(verdict))
                yield verdict


def _in_children(
    groups: Sequence[list[int]], jobs: int, root: str, shrink: bool
) -> Iterator[Verdict]:
    with ExitStack() as stack:
        children = [
            stack.enter_context(WorkerProcess(timeout=LONGEST))
            for _ in range(min(jobs, len(groups)))
        ]
        for seed, outcome in stream_in_children(
            children, play_all, groups, lambda group: (group, root, shrink)
        ):
            if isinstance(outcome, Verdict):
                yield outcome
            else:
                yield Verdict(seed, broken=((DIED, str(outcome)),))


@cache
def _stage(root: str) -> Stage:
    process_folder = Path(root) / str(os.getpid())
    process_folder.mkdir()
    return Stage(process_folder)


def play_all(seeds: Sequence[int], root: str, shrink: bool) -> list[Verdict]:
    """Return the verdicts on the seeds of a group, in a child process."""
    return [_stage(root).verdict(seed, shrink=shrink) for seed in seeds]
