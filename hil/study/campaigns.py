"""The searches of a study, and its campaigns, run in child processes on the simulated cell."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np

from hil.batch.types import Unused
from hil.batch.workers import ArchiveTask, LocalWorkers
from hil.campaign import Campaign, CampaignFolder, CampaignPlan, PlannedMotion, Stop
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.plan import plan_around
from hil.cell import Cell
from hil.design import DesignResult, DesignSettings, preset, problem_of
from hil.design.advice import NoExcitationError
from hil.design.run import DesignFolder, run_design
from hil.errors import ControllerFault, HilError
from hil.motion_checks import MotionChecks
from hil.progress import Reporter, Silent
from hil.simulation import simulated_link, simulated_provenance
from identification.excitation import RESCORE_PERIOD, Excitation, Objective, sampled
from planner import FourierSeries, PlanFile, PlannerError, plan_in_child

from .settings import Effort, StudyFolder, StudySettings

A, B, B0, AP = "a", "b", "b0", "a-printed"
LABELS: Final = {A: "A", B: "B", B0: "B, fly 0", AP: "A as printed"}
OWN_CLASS: Final = {B: "fly-by", B0: "stop-to-stop", A: "sinusoid"}
"""Class of the excitation and the held-out motions of each method."""
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
PRINTED_SINES: Final = ("a-middle", "a-home")
"""Variants with the frequencies of the paper's Table 1, for six joints."""
_PRINTED_JOINTS: Final = 6


@dataclass(frozen=True, eq=False)
class Search:
    """One search."""

    key: str  #: name of its folder
    words: str  #: description
    settings: DesignSettings
    excitation: Excitation | None = None  #: None before the search, or if nothing was found

    @property
    def notes(self) -> str:
        """Method and size of the search, for Table 1."""
        size = self.settings.search
        return f"{self.words}; {size.population} individuals, {size.generations} generations"


def searches(settings: StudySettings, n_joints: int) -> list[Search]:
    """Return all searches of a study, the main ones first."""

    def sized(method: Literal["a", "b"], effort: Effort) -> DesignSettings:
        sizes = {"population": effort.population, "generations": effort.generations, "polish": 0}
        return preset(method).replaced(seed=settings.seed, search=sizes)

    a, b = sized("a", settings.effort_a), sized("b", settings.effort_b)
    found = [
        Search(key, f"method A, sines {words}", a.replaced(sines=sines))
        for key, (words, sines) in SINES.items()
        if n_joints == _PRINTED_JOINTS or key not in PRINTED_SINES
    ]
    found.append(Search(B, "method B", b))
    found.append(Search(B0, "method B with fly 0", b.replaced(via_points={"fly": 0.0})))
    for n in settings.n_via:
        points = b.replaced(via_points={"n_via": n})
        found.append(Search(variant_key("via", n), f"B with K = {n}", points))
    for own in settings.coupling_weight:
        weighted = b.replaced(search={"weights": [1.0 - own, own]})
        words = f"B with a weight of {own:g} on the coupling index"
        found.append(Search(variant_key("weight", own), words, weighted))
    return [one for k, one in enumerate(found) if one.key not in {o.key for o in found[:k]}]


def variant_key(name: Literal["via", "weight", "fly"], value: float) -> str:
    """Return the key of method B with one setting changed."""
    settings = preset("b")
    via = settings.via_points
    assert via is not None  # method B has via points
    own = {"via": via.n_via, "weight": settings.search.weights[1], "fly": via.fly}
    return B if value == own[name] else f"b-{name}-{value:g}"


def run_searches(
    folder: StudyFolder, cell: Cell, wanted: Sequence[Search], reporter: Reporter, workers: int
) -> dict[str, Search]:
    """Run the searches that are not complete; an interrupted search resumes from its journal."""
    found = {}
    for number, one in enumerate(wanted, 1):
        place = DesignFolder(folder.design(one.key))
        result = DesignResult.load(place.result) if place.result.exists() else None
        if result is None or not result.complete or result.settings != one.settings:
            reporter.say(f"search {number} of {len(wanted)}: {one.words}")
            resume = place.settings.exists()
            try:
                result = run_design(
                    place, cell, one.settings, reporter, workers=workers, resume=resume
                ).result
            except NoExcitationError as error:
                reporter.say(f"no feasible motion: {error}")
                result = None
        found[one.key] = replace(one, excitation=None if result is None else result.excitation)
    return found


def best_sines(found: Mapping[str, Search], keys: Collection[str] = tuple(SINES)) -> str | None:
    """Return the key of the sines with the largest determinant, the criterion of method A."""
    known = {
        key: one.excitation.criteria.log10_det
        for key, one in found.items()
        if key in keys and one.excitation is not None
    }
    return max(known, key=lambda key: known[key], default=None)


