"""From a cell and settings to the problem that a search solves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.motion_checks import current_model
from identification.excitation import (
    CollisionChecker,
    Constraints,
    Objective,
    Problem,
    SearchSettings,
    SineGenome,
    ViaPointGenome,
)
from identification.excitation.constraints import clearance

from .advice import NoExcitationError
from .settings import DesignSettings, SettingsError, SineTable

if TYPE_CHECKING:
    from .knowledge import Knowledge

Array = NDArray[np.float64]


def problem_of(cell: Cell, settings: DesignSettings, known: Knowledge | None = None) -> Problem:
    """Return which motions are searched, what they must keep, and what they are to be good at.

    Args:
        cell: the robot, its limits and surroundings.
        settings: of the design.
        known: an earlier estimate, to which the motion is to add.

    Raises:
        SettingsError: settings that do not fit the cell.
        CellError: the cell file lacks a table that the settings need.
        NoExcitationError: home itself, where the motion is to begin, is not clear.
    """
    constraints = settings.constraints
    checker = CollisionChecker(cell.urdf, cell.workspace) if constraints.collision else None
    if checker is not None and constraints.closed and settings.via_points is not None:
        _require_clear_home(cell, checker)
    return Problem(
        genome=_genome(cell, settings, checker),
        objective=_objective(cell, settings, known),
        constraints=Constraints(
            limits=cell.joint_limits,
            min_duration=constraints.min_duration,
            max_duration=constraints.max_duration,
            checker=checker,
            currents=current_model(cell) if constraints.current else None,
            # A series without a ramp rests nowhere; whoever asks for one wants to look at it.
            at_rest=settings.sines is None or settings.sines.ramp > 0.0,
        ),
    )


def _require_clear_home(cell: Cell, checker: CollisionChecker) -> None:
    contact = clearance(checker, cell.home[None])
    if contact is not None:
        raise NoExcitationError(
            f"no motion can begin at home: {contact}; correct [workspace] or home_deg in "
            f"[campaign] of {cell.path}"
        )


def search_settings(settings: DesignSettings) -> SearchSettings:
    """Return the part of the settings that the search itself reads."""
    search = settings.search
    return SearchSettings(
        method=settings.method,
        population=search.population,
        generations=search.generations,
        crossover=search.crossover,
        mutation=search.mutation,
        weights=search.weights,
        seed=settings.seed,
        polish=search.polish,
        crossover_eta=search.crossover_eta,
        mutation_eta=search.mutation_eta,
    )


def _genome(
    cell: Cell, settings: DesignSettings, checker: CollisionChecker | None
) -> ViaPointGenome | SineGenome:
    via = settings.via_points
    if via is not None:
        return ViaPointGenome(
            cell.joint_limits,
            n_via=via.n_via,
            fly=via.fly,
            slowest=via.slowest,
            range_share=via.range_share,
            home=cell.home if settings.constraints.closed else None,
            checker=checker,
        )
    sines = settings.sines
    assert sines is not None  # the settings hold one of the two
    return SineGenome(
        cell.joint_limits,
        length=sines.length,
        harmonics=sines.harmonics,
        ramp=sines.ramp,
        offset=_offset(cell, sines),
        slowest=_per_joint(cell, "sines.slowest", sines.slowest),
        fastest=None
        if isinstance(sines.fastest, str)
        else _per_joint(cell, "sines.fastest", sines.fastest),
    )


def _offset(cell: Cell, sines: SineTable) -> Array | None:
    if sines.offset == "middle":
        return None
    if sines.offset == "home":
        return cell.home
    angles = np.radians(_listed(cell, "sines.offset", sines.offset))
    limits = cell.file.limits
    return cell.urdf_angles(angles) if limits and limits.frame == "controller" else angles


def _per_joint(cell: Cell, field: str, values: list[float]) -> Array:
    """Return one value for each joint (n,); one alone is for all."""
    return _listed(cell, field, values * len(cell.joint_names) if len(values) == 1 else values)


def _listed(cell: Cell, field: str, values: list[float] | str) -> Array:
    if len(values) != len(cell.joint_names):
        raise SettingsError(
            None,
            f"has {len(values)} entries, the arm {len(cell.joint_names)} joints",
            field=f"{field} = {values}",
            remedy=f"give one for each of {', '.join(cell.joint_names)}",
        )
    return np.array(values, dtype=np.float64)


def _objective(cell: Cell, settings: DesignSettings, known: Knowledge | None) -> Objective:
    parameters = _essential(cell, settings, known)
    if known is None:
        return Objective(cell.model, parameters=parameters)
    return Objective(
        cell.model,
        parameters=parameters,
        joint_weights=known.joint_weights,
        earlier=known.gram,
        earlier_samples=known.samples,
        repetitions=known.repetitions,
    )


def _essential(
    cell: Cell, settings: DesignSettings, known: Knowledge | None
) -> NDArray[np.intp] | None:
    """Return which parameters count, None for all."""
    objective, names = settings.objective, cell.model.parameter_names
    if objective.max_relative_std is not None:
        return _known_well(objective.max_relative_std, known)
    if objective.parameters == "all":
        return None
    chosen = []
    for name in objective.parameters:
        if name not in names or objective.parameters.count(name) > 1:
            wrong = "no parameter of this robot" if name not in names else "named twice"
            raise SettingsError(
                None,
                f"is {wrong}",
                field=f"objective.parameters = {name!r}",
                remedy=f"known are: {', '.join(names)}",
            )
        chosen.append(names.index(name))
    return np.array(sorted(chosen), dtype=np.intp)


def _known_well(percent: float, known: Knowledge | None) -> NDArray[np.intp]:
    field = f"objective.max_relative_std = {percent:g}"
    if known is None:
        raise SettingsError(
            None, "needs an earlier estimate", field=field, remedy="name archives with --earlier"
        )
    chosen = np.flatnonzero(known.relative_std <= percent / 100.0)
    if len(chosen) < 2:
        best = 100.0 * np.sort(known.relative_std)[1]
        raise SettingsError(
            None,
            f"leaves {len(chosen)} parameters, and a design needs two",
            field=field,
            remedy=f"at {best:.3g} % two would be left",
        )
    return np.asarray(chosen, dtype=np.intp)
