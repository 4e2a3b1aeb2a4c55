"""The searches of a study: several of each method, each over the open choices of its method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from hil.base.progress import Reporter, Silent
from hil.batch.cluster import Cluster
from hil.cell import Cell
from hil.design import DesignResult, DesignSettings, preset
from hil.design.design import DesignFolder, run_design
from hil.design.messages import NoExcitationError
from identification.excitation import Excitation, Method

from .child_calls import in_children
from .settings import Effort, StudyFolder, StudySettings

LABELS: Final[Mapping[Method, str]] = {"a": "A", "b": "B", "gradient": "gradient"}
"""The methods of a study: the paper's two, and the default of `hil design`."""
SINES: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "middle": ("about the middle of the ranges, frequencies as printed", {}),
    "home": ("about the home posture, frequencies as printed", {"offset": "home"}),
    "middle-fast": (
        "about the middle of the ranges, frequencies up to the appendix's bound",
        {"fastest": "from limits"},
    ),
    "home-fast": (
        "about the home posture, frequencies up to the appendix's bound",
        {"offset": "home", "fastest": "from limits"},
    ),
}
"""Choices that the paper leaves open for method A."""
_PRINTED_SINES: Final = ("middle", "home")
"""Choices with the frequencies of the paper's Table 1, for six joints."""
_PRINTED_JOINTS: Final = 6
VIA_POINTS: Final = {
    "six": ("6 via points as printed", 6),
    "twelve": ("12 via points", 12),
}
"""Choices of method B: with the printed six points an arm as fast as this one is slow for 16 s."""
_SEEDS_PER_STUDY: Final = 1000  # of each study


@dataclass(frozen=True)
class SearchChoice:
    """One open choice of a method."""

    key: str
    words: str
    settings: DesignSettings


@dataclass(frozen=True)
class SearchPlan:
    """One search of a method: of the best motions of its choices the method's criterion takes one.

    The choices share the search's effort.
    """

    key: str  #: of its folders
    method: Method
    choices: tuple[SearchChoice, ...]


@dataclass(frozen=True, eq=False)
class Search:
    """The result of a search."""

    key: str
    method: Method
    choice: str  #: words
    excitation: Excitation
    tried: int  #: motions, of all choices
    settings: DesignSettings = field(repr=False)


def search_plans(settings: StudySettings, n_joints: int) -> list[SearchPlan]:
    """Return all searches of a study."""
    return [
        SearchPlan(f"{method}-{number:02}", method, _CHOICES[method](settings, number, n_joints))
        for method in LABELS
        for number in range(settings.searches)
    ]


def _sines(settings: StudySettings, number: int, n_joints: int) -> tuple[SearchChoice, ...]:
    duration = settings.duration
    return tuple(
        SearchChoice(
            key,
            f"sines {words}",
            _searched("a", settings, number, settings.effort_a).replaced(
                sines={"length": duration, **changes},
                constraints={"max_duration": duration},
            ),
        )
        for key, (words, changes) in SINES.items()
        if n_joints == _PRINTED_JOINTS or key not in _PRINTED_SINES
    )


def _via_points(settings: StudySettings, number: int, _: int) -> tuple[SearchChoice, ...]:
    base = _searched("b", settings, number, settings.effort_b).replaced(
        constraints=_durations(settings)
    )
    return tuple(
        SearchChoice(key, words, base.replaced(via_points={"n_via": count}))
        for key, (words, count) in VIA_POINTS.items()
    )


def _gradient(settings: StudySettings, number: int, _: int) -> tuple[SearchChoice, ...]:
    base = _searched("gradient", settings, number, settings.effort_gradient)
    chosen = base.replaced(
        search={"gradient": settings.gradient_steps}, constraints=_durations(settings)
    )
    return (SearchChoice("default", "16 via points, improved by the gradient", chosen),)


_CHOICES: Final[Mapping[Method, Callable[[StudySettings, int, int], tuple[SearchChoice, ...]]]] = {
    "a": _sines,
    "b": _via_points,
    "gradient": _gradient,
}


def _searched(
    method: Method, settings: StudySettings, number: int, effort: Effort
) -> DesignSettings:
    return preset(method).replaced(
        seed=_SEEDS_PER_STUDY * settings.seed + number, search=dict(effort.model_dump())
    )


def _durations(settings: StudySettings) -> dict[str, Any]:
    """Return bounds of the duration of motions through via points."""
    duration = settings.duration
    return {"min_duration": settings.shortest * duration, "max_duration": duration}


def run_searches(
    folder: StudyFolder,
    cell: Cell,
    plans: Sequence[SearchPlan],
    reporter: Reporter,
    cluster: Cluster,
) -> list[Search]:
    """Run the searches that are not complete; an interrupted one resumes from its journal.

    Args:
        folder: of the study.
        cell: that is simulated.
        plans: of the searches.
        reporter: of progress.
        cluster: of workers.

    Raises:
        NoExcitationError: a search found no motion with any of its choices.
        StudyError: a search was not completed; a restart resumes.
    """
    every = [(plan, choice) for plan in plans for choice in plan.choices]
    calls = [
        (place := folder.design(plan.key, choice.key), (place, cell, choice.settings))
        for plan, choice in every
    ]
    results = in_children(searched, calls, "searching excitations", reporter, cluster)
    found: dict[str, list[tuple[SearchChoice, DesignResult]]] = {plan.key: [] for plan in plans}
    for (plan, choice), result in zip(every, results, strict=True):
        if result is not None:
            found[plan.key].append((choice, result))
    return [take_best(plan, found[plan.key]) for plan in plans]


def searched(place: Path, cell: Cell, settings: DesignSettings) -> DesignResult | None:
    """Search with one choice, unless that is done; None if it finds no feasible motion."""
    folder = DesignFolder(place)
    result = DesignResult.load(folder.result) if folder.result.exists() else None
    if result is not None and result.complete and result.settings == settings:
        return result
    resume = folder.settings.exists()
    try:
        return run_design(folder, cell, settings, Silent(), workers=1, resume=resume).result
    except NoExcitationError:
        return None


def take_best(plan: SearchPlan, found: Sequence[tuple[SearchChoice, DesignResult]]) -> Search:
    """Return the motion of largest determinant (eq. 9) for A, of largest fitness (eq. 7) for B."""

    def score(one: tuple[SearchChoice, DesignResult]) -> float:
        criteria = one[1].excitation.criteria
        return criteria.log10_det if plan.method == "a" else criteria.fitness

    if not found:
        raise NoExcitationError(
            f"search {plan.key} found no motion that satisfies all constraints of the cell; search"
            " longer (without --quick), or with another --seed"
        )
    choice, result = max(found, key=score)
    tried = sum(other.excitation.tried for _, other in found)
    return Search(plan.key, plan.method, choice.words, result.excitation, tried, result.settings)
