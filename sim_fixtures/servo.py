"""Servo of the simulated controller: position, velocity and current loops of each axis.

All loops are on the motor side, once per `LOOP_PERIOD`, with encoder positions:

    demanded speed  = target speed + position gain * (target - measured)
    target current  = model current + velocity gain * (speed error + its integral)

In some modes the PC adds to the demanded speed and the target current. The model current is that of
the dynamic model for the target motion of the cycle. The actual current follows the target current
with a lag and noise (`CurrentLoop`).

The cycle in which the PC sends targets may be longer (`CycleServo`): as in a real drive, the loops
do not get slower with it. At 2 ms they would excite the resonances of elastic gears.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp, inf, pi
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from sim_fixtures.arrays import Array
from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.plant import Carried, PlantTruth, build_model, carry, scale_bodies
from sim_fixtures.settings import ServoSettings

LOOP_PERIOD = 0.001
"""Period of the loops, s; a cycle of the controller has a whole number of them."""
COULOMB_SPEED = 0.02  # width of the sign change of the model's Coulomb torque [rad/s]


class NominalModel:
    """Inverse dynamics with random relative errors of links, rotors and friction.

    `error` is the smallest and largest relative error; signs are random. Mass, first moment and
    tensor of a link have the same error. `gravity` in m/s2 in the base frame. `entered` is the
    payload that the operator has entered.
    """

    def __init__(
        self,
        urdf: str,
        truth: PlantTruth,
        *,
        gravity: ArrayLike,
        error: tuple[float, float],
        rng: np.random.Generator,
        entered: Carried | None = None,
    ) -> None:
        n = truth.n_joints

        def factors() -> Array:
            signs: Array = rng.choice((-1.0, 1.0), size=n)
            return 1.0 + rng.uniform(*error, size=n) * signs

        self.rotor_inertia = truth.rotor_inertia * factors()
        self._model = build_model(urdf, gravity, self.rotor_inertia, truth.inertia_scale)
        scale_bodies(self._model, factors())
        carry(self._model, entered)
        self._data = self._model.createData()
        self._coulomb = truth.coulomb * factors()
        self._viscous = truth.viscous * factors()

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the joint torques (n,) [N m] of a motion."""
        torque: Array = pin.rnea(self._model, self._data, q, qd, qdd) + self._viscous * qd
        torque += self._coulomb * np.tanh(qd * (1.0 / COULOMB_SPEED))
        return torque

    def diagonal_inertia(self, q: Array) -> Array:
        """Return the diagonal of the joint-space inertia matrix (n,) [kg m2], rotors included."""
        diagonal: Array = pin.crba(self._model, self._data, q).diagonal()
        return diagonal


class CycleDemand(NamedTuple):
    """Input of the servo for one cycle of the controller, motor side, (n,) each.

    Position [rev], its change [rev per cycle], and what is added to the demanded speed [rev per
    cycle] and to the target current [A].
    """

    target: list[float]
    delta: list[float]
    speed: list[float]
    current: list[float]


_TURN = 2.0 * pi
INERTIA_CYCLES = 8  # cycles between two evaluations of the inertia, which changes slowly


