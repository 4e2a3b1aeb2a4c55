"""Whether 95 % intervals of `hil identify` hold the truth of arms that were simulated without hil.

Run with ``python -m benchmarks.coverage [--seeds N] [--arms NAME ...] [--delays MS ...]
[--quadratic] [--load SHARE] [--stribeck SHARE] [--stribeck-speed SPEED] [--drift SHARE] [--white]
[--rate HZ] [--speed SHARE] [--scale SHARE] [--ensemble N] [--json]``. Each run is a log of its own
seed, imported and identified with default settings; another motion is held out. Motion, dynamics
(pinocchio's RNEA), friction and noise share no code with what is tested, only the URDF; what the
parameters are called and how they are grouped is the project's.

- The arm is not its URDF: masses differ by 10 to 20 %, centres and inertias alike, by a congruence
  of the pseudo-inertia, which keeps a body physically consistent. Its rotors are in no URDF.
- Friction is Coulomb, viscous and an offset, the law that an import assumes. ``--quadratic`` adds a
  term with the speed squared, and states all four in the archive. ``--load`` lets dry friction grow
  by a share of the rigid body's torque, which no archive states.
- ``--stribeck`` raises dry friction at rest by a share, which decays with ``exp(-(v / v_s)²)``; v_s
  is 0.1 rad/s or that of ``--stribeck-speed``. ``--drift`` lets dry and viscous friction fall by a
  share over the fitted log, linearly; the held-out motion follows. No archive states either.
  The true coefficients are the law's own: Coulomb and viscous friction without the Stribeck
  part; of friction that drifts its values at the start, in the middle and at the end of the log.
- The motion is a random Fourier series within the URDF's limits that starts and ends at rest.
  ``--speed`` is the share of the largest speeds that it may use.
- The scale of each joint's torque is off by 3 % (standard deviation), as an import assumes of one
  that nobody stated; ``--scale`` is another share.
- Positions have 1e-5 rad of noise. The torque has 1.4 % of its scatter, half of its power white and
  half with a memory of 50 ms; ``--white`` all white. It is logged a delay late, the same for all
  joints.

Figures per arm and delay, and of all; a seed is the same arm, motion and noise at every delay:

- ``inertial``, ``friction``: share of 95 % intervals in units of the arm's torque that hold the
  true value, over all determined parameters and runs, with two standard errors over the draws. True
  are the parameters that fit the torques in the scale of the log without noise best, by the
  weights of the identification; with ``--scale 0`` they are the arm's. ``inertial_absolute``,
  ``friction_absolute``: of absolute intervals and the parameters of the arm.
- ``undetermined``: parameters without an interval. ``dropped``: coefficients of true friction that
  the model does not have. ``width``: median half width of an inertial interval over the true value.
- ``inertial_over_bound``, ``friction_over_bound``: median half width of the former intervals over
  that of the Cramer-Rao bound of all rows, under the true covariance of their noise
  (`benchmarks.cramer_rao`); ``friction_least_squares``: the same of weighted least squares, which
  does not know that the noise is coloured.
- ``ensemble`` (with ``--ensemble N``): spread of the held-out torque without noise of N arms drawn
  from the posterior, over the error of the estimate there, both root mean squares over runs and
  moving joints in shares of each joint's torque: one, if arms differ as much as they are uncertain.
- ``delay_near``: runs whose applied delay is within 0.3 ms of the truth on every joint;
  ``delay_bias_ms``: mean of applied less true; ``delay_half_ms``: median half width of its interval
  where a run states one, ``delay_intervals`` their number, ``delay_held`` that of those which hold
  the true delay.
- ``doubted``: runs whose verdict puts the friction law of some joint in doubt; ``friction_width``:
  median half width of an interval of Coulomb or viscous friction over the true value. ``plain``:
  runs whose verdict is good without a reservation in its line.
- ``false_causes``: runs whose verdict blames something, other than a delay that is there, by the
  name of the finding. ``good``: runs whose verdict is good.
- ``inside``: share of held-out means of torque inside their intervals (`calibration` in
  `results.json`). ``error``: of held-out torque, all rows. ``seconds``: of the processor, mean.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pinocchio as pin
import scipy.signal
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.arms import ARMS, urdf
from benchmarks.board import suspicious
from benchmarks.cramer_rao import PROJECT_ORDER, base_regressor, bound, least_squares_deviations
from benchmarks.degradations import CAUSES
from benchmarks.joint_log import JointLog
from benchmarks.plain_fit import robot_from_urdf
from hil.base.progress import Silent
from hil.importers.imported_robot import IMPORTED_LAW, Robot
from hil.pipeline.identification import identify_archives
from hil.pipeline.identified_model import IdentifiedModel, ensemble_of, model_of
from hil.results.results import Results
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion as SampledMotion
from identification.model.robot import RobotModel
from identification.validation.finding_messages import FORM

Array = NDArray[np.float64]

FITTED_TIME: Final = 30.0  # s
HELD_OUT_TIME: Final = 12.0  # s
DELAYS: Final = (0.0, 1.3, 4.0, 10.0)  # ms
NEAR: Final = 0.3e-3  # s
_NORMAL: Final = 1.96  # standard deviations in half a 95 % interval of known variance
QUADRATIC_LAW: Final = FrictionLaw(third="quadratic", offset=True)

_BASE_FREQUENCY: Final = 0.1  # Hz
_HARMONICS: Final = 10
_ROOM_SHARE: Final = 0.6  # of the way from the middle of a range to its end
_MOST_ROOM: Final = 2.0  # rad
_ACCELERATION: Final = 4.0  # 1/s, largest acceleration over largest speed
_RAMP: Final = 1.0  # s, from rest to the series and back
_POSITION_NOISE: Final = 1e-5  # rad
_TORQUE_NOISE: Final = 0.014  # of the scatter of each joint's torque
_MEMORY: Final = 0.05  # s, of the coloured half of the torque noise
_DRY_SPEED: Final = 1e-3  # rad/s, below which dry friction is not full
_SHAPE_SCATTER: Final = 0.05  # of the pseudo-inertia's congruence, each entry
_MASS_SCATTER: Final = 0.12  # of the logarithm of a body's density
_FRICTION_SCATTER: Final = 0.2  # of each coefficient
_FEW_ROWS: Final = 5  # of which one is predicted by drawn arms
_FRICTION_SYMBOLS: Final = ("f0", "f1", "f2", "fo", "fl", "fs")  # in the order of `Friction`
_DRIFTING: Final = ("f0_", "f1_", "f2_")  # names of coefficients that are compared as they fall


class Conditions(NamedTuple):
    """What all runs of a study have in common.

    Attributes:
        quadratic: whether friction has a term with the speed squared, stated in the archive.
        white: whether the noise of the torque has no memory.
        rate: of the log [Hz].
        speed: share of the URDF's largest speeds that motions may use.
        scale: standard deviation of the scale of each joint's logged torque, as a share.
        load: share of the rigid body's torque by which dry friction grows.
        stribeck: share by which dry friction at rest exceeds that in motion.
        stribeck_speed: over which it decays [rad/s].
        drift: share by which friction falls over the fitted log.
        ensemble: number of arms that are drawn from each posterior.
    """

    quadratic: bool = False
    white: bool = False
    rate: float = 250.0
    speed: float = 0.7
    scale: float = 0.03
    load: float = 0.0
    stribeck: float = 0.0
    stribeck_speed: float = 0.1
    drift: float = 0.0
    ensemble: int = 0


DEFAULTS: Final = Conditions()


class Friction(NamedTuple):
    """Coefficients (n,) of Coulomb [N·m], viscous, quadratic friction, an offset and the load.

    Dry friction at rest exceeds that in motion by a share `stribeck`, over a speed [rad/s].
    """

    coulomb: Array
    viscous: Array
    quadratic: Array
    offset: Array
    load: Array
    stribeck: float = 0.0
    stribeck_speed: float = 1.0

    def torque(self, velocity: Array, rigid: Array, level: Array | float = 1.0) -> Array:
        """Torque (m, n) at speeds and torques of the rigid body (m, n), times a level (m,)."""
        at_rest = 1.0 + self.stribeck * np.exp(-((velocity / self.stribeck_speed) ** 2))
        dry = self.coulomb * at_rest + self.load * np.abs(rigid)
        dry = dry * np.tanh(velocity / _DRY_SPEED)
        fluid = self.viscous * velocity + self.quadratic * np.abs(velocity) * velocity
        return np.asarray(np.reshape(level, (-1, 1)) * (dry + fluid) + self.offset)


@dataclass(frozen=True, eq=False)
class ArmType:
    """An arm and the sizes of what its URDF does not have.

    Attributes:
        locked: positions of joints of the URDF that do not belong to the arm.
        rotor: inertias (n,) at the joints [kg·m²].
        coulomb: (n,) [N·m].
        viscous: (n,) [N·m·s/rad].
        rated_payload: [kg].
    """

    urdf: str | Path
    rotor: tuple[float, ...]
    coulomb: tuple[float, ...]
    viscous: tuple[float, ...]
    rated_payload: float
    locked: Mapping[str, float] = field(default_factory=dict)


ARM_TYPES: Final[Mapping[str, ArmType]] = {
    "ns16": ArmType(
        urdf=ARMS["ns16"],
        rotor=(7.6, 24.6, 10.5, 0.25, 0.30, 0.12),
        coulomb=(68.0, 108.0, 50.0, 9.2, 8.9, 5.1),
        viscous=(41.0, 63.0, 39.0, 3.3, 8.2, 4.5),
        rated_payload=16.0,
    ),
    "panda": ArmType(
        urdf=ARMS["panda"],
        rotor=(0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2),
        coulomb=(0.8, 0.9, 0.7, 0.8, 0.6, 0.4, 0.5),
        viscous=(1.2, 1.4, 1.0, 1.1, 0.6, 0.5, 0.4),
        rated_payload=3.0,
        locked={"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0},
    ),
}
"""A heavy geared arm, whose wrist has more friction than inertia, and a light one."""


@dataclass(frozen=True, eq=False)
class Arm:
    """One drawn arm: bodies and rotors (as armature) in pinocchio's model, and friction."""

    robot: Any
    friction: Friction

    def torque(
        self, position: Array, velocity: Array, acceleration: Array, level: Array | float = 1.0
    ) -> Array:
        """Torque (m, n) of the joints, with friction at a level (m,) of the drawn one."""
        rigid = self.rigid_torque(position, velocity, acceleration)
        return rigid + self.friction.torque(velocity, rigid, level)

    def rigid_torque(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torque (m, n) of bodies and rotors."""
        data = self.robot.createData()
        states = zip(position, velocity, acceleration, strict=True)
        return np.array([pin.rnea(self.robot, data, *state) for state in states])


def drawn_arm(kind: ArmType, seed: int, conditions: Conditions = DEFAULTS) -> Arm:
    """Draw an arm near its URDF."""
    random = np.random.default_rng([seed, 1])
    robot = robot_from_urdf(urdf(kind.urdf).read_text(encoding="utf-8"), locked=kind.locked)
    for joint in range(1, robot.njoints):
        robot.inertias[joint] = drawn_body(robot.inertias[joint], random)

    def near(values: Sequence[float]) -> Array:
        scatter = 1.0 + _FRICTION_SCATTER * random.uniform(-1.0, 1.0, len(values))
        return np.asarray(scatter * np.array(values))

    robot.armature = near(kind.rotor)
    coulomb = near(kind.coulomb)
    viscous = near(kind.viscous)
    offset = 0.2 * coulomb * random.uniform(-1.0, 1.0, len(coulomb))
    # At full speed it is as large as a third of the viscous term.
    share = near([1.0 / 3.0] * len(coulomb)) if conditions.quadratic else np.zeros(len(coulomb))
    quadratic = share * viscous / robot.velocityLimit
    load = np.full(len(coulomb), conditions.load)
    rise = conditions.stribeck, conditions.stribeck_speed
    return Arm(robot, Friction(coulomb, viscous, quadratic, offset, load, *rise))


def drawn_body(body: Any, random: np.random.Generator) -> Any:
    """A physically consistent body near one: its mass distribution sheared, and denser or lighter.

    In units of the body's own size, so that its centre moves by a share of that.
    """
    pseudo = body.toPseudoInertia()
    matrix = np.block([[pseudo.sigma, pseudo.h[:, None]], [pseudo.h[None, :], pseudo.mass]])
    size = np.sqrt(np.trace(pseudo.sigma) / pseudo.mass)
    unit = np.diag([size, size, size, 1.0])
    shear = np.eye(4) + _SHAPE_SCATTER * random.standard_normal((4, 4))
    shear = unit @ shear @ np.linalg.inv(unit)
    moved = np.exp(_MASS_SCATTER * random.standard_normal()) * shear @ matrix @ shear.T
    return pin.Inertia.FromPseudoInertia(
        pin.PseudoInertia(moved[3, 3], moved[:3, 3], moved[:3, :3])
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """A Fourier series (k harmonics of n joints) between two ramps from and to rest."""

    centre: Array  # (n,)
    cosine: Array  # (k, n)
    sine: Array  # (k, n)
    duration: float  # s

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration (m, n); at rest before and after the motion."""
        rate = 2.0 * np.pi * _BASE_FREQUENCY * np.arange(1, len(self.cosine) + 1)
        angle = time[:, None] * rate
        c = np.cos(angle)
        s = np.sin(angle)
        wave = c @ self.cosine + s @ self.sine
        slope = (c * rate) @ self.sine - (s * rate) @ self.cosine
        bend = -(c * rate**2) @ self.cosine - (s * rate**2) @ self.sine
        w, dw, ddw = (column[:, None] for column in self._ramp(time))
        position = self.centre + w * wave
        velocity = w * slope + dw * wave
        return position, velocity, w * bend + 2.0 * dw * slope + ddw * wave

    def _ramp(self, time: Array) -> tuple[Array, Array, Array]:
        """Quintic from 0 to 1, and back at the end, with two derivatives (m,)."""
        x = np.clip(np.minimum(time, self.duration - time) / _RAMP, 0.0, 1.0)
        way = np.where(time < 0.5 * self.duration, 1.0, -1.0) / _RAMP
        value = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        slope = 30.0 * x**2 * (1.0 - x) ** 2 * way
        return value, slope, 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) * way**2


