"""Motors, gears and links of the simulated robot: target currents in, encoder positions out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.effects import FrictionDrift, TorqueRipple, UnmodelledEffects
from sim_fixtures.elastic_plant import ElasticPlant
from sim_fixtures.mishaps import Mishaps
from sim_fixtures.plant import Plant
from sim_fixtures.servo import CurrentLoop
from sim_fixtures.settings import ControllerSettings
from sim_fixtures.truth import PlantTruth

_BLOCK = 1024


class NoiseSource:
    """White Gaussian noise, one value per axis and call."""

    def __init__(self, deviation: float, n_axes: int, rng: np.random.Generator) -> None:
        """Start a source of its own; `deviation` is the standard deviation."""
        self._deviation = deviation
        self._rng = rng
        self._n_axes = n_axes
        self._block: list[list[float]] = []
        self._silence = [0.0] * n_axes

    def draw(self) -> list[float]:
        """Return the next values, (n,)."""
        if self._deviation == 0.0:
            return self._silence
        if not self._block:
            shape = (_BLOCK, self._n_axes)
            self._block = (self._rng.standard_normal(shape) * self._deviation).tolist()
        return self._block.pop()


Array = NDArray[np.float64]


class SimulatedArm:
    """What the controller's cables lead to.

    Attributes:
        plant: the mechanics.
        currents: currents that flowed in the last sub-step, (n,) [A].
        mishaps: what happens to the mechanics from outside.
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
        """Put the arm at rest with closed brakes; arguments as for `SimulatedController`."""
        self._drive = drive
        self._period = settings.period
        self._substeps = settings.substeps
        self._substep = settings.period / settings.substeps
        # closed brakes hold as much as the motors could lift
        holding = [abs(t) for t in drive.joint_torques(drive.current_limit)]
        if effects.is_elastic:
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
        self.mishaps = Mishaps(holding)
        self._ripple: TorqueRipple | None = None
        if effects.torque_ripple > 0.0:
            self._ripple = TorqueRipple(effects.torque_ripple * truth.coulomb, ripple_rng)
        self._drift: FrictionDrift | None = None
        if effects.friction_drift > 0.0:
            self._drift = FrictionDrift(effects.friction_drift, n)

    def encoders(self) -> list[float]:
        """Return the motor positions [rev] in whole encoder counts."""
        return self._drive.encoder(self._motors(), self._encoder_noise.draw())

    def run_cycle(self, target_currents: Sequence[float] | None, *, braked: bool) -> None:
        """Let one period pass under target currents (n,) [A]; None for a drive that is off."""
        plant = self.plant
        plant.close_brakes(braked)
        mishaps = self.mishaps
        if mishaps.changed:
            plant.jam(mishaps.jam)
        load = None if braked else mishaps.load
        if self._drift is not None:
            plant.scale_friction(self._drift.scale(plant.velocity, self._period))
        noise = self._current_noise.draw()
        for _ in range(self._substeps):
            if target_currents is None:
                self._loop.cut()
                self.currents = [0.0] * len(self.currents)
            else:
                self.currents = self._loop.substep(target_currents, noise)
            torque = np.array(self._drive.joint_torques(self.currents))
            if self._ripple is not None:
                torque += self._ripple.torque(self._motors())
            if load is not None:
                torque += load
            plant.step(torque, self._substep)
        mishaps.pass_cycle()

    def _motors(self) -> list[float]:
        position: list[float] = self.plant.motor_position.tolist()
        return self._drive.motor_revolutions(position)
