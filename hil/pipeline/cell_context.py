"""Facts about cell and recordings that an estimate and its verdict need besides the model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from hil.archive import open_archive
from hil.base.arrays import Array
from hil.cell import Cell
from hil.cell.nominal import nominal_of
from identification.estimators.torque_channel import torque_noiseless_above
from identification.factor.estimate import Estimate
from identification.model.friction import COULOMB, TERMS
from identification.model.joint_ranges import urdf_limits
from identification.selection.questions import FRICTION_AT_SPEED, LOAD, LOW_PASS, REVERSAL
from identification.signals.angle_wraps import UNWRAPPED
from identification.signals.masks import RowReason
from identification.signals.play import ToAndFro, steps_to_and_fro
from identification.signals.position_steps import PositionJump, position_steps
from identification.signals.recording import MIN_MOVEMENT
from identification.signals.samples import Samples
from identification.validation.controller_inertia import InertiaRatio, inertia_ratio
from identification.validation.evidence import CellContext
from identification.validation.finding import (
    Finding,
    FindingKey,
    RemedyKey,
    RepeatedSamples,
    Thresholds,
    Value,
)
from identification.validation.nominal_scale import nominal_scale
from identification.validation.prediction import PredictionError, pooled_error
from identification.validation.residuals import folded_noise

from .prepared import Prepared
from .recorded_rows import commanded_positions, faulty_rows, retimed, row_counters
from .sources import Source, Sources, has_commands_as_positions
from .torque_scale import TorqueScale, torque_scale

_MAX_POSTURES = 500
_TIME_TOLERANCE = 1e-6  # s


def controller_error(
    cell: Cell, sources: Sequence[Source], samples: Sequence[Samples]
) -> PredictionError | None:
    """Return the torque error of the controller's model; None if an archive lacks its current."""
    if cell.file.drive_train is None:
        return None
    errors = []
    for source, prepared in zip(sources, samples, strict=True):
        current = _column_at(source, "model_current", prepared.motion.time)
        if current is None:
            return None
        torque = cell.drive_train.joint_torque(current)
        errors.append(PredictionError.between(prepared.torque, torque, prepared.usable))
    return pooled_error(errors) if errors else None


