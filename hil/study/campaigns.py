"""The searches of a study, and its campaigns, run in child processes on the simulated cell."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

from hil.base.errors import ExecutionError, HilError
from hil.base.progress import Reporter, Silent
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive
from hil.campaign import Campaign, CampaignFolder, CampaignPlan, Stop
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.plan import moves_of, plan_around
from hil.cell import Cell
from hil.control.motion_checks import MotionChecks
from hil.control.simulation import simulated_link, simulated_provenance
from hil.design import DesignResult, DesignSettings, preset
from hil.design.messages import NoExcitationError
from hil.design.run import DesignFolder, run_design
from identification.excitation import Excitation

from .settings import StudyFolder, StudySettings

A: Final = "a"
B: Final = "b"
LABELS: Final = {A: "A", B: "B"}
NO_EFFECTS = "no-effects"
EFFECTS = "effects"
SINES: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "a-middle": ("about the middle of the ranges, frequencies as printed", {}),
    "a-home": ("about the home posture, frequencies as printed", {"offset": "home"}),
    "a-middle-fast": (
        "about the middle of the ranges, frequencies up to the appendix's bound",
        {"fastest": "from limits"},
    ),
    "a-home-fast": (
        "about the home posture, frequencies up to the appendix's bound",
        {"offset": "home", "fastest": "from limits"},
    ),
}
"""Variants of method A where the paper is not specific; each is searched and the best is used."""
_PRINTED_SINES: Final = ("a-middle", "a-home")
"""Variants with the frequencies of the paper's Table 1, for six joints."""
_PRINTED_JOINTS: Final = 6

T = TypeVar("T")


class StudyError(HilError):
    """A study was not completed; a restart resumes it."""


@dataclass(frozen=True, eq=False)
class Search:
    """One search."""

    key: str  #: name of its folder
    description: str
    settings: DesignSettings
    excitation: Excitation | None = None  #: None before the search, or if nothing was found


def searches(settings: StudySettings, n_joints: int) -> list[Search]:
    """Return all searches of a study."""
    a, b = (
        preset_settings.replaced(
            seed=settings.seed,
            search={
                "population": effort.population,
                "generations": effort.generations,
            },
        )
        for preset_settings, effort in (
            (preset(A), settings.effort_a),
            (preset(B), settings.effort_b),
        )
    )
    sines = [
        Search(key, f"method A, sines {description}", a.replaced(sines=changes))
        for key, (description, changes) in SINES.items()
        if n_joints == _PRINTED_JOINTS or key not in _PRINTED_SINES
    ]
    return [*sines, Search(B, "method B", b)]


def run_searches(
    folder: StudyFolder, cell: Cell, wanted: Sequence[Search], reporter: Reporter, workers: int
) -> list[Search]:
    """Run the searches that are not complete; an interrupted search resumes from its journal."""
    searches = []
    for number, search in enumerate(wanted, 1):
        place = DesignFolder(folder.design(search.key))
        result = DesignResult.load(place.result) if place.result.exists() else None
        if result is None or not result.complete or result.settings != search.settings:
            reporter.step(f"search {number} of {len(wanted)}: {search.description}")
            resume = place.settings.exists()
            try:
                result = run_design(
                    place, cell, search.settings, reporter, workers=workers, resume=resume
                ).result
            except NoExcitationError as error:
                reporter.say(f"no feasible motion: {error}")
                result = None
        searches.append(replace(search, excitation=None if result is None else result.excitation))
    return searches


def chosen(searches: Sequence[Search]) -> dict[str, Search]:
    """Return the search of each method, of A that of largest determinant, its criterion.

    Raises:
        NoExcitationError: a method found no motion.
    """

    def score(search: Search) -> float:
        return -float("inf") if search.excitation is None else search.excitation.criteria.log10_det

    sines = max((search for search in searches if search.key != B), key=score)
    best = {A: sines, B: next(search for search in searches if search.key == B)}
    for search in best.values():
        if search.excitation is None:
            raise NoExcitationError(
                f"{search.description} found no motion that satisfies all constraints of the cell;"
                " search longer (without --quick), or with another --seed"
            )
    return best


@dataclass(frozen=True, eq=False)
class StudyExecution:
    """One campaign of the study."""

    root: Path  #: its folder
    cell: Cell
    plan: CampaignPlan
    effects: bool  #: whether unmodelled effects are simulated

    @property
    def complete(self) -> bool:
        """Whether all archives exist and are intact."""
        folder = CampaignFolder(self.root)
        kinds = ("standstill", "excitation", "validation")
        motions = 1 + self.cell.campaign.repetitions + len(self.plan.validation)
        return (self.root / "manifest.json").exists() and (
            sum(len(folder.completed(kind)) for kind in kinds) >= motions
        )


def plan_study(
    folder: StudyFolder, cell: Cell, settings: StudySettings, best: Mapping[str, Search]
) -> dict[str, dict[str, StudyExecution]]:
    """Return the campaigns by condition and method; the held-out motions are in those of B.

    These are random motions through as many via points as its excitation has, with its fly.
    """
    excitations = {key: search.excitation for key, search in best.items()}
    main = cell.with_campaign(
        repetitions=settings.repetitions,
        validation_runs=settings.motions,
        simulation_seed=settings.seed,
    )
    excitation = excitations[B]
    assert excitation is not None  # see `chosen`
    random = main.with_values({"campaign.fly": excitation.fly, "campaign.seed": settings.seed})
    held_out = {B: plan_around(random, excitation, MotionChecks.of(cell)).validation}
    return {
        condition: {
            key: StudyExecution(
                folder.campaign(condition, key),
                main,
                CampaignPlan(excitation, tuple(held_out.get(key, ())), moves_of(cell, excitation)),
                condition == EFFECTS,
            )
            for key, excitation in excitations.items()
            if excitation is not None
        }
        for condition in ((NO_EFFECTS, EFFECTS) if settings.effects else (NO_EFFECTS,))
    }


def execute(execution: StudyExecution) -> None:
    """Run or resume one campaign.

    Raises:
        StudyError: the controller ended it.
    """
    root = execution.root
    if execution.complete:
        return
    if (root / "manifest.json").exists():
        campaign = Campaign.open(root)
    else:
        if root.exists():  # interrupted while it was created
            shutil.rmtree(root)
        campaign = Campaign.create(root, execution.cell, execution.plan)
    try:
        campaign.run(
            simulated_link(campaign.cell, effects=execution.effects),
            Stop(),
            Silent(),
            provenance=simulated_provenance(campaign.cell, execution.effects),
            durable=False,
            unrehearsed=True,
        )
    except (ExecutionError, RepetitionsRejectedError) as error:
        raise StudyError(
            f"the controller ended the excitation: {error}; search another one with --seed, in"
            " another folder"
        ) from error


def in_children(
    function: Callable[..., T],
    calls: Sequence[tuple[Path, tuple[Any, ...]]],
    title: str,
    reporter: Reporter,
    cluster: Cluster,
) -> list[T]:
    """Call a function in child processes with the arguments of each place; results in order.

    Raises:
        StudyError: a call failed, crashed or timed out.
    """
    tasks = [ClusterTask(str(place), function, arguments) for place, arguments in calls]
    values: list[T] = []
    with reporter.task(title, len(tasks)) as task:
        results = cluster.results(tasks, task.advance)
    for result in results:
        if isinstance(result, SkippedArchive):
            raise StudyError(f"{result.path}: {result.reason}; start the study again to resume")
        values.append(result)
    return values