class Servo:
    """Position and velocity loops; per-axis values are lists (n,), motor side.

    A cycle is one of the loops, of `period` [s].

    Attributes:
        target, delta: demanded position of the present cycle [motor rev] and its speed [per cycle].
        measured, measured_delta: encoder position and difference to the previous cycle [motor rev].
        current: target current computed in the last cycle [A].
        model_current: the dynamic model's share of it [A].
        inertia: diagonal of the model's inertia matrix on the *joint* side [kg m2].
    """

    def __init__(
        self,
        drive: SimulatedDrive,
        model: NominalModel,
        settings: ServoSettings,
        *,
        period: float,
        current_resolution: float = 0.0,
    ) -> None:
        n = drive.n_axes
        self._drive = drive
        self._model = model
        self._settings = settings
        self._period = period
        self._resolution = current_resolution
        self._deadband = settings.deadband_counts / drive.encoder_counts
        self._rotor_gain = [
            settings.rotor_bandwidth * inertia if inertia > 0.0 else inf
            for inertia in model.rotor_inertia.tolist()
        ]
        self._gear_squared = [ratio * ratio for ratio in drive.gear_ratio]
        self.target = [0.0] * n
        self.measured = [0.0] * n
        self.release()

    def release(self) -> None:
        """Reset: no current, zero integrals, targets at the measured positions."""
        n = self._drive.n_axes
        self.target = list(self.measured)
        self.delta = [0.0] * n
        self._delta_before = [0.0] * n
        self.measured_delta = [0.0] * n
        self.current = [0.0] * n
        self.model_current = [0.0] * n
        self.inertia = [0.0] * n
        self._gains = [0.0] * n
        self._tick = 0
        self._integral = [0.0] * n
        self.feed()

    def measure(self, revolutions: Sequence[float]) -> None:
        """Set the encoder positions of a new cycle."""
        self.measured_delta = [p - q for p, q in zip(revolutions, self.measured, strict=True)]
        self.measured = list(revolutions)

    def start_at(self, revolutions: Sequence[float]) -> None:
        """Set the encoder positions of the first cycle."""
        self.measured = list(revolutions)
        self.release()

    def following_error(self) -> list[float]:
        """Return target minus measured [motor rev]."""
        return [t - p for t, p in zip(self.target, self.measured, strict=True)]

    def feed(
        self, speed: Sequence[float] | None = None, current: Sequence[float] | None = None
    ) -> None:
        """Set the feed-forward of speed (n,) [motor rev per cycle] and current (n,) [A]."""
        zero = (0.0,) * self._drive.n_axes
        self._fed_speed = zero if speed is None else tuple(speed)
        self._fed_current = zero if current is None else tuple(current)

    def advance(self, target: Sequence[float], delta: Sequence[float]) -> list[float]:
        """Return the target currents of the cycle, (n,) [A].

        The target is that of the next cycle, position [motor rev] and speed [motor rev per cycle].
        """
        self.model_current = self._feed_forward(target, delta)
        self.current = self._close_loops(self._gains)
        self._delta_before = self.delta
        self.target = list(target)
        self.delta = list(delta)
        return self.current

    def _feed_forward(self, target: Sequence[float], delta: Sequence[float]) -> list[float]:
        """Return the model currents for the motion in the middle of the cycle."""
        rate = 1.0 / self._period
        drive = self._drive
        middle = [0.5 * (a + b) for a, b in zip(self.target, target, strict=True)]
        speed = [0.5 * rate * (a + b) for a, b in zip(self.delta, delta, strict=True)]
        acceleration = [rate * rate * (b - a) for a, b in zip(self.delta, delta, strict=True)]
        q = np.array(drive.joint_angles(middle))
        qd = np.array(drive.joint_speeds(speed))
        qdd = np.array(drive.joint_speeds(acceleration))
        if self._tick % INERTIA_CYCLES == 0:
            self.inertia = self._model.diagonal_inertia(q).tolist()
            self._gains = self._velocity_gains()
        self._tick += 1
        return drive.currents(self._model.torque(q, qd, qdd).tolist())

    def _velocity_gains(self) -> list[float]:
        """Return the gain of each velocity loop [A s/motor rev]."""
        bandwidth = self._settings.velocity_bandwidth
        return [
            _TURN * min(bandwidth * inertia, rotor) / (squared * kt)
            for inertia, rotor, squared, kt in zip(
                self.inertia,
                self._rotor_gain,
                self._gear_squared,
                self._drive.torque_constant,
                strict=True,
            )
        ]

    def _close_loops(self, gains: Sequence[float]) -> list[float]:
        """Return the target currents [A]; `gains` in A per motor rev/s."""
        settings = self._settings
        rate = 1.0 / self._period
        resolution = self._resolution
        integral = self._integral
        deadband = self._deadband
        position_gain = settings.position_gain
        growth = settings.integral_rate * self._period
        currents = []
        rows = zip(
            self.target,
            self.delta,
            self._delta_before,
            self._fed_speed,
            self._fed_current,
            self.measured,
            self.measured_delta,
            gains,
            self.model_current,
            self._drive.current_limit,
            strict=True,
        )
        for i, row in enumerate(rows):
            target, delta, before, fed, extra, measured, moved, gain, model, limit = row
            error = target - measured
            # the encoder difference is the speed half a cycle ago, like the mean of the targets
            lag = rate * (0.5 * (delta + before) + fed - moved) + position_gain * error
            total = integral[i]
            if delta != 0.0 or fed != 0.0 or abs(error) > deadband:
                total += growth * lag
            wanted = model + extra + gain * (lag + total)
            current = _within(limit, wanted)
            if current == wanted or lag * wanted < 0.0:  # anti-windup
                integral[i] = total
            if resolution > 0.0:
                current = _within(limit, round(current / resolution) * resolution)
            currents.append(current)
        return currents


