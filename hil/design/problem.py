"""The search problem of a cell and design settings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from hil.cell import AngleFrame, Cell
from hil.motion_checks import always_so, collision_checker, current_model, planned, violation_text
from identification.excitation import (
    CollisionChecker,
    Constraints,
    CurrentModel,
    Objective,
    Problem,
    SearchSettings,
    SineGenome,
    ViaPointGenome,
)
from identification.excitation.constraints import clearance
from identification.model.motion import Motion

from .advice import NoExcitationError
from .settings import DesignSettings, SettingsError

Array = NDArray[np.float64]

# Random states, and smallest pivot of an independent parameter relative to the largest.
_STATES: Final = 300
_SEED: Final = 20140901
_INDEPENDENT: Final = 1e-6


@dataclass(frozen=True, eq=False)
class EarlierEstimate:
    """An earlier estimate and its information."""

    names: tuple[str, ...]  #: of the model's parameters (p,)
    values: Array  #: estimates (p,)
    std: Array  #: standard deviations (p,), infinite if undetermined
    joint_weights: Array  #: 1 / variance of each joint's torque residual (n,)
    #: information (p, p) of all motions with these weights, at one sample per
    #: `identification.excitation.SAMPLE_PERIOD`
    gram: Array
    samples: int  #: time samples in it
    repetitions: int  #: planned runs of the new motion
    archives: tuple[tuple[str, str], ...] = ()  #: name and SHA-256 of each file

    @property
    def relative_std(self) -> Array:
        """Standard deviation relative to the absolute value (p,), infinite for 0."""
        size = np.abs(self.values)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(size > 0.0, self.std / size, np.inf)


def problem_of(
    cell: Cell, settings: DesignSettings, earlier: EarlierEstimate | None = None
) -> Problem:
    """Return genome, objective and constraints of a search.

    Raises:
        SettingsError: settings that do not fit the cell.
        CellError: the cell file lacks a required table.
        NoExcitationError: the initial posture collides, or exceeds the current limits at rest.
    """
    constraints = settings.constraints
    checker = collision_checker(cell) if constraints.collision else None
    currents = planned(current_model(cell)) if constraints.current else None
    genome = _genome(cell, settings, checker)
    _require_start(cell, genome, checker, currents)
    return Problem(
        genome=genome,
        objective=_objective(cell, settings, earlier),
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
        where, posture, setting = (
            "in the mean posture of the sines",
            genome.centre,
            "[sines] offset",
        )
    elif genome.home is not None:
        where, posture, setting = "at home", genome.home, "home_deg in [campaign]"
    else:
        return
    zero, frame = np.zeros_like(posture[None]), AngleFrame.of(cell)
    contact = None if checker is None else clearance(checker, posture[None])
    exceeded = currents.check(Motion(np.zeros(1), posture[None], zero, zero)) if currents else []
    if checker is not None and contact is not None:
        reason = violation_text(contact, frame)
        remedy = always_so(contact, checker) or f"correct [workspace] or {setting}"
    elif exceeded:
        worst = replace(max(exceeded, key=lambda violation: violation.excess), time=None)
        reason = f"at rest there, {violation_text(worst, frame)}"
        remedy = f"correct [drive_train], [nominal] with its uncertainty, or {setting}"
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


def _inside(cell: Cell, asked: list[float], shown: Array) -> Array:
    """Return the URDF angles (n,) of a posture that must be within the limits."""
    frame, limits = AngleFrame.of(cell), cell.joint_limits
    angles = frame.urdf(shown)
    for joint in np.flatnonzero(~((angles > limits.lower) & (angles < limits.upper))).tolist():
        ends = sorted(float(frame.shown(end)[joint]) for end in (limits.lower, limits.upper))
        raise SettingsError(
            None,
            f"{cell.joint_names[joint]} = {shown[joint]:g} deg is outside its limits, {ends[0]:g} "
            f"to {ends[1]:g} deg ({frame.whose})",
            field=f"sines.offset = {asked}",
            remedy="choose a posture within the limits",
        )
    return np.asarray(angles)


def _objective(cell: Cell, settings: DesignSettings, earlier: EarlierEstimate | None) -> Objective:
    if settings.objective.parameters == "payload":
        return _payload_objective(cell, earlier)
    chosen = _essential(cell, settings, earlier)
    if earlier is None:
        return Objective(cell.model, parameters=chosen)
    return Objective(
        cell.model,
        parameters=chosen,
        joint_weights=earlier.joint_weights,
        earlier=earlier.gram,
        earlier_samples=earlier.samples,
        repetitions=earlier.repetitions,
    )


def _payload_objective(cell: Cell, earlier: EarlierEstimate | None) -> Objective:
    """Return the objective of a payload, with its identifiable parameters."""
    if earlier is not None:
        raise SettingsError(
            None,
            "assumes the arm's parameters as known, so that earlier archives have no effect",
            field='objective.parameters = "payload"',
            remedy="leave out --earlier",
        )
    model = cell.model.of_payload()
    states = np.random.default_rng(_SEED).uniform(-2.0, 2.0, (3, _STATES, model.n_joints))
    rows = model.regressor(*states).dense(model.n_parameters).reshape(-1, model.n_parameters)
    length = np.linalg.norm(rows, axis=0)
    _, triangle, order = scipy.linalg.qr(
        rows / np.where(length > 0.0, length, 1.0), mode="economic", pivoting=True
    )
    size = np.abs(np.diag(triangle))
    chosen = np.sort(order[: np.count_nonzero(size > _INDEPENDENT * size[0])])
    return Objective(model, parameters=chosen)


def _essential(
    cell: Cell, settings: DesignSettings, earlier: EarlierEstimate | None
) -> NDArray[np.intp] | None:
    """Return the indices of the parameters in the criteria, None for all."""
    names, named = cell.model.parameter_names, settings.objective.named
    percent = settings.objective.max_relative_std
    if percent is not None:
        field = f"objective.max_relative_std = {percent:g}"
        if earlier is None:
            problem, remedy = "needs an earlier estimate", "name archives with --earlier"
            raise SettingsError(None, problem, field=field, remedy=remedy)
        chosen = np.flatnonzero(earlier.relative_std <= percent / 100.0)
        if len(chosen) < 2:
            problem = f"leaves {len(chosen)} parameters, a design needs two"
            remedy = f"at {100.0 * np.sort(earlier.relative_std)[1]:.3g} % two would be left"
            raise SettingsError(None, problem, field=field, remedy=remedy)
        return np.asarray(chosen, dtype=np.intp)
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
