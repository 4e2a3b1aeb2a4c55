"""What a study executes: each excitation, in the campaign it is repeated in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from hil.campaign import CampaignPlan, PlannedMotion
from hil.cell import Cell
from hil.cell.text import replaced_value
from hil.design.advice import NoExcitationError
from hil.motion_checks import MotionChecks
from identification.excitation import Excitation
from planner import PlanFile

from .designs import (
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
from .drawn import FEWEST
from .execution import Execution
from .folder import StudyFolder
from .motions import sine_motions, via_point_motions
from .one_effect import ONE_EFFECT, effect_key, effects_of, with_only
from .settings import StudySettings
from .workers import StudyError

PLAIN, EFFECTS, ABLATION = "plain", "effects", "ablation"
CONDITIONS: Final = (PLAIN, EFFECTS)


# What the keys of an ablation's campaigns have in them.
_KEY_PARTS: Final = {
    "fly": "fly",
    "n_via": "via",
    "weight": "weight",
    "noise": "noise",
    ONE_EFFECT: "only",
}
SINES_ABLATION: Final = "sines"
_ONE_EFFECT_SHARE: Final = 5
"""One effect alone is tried on this part of the held-out motions, on two at least."""


@dataclass(frozen=True, eq=False)
class Plans:
    """All campaigns of a study.

    Attributes:
        sines: key of the search that method A is represented by.
        printed: key of the search for the paper's own sines; None where these are `sines`, or
            there are none.
        excitations: A, B, B with fly 0, and the paper's own sines.
        executions: by condition and key.
        missing: what cannot be run, by ablation, in sentences.
    """

    sines: str
    printed: str | None
    excitations: dict[str, Excitation]
    executions: dict[str, dict[str, Execution]]
    missing: dict[str, list[str]]

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
        missing = {name: list(sentences) for name, sentences in self.missing.items()}
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
                parts = _KEY_PARTS.items()
                name = next((n for n, part in parts if f"-{part}-" in key), SINES_ABLATION)
                missing[name].append(f"{key} could not be run: {ended[one.root]}")
        return replace(self, executions=executions, missing=missing)


def noise_key(method: str, factor: float) -> str:
    """Key of a method's campaign with so many times the noise."""
    return f"{method}-noise-{factor:g}"