def _within(limit: float, value: float) -> float:
    """Return `value` clipped to +-`limit`; faster than `min` and `max`."""
    if value < limit:
        return value if value > -limit else -limit
    return limit


class CycleServo:
    """The loops over the cycles of the controller; per-axis values are lists (n,), motor side.

    Between two targets the speed of the loops is linear in time. What the PC sends as the speed of
    a target is the step to it, the mean speed of a cycle; the speed at its end is extrapolated from
    the last two steps. With the step itself, the feed-forward would lag by half a
    cycle. A target that does not agree with its speed, as after a lost reply, moves the position of
    the loops alone, not their speed.

    Attributes:
        target, delta: demanded position at the end of the cycle, and the step to it [motor rev].
        measured, measured_delta: encoder position and difference to the previous cycle [motor rev].
        current: mean target current of the last cycle [A].
        model_current: the dynamic model's share of it [A].
    """

    def __init__(
        self,
        drive: SimulatedDrive,
        model: NominalModel,
        settings: ServoSettings,
        *,
        period: float,
        current_resolution: float = 0.0,
    ) -> None:
        self._n_loops = loops_per_cycle(period)
        self._loops = Servo(
            drive,
            model,
            settings,
            period=period / self._n_loops,
            current_resolution=current_resolution,
        )
        self.measured_delta = [0.0] * drive.n_axes
        self._take_state()

    def _take_state(self) -> None:
        """Set the values of the cycle from released loops."""
        loops = self._loops
        self.target = list(loops.target)
        self.delta = list(loops.delta)
        self._speed = list(loops.delta)
        self.measured = list(loops.measured)
        self.current = list(loops.current)
        self.model_current = list(loops.model_current)

    @property
    def inertia(self) -> list[float]:
        """Diagonal of the model's inertia matrix on the joint side (n,) [kg m2]."""
        return self._loops.inertia

    def release(self) -> None:
        """Reset: no current, zero integrals, targets at the measured positions."""
        self._loops.release()
        self.measured_delta = [0.0] * len(self.measured)
        self._take_state()

    def start_at(self, revolutions: Sequence[float]) -> None:
        """Set the encoder positions of the first cycle."""
        self._loops.start_at(revolutions)
        self.release()

    def measure(self, revolutions: Sequence[float]) -> None:
        """Set the encoder positions of a cycle with the drive off."""
        self._loops.measure(revolutions)
        self._end_cycle()

    def following_error(self) -> list[float]:
        """Return target minus measured [motor rev]."""
        return self._loops.following_error()

    def run_cycle(
        self,
        demand: CycleDemand,
        drive_arm: Callable[[Sequence[float]], Sequence[float]],
    ) -> None:
        """Run all loops of a cycle.

        `drive_arm` applies target currents (n,) [A] for one period of the loops and returns the
        encoder positions (n,) [motor rev] after it.
        """
        loops = self._loops
        n = self._n_loops
        loops.feed([speed / n for speed in demand.speed], demand.current)
        currents = []
        model_currents = []
        for target, delta in self._set_points(demand):
            currents.append(loops.advance(target, delta))
            model_currents.append(loops.model_current)
            loops.measure(drive_arm(loops.current))
        self.target = list(demand.target)
        self.delta = list(demand.delta)
        self.current = _means(currents)
        self.model_current = _means(model_currents)
        self._end_cycle()

    def _end_cycle(self) -> None:
        """Take the encoder positions of the loops for the cycle."""
        measured = list(self._loops.measured)
        self.measured_delta = [p - q for p, q in zip(measured, self.measured, strict=True)]
        self.measured = measured

    def _set_points(self, demand: CycleDemand) -> list[tuple[list[float], list[float]]]:
        """Return position [motor rev] and speed [per loop] of each loop of a cycle."""
        n = self._n_loops
        if n == 1:
            return [(demand.target, demand.delta)]
        ends = [
            _end_speed(step, before) for step, before in zip(demand.delta, self.delta, strict=True)
        ]
        points = []
        for loop in range(1, n):
            s = loop / n
            position = []
            speed = []
            for start, end, v, w in zip(self.target, demand.target, self._speed, ends, strict=True):
                # Linear for the part of the step that is not in the speeds, as after a lost reply.
                position.append(start + s * (end - start - 0.5 * (1.0 - s) * (w - v)))
                speed.append((v + s * (w - v)) / n)
            points.append((position, speed))
        points.append((list(demand.target), [w / n for w in ends]))
        self._speed = ends
        return points