def drawn_motion(
    robot: Any, random: np.random.Generator, duration: float, speed_share: float
) -> Motion:
    """Draw a motion within the URDF's limits of position and a share of those of speed."""
    n = robot.nv
    harmonic = np.arange(1.0, _HARMONICS + 1.0)[:, None]
    cosine, sine = random.standard_normal((2, _HARMONICS, n)) / harmonic
    centre = 0.5 * (robot.lowerPositionLimit + robot.upperPositionLimit)
    room = 0.5 * (robot.upperPositionLimit - robot.lowerPositionLimit)
    room = np.minimum(_ROOM_SHARE * room, _MOST_ROOM)
    series = Motion(np.zeros(n), cosine, sine, duration)
    largest = [np.abs(values).max(axis=0) for values in series.at(np.arange(0.0, duration, 0.01))]
    speed = speed_share * robot.velocityLimit
    limits = room, speed, _ACCELERATION * speed
    scale = np.min([limit / most for limit, most in zip(limits, largest, strict=True)], axis=0)
    return Motion(centre, scale * cosine, scale * sine, duration)


class Logged(NamedTuple):
    """What a logger has written: m rows of n joints."""

    time: Array
    position: Array
    torque: Array


def logged(
    arm: Arm, seed: int, part: int, duration: float, delay: float, conditions: Conditions
) -> Logged:
    """Log a motion with noise, the torque a delay [s] late."""
    random, motion, time = _part(arm, seed, part, duration, conditions)
    torque = arm.torque(*motion.at(time - delay), _level(part, time, duration, conditions))
    noise = random.standard_normal(torque.shape)
    if not conditions.white:
        keep = _kept(conditions)
        drive = np.sqrt(1.0 - keep**2) * random.standard_normal(torque.shape)
        noise = np.sqrt(0.5) * (noise + scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0))
    torque += _TORQUE_NOISE * torque.std(axis=0) * noise
    torque *= torque_scale(seed, torque.shape[1], conditions)
    position = motion.at(time)[0]
    return Logged(time, position + _POSITION_NOISE * random.standard_normal(torque.shape), torque)


