"""The campaigns of a study: planned, and run in child processes against the simulated cell."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from hil.campaign import Campaign, CampaignFolder, CampaignPlan, PlannedMotion, Stop
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.quick_design import plan_around
from hil.cell import Cell
from hil.design import DesignSettings, problem_of
from hil.design.advice import NoExcitationError
from hil.errors import ControllerFault, HilError
from hil.motion_checks import MotionChecks
from hil.progress import Reporter, Silent
from hil.simulation import simulated_link, simulated_provenance
from identification import IdentificationError
from identification.excitation import (
    Excitation,
    sampled,
)
from planner import FourierSeries, PlanFile, PlannerError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess, map_in_children

from .searches import (
    AP,
    B0,
    SINES,
    A,
    B,
    Found,
    best_sines,
    fly_key,
    printed_sines,
    via_key,
    weight_key,
    with_fly,
)
from .settings import StudyFolder, StudySettings

T = TypeVar("T")

NO_EFFECTS, EFFECTS, ABLATION = "plain", "effects", "ablation"
LONGEST: Final = 6 * 3600.0
"""s that one campaign, or one reading of archives, may last."""

# Streams of random numbers that no search and no other class draws from.
_STOPS_SEED, _SINES_SEED, _TRIES = 1_000_003, 5, 400


class StudyError(HilError):
    """A part of a study was not completed; starting it again resumes there."""


@dataclass(frozen=True, eq=False)
class Execution:
    """One campaign to be run: its folder, the cell with the number of repetitions, and its plan.

    With `effects`, the unmodelled effects are switched on.
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
    def complete(self) -> bool:
        """Whether every one of them exists as it was written."""
        folder, kinds = CampaignFolder(self.root), ("standstill", "excitation", "validation")
        return (self.root / "manifest.json").exists() and (
            sum(len(folder.completed(kind)) for kind in kinds) >= self.motions
        )


@dataclass(frozen=True, eq=False)
class Plans:
    """All campaigns of a study.

    Attributes:
        sines: key of the search that method A is represented by.
        printed: key of the search for the paper's own sines; None where these are `sines`, or
            there are none.
        excitations: A, B, B with fly 0, and the paper's own sines.
        executions: by condition and key.
        missing: what cannot be run, in sentences.
    """

    sines: str
    printed: str | None
    excitations: dict[str, Excitation]
    executions: dict[str, dict[str, Execution]]
    missing: list[str]

    @property
    def all(self) -> list[Execution]:
        """Every campaign, the longest first: several processes then end at about the same time."""
        every = [one for some in self.executions.values() for one in some.values()]
        return sorted(every, key=lambda one: (one.motions, one.effects), reverse=True)

    def without(self, ended: Mapping[Path, str]) -> Plans:
        """These plans less the campaigns that the controller ended, by folder.

        Raises:
            StudyError: A, B or B with fly 0 itself was ended.
        """
        missing = list(self.missing)
        executions = {condition: dict(some) for condition, some in self.executions.items()}
        for condition, some in self.executions.items():
            for key, one in some.items():
                if one.root not in ended:
                    continue
                if (condition != ABLATION and key != AP) or key == B:
                    raise StudyError(
                        f"{one.root}: this arm cannot bear the excitation that was found for it:"
                        f" {ended[one.root]}; another search (--seed, in another folder) finds"
                        " another one"
                    )
                del executions[condition][key]
                missing.append(f"{key} could not be run: {ended[one.root]}")
        return replace(self, executions=executions, missing=missing)


def noise_key(method: str, factor: float) -> str:
    """Key of a method's campaign with so many times the noise."""
    return f"{method}-noise-{factor:g}"


def plan_study(
    folder: StudyFolder, cell: Cell, settings: StudySettings, found: Mapping[str, Found]
) -> Plans:
    """Plan all campaigns of a study.

    Each method's campaign holds its excitation and the held-out motions of its own class, so that
    it is a whole campaign by itself.

    Raises:
        NoExcitationError: a method has no motion, or no held-out motion satisfies the constraints.
    """
    checks, sines, printed = MotionChecks.of(cell), best_sines(found), printed_sines(found)
    excitations = {A: _of(found, sines), B: _of(found, B), B0: _of(found, B0)}
    if printed is not None:
        excitations[AP] = _of(found, printed)
    count, seed, fly = settings.motions, settings.seed, excitations[B].fly
    assert fly  # of the preset, above 0: its held-out motions are fly-by whatever the cell says
    held_out = {
        A: sine_motions(cell, found[sines].search.settings, checks, count=count, seed=seed),
        B: via_point_motions(cell, excitations[B], checks, fly=fly, count=count, seed=seed),
        B0: via_point_motions(
            cell, excitations[B0], checks, fly=0.0, count=count, seed=seed + _STOPS_SEED
        ),
    }
    main = cell.with_campaign(
        repetitions=settings.repetitions, validation_runs=count, simulation_seed=seed
    )
    few = cell.with_campaign(repetitions=settings.ablation_repetitions, simulation_seed=seed)
    executions: dict[str, dict[str, Execution]] = {}

    def add(
        condition: str, key: str, arm: Cell, excitation: Excitation,
        motions: Sequence[PlannedMotion] = (), *, effects: bool = False,
    ) -> None:  # fmt: skip
        plan = _plan(arm, excitation, motions)
        one = Execution(folder.campaign(condition, key), arm, plan, effects)
        executions.setdefault(condition, {})[key] = one

    for condition in (NO_EFFECTS, EFFECTS) if settings.effects else (NO_EFFECTS,):
        for key, one in excitations.items():
            on = condition == EFFECTS
            add(condition, key, main, one, held_out.get(key, ()), effects=on)
    varied, missing = _varied(cell, settings, found, checks)
    for key, one in varied.items():
        add(ABLATION, key, few, one)
    for factor in settings.noise:
        noisy = few.with_values(
            {"simulation.current_noise": factor * cell.simulation.current_noise}
        )
        for key in (A, B):
            add(ABLATION, noise_key(key, factor), noisy, excitations[key])
    return Plans(sines, printed, excitations, executions, missing)