def controller_inertia(
    cell: Cell, estimate: Estimate, sources: Sequence[Source]
) -> InertiaRatio | None:
    """Return the controller's diagonal inertia over the identified one; None if not sent."""
    if cell.file.drive_train is None or estimate.undetermined:
        return None
    received = []
    for source in sources:
        recording = source.recording
        few = slice(None, None, max(1, recording.n_samples // _MAX_POSTURES))
        inertia = _column_at(source, "diagonal_inertia", recording.time[few])
        if inertia is not None:
            received.append((recording.position[few], inertia))
    if not received:
        return None
    positions, inertia = map(np.concatenate, zip(*received, strict=True))
    return inertia_ratio(cell.model, estimate.values, positions, inertia)


def _column_at(source: Source, field: str, time: Array) -> Array | None:
    """Return a channel (m, n) of a complete archive at some times; None if absent or zero."""
    if source.context is not None:
        return None  # a part
    archive = open_archive(source.path, fields=("cycle", field))
    column = archive.columns.get(field)
    cycle = archive.columns.get("cycle")
    if column is None or cycle is None or archive.period is None:
        return None
    if not np.isfinite(column).all() or not np.any(column):
        return None
    at = (cycle - cycle[0]) * archive.period
    rows = np.clip(np.searchsorted(at, time - _TIME_TOLERANCE), 0, len(at) - 1)
    if np.abs(at[rows] - time).max() > _TIME_TOLERANCE:
        return None
    return np.asarray(column[rows])


# Position changes below this share of a joint's range are floating-point rounding.
_ROUNDING_SHARE: Final = 1e-9
_STEP_QUANTILE: Final = 0.01  # of the changes between samples: one step of a coarse encoder
_MAX_GRID_DEVIATION: Final = 0.05  # distance from a multiple of the step, in steps
_MAX_ROUNDING_SHARE: Final = 0.02  # of accelerations, as a share
_EXACT_ERROR: Final = 1e-4  # relative error below the resolution of any sensor
_NOISE_RECORDINGS: Final = 3  # recordings that show the noise of the torque
_MAX_NOISE_SHARE: Final = 0.5  # of the squared residual
_PLAY_TOLERANCE: Final = 0.5  # relative, of a step by a play
# a low-pass above this multiple of the motion's bandwidth has no effect
_MAX_BANDWIDTH_RATIO: Final = 2.0


def cell_context_of(prepared: Prepared, estimate: Estimate) -> CellContext:
    """Collect the facts about the cell and the recordings that a verdict needs."""
    cell = prepared.sources.cell
    sources = prepared.sources
    recorded = sources.training if sources.in_sample else (*sources.training, *sources.held_out)
    driven = cell.file.drive_train is not None
    saturated = prepared.masked.get(RowReason.SATURATED)
    nominal = nominal_of(cell)
    steps = [position_steps(source.recording, source.name) for source in recorded]
    play = _play(prepared, estimate)
    return CellContext(
        torque_limit=torque_limits(cell),
        saturated=None if saturated is None else saturated / max(prepared.rows, 1),
        motor_from_joint=cell.drive_train.motor_from_joint if driven else None,
        controller=controller_error(cell, sources.held_out, prepared.held_out),
        nominal_scale=None
        if nominal is None
        else nominal_scale(
            cell.model,
            nominal.values,
            prepared.training,
            rotors_known=nominal.rotors_known,
            share=nominal.share,
        ),
        jumps=tuple(
            jump
            for source_steps in steps
            for jump in source_steps.jumps
            if not _is_of_play(jump, play, cell.joint_names)
        ),
        play=play,
        controller_inertia=controller_inertia(
            cell, estimate, (*sources.training, *sources.held_out)
        ),
        delays=prepared.delays,
        assumed_delay=prepared.assumed_delay,
        corrections=(
            *faulty_rows(recorded),
            *_spikes(prepared),
            *_unmeasured(prepared),
            *_commanded(recorded, prepared),
            *row_counters(recorded),
            *retimed(prepared.sources.training),
            *_log([jump for source_steps in steps for jump in source_steps.logged]),
            *_wrapped(recorded),
            *_torque_channel(prepared),
            *_friction_law(prepared),
            *_resolution(prepared),
            *_sampling_rate(prepared, estimate),
        ),
        commanded_positions=any(has_commands_as_positions(each.recording) for each in recorded),
        added_friction=_added_friction(prepared),
        scale_std=torque_scale_of(sources).std,
    )


def _play(prepared: Prepared, estimate: Estimate) -> tuple[ToAndFro, ...]:
    """Return the joints whose positions step to and fro where the load of their gear reverses."""
    sources, runs = prepared.sources.training, prepared.training
    if not prepared.sources.in_sample:
        sources, runs = (*sources, *prepared.sources.held_out), (*runs, *prepared.held_out)
    found = tuple(steps_to_and_fro([source.recording for source in sources]))
    if not found:
        return ()
    model = prepared.sources.cell.model
    loads = [model.gear_torque(estimate.values, run.motion) for run in runs]
    times = [run.motion.time for run in runs]
    return tuple(
        each for each in found if each.follows(times, [load[:, each.joint] for load in loads])
    )


def _is_of_play(jump: PositionJump, play: Sequence[ToAndFro], joint_names: Sequence[str]) -> bool:
    """Return whether a step of a position is one of those by a play."""
    return any(
        joint_names[each.joint] == jump.joint
        and abs(abs(jump.size) - each.size) < _PLAY_TOLERANCE * each.size
        for each in play
    )


def joint_ranges(sources: Sources) -> tuple[Array, Array]:
    """Return the lower and upper ends (n,) of the workspace [rad or m].

    The limits of the cell, else of the URDF; without these a whole turn, or of a prismatic
    joint what was recorded.
    """
    cell = sources.cell
    if cell.file.limits is not None:
        limits = cell.joint_limits
        return limits.lower, limits.upper
    stated = urdf_limits(cell.urdf, cell.joint_names)
    recorded = np.concatenate(
        [source.recording.position for source in (*sources.training, *sources.held_out)]
    )
    turns = cell.model.chain.revolute
    ends = (
        np.where(turns, -np.pi, recorded.min(axis=0)),
        np.where(turns, np.pi, recorded.max(axis=0)),
    )
    bounded = np.isfinite(stated.lower) & np.isfinite(stated.upper)
    return np.where(bounded, stated.lower, ends[0]), np.where(bounded, stated.upper, ends[1])


def _doubtful(key: FindingKey, remedy: RemedyKey, **values: Value) -> Finding:
    return Finding(key, "doubtful", remedy, values=values)


def _spikes(prepared: Prepared) -> Iterator[Finding]:
    """Yield a finding about samples of torque that stand out alone."""
    counts = prepared.masked.get(RowReason.SPIKE)
    if counts is None or not counts.any():
        return
    found = _doubtful("spikes", "check for damaged packets", rows=prepared.rows)
    yield found.about(counts > 0, count=counts)


def _unmeasured(prepared: Prepared) -> Iterator[Finding]:
    """Yield a finding about joints that move, and whose torque is zero or constant throughout."""
    counts = prepared.masked.get(RowReason.UNMEASURED)
    if counts is None or not counts.any():
        return
    recorded = (*prepared.sources.training, *prepared.sources.held_out)
    moved = np.max([np.ptp(each.recording.position, axis=0) for each in recorded], axis=0)
    silent = (counts > 0) & (moved > MIN_MOVEMENT)
    if silent.any():
        yield Finding("no torque", "wrong", "resolve the torque", "cause").about(silent)


def _commanded(sources: Sequence[Source], prepared: Prepared) -> Iterator[Finding]:
    """Yield a finding about positions that are commands."""
    delays = prepared.delays
    significant = delays is not None and delays.significant
    yield from commanded_positions(sources, delays.delay if delays and significant else None)


def _log(steps: Sequence[PositionJump]) -> Iterator[Finding]:
    """Yield a finding about samples that the log repeats or has late."""
    if steps:
        counts = Counter((step.recording, step.joint) for step in steps)
        samples = tuple(
            RepeatedSamples(joint, count, name) for (name, joint), count in counts.items()
        )
        first = min(steps, key=lambda step: step.time)
        yield _doubtful("repeated samples", "log each sample once", samples=samples, first=first)


def _wrapped(sources: Sequence[Source]) -> Iterator[Finding]:
    """Yield a finding about angles that were unwrapped."""
    joints = {source.name: source.recording.provenance.get(UNWRAPPED) for source in sources}
    angles = tuple(f"{names} of {name}" for name, names in joints.items() if names)
    if angles:
        yield Finding("unwrapped angles", "information", values={"angles": angles})


def _added_friction(prepared: Prepared) -> tuple[str, ...]:
    """Return the symbols of friction terms chosen by inner prediction without being stated."""
    chosen = prepared.settings.friction
    if not any(choice.name == FRICTION_AT_SPEED for choice in prepared.settings.choices):
        return ()
    stated = prepared.sources.cell.stated.robot.friction
    added = [
        term.symbol
        for term in TERMS
        if (option := term.option) in chosen
        and chosen[option] not in (None, "none", 0.0, False)
        and getattr(stated, option) in (None, "none", 0.0, False)
    ]
    return tuple(dict.fromkeys(added))


def _friction_law(prepared: Prepared) -> Iterator[Finding]:
    """Yield a finding if inner prediction chose another friction law than the archives state."""
    names = (FRICTION_AT_SPEED, LOAD, REVERSAL)
    if not any(choice.chosen for choice in prepared.settings.choices if choice.name in names):
        return
    cell = prepared.sources.cell
    law = cell.model.friction.laws[0]
    table = cell.stated.robot.friction
    stated = law.changed({term.option: getattr(table, term.option) for term in TERMS})
    laws: dict[str, Value] = {"law": law, "stated": stated}
    removed = [term for term in stated.terms if term not in law.terms]
    if law.tanh is not None and law.coulomb:
        removed = [term for term in removed if term != COULOMB]  # it reverses smoothly
    if removed:
        key: FindingKey = "chosen friction law in place of the stated"
        yield _doubtful(key, "keep the stated friction", **laws)
    else:
        yield Finding("chosen friction law", "information", values=laws)


def _torque_channel(prepared: Prepared) -> Iterator[Finding]:
    """Yield findings about a delay or low-pass of the torque chosen by inner prediction."""
    chosen = [choice.name for choice in prepared.settings.choices if choice.chosen]
    how = prepared.settings.preprocessing
    if prepared.delays is None and how.torque_delay != prepared.settings.stated_delay:
        remedy: RemedyKey = "state the delay, or correct the program"
        yield _doubtful("delay chosen by prediction", remedy, delay=1e3 * how.torque_delay)
    width = how.torque_bandwidth
    remedy = "record the torque unfiltered"
    if LOW_PASS in chosen and width is not None:
        yield _doubtful("filtered torque", remedy, bandwidth=width, shape=str(how.torque_shape))
        return
    exact = any(choice.errors[choice.chosen] < _EXACT_ERROR for choice in prepared.settings.choices)
    if exact or REVERSAL in chosen:
        return  # computed for this motion, or it would not be predicted to rounding
    above = torque_noiseless_above(prepared.sources.training[0].recording)
    if above is not None and width is None and above < _MAX_BANDWIDTH_RATIO * how.rigid_bandwidth:
        yield _doubtful("filtered or computed torque", remedy, bandwidth=above)


def _resolution(prepared: Prepared) -> Iterator[Finding]:
    """Yield findings if the resolution of the positions is too low.

    For their accelerations: rounding to a step q is white noise of variance q²/12; after smoothing
    with a bandwidth B it contributes q²/12 (2 / rate) (2 pi)^4 B^5 / 5 to the variance of the
    acceleration. For friction at rest: it reverses over the presliding displacement, and a larger
    step of a resting joint makes its direction one of rounding.
    """
    names = prepared.sources.cell.joint_names
    model = prepared.sources.cell.model
    coarse, reversing = np.zeros((2, len(names)))
    for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True):
        recording = source.recording
        interval = float(np.median(np.diff(recording.time)))
        resting = np.any(samples.usable & ~model.moving(samples.motion.velocity), axis=0)
        for j in range(len(names)):
            step = grid_step(recording.position[:, j])
            if step is None:
                continue
            width = min(samples.position_bandwidth[j], 0.5 / interval)
            noise = step**2 / 12.0 * 2.0 * interval * (2.0 * np.pi) ** 4 * width**5 / 5.0
            if np.sqrt(noise) > _MAX_ROUNDING_SHARE * samples.motion.acceleration[:, j].std():
                coarse[j] = max(step, coarse[j])
            law = model.friction.laws[j]
            if law.coulomb and resting[j] and 0.0 < (law.presliding or 0.0) < step:
                reversing[j] = max(step, reversing[j])
    if coarse.any():
        found = _doubtful("coarse positions", "record more digits", limit=_MAX_ROUNDING_SHARE)
        yield found.about(coarse > 0.0, step=coarse, unit=model.chain.position_units)
    elif reversing.any():
        presliding = max(law.presliding or 0.0 for law in model.friction.laws)
        remedy: RemedyKey = "record more digits, or leave slow rows out"
        found = _doubtful("coarse positions at rest", remedy, presliding=presliding)
        yield found.about(reversing > 0.0, step=reversing, unit=model.chain.position_units)


def _sampling_rate(prepared: Prepared, estimate: Estimate) -> Iterator[Finding]:
    """Yield a finding if most of a large error is noise that sampling folds into the motion's."""
    how = prepared.settings.preprocessing
    if how.torque_bandwidth is not None:
        return
    few = prepared.training[:_NOISE_RECORDINGS]
    model = prepared.sources.cell.model
    noise = folded_noise(model, estimate.values, few, how.rigid_bandwidth)
    if noise.share > _MAX_NOISE_SHARE and noise.error > Thresholds().unexplained:
        rate = 1.0 / float(np.median(np.diff(few[0].motion.time)))
        yield _doubtful(
            "folded noise",
            "log at a higher rate",
            rate=rate,
            bandwidth=how.rigid_bandwidth,
            noise=noise.share,
        )


def grid_step(position: Array) -> float | None:
    """Return the step of the grid that the positions (m,) of a joint lie on, None without one."""
    moves = np.abs(np.diff(position))
    moves = moves[moves > _ROUNDING_SHARE * np.ptp(position)]
    if not moves.size:
        return None
    step = float(np.quantile(moves, _STEP_QUANTILE))
    # Of positions without a grid, a tenth is that near to multiples of any step by chance.
    off = np.abs(moves / step - np.rint(moves / step))
    return step if np.mean(off < _MAX_GRID_DEVIATION) > 0.5 else None


def torque_limits(cell: Cell) -> Array | None:
    """Return the maximum torque of each joint (n,) [N·m or N], NaN if unknown; None without any."""
    if cell.file.drive_train is not None:
        drives = cell.drive_train
        gear = np.abs(np.diag(drives.motor_from_joint))
        return np.asarray(gear * drives.torque_constant * drives.current_limit)
    effort = urdf_limits(cell.urdf, cell.joint_names).effort
    limits = np.where(np.isfinite(effort), effort, np.nan)
    return None if np.isnan(limits).all() else limits


def torque_scale_of(sources: Sources) -> TorqueScale:
    """Return the uncertainty of the torques of the fitted recordings."""
    recordings = [source.recording for source in sources.training]
    return torque_scale(sources.cell, recordings, simulated=sources.header.only_simulated)
