"""Simulated robot with motors and gears: target currents in, encoder positions out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from sim_fixtures.arrays import Array
from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.plant import ElasticPlant, Plant, PlantTruth
from sim_fixtures.servo import CurrentLoop, loops_per_cycle
from sim_fixtures.settings import ControllerSettings

DisturbanceKind = Literal["jam", "load", "slip"]

_JAM_FACTOR = 10.0
_ROWS: dict[DisturbanceKind, int] = {"jam": 0, "load": 1, "slip": 2}


class Disturbances:
    """Jams, external loads and encoder errors of the axes, each for a number of cycles.

    `motor_torque` is the largest torque of each motor at its joint, (n,) [N m]; `changed` whether
    jams have changed since the last cycle.
    """

    def __init__(self, motor_torque: Sequence[float]) -> None:
        self._torque: Array = np.array(motor_torque, dtype=np.float64)
        self._size: Array = np.zeros((3, self._torque.size))
        self._left = np.zeros((3, self._torque.size), np.int64)
        self.changed = False
        self._any = False

    def begin(self, kind: DisturbanceKind, axis: int, size: float, cycles: int) -> None:
        """Disturb one axis for some cycles.

        Args:
            kind: "jam": the axis is stuck; "load": an external torque; "slip": an encoder error.
            axis: from 0.
            size: of a load, as a share of the motor's largest torque; of a slip, in motor
                revolutions.
            cycles: that it lasts.
        """
        row = _ROWS[kind]
        self._size[row, axis] = size
        self._left[row, axis] = cycles
        self.changed = self._any = True

    @property
    def jam(self) -> Array | None:
        """Friction of jammed joints, (n,) [N m]; None without a jam."""
        stuck = self._left[0] > 0
        return np.where(stuck, _JAM_FACTOR * self._torque, 0.0) if stuck.any() else None

    @property
    def load(self) -> Array | None:
        """External torques, (n,) [N m], or None."""
        return self._of(1) * self._torque if self._any else None

    @property
    def slip(self) -> Array | None:
        """Error of the reported encoder positions, (n,) [motor rev], or None."""
        return self._of(2) if self._any else None

    def _of(self, row: int) -> Array:
        values: Array = np.where(self._left[row] > 0, self._size[row], 0.0)
        return values

    def advance(self) -> None:
        """Advance by one cycle."""
        if self._any:
            before = self._left[0] > 0
            np.maximum(self._left - 1, 0, out=self._left)
            self.changed = bool((before != (self._left[0] > 0)).any())
            self._any = bool(self._left.any()) or self.changed


RIPPLES_PER_TURN = 2
WARM_UP_TIME = 600.0  # time constant of the friction drift [s]
HALF_WARM_SPEED = 0.5  # speed at which the final warmth of a joint is one half [rad/s]


@dataclass(frozen=True)
class UnmodelledEffects:
    """Effects that the estimator does not model; zero by default.

    On a fast motion of the NS 16 at default sizes, the torque of the true rigid model differs from
    the converted current (both low-passed at 30 Hz) by about: ripple 1-2 %, drift 1-4 % (cold arm),
    elasticity 1.5 % on axis 1, delay below 0.3 %.

    The ripple has two periods per motor turn. The true friction is that of a half-warm joint; a run
    starts cold.
    """

    torque_ripple: float = 0.0  # amplitude as a share of the Coulomb torque of the joint
    friction_drift: float = 0.0  # relative decrease of all friction between cold and hot
    elasticity: tuple[float, ...] = ()  # compliance of each gear [rad/(N m)], (n,) or empty
    delay: float = 0.0  # additional delay of the target current [s], in sub-steps of the plant

    def __post_init__(self) -> None:
        object.__setattr__(self, "elasticity", tuple(float(c) for c in self.elasticity))

    @classmethod
    def default_sizes(cls, n_joints: int) -> UnmodelledEffects:
        """Return all effects at their default sizes."""
        elasticity = (0.5e-6, 0.5e-6, 1.25e-6)[:n_joints]
        return cls(
            torque_ripple=0.10,
            friction_drift=0.08,
            elasticity=elasticity + (0.0,) * (n_joints - len(elasticity)),
            delay=0.0005,
        )


class SimulatedRipple:
    """Torque ripple of amplitudes (n,) [N m] on the joint side, with random phases."""

    def __init__(self, amplitude: Array, rng: np.random.Generator) -> None:
        self._amplitude = amplitude
        self._phase = rng.uniform(0.0, 2.0 * pi, size=amplitude.size)

    def torque(self, motor_revolutions: Sequence[float]) -> Array:
        """Return the joint torques (n,) [N m] at motor positions (n,)."""
        angle = (2.0 * pi * RIPPLES_PER_TURN) * np.array(motor_revolutions)
        torque: Array = self._amplitude * np.sin(angle + self._phase)
        return torque


class SimulatedDrift:
    """Friction of joints that warm up by moving, from cold; `drift` as `friction_drift`."""

    def __init__(self, drift: float, n_joints: int) -> None:
        self._drift = drift
        self._warmth = np.zeros(n_joints)

    def scale(self, velocity: Array, duration: float) -> Array:
        """Return the factor on the friction (n,) after `duration` [s] at a velocity."""
        speed = np.abs(velocity)
        final = speed / (speed + HALF_WARM_SPEED)
        self._warmth += (duration / WARM_UP_TIME) * (final - self._warmth)
        factor: Array = 1.0 + self._drift * (0.5 - self._warmth)
        return factor


_BLOCK_SAMPLES = 1024


class NoiseSource:
    """White Gaussian noise of a standard deviation, one value per axis and call."""

    def __init__(self, deviation: float, n_axes: int, rng: np.random.Generator) -> None:
        self._deviation = deviation
        self._rng = rng
        self._n_axes = n_axes
        self._block: list[list[float]] = []
        self._zeros = [0.0] * n_axes

    def draw(self) -> list[float]:
        """Return the next values, (n,)."""
        if self._deviation == 0.0:
            return self._zeros
        if not self._block:
            shape = (_BLOCK_SAMPLES, self._n_axes)
            self._block = (self._rng.standard_normal(shape) * self._deviation).tolist()
        return self._block.pop()


class SimulatedArm:
    """Plant, drives and encoders of the arm, at rest with closed brakes.

    The arguments are those of `SimulatedController`; `currents` (n,) [A] are those of the last sub-
    step.
    """

    def __init__(
        self,
        urdf: str,
        drive: SimulatedDrive,
        truth: PlantTruth,
        settings: ControllerSettings,
        *,
        effects: UnmodelledEffects,
        gravity: ArrayLike,
        position: ArrayLike | None,
        rng: np.random.Generator,
    ) -> None:
        self._drive = drive
        self._period = settings.period
        self._substeps = settings.substeps
        self._loops = loops_per_cycle(settings.period)
        self._substep = settings.period / (self._loops * settings.substeps)
        # closed brakes hold the largest torques of the motors
        holding = [abs(t) for t in drive.joint_torques(drive.current_limit)]
        if any(effects.elasticity):
            self.plant: Plant = ElasticPlant(
                urdf, truth, gravity=gravity, position=position, brake_torque=holding,
                elasticity=effects.elasticity, step=self._substep,
            )  # fmt: skip
        else:
            self.plant = Plant(
                urdf, truth, gravity=gravity, position=position, brake_torque=holding
            )
        n = drive.n_axes
        current_rng, encoder_rng, ripple_rng = rng.spawn(3)
        self._current_noise = NoiseSource(settings.current_noise, n, current_rng)
        self._encoder_noise = NoiseSource(settings.encoder_noise, n, encoder_rng)
        self._loop = CurrentLoop(
            n,
            lag=settings.servo.current_lag,
            substep=self._substep,
            delay_substeps=round(effects.delay / self._substep),
        )
        self.currents = [0.0] * n
        self._load: Array | None = None
        self.disturbances = Disturbances(holding)
        self._ripple: SimulatedRipple | None = None
        if effects.torque_ripple > 0.0:
            self._ripple = SimulatedRipple(effects.torque_ripple * truth.coulomb, ripple_rng)
        self._drift: SimulatedDrift | None = None
        if effects.friction_drift > 0.0:
            self._drift = SimulatedDrift(effects.friction_drift, n)

    def encoders(self) -> list[float]:
        """Return the motor positions [rev] in whole encoder counts."""
        return self._drive.encoder(self._motors(), self._encoder_noise.draw())

    def begin_cycle(self, *, braked: bool) -> None:
        """Begin a cycle of the controller with closed or open brakes."""
        plant = self.plant
        plant.close_brakes(braked)
        disturbances = self.disturbances
        if disturbances.changed:
            plant.jam(disturbances.jam)
        self._load = None if braked else disturbances.load
        if self._drift is not None:
            plant.scale_friction(self._drift.scale(plant.velocity, self._period))

    def run(self, target_currents: Sequence[float]) -> list[float]:
        """Simulate one period of the servo loops; return the encoder positions [motor rev].

        `target_currents` are (n,) [A].
        """
        noise = self._current_noise.draw()
        for _ in range(self._substeps):
            self.currents = self._loop.substep(target_currents, noise)
            self._step()
        return self.encoders()

    def end_cycle(self) -> None:
        """End the cycle."""
        self.disturbances.advance()

    def run_unpowered_cycle(self) -> None:
        """Simulate a cycle with the drive off and closed brakes."""
        self.begin_cycle(braked=True)
        for _ in range(self._loops):
            self._current_noise.draw()
            for _ in range(self._substeps):
                self._loop.cut()
                self.currents = [0.0] * len(self.currents)
                self._step()
        self.end_cycle()

    def _step(self) -> None:
        """Simulate one sub-step under the present currents."""
        torque = np.array(self._drive.joint_torques(self.currents))
        if self._ripple is not None:
            torque += self._ripple.torque(self._motors())
        if self._load is not None:
            torque += self._load
        self.plant.step(torque, self._substep)

    def _motors(self) -> list[float]:
        position: list[float] = self.plant.motor_position.tolist()
        return self._drive.motor_revolutions(position)
