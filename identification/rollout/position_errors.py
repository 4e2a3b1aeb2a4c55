"""Position errors of simulated windows: identified arm, nominal arm, ensemble of arms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square
from identification.distributions import student_limit
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import unsupported_torque
from identification.model.flange import flange_motion
from identification.model.kinematics import Chain
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.rollout.mujoco_simulation import MAX_POSITION_ERROR, Feedback, RolloutArm
from identification.rollout.servo_by_torque import PositionServo, command_of
from identification.rollout.windows import Stretch, Windows, stretches_of
from identification.signals.samples import Samples

HORIZONS: Final = (0.1, 0.2, 0.5, 1.0)
"""Times after the start of a window at which positions are compared [s]."""


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Windows of recordings, and what acts on an arm in them."""

    windows: Windows
    samples: tuple[Samples, ...]  #: of each stretch
    servo: PositionServo | None = None  #: in place of the recorded torque
    delay: float = 0.0  #: by which the recorded torque is applied later [s]

    def force(self, arm: ExportedArm, simulated: RolloutArm) -> Array:
        """Return what acts on the joints of an arm in MuJoCo (w, K, n).

        What MuJoCo cannot simulate acts as along the measured motion, as does the part of the
        arm's torque that a low-pass took from the record.
        """
        windows = self.windows
        servo = self.servo
        parts = []
        for stretch, samples in zip(windows.stretches, self.samples, strict=True):
            beside = _removed(stretch, samples, arm) + _late(stretch, arm)
            beside = beside - unsupported_torque(arm, stretch.motion)
            if servo is None:
                beside = beside + _delayed(stretch, self.delay)
                position = stretch.motion.position
                rate = stretch.after
            else:
                position, rate = command_of(stretch, servo.delays)
            change = stretch.after - stretch.motion.velocity
            parts.append(simulated.force(beside, position, rate, change))
        force = windows.cut(parts)
        return force if servo is None else force + self._held(servo)

    def _held(self, servo: PositionServo) -> Array:
        """Return the constant torque in addition to a servo in each window (w, 1, n).

        Where the offset is not known, the torque at the start of a window shows it, with all that
        the servo's law lacks at that instant.
        """
        if servo.offset is not None:
            return np.asarray(servo.kp * servo.offset)[None, None]
        torque = []
        for stretch in self.windows.stretches:
            position, rate = command_of(stretch, servo.delays)
            error = position - stretch.motion.position
            slip = rate - stretch.after
            torque.append(stretch.torque - servo.kp * error - servo.kd * slip)
        return self.windows.at_start(torque)[:, None]


def recorded_stretches(
    model: RobotModel, recordings: Sequence[tuple[Samples, Array | None]], step: float
) -> tuple[list[Stretch], list[Samples]]:
    """Return the stretches of samples with their commanded positions, and the samples of each."""
    stretches = []
    owners = []
    for samples, commanded in recordings:
        parts = stretches_of(samples, samples.known_torque(model), step, commanded)
        stretches += parts
        owners += [samples] * len(parts)
    return stretches, owners


def joint_inertia(arm: ExportedArm, step: float) -> Array:
    """Return the inertia that each joint turns at its zero position (n,) [kg·m² or kg]."""
    none = np.zeros(arm.model.n_joints)
    simulated = RolloutArm.of(arm, step, Feedback(none, none))
    return np.asarray(simulated.model.dof_M0[simulated.order])


def light_feedback(arm: ExportedArm, step: float, frequency: float) -> Feedback:
    """Return a critically damped feedback of some natural frequency [Hz] for each joint alone."""
    inertia = joint_inertia(arm, step)
    rate = 2.0 * np.pi * frequency
    return Feedback(rate**2 * inertia, 2.0 * rate * inertia)


def simulate(
    arm: ExportedArm, motion: RecordedMotion, feedback: Feedback, extra: Array | float = 0.0
) -> Array:
    """Return the positions of an arm at the horizons (w, h, n), not finite where it is unstable.

    Args:
        arm: that is simulated.
        motion: that was recorded.
        feedback: to the measured positions.
        extra: torque in addition (w, K, n).

    Raises:
        NotSimulatedError: MuJoCo does not accept the arm.
    """
    windows = motion.windows
    simulated = RolloutArm.of(arm, windows.step, feedback)
    force = motion.force(arm, simulated) + extra
    positions = simulated.simulate(windows.position[:, 0], windows.start, force, windows.position)
    return positions[:, horizon_rows(windows)]