def torque_scale(seed: int, joints: int, conditions: Conditions) -> Array:
    """Factors (n,) of the logged torques.

    Of the sensors or torque constants of the arm, so that they are the same in all of its motions.
    """
    random = np.random.default_rng([seed, 3])
    return np.asarray(1.0 + conditions.scale * random.standard_normal(joints))


def _part(
    arm: Arm, seed: int, part: int, duration: float, conditions: Conditions
) -> tuple[np.random.Generator, Motion, Array]:
    """Draws of a log, of which the first are its motion, that motion, and the times (m,)."""
    random = np.random.default_rng([seed, 2, part])
    motion = drawn_motion(arm.robot, random, duration, conditions.speed)
    return random, motion, np.arange(round(duration * conditions.rate)) / conditions.rate


def _level(part: int, time: Array, duration: float, conditions: Conditions) -> Array:
    """Friction over the drawn one (m,): it falls in the fitted log, which the others follow."""
    worn = np.minimum(time / duration, 1.0) if part == 0 else np.ones_like(time)
    return np.asarray(1.0 - conditions.drift * worn)


def _kept(conditions: Conditions) -> float:
    """Correlation of the coloured half of the noise from one row to the next, 0 if it is white."""
    return 0.0 if conditions.white else float(np.exp(-1.0 / (_MEMORY * conditions.rate)))