def _end_speed(step: float, before: float) -> float:
    """Return the speed at the end of a cycle from its step and that before; all per cycle.

    It is extrapolated, except to and from a target that is held.
    """
    return step + 0.5 * (step - before) if step and before else step


def loops_per_cycle(period: float) -> int:
    """Return the number of servo loops in a cycle of `period` [s]."""
    return max(1, round(period / LOOP_PERIOD))


def _means(rows: Sequence[list[float]]) -> list[float]:
    """Return the means over rows of equal length."""
    return (
        rows[0]
        if len(rows) == 1
        else [sum(column) / len(rows) for column in zip(*rows, strict=True)]
    )


class CurrentLoop:
    """Actual current: the target through a delay and a first-order lag [s], plus noise.

    Currents are means over a sub-step [s], so that the lag does not depend on its length.
    """

    def __init__(self, n_axes: int, *, lag: float, substep: float, delay_substeps: int) -> None:
        self._decay = exp(-substep / lag) if lag > 0.0 else 0.0
        # mean of exp(-t / lag) over the sub-step
        self._mean = lag / substep * (1.0 - self._decay)
        self._state = [0.0] * n_axes
        self._queue: list[Sequence[float]] = [[0.0] * n_axes for _ in range(delay_substeps)]

    def substep(self, target: Sequence[float], noise: Sequence[float]) -> list[float]:
        """Return the mean current (n,) [A] of the next sub-step."""
        if self._queue:
            self._queue.append(target)
            target = self._queue.pop(0)
        decay = self._decay
        mean = self._mean
        lag = [s - t for s, t in zip(self._state, target, strict=True)]
        self._state = [t + decay * x for t, x in zip(target, lag, strict=True)]
        return [t + mean * x + e for t, x, e in zip(target, lag, noise, strict=True)]

    def cut(self) -> None:
        """Set the current to zero, as a drive does that is switched off."""
        self._state = [0.0] * len(self._state)
        self._queue = [list(self._state) for _ in self._queue]