def plan_study(
    folder: StudyFolder, cell: Cell, settings: StudySettings, found: dict[str, Found]
) -> Plans:
    """Plan all campaigns of a study.

    Each method's campaign holds its excitation and the held-out motions of its own class, so that
    it is a whole campaign by itself.

    Raises:
        NoExcitationError: a method has no motion, or no held-out motion keeps the constraints.
    """
    checks, sines, printed = MotionChecks.of(cell), best_sines(found), printed_sines(found)
    excitations = {A: _of(found, sines), B: _of(found, B), B0: _of(found, B0)}
    if printed is not None:
        excitations[AP] = _of(found, printed)
    count, seed = settings.motions, settings.seed
    fly = excitations[B].fly
    assert fly  # of the preset, above 0: its held-out motions are fly-by whatever the cell says
    held_out = {
        A: sine_motions(cell, found[sines].search.settings, checks, count=count, seed=seed),
        B: via_point_motions(cell, checks, fly=fly, count=count, seed=seed),
        B0: via_point_motions(cell, checks, fly=0.0, count=count, seed=seed),
    }
    main = cell.with_campaign(
        repetitions=settings.repetitions, validation_runs=count, simulation_seed=seed
    )
    executions = {
        condition: {
            key: Execution(
                folder.campaign(condition, key),
                main,
                _plan(cell, one, held_out.get(key, ())),
                effects=condition == EFFECTS,
            )
            for key, one in excitations.items()
        }
        for condition in (CONDITIONS if settings.effects else (PLAIN,))
    }
    few = cell.with_campaign(
        repetitions=settings.ablation_repetitions, simulation_seed=settings.seed
    )
    varied, missing = _varied(cell, settings, found, checks)
    executions[ABLATION] = (
        {
            key: Execution(folder.campaign(ABLATION, key), few, _plan(cell, one))
            for key, one in varied.items()
        }
        | {
            noise_key(key, factor): Execution(
                folder.campaign(ABLATION, noise_key(key, factor)),
                with_noise(few, factor),
                _plan(cell, excitations[key]),
            )
            for factor in settings.noise
            for key in (A, B)
        }
        | {
            key: Execution(folder.campaign(ABLATION, key), few, _plan(cell, one))
            for key in SINES
            if key in found and (one := found[key].excitation) is not None
        }
    )
    if with_single_effects(settings):
        seen = held_out[B][: max(2, count // _ONE_EFFECT_SHARE)]
        executions[ABLATION] |= _one_effect(folder, few, excitations, seen)
    return Plans(sines, printed, excitations, executions, missing)


def with_single_effects(settings: StudySettings) -> bool:
    """Whether the effects are tried one by one: of fewer repetitions nothing could be told."""
    return settings.effects and settings.ablation_repetitions >= FEWEST


def _one_effect(
    folder: StudyFolder,
    few: Cell,
    excitations: Mapping[str, Excitation],
    held_out: Sequence[PlannedMotion],
) -> dict[str, Execution]:
    """A and B with one effect each; B's campaign holds motions of the arm with that effect."""
    return {
        effect_key(method, effect): Execution(
            folder.campaign(ABLATION, effect_key(method, effect)),
            with_only(few, effect),
            _plan(few, excitations[method], held_out if method == B else ()),
            effects=True,
        )
        for effect in effects_of(few)
        for method in (A, B)
    }


def with_noise(cell: Cell, factor: float) -> Cell:
    """The cell with its current noise multiplied, in its text too."""
    noise = factor * cell.simulation.current_noise
    text = replaced_value(cell.text, "simulation", "current_noise", noise)
    return Cell.from_texts(text, cell.urdf, cell.path)


def _varied(
    cell: Cell, settings: StudySettings, found: dict[str, Found], checks: MotionChecks
) -> tuple[dict[str, Excitation], dict[str, list[str]]]:
    """Excitations of the ablations by key, B itself among them; and what there is none of."""
    base = _of(found, B)
    varied: dict[str, Excitation] = {B: base}
    missing: dict[str, list[str]] = {name: [] for name in (*_KEY_PARTS, SINES_ABLATION)}
    for key in SINES:
        if key in found and found[key].excitation is None:
            missing[SINES_ABLATION].append(f"The search of {found[key].search.words} found none.")
    for fly in settings.fly:
        if fly_key(fly) not in varied:
            try:
                varied[fly_key(fly)] = with_fly(cell, base, fly, checks)
            except NoExcitationError as error:
                missing["fly"].append(f"B's via points cannot be run so: {error}.")
    wanted = [("n_via", via_key(k), f"K = {k}") for k in settings.n_via]
    wanted += [("weight", weight_key(w), f"a weight of {w:g}") for w in settings.coupling_weight]
    for ablation, key, words in wanted:
        one = found[key].excitation
        if one is None:
            missing[ablation].append(f"The search with {words} found no motion.")
        else:
            varied[key] = one
    return varied, missing


def _plan(
    cell: Cell, excitation: Excitation, held_out: Sequence[PlannedMotion] = ()
) -> CampaignPlan:
    moves, points = excitation.moves, excitation.via_points
    kept = None
    if moves is not None and points is not None:
        kept = PlanFile(cell.joint_names, points[0], moves, limits=cell.joint_limits)
    return CampaignPlan(excitation, tuple(held_out), kept)


def _of(found: dict[str, Found], key: str) -> Excitation:
    excitation = found[key].excitation
    if excitation is None:
        raise NoExcitationError(
            f"{found[key].search.words} found no motion that keeps all constraints of the cell; "
            "search longer (without --quick), or with another --seed"
        )
    return excitation