def with_fly(cell: Cell, excitation: Excitation, fly: float, checks: MotionChecks) -> Excitation:
    """Plan the via points of an excitation with another fly share, or raise NoExcitationError."""
    points, speed = excitation.via_points, excitation.speed
    assert points is not None and speed is not None
    try:
        trajectory = plan_in_child(points, cell.joint_limits, speed=speed, fly=fly)
    except PlannerError as error:
        raise NoExcitationError(f"fly {fly:g}: {error}") from error
    if (refusal := checks.refusal(trajectory)) is not None:
        raise NoExcitationError(f"fly {fly:g}: {refusal}")
    criteria = Objective(cell.model).criteria(trajectory, RESCORE_PERIOD)
    return replace(excitation, trajectory=trajectory, criteria=criteria, fly=fly)


T = TypeVar("T")

NO_EFFECTS, EFFECTS, ABLATION = "plain", "effects", "ablation"
LONGEST: Final = 6 * 3600.0  #: Time limit of one campaign or one estimation, s

# Seeds that differ from those of searches and of other classes.
_STOPS_SEED, _SINES_SEED, _TRIES = 1_000_003, 5, 400


class StudyError(HilError):
    """A study was not completed; a restart resumes it."""


@dataclass(frozen=True, eq=False)
class Execution:
    """One campaign of the study."""

    root: Path  #: its folder
    cell: Cell
    plan: CampaignPlan
    effects: bool = False  #: whether unmodelled effects are simulated

    @property
    def motions(self) -> int:
        """Number of archives."""
        return 1 + self.cell.campaign.repetitions + len(self.plan.validation)

    @property
    def complete(self) -> bool:
        """Whether all archives exist and are intact."""
        folder, kinds = CampaignFolder(self.root), ("standstill", "excitation", "validation")
        return (self.root / "manifest.json").exists() and (
            sum(len(folder.completed(kind)) for kind in kinds) >= self.motions
        )


@dataclass(frozen=True, eq=False)
class Plans:
    """All campaigns of a study."""

    searched: dict[str, str]
    """Key of each method's search; with `AP` only if the printed sines differ from those of A."""
    executions: dict[str, dict[str, Execution]]  #: By condition and key
    missing: list[str]  #: Notes on campaigns that cannot be run

    @property
    def all(self) -> list[Execution]:
        """All campaigns, the longest first to balance the load of the workers."""
        every = [one for some in self.executions.values() for one in some.values()]
        return sorted(every, key=lambda one: (one.motions, one.effects), reverse=True)

    def without(self, ended: Mapping[Path, str]) -> Plans:
        """Return the plans without ended campaigns, by folder; StudyError for A, B and B0."""
        executions, missing = dict[str, dict[str, Execution]](), list(self.missing)
        for condition, some in self.executions.items():
            executions[condition] = {key: e for key, e in some.items() if e.root not in ended}
            for key, root in ((key, e.root) for key, e in some.items() if e.root in ended):
                if key == B or (condition != ABLATION and key != AP):
                    raise StudyError(
                        f"{root}: the controller ended the excitation: {ended[root]}; search"
                        " another one with --seed, in another folder"
                    )
                missing.append(f"{key} could not be run: {ended[root]}")
        return replace(self, executions=executions, missing=missing)


def noise_key(method: str, factor: float) -> str:
    """Return the key of a method's campaign with `factor` times the noise."""
    return f"{method}-noise-{factor:g}"


def plan_study(
    folder: StudyFolder, cell: Cell, settings: StudySettings, found: Mapping[str, Search]
) -> Plans:
    """Plan all campaigns, each with held-out motions of its class, or raise NoExcitationError."""
    checks, printed = MotionChecks.of(cell), best_sines(found, PRINTED_SINES)
    sines = best_sines(found) or next(key for key in SINES if key in found)
    searched = {A: sines, B: B, B0: B0}
    if printed is not None and sines not in PRINTED_SINES:
        searched[AP] = printed
    excitations: dict[str, Excitation] = {}
    for key, name in searched.items():
        if (one := found[name].excitation) is None:
            raise NoExcitationError(
                f"{found[name].words} found no motion that satisfies all constraints of the cell;"
                " search longer (without --quick), or with another --seed"
            )
        excitations[key] = one
    count, seed, fly = settings.motions, settings.seed, excitations[B].fly
    assert fly  # of the preset, above 0

    def via_motions(key: str, fly: float, seed: int) -> tuple[PlannedMotion, ...]:
        """Return random motions through as many via points as the cell's excitation has."""
        own = {"campaign.fly": fly, "campaign.seed": seed, "campaign.validation_runs": count}
        return plan_around(cell.with_values(own), excitations[key], checks).validation

    held_out = {
        A: _sine_motions(cell, found[sines].settings, checks, count=count, seed=seed),
        B: via_motions(B, fly, seed),
        B0: via_motions(B0, 0.0, seed + _STOPS_SEED),
    }
    main = cell.with_campaign(
        repetitions=settings.repetitions, validation_runs=count, simulation_seed=seed
    )
    few = cell.with_campaign(repetitions=settings.ablation_repetitions, simulation_seed=seed)
    plans = {key: _plan(main, one, held_out.get(key, ())) for key, one in excitations.items()}
    executions = {
        condition: {
            key: Execution(folder.campaign(condition, key), main, plan, condition == EFFECTS)
            for key, plan in plans.items()
        }
        for condition in ((NO_EFFECTS, EFFECTS) if settings.effects else (NO_EFFECTS,))
    }
    varied, missing = _varied(cell, settings, found, excitations[B], checks)
    arms = {key: (few, one) for key, one in varied.items()}
    for factor in settings.noise:
        noise = {"simulation.current_noise": factor * cell.simulation.current_noise}
        for key in (A, B):
            arms[noise_key(key, factor)] = few.with_values(noise), excitations[key]
    executions[ABLATION] = {
        key: Execution(folder.campaign(ABLATION, key), arm, _plan(arm, one))
        for key, (arm, one) in arms.items()
    }
    return Plans(searched, executions, missing)