class Truth(NamedTuple):
    """What the log of a fitted motion can show, by the names of the parameters.

    Attributes:
        values: of the arm; NaN of a term of which the arm has none with that speed.
        rows: its regressor without noise (n, m, p), parameters in the order of `known`.
        noise: standard deviations of the torque's noise (n,).
        keep: correlation of its coloured half from one row to the next.
        scale: logged over true torque (n,).
    """

    values: Mapping[str, float]
    rows: Array
    noise: Array
    keep: float
    scale: Array

    @property
    def known(self) -> dict[str, float]:
        """Values of parameters that the arm has."""
        return {name: value for name, value in self.values.items() if not np.isnan(value)}

    @property
    def bound(self) -> dict[str, float]:
        """Least standard deviations."""
        return self._by_name(bound(self.rows, self.noise, self.keep))

    @property
    def least_squares(self) -> dict[str, float]:
        """Standard deviations of weighted least squares."""
        return self._by_name(least_squares_deviations(self.rows, self.noise, self.keep))

    def in_scale(self, std: Array, level: float = 1.0) -> dict[str, float]:
        """Parameters that fit the torques in the scale of the log best, for residuals std (n,).

        Coefficients that drift are at a level of the drawn ones.
        """
        values = np.array(
            [
                value * (level if name.startswith(_DRIFTING) else 1.0)
                for name, value in self.known.items()
            ]
        )
        weighted = self.rows / std[:, None, None]
        information = np.einsum("jmp,jmq->pq", weighted, weighted)
        # Solved for the change, which is exactly zero in the true scale.
        pull = np.einsum(
            "jmp,j,jmq,q->p", weighted, self.scale - 1.0, weighted, values, optimize=True
        )
        return self._by_name(values + np.linalg.solve(information, pull))

    def _by_name(self, figures: Array) -> dict[str, float]:
        return dict(zip(self.known, figures.tolist(), strict=True))