def horizon_rows(windows: Windows) -> list[int]:
    """Return the steps of a window that end at the horizons."""
    return [round(horizon / windows.step) - 1 for horizon in HORIZONS]


def continued(windows: Windows) -> Array:
    """Return the positions at the horizons (w, h, n) of joints that keep their start velocity."""
    moved = windows.start[:, None] * np.array(HORIZONS)[:, None]
    return np.asarray(windows.position[:, :1] + moved)


def _removed(stretch: Stretch, samples: Samples, arm: ExportedArm) -> Array:
    """Return the part of an arm's torque (g, n) that the low-pass of the record removed."""
    if samples.torque_bandwidth is None:
        return np.zeros_like(stretch.motion.position)
    model = arm.model
    whole = model.torque(arm.values, samples.motion.without_load())
    removed = whole - samples.predicted_torque(model, arm.values)
    return stretch.mean_about_instants(removed[stretch.part])


def _late(stretch: Stretch, arm: ExportedArm) -> Array:
    """Return what centrifugal torques (g, n) lack, which MuJoCo computes half a step early."""
    model = arm.model
    motion = stretch.motion
    before = replace(motion, velocity=stretch.before)
    late = _late_of_links(model, arm.standard[model.layout.links].tobytes(), stretch)
    return np.asarray(late + model.load_torque(before) - model.load_torque(motion))


@lru_cache(maxsize=64)
def _late_of_links(model: RobotModel, links: bytes, stretch: Stretch) -> Array:
    """Return the inertia of links without payload, which a polish never changes."""
    plan = RegressorPlan.of_bodies(model.chain, model.gravity)
    parameters = np.frombuffer(links)
    motion = stretch.motion.kinematics()
    early = plan.torque(parameters, replace(motion, velocity=stretch.before))
    return early - plan.torque(parameters, motion)


def _delayed(stretch: Stretch, delay: float) -> Array:
    """Return the recorded torque (g, n), `delay` [s] earlier."""
    if delay == 0.0:
        return stretch.torque
    time = stretch.motion.time
    columns = [np.interp(time - delay, time, column) for column in stretch.torque.T]
    return np.column_stack(columns)


