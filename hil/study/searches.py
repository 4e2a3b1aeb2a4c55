"""The searches of a study: methods A and B, and the variants of B that the ablations ask for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from hil.cell import Cell
from hil.design import DesignResult, DesignSettings, preset
from hil.design.advice import NoExcitationError
from hil.design.folder import DesignFolder
from hil.design.run import run_design
from hil.motion_checks import MotionChecks
from hil.progress import Reporter
from identification.excitation import RESCORE_PERIOD, Excitation, Objective
from planner import PlannerError, plan_in_child

from .settings import Effort, StudyFolder, StudySettings

A, B, B0, AP = "a", "b", "b0", "a-printed"
LABELS: Final = {A: "A", B: "B", B0: "B, fly 0", AP: "A as printed"}
SINES: Final = {
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
"""Method A has a search for each choice that the paper leaves open, and uses the best."""
_PRINTED_JOINTS: Final = 6


@dataclass(frozen=True)
class Search:
    """One search: the key names its folder, `words` say what is searched."""

    key: str
    words: str
    settings: DesignSettings

    @property
    def notes(self) -> str:
        """What is searched and how long, as the notes of the paper's Table 1."""
        search, via, sines = self.settings.search, self.settings.via_points, self.settings.sines
        effort = f"{search.population} individuals, {search.generations} generations"
        if via is not None:
            one, two = search.weights
            fly = f"{100.0 * via.fly:.0f} %"
            return f"K = {via.n_via}, fly {fly}, λ1 = {one:g}, λ2 = {two:g}; {effort}"
        harmonics = "" if sines is None else f"W = {sines.harmonics}, "
        return f"{harmonics}{self.words.removeprefix('method A, ')}; {effort}"


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found; `excitation` is None where no motion satisfied the constraints."""

    search: Search
    excitation: Excitation | None


def searches(settings: StudySettings, n_joints: int) -> list[Search]:
    """All searches of a study, those that everything rests on first.

    The frequencies that the paper prints are those of six joints: another arm has the appendix's
    bound alone.
    """
    a = preset("a").replaced(seed=settings.seed, search=_effort(settings.effort_a))
    b = preset("b").replaced(seed=settings.seed, search=_effort(settings.effort_b))
    found = [
        Search(key, f"method A, sines {words}", a.replaced(sines=sines))
        for key, (words, sines) in SINES.items()
        if n_joints == _PRINTED_JOINTS or "fastest" in sines
    ]
    found += [
        Search(B, "method B", b),
        Search(B0, "method B with fly 0", b.replaced(via_points={"fly": 0.0})),
    ]
    varied = [
        (via_key(n), f"B with K = {n}", b.replaced(via_points={"n_via": n})) for n in settings.n_via
    ] + [
        (
            weight_key(own),
            f"B with a weight of {own:g} on the coupling index",
            b.replaced(search={"weights": [1.0 - own, own]}),
        )
        for own in settings.coupling_weight
    ]
    return found + [Search(*one) for one in varied if one[0] != B]


def via_key(n_via: int) -> str:
    """Key of B with so many via points; that of B itself for its own number."""
    via = preset("b").via_points
    return B if via is not None and n_via == via.n_via else f"b-via-{n_via}"


def weight_key(weight: float) -> str:
    """Key of B with this weight on the coupling index; that of B itself for its own weight."""
    return B if weight == preset("b").search.weights[1] else f"b-weight-{weight:g}"


def fly_key(fly: float) -> str:
    """Key of B's via points run with another fly-by share; that of B itself for its own."""
    via = preset("b").via_points
    return B if via is not None and fly == via.fly else f"b-fly-{fly:g}"


def run_searches(
    folder: StudyFolder,
    cell: Cell,
    wanted: Sequence[Search],
    reporter: Reporter,
    *,
    workers: int,
) -> dict[str, Found]:
    """Search what was not found yet; an interrupted search resumes from its journal.

    Raises:
        HilError: see :func:`hil.design.run.run_design`; that a search finds nothing is no error.
    """
    found = {}
    for number, one in enumerate(wanted, 1):
        place = DesignFolder(folder.design(one.key))
        done = _complete(place, one.settings)
        if done is None:
            reporter.say(f"search {number} of {len(wanted)}: {one.words}")
            resume = place.settings.exists()
            try:
                done = run_design(
                    place, cell, one.settings, reporter, workers=workers, resume=resume
                ).result
            except NoExcitationError as error:
                reporter.say(f"no motion was found: {error}")
        found[one.key] = Found(one, None if done is None else done.excitation)
    return found


def best_sines(found: Mapping[str, Found]) -> str:
    """Key of the sines of largest determinant, which is what method A searches.

    Raises:
        NoExcitationError: no search of method A found anything.
    """
    able = _determinants(found, tuple(SINES))
    if not able:
        raise NoExcitationError(
            "no sum of sines satisfies all constraints of the cell; search longer (without --quick)"
        )
    return max(able, key=lambda key: able[key])


def printed_sines(found: Mapping[str, Found]) -> str | None:
    """Key of the paper's own method A: the frequencies of its Table 1, largest determinant.

    None where method A's best search has these frequencies itself, or none of them was found.
    """
    able = _determinants(found, ("a-middle", "a-home"))
    if not able or best_sines(found) in able:
        return None
    return max(able, key=lambda key: able[key])


def _determinants(found: Mapping[str, Found], keys: Sequence[str]) -> dict[str, float]:
    known = {key: found[key].excitation for key in keys if key in found}
    return {key: one.criteria.log10_det for key, one in known.items() if one is not None}


def with_fly(cell: Cell, excitation: Excitation, fly: float, checks: MotionChecks) -> Excitation:
    """The via points of an excitation run with another fly-by share.

    Raises:
        NoExcitationError: the motion must not be sent, or cannot be planned.
    """
    assert excitation.via_points is not None and excitation.speed is not None
    try:
        trajectory = plan_in_child(
            excitation.via_points, cell.joint_limits, speed=excitation.speed, fly=fly
        )
    except PlannerError as error:
        raise NoExcitationError(f"fly {fly:g}: {error}") from error
    refusal = checks.refusal(trajectory)
    if refusal is not None:
        raise NoExcitationError(f"fly {fly:g}: {refusal}")
    criteria = Objective(cell.model).criteria(trajectory, RESCORE_PERIOD)
    return replace(excitation, trajectory=trajectory, criteria=criteria, fly=fly)


def _complete(place: DesignFolder, settings: DesignSettings) -> DesignResult | None:
    """The design in a folder, where it was completed under these settings."""
    if not place.result.exists():
        return None
    there = DesignResult.load(place.result)
    return there if there.complete and there.settings == settings else None


def _effort(effort: Effort) -> dict[str, int]:
    return {"population": effort.population, "generations": effort.generations, "polish": 0}
