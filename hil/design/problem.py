"""From a cell and settings to the problem that a search solves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

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
from .settings import DesignSettings, SettingsError, SineTable

Array = NDArray[np.float64]

# States that excite every parameter of a load that an arm feels, and the share of the largest from
# which on one is independent of the others.
_STATES: Final = 300
_SEED: Final = 20140901
_INDEPENDENT: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Knowledge:
    """An earlier estimate, and the information that it came from.

    Attributes:
        names: of the model's parameters (p,).
        values: their estimates (p,).
        std: their standard deviations (p,), infinite for one that was not determined.
        joint_weights: 1 / variance of each joint's torque residual (n,).
        gram: information (p, p) of all that was moved, held out or not, weighted by these, as if
            sampled every `identification.excitation.SAMPLE_PERIOD`, as motions of a search are.
        samples: time samples in it, of equal weight.
        repetitions: how often the new motion is going to be run.
        archives: name and SHA-256 of each file whose motion is in it.
    """

    names: tuple[str, ...]
    values: Array
    std: Array
    joint_weights: Array
    gram: Array
    samples: int
    repetitions: int
    archives: tuple[tuple[str, str], ...] = ()

    @property
    def relative_std(self) -> Array:
        """Standard deviation as a share of the value's size (p,), infinite for a value of 0."""
        size = np.abs(self.values)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(size > 0.0, self.std / size, np.inf)


def problem_of(cell: Cell, settings: DesignSettings, known: Knowledge | None = None) -> Problem:
    """Return which motions are searched, what they must keep, and what they are to be good at.

    Args:
        cell: the robot, its limits and surroundings.
        settings: of the design.
        known: an earlier estimate, to which the motion is to add.

    Raises:
        SettingsError: settings that do not fit the cell.
        CellError: the cell file lacks a table that the settings need.
        NoExcitationError: where the motion is to begin, home or the middle of sines, is not clear,
            or the motors cannot hold the arm there.
    """
    constraints = settings.constraints
    checker = collision_checker(cell) if constraints.collision else None
    currents = planned(current_model(cell)) if constraints.current else None
    genome = _genome(cell, settings, checker)
    _require_beginning(cell, genome, checker, currents)
    return Problem(
        genome=genome,
        objective=_objective(cell, settings, known),
        constraints=Constraints(
            limits=cell.joint_limits,
            min_duration=constraints.min_duration,
            max_duration=constraints.max_duration,
            checker=checker,
            currents=currents,
            # A series without a ramp rests nowhere; whoever asks for one wants to look at it.
            at_rest=settings.sines is None or settings.sines.ramp > 0.0,
        ),
    )


def _require_beginning(
    cell: Cell,
    genome: ViaPointGenome | SineGenome,
    checker: CollisionChecker | None,
    currents: CurrentModel | None,
) -> None:
    """Refuse, before any motion is tried, a posture in which every one of them begins."""
    if isinstance(genome, SineGenome):
        where, posture, elsewhere = "where the sines swing about", genome.centre, "[sines] offset"
    elif genome.home is not None:
        where, posture, elsewhere = "at home", genome.home, "home_deg in [campaign]"
    else:
        return
    still, reason = np.zeros_like(posture[None]), ""
    contact = None if checker is None else clearance(checker, posture[None])
    too_much = currents.check(Motion(np.zeros(1), posture[None], still, still)) if currents else []
    if checker is not None and contact is not None:
        reason = violation_text(contact, AngleFrame.of(cell))
        remedy = always_so(contact, checker) or f"correct [workspace] or {elsewhere}"
    elif too_much:
        worst = replace(max(too_much, key=lambda violation: violation.excess), time=None)
        reason = f"at rest there, {violation_text(worst, AngleFrame.of(cell))}"
        remedy = f"correct [drive_train], [nominal] with its uncertainty, or {elsewhere}"
    if reason:
        raise NoExcitationError(f"no motion can begin {where}: {reason}; {remedy} ({cell.path})")


def search_settings(settings: DesignSettings) -> SearchSettings:
    """Return the part of the settings that the search itself reads."""
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
    frame, limits = AngleFrame.of(cell), cell.joint_limits
    shown = _angles_of(cell, "sines.offset", sines.offset)
    angles = frame.urdf(shown)
    for joint in np.flatnonzero(~((angles > limits.lower) & (angles < limits.upper))).tolist():
        ends = sorted(float(frame.shown(end)[joint]) for end in (limits.lower, limits.upper))
        raise SettingsError(
            None,
            f"{cell.joint_names[joint]} is not inside its limits, {ends[0]:g} to {ends[1]:g} deg, "
            f"at {shown[joint]:g} deg ({frame.whose})",
            field=f"sines.offset = {sines.offset}",
            remedy="swing about a posture inside the limits",
        )
    return angles


def _per_joint(cell: Cell, field: str, values: list[float]) -> Array:
    """Return one value for each joint (n,); one alone is for all."""
    return _angles_of(cell, field, values * len(cell.joint_names) if len(values) == 1 else values)


def _angles_of(cell: Cell, field: str, values: list[float] | str) -> Array:
    if len(values) != len(cell.joint_names):
        raise SettingsError(
            None,
            f"has {len(values)} entries, the arm {len(cell.joint_names)} joints",
            field=f"{field} = {values}",
            remedy=f"give one for each of {', '.join(cell.joint_names)}",
        )
    return np.array(values, dtype=np.float64)


def _objective(cell: Cell, settings: DesignSettings, known: Knowledge | None) -> Objective:
    if settings.objective.parameters == "payload":
        return _payload_objective(cell, known)
    earlier: dict[str, Any] = {}
    if known is not None:
        earlier = {
            "joint_weights": known.joint_weights,
            "earlier": known.gram,
            "earlier_samples": known.samples,
            "repetitions": known.repetitions,
        }
    return Objective(cell.model, parameters=_essential(cell, settings, known), **earlier)


def _payload_objective(cell: Cell, known: Knowledge | None) -> Objective:
    """Of a body on the last link, by those of its parameters that some motion distinguishes."""
    if known is not None:
        raise SettingsError(
            None,
            "assumes the arm's parameters as known: earlier archives add nothing",
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
    cell: Cell, settings: DesignSettings, known: Knowledge | None
) -> NDArray[np.intp] | None:
    """Return which parameters count, None for all."""
    names, named = cell.model.parameter_names, settings.objective.named
    percent = settings.objective.max_relative_std
    if percent is None and named is None:
        return None
    if percent is not None:
        field = f"objective.max_relative_std = {percent:g}"
        if known is None:
            problem, remedy = "needs an earlier estimate", "name archives with --earlier"
            raise SettingsError(None, problem, field=field, remedy=remedy)
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
    for name in named or ():
        if name not in names or (named or []).count(name) > 1:
            raise SettingsError(
                None,
                f"is {'named twice' if name in names else 'no parameter of this robot'}",
                field=f"objective.parameters = {name!r}",
                remedy=f"known are: {', '.join(names)}",
            )
    return np.array(sorted(names.index(name) for name in named or ()), dtype=np.intp)
