"""The campaigns of a study, each run in a child process against the simulated cell."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hil.archive import ArchiveName
from hil.campaign import Campaign, CampaignFolder, CampaignPlan, Stop
from hil.campaign.errors import RepetitionsRejectedError
from hil.cell import Cell
from hil.errors import ControllerFault
from hil.progress import Reporter, Silent, Task
from hil.simulation import simulated_link, simulated_provenance

from .workers import Workers

_LOOK: Final = 1.0
"""s between two looks at how far the campaigns are."""
_COUNTED: Final = ("standstill", "excitation", "validation")


@dataclass(frozen=True, eq=False)
class Execution:
    """One campaign to be run.

    Attributes:
        root: its folder.
        cell: the simulated cell, with the number of repetitions.
        plan: what is run.
        effects: whether what the model leaves out is switched on.
    """

    root: Path
    cell: Cell
    plan: CampaignPlan
    effects: bool = False

    @property
    def motions(self) -> int:
        """Archives that are read later."""
        return 1 + self.cell.campaign.repetitions + len(self.plan.validation)

    @property
    def done(self) -> int:
        """How many of them are in the manifest."""
        folder = CampaignFolder(self.root)
        if not (self.root / "manifest.json").exists():
            return 0
        names = [ArchiveName.parse(entry.name) for entry in folder.manifest()]
        return len({(n.kind, n.index) for n in names if n is not None and n.kind in _COUNTED})

    @property
    def whole(self) -> bool:
        """Whether every one of them is there and as it was written."""
        if self.done < self.motions:
            return False
        folder = CampaignFolder(self.root)
        return sum(len(folder.completed(kind)) for kind in _COUNTED) >= self.motions


def execute_all(
    executions: Sequence[Execution], reporter: Reporter, workers: Workers
) -> dict[Path, str]:
    """Run what is missing of several campaigns, side by side.

    Returns:
        By folder, why the controller ended a campaign; what is not in it came to its end.

    Raises:
        StudyError: a campaign was refused, or its process did not come to its end.
    """
    missing = [one for one in executions if not one.whole]
    if not missing:
        return {}
    total = sum(one.motions for one in missing)
    with (
        reporter.task("running campaigns (motions)", total) as task,
        _watched(missing, task),
    ):
        ended = workers.map(execute, [(one,) for one in missing])
    return {one.root: why for one, why in zip(missing, ended, strict=True) if why is not None}


def execute(execution: Execution) -> str | None:
    """Run one campaign, in whatever process this is; what is whole in its folder is kept.

    Returns:
        Why the controller ended it, if it did: an arm may not bear what is tried on it.
    """
    root = execution.root
    if (root / "manifest.json").exists():
        campaign = Campaign.open(root)
    else:
        if root.exists():  # killed while the folder was made
            shutil.rmtree(root)
        campaign = Campaign.create(root, execution.cell, execution.plan)
    cell = campaign.cell
    try:
        campaign.run(
            simulated_link(cell, effects=execution.effects),
            Stop(),
            Silent(),
            provenance=simulated_provenance(cell, execution.effects),
            durable=False,
            unrehearsed=True,
        )
    except (ControllerFault, RepetitionsRejectedError) as error:
        return str(error)
    return None


@contextmanager
def _watched(executions: Sequence[Execution], task: Task) -> Iterator[None]:
    """Advance a task by what the manifests say, from a thread of its own."""
    over = threading.Event()

    def watch() -> None:
        seen = 0
        while True:
            last = over.wait(_LOOK)
            now = sum(one.done for one in executions)
            task.advance(now - seen, "")
            seen = now
            if last:
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