def _varied(
    cell: Cell, settings: StudySettings, found: Mapping[str, Found], checks: MotionChecks
) -> tuple[dict[str, Excitation], list[str]]:
    """Excitations of the ablations by key, B itself among them; and what there is none of."""
    varied = {B: _of(found, B)}
    missing: list[str] = []
    for fly in settings.fly:
        if fly_key(fly) not in varied:
            try:
                varied[fly_key(fly)] = with_fly(cell, varied[B], fly, checks)
            except NoExcitationError as error:
                missing.append(f"B's via points cannot be run so: {error}.")
    wanted = [via_key(k) for k in settings.n_via]
    wanted += [weight_key(w) for w in settings.coupling_weight]
    for key in wanted + [key for key in SINES if key in found]:
        one = found[key].excitation
        if one is None:
            missing.append(f"The search of {found[key].search.words} found no motion.")
        else:
            varied[key] = one
    return varied, missing


def _plan(cell: Cell, excitation: Excitation, held_out: Sequence[PlannedMotion]) -> CampaignPlan:
    moves, points = excitation.moves, excitation.via_points
    file = None
    if moves is not None and points is not None:
        file = PlanFile(cell.joint_names, points[0], moves, limits=cell.joint_limits)
    return CampaignPlan(excitation, tuple(held_out), file)


def _of(found: Mapping[str, Found], key: str) -> Excitation:
    excitation = found[key].excitation
    if excitation is None:
        raise NoExcitationError(
            f"{found[key].search.words} found no motion that satisfies all constraints of the"
            " cell; search longer (without --quick), or with another --seed"
        )
    return excitation


def via_point_motions(
    cell: Cell, excitation: Excitation, checks: MotionChecks, *, fly: float, count: int, seed: int
) -> tuple[PlannedMotion, ...]:
    """Wide random motions through as many via points as the cell's excitation has.

    Raises:
        NoExcitationError: none satisfies the constraints.
    """
    own = cell.with_values(
        {"campaign.fly": fly, "campaign.seed": seed, "campaign.validation_runs": count}
    )
    return plan_around(own, excitation, checks).validation


def sine_motions(
    cell: Cell, settings: DesignSettings, checks: MotionChecks, *, count: int, seed: int
) -> tuple[PlannedMotion, ...]:
    """Random sums of sines of the family of a search; the first do not depend on the number.

    Raises:
        NoExcitationError: none satisfies the constraints.
    """
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
    executions: Sequence[Execution], reporter: Reporter, workers: Workers
) -> dict[Path, str]:
    """Run what is missing of several campaigns, side by side.

    Returns:
        By folder, why the controller ended a campaign; what is not in it was completed.

    Raises:
        StudyError: a campaign was refused, or its process ended before it.
    """
    missing = [one for one in executions if not one.complete]
    with reporter.task("running campaigns", len(executions)) as task:
        task.advance(len(executions) - len(missing))
        ended = workers.map(
            execute, [(one,) for one in missing], done=lambda count: task.advance(count)
        )
    return {one.root: why for one, why in zip(missing, ended, strict=True) if why is not None}


def execute(execution: Execution) -> str | None:
    """Run one campaign, in whatever process this is; complete archives in its folder are reused.

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


@dataclass(frozen=True, eq=False)
class Workers:
    """Child processes; without any, all is done in this process."""

    children: tuple[WorkerProcess, ...]

    def map(
        self,
        function: Callable[..., T],
        arguments: Sequence[tuple[Any, ...]],
        done: Callable[[int], None] = lambda _: None,
    ) -> list[T]:
        """Call a function of a module with each of the arguments; results in order.

        The longest calls come first; `done` gets the number of calls that have ended.

        Raises:
            StudyError: a call was refused, ended its process, or lasted too long.
        """
        if not self.children:
            found = []
            for some in arguments:
                found += _called(function, [some])
                done(1)
            return found
        results = map_in_children(
            self.children,
            _called,
            [[k] for k in range(len(arguments))],
            lambda chunk: (function, [arguments[k] for k in chunk]),
            done=done,
        )
        for result in results:
            if isinstance(result, PlannerCrashed | PlanningTimedOut):
                raise StudyError(f"a part of the study failed ({result}); start it again to resume")
        return [one for one in results if not isinstance(one, PlannerCrashed | PlanningTimedOut)]


@contextmanager
def workers_of(count: int) -> Iterator[Workers]:
    """So many processes, ended when this is left; one is this process itself."""
    children = [WorkerProcess(timeout=LONGEST) for _ in range(count if count > 1 else 0)]
    try:
        yield Workers(tuple(children))
    finally:
        for child in children:
            child.close()


def _called(function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
    """Results of the calls; a refusal as an error that can be sent from process to process."""
    try:
        return [function(*some) for some in arguments]
    except StudyError:
        raise
    except (HilError, IdentificationError, PlannerError) as error:
        raise StudyError(str(error)) from error