def _varied(
    cell: Cell,
    settings: StudySettings,
    found: Mapping[str, Search],
    own: Excitation,
    checks: MotionChecks,
) -> tuple[dict[str, Excitation], list[str]]:
    """Return the excitations of the ablations by key, including B, and notes on missing ones."""
    varied, missing = {B: own}, list[str]()
    for fly in settings.fly:
        key = variant_key("fly", fly)
        if key not in varied:
            try:
                varied[key] = with_fly(cell, own, fly, checks)
            except NoExcitationError as error:
                missing.append(f"B's via points are not feasible with this setting: {error}.")
    wanted = [variant_key("via", n) for n in settings.n_via]
    wanted += [variant_key("weight", weight) for weight in settings.coupling_weight]
    for key in wanted + [key for key in SINES if key in found]:
        one = found[key].excitation
        if one is None:
            missing.append(f"The search of {found[key].words} found no motion.")
        else:
            varied[key] = one
    return varied, missing


def _plan(
    cell: Cell, excitation: Excitation, held_out: Sequence[PlannedMotion] = ()
) -> CampaignPlan:
    moves, points = excitation.moves, excitation.via_points
    file = None
    if moves is not None and points is not None:
        file = PlanFile(cell.joint_names, points[0], moves, limits=cell.joint_limits)
    return CampaignPlan(excitation, tuple(held_out), file)


def _sine_motions(
    cell: Cell, settings: DesignSettings, checks: MotionChecks, *, count: int, seed: int
) -> tuple[PlannedMotion, ...]:
    """Random sums of sines of the family of a search; the first do not depend on the number."""
    problem = problem_of(cell, settings)

    def one_motion(k: int) -> PlannedMotion:
        for attempt in range(_TRIES):
            random = np.random.default_rng([_SINES_SEED, seed, k, attempt])
            (motion,) = problem.genome.motions(problem.genome.sample(random, 1))
            if (
                isinstance(motion, FourierSeries)
                and not problem.constraints.violations(motion, sampled(motion))
                and checks.refusal(motion) is None
            ):
                return PlannedMotion(motion)
        raise NoExcitationError(
            f"none of {_TRIES} random sums of sines satisfies all constraints of the cell"
        )

    return tuple(one_motion(k) for k in range(count))


def execute_all(
    executions: Sequence[Execution], reporter: Reporter, workers: LocalWorkers
) -> dict[Path, str]:
    """Run the campaigns side by side; return by folder why the controller ended one.

    StudyError: a campaign was refused, or its process ended.
    """
    calls = [(one.root, (one,)) for one in executions]
    ended = in_children(execute, calls, "running campaigns", reporter, workers)
    return {one.root: why for one, why in zip(executions, ended, strict=True) if why is not None}


def execute(execution: Execution) -> str | None:
    """Run or resume one campaign; return the reason if the controller ended it."""
    root = execution.root
    if execution.complete:
        return None
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
    except (ControllerFault, RepetitionsRejectedError) as error:
        return str(error)
    return None


def in_children(
    function: Callable[..., T],
    calls: Sequence[tuple[Path, tuple[Any, ...]]],
    title: str,
    reporter: Reporter,
    workers: LocalWorkers,
) -> list[T]:
    """Call a function in child processes with the arguments of each place; results in order.

    StudyError: a call failed, crashed or timed out.
    """
    tasks = [ArchiveTask(str(place), function, own) for place, own in calls]
    found: list[T] = []
    with reporter.task(title, len(tasks)) as task:
        for one in workers.results(tasks, task.advance):
            if isinstance(one, Unused):
                raise StudyError(f"{one.path}: {one.reason}; start the study again to resume")
            found.append(one)
    return found