def truth_of(arm: Arm, model: RobotModel, seed: int, delay: float, conditions: Conditions) -> Truth:
    """What the log of the fitted motion can show, by pinocchio and the law of friction."""
    _, motion, time = _part(arm, seed, 0, FITTED_TIME, conditions)
    states = motion.at(time - delay)
    scale = torque_scale(seed, arm.robot.nv, conditions)
    rigid = arm.rigid_torque(*states)
    level = _level(0, time, FITTED_TIME, conditions)
    noise = _TORQUE_NOISE * (rigid + arm.friction.torque(states[1], rigid, level)).std(axis=0)
    base = base_regressor(arm.robot, model, *states)
    none = np.zeros((*base.shape[:2], 0))
    truth = Truth(true_values(arm, model), none, noise * scale, _kept(conditions), scale)
    rows = np.zeros((*base.shape[:2], len(truth.known)))
    rows[:, :, : base.shape[2]] = base
    for place, name in enumerate(truth.known):
        symbol, _, joint = name.partition("_")
        if symbol in _FRICTION_SYMBOLS:
            axis = int(joint) - 1
            rows[axis, :, place] = _unit_torque(symbol, states[1], rigid)[:, axis]
    return truth._replace(rows=rows)


def _unit_torque(symbol: str, velocity: Array, rigid: Array) -> Array:
    """Torque (m, n) of friction with a coefficient of one, at speeds and rigid torques (m, n)."""
    if symbol == "fs":
        dry = Friction(*np.eye(5)[0])
        rising = dry._replace(stribeck=1.0, stribeck_speed=DEFAULTS.stribeck_speed)
        return rising.torque(velocity, rigid) - dry.torque(velocity, rigid)
    return Friction(*np.eye(5)[_FRICTION_SYMBOLS.index(symbol)]).torque(velocity, rigid)


def true_values(arm: Arm, model: RobotModel) -> dict[str, float]:
    """Base parameters and friction coefficients of an arm by the project's names for them."""
    bodies = np.array([body.toDynamicParameters() for body in arm.robot.inertias[1:]])
    standard = np.zeros(model.layout.size)
    standard[model.layout.links] = bodies[:, PROJECT_ORDER]
    standard[model.layout.rotors] = arm.robot.armature
    values = dict(
        zip(model.parameter_names, (model.base.grouping @ standard).tolist(), strict=False)
    )
    friction = arm.friction
    symbols = dict(zip(_FRICTION_SYMBOLS, friction[:5], strict=False))
    if friction.stribeck:
        # Of a term with another speed there is no true coefficient.
        same = friction.stribeck_speed == DEFAULTS.stribeck_speed
        symbols["fs"] = friction.coulomb * (friction.stribeck if same else np.nan)
    for symbol, coefficients in symbols.items():
        if symbol in ("f0", "f1", "fo") or coefficients.any():
            values |= {f"{symbol}_{j}": value for j, value in enumerate(coefficients.tolist(), 1)}
    return values


class Run(NamedTuple):
    """What became of one log.

    Attributes:
        inertial: whether each determined base parameter is in its interval, in units of the torque
            of the arm.
        friction: likewise of the friction coefficients.
        inertial_absolute: likewise in absolute intervals.
        friction_absolute: likewise.
        inertial_over_bound: half widths of intervals divided by the Cramer-Rao bound's.
        friction_over_bound: likewise of true coefficients of friction.
        friction_least_squares: the latter of weighted least squares.
        undetermined: number of parameters without an interval.
        dropped: number of true friction coefficients that the model does not have.
        width: half widths of inertial intervals over the true values.
        delay_error: applied less true delay of each joint [s].
        delay_half: half width of its 95 % interval, where it is stated [s].
        spread: of the held-out torque of drawn arms (n,), as shares of the torque; empty of none.
        spread_error: error of the estimate there, likewise.
        blamed: names of findings that blame something which is not there.
        good: whether the verdict is.
        inside: share of held-out means inside their intervals.
        error: of held-out torque.
        seconds: of the processor.
        friction_width: half widths of intervals of Coulomb and viscous friction, likewise.
        doubted: whether the friction law of a joint is in doubt.
        plain: whether the verdict is good without a reservation.
    """

    inertial: list[bool]
    friction: list[bool]
    inertial_absolute: list[bool]
    friction_absolute: list[bool]
    inertial_over_bound: list[float]
    friction_over_bound: list[float]
    friction_least_squares: list[float]
    undetermined: int
    dropped: int
    width: list[float]
    delay_error: list[float]
    delay_half: list[float]
    spread: list[float]
    spread_error: list[float]
    blamed: list[str]
    good: bool
    inside: float | None
    error: float
    seconds: float
    friction_width: Sequence[float] = ()
    doubted: bool = False
    plain: bool = True


