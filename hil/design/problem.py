"""The search problem of a cell and design settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.cell import AngleFrame, Cell
from hil.control.messages import fixed_words, violation_text
from hil.control.motion_checks import (
    collision_checker,
    current_model,
    fixed_distance,
    planned,
)
from identification.excitation import (
    CollisionChecker,
    Constraints,
    CurrentModel,
    Given,
    Objective,
    Precision,
    Problem,
    SearchSettings,
    SineGenome,
    ViaPointGenome,
)
from identification.excitation.constraints import clearance
from identification.model.motion import Motion

from .messages import NoExcitationError
from .settings import DesignSettings, SettingsError


def problem_of(
    cell: Cell,
    settings: DesignSettings,
    given: Given | None = None,
    precision: Precision | None = None,
) -> Problem:
    """Return genome, objective and constraints of a search.

    Args:
        cell: of the arm.
        settings: of the search.
        given: information of earlier recordings.
        precision: what the requirements of the settings stand for.

    Raises:
        SettingsError: settings that do not fit the cell.
        CellError: the cell file lacks a required table.
        NoExcitationError: the initial posture collides, or exceeds the current limits at rest.
    """
    constraints = settings.constraints
    if settings.objective.given and given is None:
        raise SettingsError(
            None,
            "names recordings, and their information was not read",
            field="objective.given",
            remedy="pass given = hil.precision.given_recordings.given_of(cell, paths)",
        )
    if settings.objective.precision and precision is None:
        raise SettingsError(
            None,
            "names requirements, but the required quantities were not computed",
            field="objective.precision",
            remedy="pass precision = hil.precision.forecast.PrecisionDesign.of(...).precision(30)",
        )
    checker = collision_checker(cell) if constraints.collision else None
    currents = planned(current_model(cell)) if constraints.current else None
    genome = _genome(cell, settings, checker)
    _require_start(cell, genome, checker, currents)
    return Problem(
        genome=genome,
        objective=Objective(
            cell.model,
            parameters=_judged(cell, settings),
            given=given,
            precision=precision,
        ),
        constraints=Constraints(
            limits=cell.joint_limits,
            min_duration=constraints.min_duration,
            max_duration=constraints.max_duration,
            checker=checker,
            currents=currents,
            at_rest=settings.sines is None or settings.sines.ramp > 0.0,
        ),
    )


def _require_start(
    cell: Cell,
    genome: ViaPointGenome | SineGenome,
    checker: CollisionChecker | None,
    currents: CurrentModel | None,
) -> None:
    """Check the initial posture of all motions."""
    if isinstance(genome, SineGenome):
        where = "in the mean posture of the sines"
        posture = genome.centre
        setting = "[sines] offset"
    elif genome.home is not None:
        where = "at home"
        posture = genome.home
        setting = "home_deg in [campaign]"
    else:
        return
    frame = AngleFrame.of(cell)
    contact = None if checker is None else clearance(checker, posture[None])
    exceeded = currents.check(Motion.at_rest(posture[None])) if currents else []
    if checker is not None and contact is not None:
        reason = violation_text(contact, frame)
        fixed = fixed_distance(contact, checker)
        remedy = f"correct [workspace] or {setting}" if fixed is None else fixed_words(fixed)
    elif exceeded:
        worst = replace(max(exceeded, key=lambda violation: violation.excess), time=None)
        reason = f"at rest there, {violation_text(worst, frame)}"
        payload = "" if cell.model.payload is None else "the payload, "
        remedy = f"correct {payload}[drive_train], [nominal] with its uncertainty, or {setting}"
    else:
        return
    raise NoExcitationError(f"no motion can begin {where}: {reason}; {remedy} ({cell.path})")


def search_settings(settings: DesignSettings) -> SearchSettings:
    """Return the settings of the search itself."""
    table = settings.search.model_dump()
    return SearchSettings(method=settings.method, seed=settings.seed, **table)


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
    assert sines is not None  # the settings have one of the two

    def per_joint(name: str, values: list[float]) -> Array:
        """Return one value per joint (n,); a single one is for all joints."""
        joints = cell.joint_names
        if len(values) not in (1, len(joints)):
            raise SettingsError(
                None,
                f"has {len(values)} entries, the arm {len(joints)} joints",
                field=f"sines.{name} = {values}",
                remedy=f"give one for each of {', '.join(joints)}",
            )
        return np.broadcast_to(np.array(values, dtype=np.float64), len(joints)).copy()

    offset = cell.home if sines.offset == "home" else None
    if not isinstance(sines.offset, str):
        offset = _inside(cell, sines.offset, per_joint("offset", sines.offset))
    fastest = sines.fastest
    return SineGenome(
        cell.joint_limits,
        length=sines.length,
        harmonics=sines.harmonics,
        ramp=sines.ramp,
        offset=offset,
        slowest=per_joint("slowest", sines.slowest),
        fastest=None if isinstance(fastest, str) else per_joint("fastest", fastest),
    )


def _inside(cell: Cell, requested: list[float], shown: Array) -> Array:
    """Return the URDF angles (n,) of a posture that must be within the limits."""
    frame = AngleFrame.of(cell)
    limits = cell.joint_limits
    angles = frame.urdf(shown)
    for joint in np.flatnonzero(~((angles > limits.lower) & (angles < limits.upper))).tolist():
        ends = sorted(float(frame.shown(end)[joint]) for end in (limits.lower, limits.upper))
        raise SettingsError(
            None,
            f"{cell.joint_names[joint]} = {shown[joint]:g} deg is outside its limits, {ends[0]:g} "
            f"to {ends[1]:g} deg ({frame.whose})",
            field=f"sines.offset = {requested}",
            remedy="choose a posture within the limits",
        )
    return np.asarray(angles)


def _judged(cell: Cell, settings: DesignSettings) -> NDArray[np.intp] | None:
    """Return the indices of the parameters in the criteria, None for all."""
    names = cell.model.parameter_names
    named = settings.objective.named
    if named is None:
        return None
    for name in named:
        if name not in names or named.count(name) > 1:
            raise SettingsError(
                None,
                f"is {'named twice' if name in names else 'not a parameter of this robot'}",
                field=f"objective.parameters = {name!r}",
                remedy=f"known are: {', '.join(names)}",
            )
    return np.array(sorted(names.index(name) for name in named), dtype=np.intp)
