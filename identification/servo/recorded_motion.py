"""Recorded motions on an even grid, with the torque that the bodies need along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.servo.servo_simulation import JointInputs
from identification.signals.recording import Recording

SIMULATION_STEP: Final = 5e-3
"""Time step of a simulation [s]."""

LEAD_SECONDS: Final = 0.25
"""Time before a window of which its commands are known [s]: the largest delay."""
SMOOTHING_SECONDS: Final = 0.03
"""Standard deviation of the filter that smooths measured positions for the bodies' torque [s]."""
_SLOPE_STEP: Final = 1e-3  # rad or m of the difference for a slope
_MIN_SAMPLES: Final = 10
_BODY_STRIDE: Final = 4  # steps between instants at which the bodies are computed


@dataclass(frozen=True, eq=False)
class Bodies:
    """The bodies of an arm at g instants of a motion.

    Attributes:
        bias: torque (g, n) but for the inertia of each joint times its own acceleration.
        inertia: of the bodies about each joint (g, n).
        slope: of the bias by the position of the joint (g, n).
        reference: the positions (g, n).
    """

    bias: Array
    inertia: Array
    slope: Array
    reference: Array

    @classmethod
    def along(cls, model: RobotModel, values: Array, motion: Motion) -> Bodies:
        """Return the bodies along a motion; `values` (p,) are without friction and rotors."""

        def torque(states: Motion) -> Array:
            return np.asarray(model.torque(values, states) + model.load_torque(states))

        position = motion.position
        at_rest = torque(Motion.at_rest(position))
        inertia = np.empty_like(position)
        slope = np.empty_like(position)
        still = np.zeros_like(position)
        for joint in range(model.n_joints):
            unit = still.copy()
            unit[:, joint] = 1.0
            accelerated = torque(Motion.of_states(position, still, unit))
            inertia[:, joint] = (accelerated - at_rest)[:, joint]
            ends = [
                torque(Motion.at_rest(position + sign * _SLOPE_STEP * unit))[:, joint]
                for sign in (-1.0, 1.0)
            ]
            slope[:, joint] = (ends[1] - ends[0]) / (2.0 * _SLOPE_STEP)
        bias = torque(motion.kinematics()) - inertia * motion.acceleration
        return cls(bias, inertia, slope, position)

    @classmethod
    def every(cls, model: RobotModel, values: Array, motion: Motion) -> Bodies:
        """Return the bodies along a motion on a fine grid, from some of its instants."""
        count = motion.n_samples
        rows = np.unique(np.append(np.arange(0, count, _BODY_STRIDE), count - 1))
        coarse = cls.along(model, values, motion.rows(rows))
        instants = np.arange(count)

        def at_all(part: Array) -> Array:
            return np.column_stack([np.interp(instants, rows, column) for column in part.T])

        return cls(
            at_all(coarse.bias), at_all(coarse.inertia), at_all(coarse.slope), motion.position
        )


class Grid(NamedTuple):
    """Instants of a simulation, including the samples'.

    Attributes:
        step: time step [s].
        every: steps from one sample to the next.
    """

    step: float
    every: int

    @classmethod
    def of(cls, recording: Recording) -> Grid:
        """Return the grid of a recording; a fast one is simulated at some of its samples."""
        period = float(np.median(np.diff(recording.time)))
        if period < SIMULATION_STEP:
            return cls(period * max(1, round(SIMULATION_STEP / period)), 1)
        every = max(1, round(period / SIMULATION_STEP))
        return cls(period / every, every)

    @property
    def coarser(self) -> Grid:
        """The grid with half of the steps, for what is tried."""
        every = max(1, self.every // 2)
        return Grid(self.step * self.every / every, every)

    @property
    def halved(self) -> Grid:
        """The grid with instants between, whose steps add no error to the end of a fit."""
        return Grid(0.5 * self.step, 2 * self.every)


@dataclass(frozen=True, eq=False)
class ServoMotion:
    """A recorded motion without gap, on an even grid of g instants.

    Attributes:
        step: of the grid [s].
        every: steps from one sample of the recording to the next.
        command: commanded positions (g, n), of the time before each instant at which they are
            known by interpolation.
        position: measured positions, as recorded (g, n).
        velocity: smoothed (g, n).
        bodies: along the measured motion.
        turning: joints (n,) that turn, the others slide.
    """

    step: float
    every: int
    command: Array
    position: Array
    velocity: Array
    bodies: Bodies
    turning: NDArray[np.bool_]

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.step * (len(self.position) - 1)

    def along(self, bodies: Bodies) -> ServoMotion:
        """Return the motion with the bodies along another reference."""
        return replace(self, bodies=bodies)

    def inputs(self, first: int, count: int) -> JointInputs:
        """Return what acts on the n joints in `count` steps from an instant on."""
        lead = int(np.ceil(LEAD_SECONDS / self.step)) + 3
        rows = np.clip(np.arange(first - lead, first + count), 0, None)
        part = slice(first, first + count)
        return JointInputs(
            step=self.step,
            command=self.command[rows],
            lead=lead,
            bias=self.bodies.bias[part],
            inertia=self.bodies.inertia[part],
            slope=self.bodies.slope[part],
            reference=self.bodies.reference[part],
            position=self.position[first],
            velocity=self.velocity[first],
        )


def side_by_side(parts: Sequence[JointInputs]) -> JointInputs:
    """Return windows of equal length as one, their joints one after the other (c = w n)."""

    def joined(name: str) -> Array:
        return np.concatenate([getattr(part, name) for part in parts], axis=-1)

    return parts[0].mapped(joined)


def motions_of(
    recording: Recording, model: RobotModel, bodies: Array, grid: Grid
) -> list[ServoMotion]:
    """Return the parts of a recording without gap in which commands are known.

    Args:
        recording: of positions and commands.
        model: of the arm.
        bodies: its parameters (p,) without friction and rotors.
        grid: on which it is simulated.
    """
    commanded = recording.commanded_position
    if commanded is None:
        return []
    motions = []
    for part in recording.segments():
        known = np.isfinite(commanded[part]).all(axis=1)
        if np.count_nonzero(known) < _MIN_SAMPLES:
            continue
        first = part.start + int(np.argmax(known))
        rows = slice(first, part.stop)
        time = recording.time[rows]
        if time[-1] - time[0] < LEAD_SECONDS:
            continue
        motions.append(
            _motion(time, commanded[rows], recording.position[rows], model, bodies, grid)
        )
    return motions


def _motion(
    time: Array, commanded: Array, position: Array, model: RobotModel, bodies: Array, grid: Grid
) -> ServoMotion:
    """Return a motion on an even grid, with its bodies along the smoothed positions."""
    step = grid.step
    instants = np.arange(time[0], time[-1] + 1e-3 * step, step)

    def at_grid(values: Array) -> Array:
        known = [np.isfinite(column) for column in values.T]
        return np.column_stack(
            [
                np.interp(instants, time[rows], column[rows])
                for rows, column in zip(known, values.T, strict=True)
            ]
        )

    measured = at_grid(position)
    smooth = scipy.ndimage.gaussian_filter1d(
        measured, SMOOTHING_SECONDS / step, axis=0, mode="nearest"
    )
    velocity = np.gradient(smooth, step, axis=0)
    acceleration = np.gradient(velocity, step, axis=0)
    return ServoMotion(
        step,
        grid.every,
        at_grid(commanded),
        measured,
        velocity,
        Bodies.every(model, bodies, Motion.of_states(smooth, velocity, acceleration)),
        np.asarray(model.chain.revolute, np.bool_),
    )