def run(name: str, delay: float, seed: int, conditions: Conditions = DEFAULTS) -> Run:
    """Simulate an arm, log it a delay [s] late, import the log and identify it."""
    kind = ARM_TYPES[name]
    arm = drawn_arm(kind, seed, conditions)
    law = QUADRATIC_LAW if conditions.quadratic else IMPORTED_LAW
    with tempfile.TemporaryDirectory() as scratch:
        robot = Robot.from_urdf(urdf(kind.urdf), friction=law, locked=kind.locked)
        archives = []
        for part, duration in enumerate((FITTED_TIME, HELD_OUT_TIME)):
            log = logged(arm, seed, part, duration, delay, conditions)
            joint_log = JointLog(
                robot, log.time, log.position, None, log.torque, kind.rated_payload
            )
            archives.append(joint_log.imported(Path(scratch) / f"{part}.mcap"))
        start = time.process_time()
        found = identify_archives(archives[:1], Silent(), predict=archives[1:])
        seconds = time.process_time() - start
        identified = model_of(found) if conditions.ensemble else None
    model = RobotModel.from_urdf(robot.urdf, locked=kind.locked, friction=law)
    truth = truth_of(arm, model, seed, delay, conditions)
    outcome = compared(found.results, truth, delay, seconds, conditions.drift)
    if identified is None:
        return outcome
    spread, error = ensemble_spread(identified, arm, seed, conditions)
    return outcome._replace(spread=spread.tolist(), spread_error=error.tolist())


def ensemble_spread(
    identified: IdentifiedModel, arm: Arm, seed: int, conditions: Conditions
) -> tuple[Array, Array]:
    """Spread of the held-out torque of drawn arms (n,), and the error of the estimate there."""
    model = identified.cell.model
    _, motion, time = _part(arm, seed, 1, HELD_OUT_TIME, conditions)
    time = time[::_FEW_ROWS]
    states = motion.at(time)
    torque = arm.torque(*states, _level(1, time, HELD_OUT_TIME, conditions))
    torque *= torque_scale(seed, arm.robot.nv, conditions)
    moving = model.moving(states[1])

    def rms(values: Array) -> Array:
        return np.asarray(np.sqrt(np.mean(values**2, axis=0, where=moving)) / torque.std(axis=0))

    arms = ensemble_of(identified, conditions.ensemble, seed)
    sampled = SampledMotion.of_states(*states)
    drawn = np.array([model.torque(values, sampled) for values in arms.values])
    estimated = model.torque(identified.estimate.values, sampled)
    return rms(drawn.std(axis=0, ddof=1)), rms(estimated - torque)