# Errors


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Root mean square errors of an arm at the horizons."""

    joints: Array  #: position (h, n) [rad or m]; where unstable, `MAX_POSITION_ERROR`
    tool: Array  #: distance of the tool (h,) [m] in stable windows; NaN without any
    unstable: int  #: windows in which it became unstable
    unstable_joints: NDArray[np.intp]  #: of these, by the joint that left first (n,)


def errors_of(positions: Array, measured: Array, chain: Chain) -> RolloutErrors:
    """Return the errors of simulated positions (w, h, n)."""
    stable = np.isfinite(positions)
    difference = np.where(stable, positions - measured, MAX_POSITION_ERROR)
    whole = np.all(stable, axis=2)
    distances = np.full(len(HORIZONS), np.nan)
    for k in range(len(HORIZONS)):
        rows = whole[:, k]
        if rows.any():
            ends = [flange_motion(chain, at[rows, k]).position for at in (positions, measured)]
            away = ends[0] - ends[1]
            distances[k] = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    rms = root_mean_square(difference)
    first = np.count_nonzero(np.isinf(positions[:, -1]), axis=0)
    return RolloutErrors(rms, distances, int(np.count_nonzero(~whole[:, -1])), first)


def leading_joint(positions: Array, measured: Array, chain: Chain) -> int:
    """Return the joint whose error alone moves the tool most, of positions (w, n) at a horizon."""
    stable = np.isfinite(positions).all(axis=1)
    moved = np.zeros(measured.shape[1])
    if not stable.any():
        return 0
    at = flange_motion(chain, measured[stable]).position
    for joint in range(len(moved)):
        alone = measured[stable].copy()
        alone[:, joint] = positions[stable, joint]
        away = flange_motion(chain, alone).position - at
        moved[joint] = np.mean(np.sum(away**2, axis=1))
    return int(np.argmax(moved))


def coverage(ensemble: Array, measured: Array) -> Array:
    """Return the share of measured positions in the 95 % band of an ensemble (N, w, h, n): (h, n).

    The band is for one more arm, from mean and scatter of the stable ones.
    """
    count = np.count_nonzero(np.isfinite(ensemble), axis=0)
    in_band = count >= _MIN_ARMS
    filled = np.where(np.isfinite(ensemble), ensemble, 0.0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    deviation = np.where(np.isfinite(ensemble), ensemble - mean, 0.0)
    variance = np.sum(deviation**2, axis=0) / np.maximum(count - 1, 1)
    factor = float(student_limit(0.025, len(ensemble))) * np.sqrt(1.0 + 1.0 / len(ensemble))
    inside = in_band & (np.abs(measured - mean) <= factor * np.sqrt(variance))
    return np.asarray(inside.mean(axis=0))


_MIN_ARMS: Final = 3  # arms of which a scatter is computed


@dataclass(frozen=True, eq=False)
class ResidualTorque:
    """Residual torque of fitted motions, from which stretches are drawn."""

    parts: tuple[Array, ...]  #: residual at the instants of a stretch (g, n), each K or longer
    steps: int  #: number K of steps of a window

    @classmethod
    def of(
        cls, residuals: Sequence[Array], fitted: Sequence[Samples], windows: Windows
    ) -> ResidualTorque:
        """Return the residuals (m, n) of recordings, for windows."""
        means = []
        for residual, samples in zip(residuals, fitted, strict=True):
            parts = stretches_of(samples, np.zeros_like(samples.torque), windows.step)
            means += [stretch.mean_about_instants(residual[stretch.part]) for stretch in parts]
        return cls(
            tuple(stretch_means for stretch_means in means if len(stretch_means) >= windows.steps),
            windows.steps,
        )

    def draw(self, count: int, random: np.random.Generator) -> Array | float:
        """Return random stretches (count, K, n), zero without any that is long enough."""
        if not self.parts:
            return 0.0
        starts = np.array([len(part) - self.steps + 1 for part in self.parts])
        chosen = random.choice(len(starts), count, p=starts / starts.sum())
        return np.stack(
            [self.parts[k][(row := random.integers(starts[k])) : row + self.steps] for k in chosen]
        )


# What would lessen the error

_DELAY_CHANGE: Final = 5e-3  # s
Variant = tuple[str, Callable[[ExportedArm, RecordedMotion], tuple[ExportedArm, RecordedMotion]]]


def variants(joint: int) -> list[Variant]:
    """Return changes of the friction of a joint, and of the delay of all, by the effect's name."""

    def scaled(
        symbols: Sequence[str], factor: float
    ) -> Callable[..., tuple[ExportedArm, RecordedMotion]]:
        def change(arm: ExportedArm, motion: RecordedMotion) -> tuple[ExportedArm, RecordedMotion]:
            values = arm.values.copy()
            model = arm.model
            part = model.friction_part
            of = [
                friction_term.owner == joint and friction_term.symbol in symbols
                for friction_term in model.friction.terms
            ]
            values[part] = np.where(of, factor * values[part], values[part])
            return replace(arm, values=values), motion

        return change

    def delayed(later: float) -> Callable[..., tuple[ExportedArm, RecordedMotion]]:
        def change(arm: ExportedArm, motion: RecordedMotion) -> tuple[ExportedArm, RecordedMotion]:
            if motion.servo is None:
                return arm, replace(motion, delay=motion.delay + later)
            delay = max(0.0, motion.servo.delay + later)
            return arm, replace(motion, servo=motion.servo._replace(delay=delay))

        return change

    return [
        *(("dry friction", scaled(("f0", "fl"), factor)) for factor in (0.7, 1.3)),
        *(("viscous friction", scaled(("f1", "f2"), factor)) for factor in (0.7, 1.3)),
        *(("delay", delayed(later)) for later in (-_DELAY_CHANGE, _DELAY_CHANGE)),
    ]