def compared(
    results: Results, truth: Truth, delay: float, seconds: float, drift: float = 0.0
) -> Run:
    """Compare results with the truth: parameters by name, and the delay [s].

    Coefficients f0, f1 and f2 fall by a share `drift`: those at the start, in the middle and at the
    end are compared. A coefficient that the truth does not have is zero. The interval is zero wide
    where a parameter was fixed at zero, and does not hold another value.

    Raises:
        KeyError: the results have another base parameter.
    """
    n_base = results.n_base
    factor = results.uncertainty.interval_factor
    known = [
        (index >= n_base, parameter)
        for index, parameter in enumerate(results.parameters)
        if not parameter.undetermined and np.isfinite(parameter.std)
    ]
    least = truth.bound
    least_squares = truth.least_squares
    own: tuple[list[bool], list[bool]] = [], []
    absolute: tuple[list[bool], list[bool]] = [], []
    over: tuple[list[float], list[float]] = [], []
    width: list[float] = []
    friction_width: list[float] = []
    levels = (1.0, 1.0 - 0.5 * drift, 1.0 - drift) if drift else (1.0,)
    in_scale = [truth.in_scale(np.array(results.noise_std), level) for level in levels]
    for is_friction, parameter in known:
        name = parameter.name
        value = truth.values.get(name, 0.0) if is_friction else truth.values[name]
        if np.isnan(value):
            continue
        half = factor * parameter.std
        absolute_half = factor * (parameter.absolute_std or parameter.std)
        drifts = name.startswith(_DRIFTING)
        for level, scaled in zip(levels, in_scale, strict=True):
            if drifts or level == levels[len(levels) // 2]:
                error = abs(parameter.estimate - scaled.get(name, 0.0))
                own[is_friction].append(bool(error <= half))
                error = abs(parameter.estimate - (level * value if drifts else value))
                absolute[is_friction].append(bool(error <= absolute_half))
        if name in least:
            over[is_friction].append(half / (_NORMAL * least[name]))
        if not is_friction:
            width.append(half / abs(value))
        elif name.startswith(("f0_", "f1_")):
            friction_width.append(half / abs(value))
    delays = results.delays
    applied = np.zeros(len(results.joint_names)) if delays is None else np.array(delays.applied)
    half_widths = [] if delays is None else [half for half in delays.interval if half is not None]
    present = {"delay": delay > 0.0, "friction": drift > 0.0}
    justified = {check for check, there in present.items() if there}
    checks = [finding.check for finding in suspicious(results)]
    blamed = [check for check in checks if check in CAUSES - justified]
    return Run(
        inertial=own[0],
        friction=own[1],
        inertial_absolute=absolute[0],
        friction_absolute=absolute[1],
        inertial_over_bound=over[0],
        friction_over_bound=over[1],
        friction_least_squares=[
            least_squares[name] / least[name]
            for name in least
            if name.partition("_")[0] in _FRICTION_SYMBOLS
        ],
        undetermined=len(results.parameters) - len(known),
        dropped=len(truth.known.keys() - {parameter.name for parameter in results.parameters}),
        width=width,
        friction_width=friction_width,
        doubted=FORM in checks,
        delay_error=(applied - delay).tolist(),
        delay_half=half_widths,
        spread=[],
        spread_error=[],
        blamed=list(dict.fromkeys(blamed)),
        good=results.verdict.good,
        plain=results.verdict.good
        and not any(finding.reservation for finding in suspicious(results)),
        inside=None if results.calibration is None else results.calibration.inside,
        error=results.validation[0].all_rows_relative_error,
        seconds=seconds,
    )


def figures(draws: Sequence[Sequence[Run]]) -> dict[str, Any]:
    """Figures of the runs of some draws, each one arm, motion and noise; see the module."""
    runs = [run for draw in draws for run in draw]
    near = [all(abs(error) <= NEAR for error in run.delay_error) for run in runs]
    bias = np.mean([error for run in runs for error in run.delay_error])
    halves = [half for run in runs for half in run.delay_half]
    stated = [run for run in runs if run.delay_half]
    held = [abs(run.delay_error[0]) <= run.delay_half[0] for run in stated]
    inside = [run.inside for run in runs if run.inside is not None]
    return {
        "runs": len(runs),
        **_coverage("inertial", [[run.inertial for run in draw] for draw in draws]),
        **_coverage("friction", [[run.friction for run in draw] for draw in draws]),
        **_coverage(
            "inertial_absolute", [[run.inertial_absolute for run in draw] for draw in draws]
        ),
        **_coverage(
            "friction_absolute", [[run.friction_absolute for run in draw] for draw in draws]
        ),
        "inertial_over_bound": _median([run.inertial_over_bound for run in runs]),
        "friction_over_bound": _median([run.friction_over_bound for run in runs]),
        "friction_least_squares": _median([run.friction_least_squares for run in runs]),
        "undetermined": sum(run.undetermined for run in runs),
        "dropped": sum(run.dropped for run in runs),
        "width": _rounded(np.median([share for run in runs for share in run.width])),
        "friction_width": _rounded(
            np.median([share for run in runs for share in run.friction_width] or [0.0])
        ),
        "doubted": sum(run.doubted for run in runs),
        "ensemble": _ratio_of_squares(
            [share for run in runs for share in run.spread],
            [share for run in runs for share in run.spread_error],
        ),
        "delay_near": sum(near),
        "delay_bias_ms": _rounded(1e3 * bias),
        "delay_half_ms": _rounded(1e3 * np.median(halves)) if halves else None,
        "delay_intervals": len(held),
        "delay_held": sum(held),
        "false_causes": dict(Counter(name for run in runs for name in run.blamed)),
        "good": sum(run.good for run in runs),
        "plain": sum(run.plain for run in runs),
        "inside": _rounded(np.mean(inside)) if inside else None,
        "error": _rounded(np.mean([run.error for run in runs])),
        "seconds": _rounded(np.mean([run.seconds for run in runs])),
    }


def _coverage(name: str, intervals: Sequence[Sequence[Sequence[bool]]]) -> dict[str, float | None]:
    """Share of all intervals by draw and run, and two standard errors over the draws."""
    by_draw = [[held for run in draw for held in run] for draw in intervals]
    held = [value for values in by_draw for value in values]
    shares = [np.mean(values) for values in by_draw if values]
    if not shares:
        return {name: None, f"{name}_unsure": None}
    unsure = None
    if len(shares) > 1:
        unsure = _rounded(2.0 * np.std(shares, ddof=1) / np.sqrt(len(shares)))
    return {name: _rounded(np.mean(held)), f"{name}_unsure": unsure}


def _ratio_of_squares(spread: Sequence[float], error: Sequence[float]) -> float | None:
    return _rounded(np.linalg.norm(spread) / np.linalg.norm(error)) if spread else None


def _median(figures: Sequence[Sequence[float]]) -> float | None:
    every = [figure for figures_of_run in figures for figure in figures_of_run]
    return _rounded(np.median(every)) if every else None


def _rounded(number: float | np.floating[Any]) -> float:
    return float(f"{number:.4g}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate and identify, print a line per arm and delay, then the line of JSON."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="runs per arm and delay")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--arms", nargs="+", choices=list(ARM_TYPES), default=list(ARM_TYPES))
    parser.add_argument("--delays", nargs="+", type=float, default=DELAYS, metavar="MS")
    parser.add_argument("--quadratic", action="store_true", help="true, and stated in the archive")
    parser.add_argument("--load", type=float, default=DEFAULTS.load, metavar="SHARE")
    parser.add_argument("--stribeck", type=float, default=DEFAULTS.stribeck, metavar="SHARE")
    parser.add_argument(
        "--stribeck-speed", type=float, default=DEFAULTS.stribeck_speed, metavar="SPEED"
    )
    parser.add_argument("--drift", type=float, default=DEFAULTS.drift, metavar="SHARE")
    parser.add_argument("--white", action="store_true", help="no coloured noise of the torque")
    parser.add_argument("--rate", type=float, default=DEFAULTS.rate, metavar="HZ")
    parser.add_argument("--speed", type=float, default=DEFAULTS.speed, metavar="SHARE")
    parser.add_argument("--scale", type=float, default=DEFAULTS.scale, metavar="SHARE")
    parser.add_argument("--ensemble", type=int, default=DEFAULTS.ensemble, metavar="N")
    options = parser.parse_args(arguments)
    conditions = Conditions(
        options.quadratic,
        options.white,
        options.rate,
        options.speed,
        options.scale,
        options.load,
        options.stribeck,
        options.stribeck_speed,
        options.drift,
        options.ensemble,
    )
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    cells: dict[str, dict[str, Any]] = {}
    draws: dict[tuple[str, int], list[Run]] = {}
    for name in options.arms:
        for delay in options.delays:
            cell = f"{name}, {delay:g} ms"
            runs = []
            for seed in seeds:
                outcome = run(name, 1e-3 * delay, seed, conditions)
                runs.append([outcome])
                draws.setdefault((name, seed), []).append(outcome)
                seconds = f"{cell}, seed {seed}: {outcome.seconds:.1f} s of processor"
                print(seconds, file=sys.stderr, flush=True)
            cells[cell] = figures(runs)
            if not options.json:
                print(_line(cell, cells[cell]), flush=True)
    every = figures(list(draws.values()))
    if not options.json:
        print(_line("all", every))
    show({"cells": cells, "all": every, **conditions._asdict()}, only_json=True)


def _line(cell: str, row: Mapping[str, Any]) -> str:
    """Return the figures of some runs as a line."""
    shown = [f"{cell:14}"]
    for name in ("inertial", "friction", "inertial_absolute", "friction_absolute"):
        share = row[name]
        unsure = row[f"{name}_unsure"]
        within = "" if unsure is None else f" ± {unsure:.1%}"
        shown.append(f"{name} " + ("-" if share is None else f"{share:.1%}{within}"))
    bounds = ("inertial_over_bound", "friction_over_bound", "friction_least_squares")
    shown += [f"{name} {row[name]}" for name in (*bounds, "ensemble", "undetermined", "dropped")]
    shown.append(f"delay near {row['delay_near']} of {row['runs']}, bias {row['delay_bias_ms']} ms")
    shown.append(f"in {row['delay_held']} of {row['delay_intervals']} intervals")
    shown.append(f"false causes {row['false_causes'] or 'none'}")
    shown.append(f"good {row['good']}")
    shown.append(f"plain {row['plain']}  doubted {row['doubted']}")
    last = ("width", "friction_width", "inside", "error", "seconds")
    shown += [f"{name} {row[name]}" for name in last]
    return "  ".join(shown)


if __name__ == "__main__":
    main()
