"""Simulated recordings that determine little: `hil identify` against ordinary fits.

Run with ``python -m benchmarks.poor_recordings [--seeds N] [--first-seed N] [--json]``. Each seed
draws an arm of the package example-robot-data, what its URDF does not say, a motion, and a logger;
half of the seeds predict the rest of the motion that is fitted, half another one. Most of this is
not in the model that is fitted, and nothing is of the recordings of `benchmarks.board`.

- The arm: bodies near those of the URDF, for a fifth of the seeds a URDF without masses; rotors.
- Friction: Coulomb (of other size in the other direction), viscous (or with the root of the
  speed), Stribeck, a share of the load, falling by up to 20 % as the gears warm; a ripple of the
  torque along the position; torque constants off by 3 %.
- The motion: a Fourier series, moves from point to point with rests, or one slow sine per joint;
  for a quarter of the seeds two joints, or all but one, stand still.
- The logger: 8 to 60 s at 50 to 1000 Hz, rounded positions, with or without velocity, torque late,
  filtered and with coloured noise.

Errors are of all rows of what is predicted [%], over all joints, as on the board: of hil, of the
ordinary fits of `benchmarks.plain_fit`, and of the URDF's masses with fitted friction.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import scipy.signal
from numpy.typing import NDArray

from benchmarks import parser_of, plain_fit, show
from benchmarks.arms import urdf
from benchmarks.averaging import ALL, watched
from benchmarks.board import ABOVE_PLAIN, identified
from benchmarks.coverage import drawn_body
from benchmarks.joint_log import JointLog
from benchmarks.plain_fit import robot_from_urdf
from hil.base.errors import HilError
from hil.importers.imported_robot import Robot
from identification.errors import IdentificationError
from identification.model.urdf_text import urdf_tree

Array = NDArray[np.float64]
Random = np.random.Generator

FITTED_SHARE: Final = 0.7
_MOST_ROWS: Final = 20_000
_RATED_PAYLOAD: Final = 3.0  # kg, which nothing here depends on
_ROOM_SHARE: Final = 0.6  # of half the range of a joint
_MOST_ROOM: Final = 2.0  # rad
_UNSTATED_RANGE: Final = 2.5  # rad, of a joint whose limits say nothing
_UNSTATED_SPEED: Final = 2.0  # rad/s
_FASTEST: Final = 20.0  # rad/s that a URDF may state
_ACCELERATION: Final = 4.0  # 1/s, largest acceleration over largest speed
_SMOOTH: Final = 20.0  # Hz, above which no arm follows
_BESIDE: Final = 0.5  # s before and after a log
_POSTURES: Final = 60  # that give each joint's scale of torque
_POSITION_NOISE: Final = 1e-5  # rad
_VELOCITY_NOISE: Final = 0.003  # of the largest speed
_MEMORY: Final = 0.05  # s, of the coloured half of the noise
_WARM_UP: Final = 40.0  # s


class ArmType(NamedTuple):
    """A URDF of example-robot-data, and the joints of the arm by how their names begin."""

    urdf: str
    prefixes: tuple[str, ...] = ("",)
    without: str = "finger"


ARM_TYPES: Final[Mapping[str, ArmType]] = {
    "ur3": ArmType("ur_description/urdf/ur3_robot.urdf"),
    "ur5": ArmType("ur_description/urdf/ur5_robot.urdf"),
    "panda": ArmType("panda_description/urdf/panda.urdf", ("panda_joint",)),
    "xarm7": ArmType("xarm_description/urdf/xarm7.urdf", ("joint",)),
    "talos": ArmType("talos_data/robots/talos_left_arm.urdf", ("arm_left",)),
    "tiago": ArmType("tiago_description/robots/tiago_no_hand.urdf", ("arm_",)),
    "baxter": ArmType("baxter_description/urdf/baxter.urdf", ("left_",)),
    "romeo": ArmType(
        "romeo_description/urdf/romeo.urdf", ("LShoulder", "LElbow", "LWrist"), "Finger"
    ),
}


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm, its joints' limits (n,), and what its URDF does not say; torques in N·m."""

    text: str
    locked: Mapping[str, float]
    robot: Any
    lower: Array
    upper: Array
    speed: Array
    scale: Array  # of the torque
    coulomb: Array
    viscous: Array
    offset: Array
    rotor: Array
    asymmetry: float
    load: float
    stribeck: float
    power: float  # of the speed, in viscous friction
    warming: float  # share of friction
    ripple: Array
    ripples: Array  # per rad
    phase: Array
    constants: Array

    def torque(self, time: Array, motion: Motion) -> Array:
        """Torque (m, n) along a motion, at times (m,) since the arm was cold."""
        position, velocity, acceleration = motion
        data = self.robot.createData()
        rigid = np.array(
            [pin.rnea(self.robot, data, *state) for state in zip(*motion, strict=True)]
        )
        direction = np.tanh(velocity / (0.002 * self.speed))
        share = np.abs(velocity) / self.speed
        dry = self.coulomb * (1.0 + self.asymmetry * np.sign(velocity)) + self.load * np.abs(rigid)
        dry = dry * (1.0 + self.stribeck * np.exp(-share / 0.05)) * direction
        fluid = self.viscous * self.speed * np.sign(velocity) * share**self.power
        cooling = 1.0 - self.warming * (1.0 - np.exp(-time[:, None] / _WARM_UP))
        ripple = self.ripple * np.sin(self.ripples * position + self.phase)
        motors = self.rotor * acceleration + self.offset + ripple
        return np.asarray(self.constants * (rigid + motors + cooling * (dry + fluid)))


class Motion(NamedTuple):
    """Positions, velocities and accelerations (m, n)."""

    position: Array
    velocity: Array
    acceleration: Array


class Logger(NamedTuple):
    """How a motion is written.

    Attributes:
        rate: [Hz].
        delay: of the torque [s].
        cutoff: of a low-pass of the torque [Hz], 0 for none.
        resolution: of the positions [rad], 0 for none.
        noise: of the torque, as a share of each joint's scale.
        has_velocity: whether velocities are written.
    """

    rate: float
    delay: float
    cutoff: float
    resolution: float
    noise: float
    has_velocity: bool


def drawn_arm(random: Random) -> tuple[str, Arm]:
    """Draw an arm type, and an arm near its URDF."""
    name = str(random.choice(list(ARM_TYPES)))
    kind = ARM_TYPES[name]
    text = urdf(kind.urdf).read_text(encoding="utf-8")
    every = [joint for joint in pin.buildModelFromXML(text).names if joint != "universe"]
    chosen = [j for j in every if j.startswith(kind.prefixes) and kind.without not in j]
    locked = dict.fromkeys((joint for joint in every if joint not in chosen), 0.0)
    robot = robot_from_urdf(text, locked=locked)
    for joint in range(1, robot.njoints):
        robot.inertias[joint] = drawn_body(robot.inertias[joint], random)
    n = robot.nv
    lower = robot.lowerPositionLimit
    upper = robot.upperPositionLimit
    stated = np.isfinite(lower) & np.isfinite(upper) & (upper - lower < 50.0)
    stated &= upper - lower > 0.05
    lower = np.where(stated, lower, -_UNSTATED_RANGE)
    upper = np.where(stated, upper, _UNSTATED_RANGE)
    limit = robot.velocityLimit
    speed = np.where((limit > 0.05) & (limit < _FASTEST), limit, _UNSTATED_SPEED)
    scale = torque_scale(robot, lower, upper, speed, random)
    coulomb = scale * random.uniform(0.05, 0.5, n)
    arm = Arm(
        text=without_masses(text) if random.random() < 0.2 else text,
        locked=locked,
        robot=robot,
        lower=lower,
        upper=upper,
        speed=speed,
        scale=scale,
        coulomb=coulomb,
        viscous=scale * random.uniform(0.05, 0.5, n) / speed,
        offset=coulomb * random.uniform(-0.3, 0.3, n),
        rotor=scale * random.uniform(0.0, 0.3, n) / (2.0 * speed),
        asymmetry=random.choice([0.0, 0.15]),
        load=random.choice([0.0, 0.0, 0.05, 0.15]),
        stribeck=random.choice([0.0, 0.0, 0.3]),
        power=random.choice([1.0, 1.0, 0.5]),
        warming=random.choice([0.0, 0.1, 0.2]),
        ripple=scale * random.choice([0.0, 0.03, 0.08]),
        ripples=random.integers(3, 40, n).astype(np.float64),
        phase=random.uniform(0.0, 2.0 * np.pi, n),
        constants=1.0 + random.choice([0.0, 0.03]) * random.standard_normal(n),
    )
    return name, arm


def torque_scale(robot: Any, lower: Array, upper: Array, speed: Array, random: Random) -> Array:
    """RMS torque of each joint (n,) over random states, at least a fiftieth of the largest."""
    n = robot.nv
    data = robot.createData()
    torques = [
        pin.rnea(
            robot,
            data,
            lower + (upper - lower) * random.random(n),
            0.4 * speed * random.standard_normal(n),
            2.0 * speed * random.standard_normal(n),
        )
        for _ in range(_POSTURES)
    ]
    scale = np.sqrt(np.mean(np.square(torques), axis=0))
    return np.asarray(np.maximum(scale, 0.02 * scale.max()))


def without_masses(text: str) -> str:
    """The URDF with bodies of one kilogram, as exporters write that know none."""
    tree = urdf_tree(text)
    for inertial in tree.iter("inertial"):
        for mass in inertial.iter("mass"):
            mass.set("value", "1.0")
        for inertia in inertial.iter("inertia"):
            for axes in ("ixx", "iyy", "izz"):
                inertia.set(axes, "0.01")
            for axes in ("ixy", "ixz", "iyz"):
                inertia.set(axes, "0.0")
    return ElementTree.tostring(tree, encoding="unicode")


def fourier(random: Random, time: Array, room: float, speed: float) -> Array:
    """A Fourier series (m,) from rest, within room [rad] and speed [rad/s]."""
    harmonics = np.arange(1, random.integers(4, 12) + 1)[:, None]
    angle = 2.0 * np.pi * random.choice([0.05, 0.1, 0.15]) * harmonics * time
    cosine, sine = random.standard_normal((2, len(harmonics), 1)) / harmonics
    wave = (cosine * np.cos(angle) + sine * np.sin(angle)).sum(axis=0)
    wave = wave - wave[0]
    slope = np.gradient(wave, time)
    bend = np.gradient(slope, time)
    largest = [np.abs(values).max() for values in (wave, slope, bend)]
    limits = (room, speed, _ACCELERATION * speed)
    size = min(limit / most for limit, most in zip(limits, largest, strict=True))
    return np.asarray(size * wave * quintic(np.minimum(time, 1.0)))


def point_to_point(random: Random, time: Array, room: float, speed: float) -> Array:
    """Quintic moves (m,) to random points, with rests between them."""
    targets = [0.0]
    ends = [0.0]
    while ends[-1] < time[-1]:
        target = room * random.uniform(-1.0, 1.0)
        way = abs(target - targets[-1])
        duration = max(0.6, 1.9 * way / speed, np.sqrt(6.0 * way / (_ACCELERATION * speed)))
        rest = random.uniform(0.0, 0.8)
        targets += [target, target]
        ends += [ends[-1] + duration, ends[-1] + duration + rest]
    leg = np.clip(np.searchsorted(ends, time, side="right") - 1, 0, len(ends) - 2)
    start = np.array(ends)[leg]
    stop = np.array(ends)[leg + 1]
    share = quintic((time - start) / np.maximum(stop - start, 1e-9))
    return np.asarray(np.array(targets)[leg] * (1.0 - share) + np.array(targets)[leg + 1] * share)


def slow_sine(random: Random, time: Array, room: float, speed: float) -> Array:
    """One sine (m,), often less than a period."""
    angle = 2.0 * np.pi * random.uniform(0.05, 0.2) * time + random.uniform(0.0, 2.0 * np.pi)
    wave = room * random.uniform(-1.0, 1.0) * (np.sin(angle) - np.sin(angle[0]))
    fastest = float(np.abs(np.gradient(wave, time)).max())
    return np.asarray(wave * min(1.0, speed / fastest))


def quintic(share: Array) -> Array:
    """From rest at 0 to rest at 1 for shares (m,) of the time."""
    return np.asarray(share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


MOTIONS: Final[Mapping[str, Callable[[Random, Array, float, float], Array]]] = {
    "fourier": fourier,
    "point to point": point_to_point,
    "slow sines": slow_sine,
}


def drawn_motion(
    random: Random, arm: Arm, kind: str, time: Array, still: Sequence[int] = ()
) -> Motion:
    """Draw a motion of all joints but those that stand `still`."""
    room = np.minimum(_ROOM_SHARE * 0.5 * (arm.upper - arm.lower), _MOST_ROOM)
    speed = random.uniform(0.2, 0.8) * arm.speed
    position = np.tile(0.5 * (arm.lower + arm.upper), (len(time), 1))
    for joint in range(len(room)):
        if joint not in still:
            position[:, joint] += MOTIONS[kind](random, time, room[joint], speed[joint])
    rate = 1.0 / float(time[1] - time[0])
    low_pass = scipy.signal.butter(3, min(_SMOOTH, 0.4 * rate), fs=rate, output="sos")
    position = scipy.signal.sosfiltfilt(low_pass, position, axis=0)
    velocity = np.gradient(position, time, axis=0)
    return Motion(position, velocity, np.gradient(velocity, time, axis=0))


def logged(
    random: Random, arm: Arm, motion: Motion, time: Array, logger: Logger, begin: float
) -> JointLog:
    """Log a motion at times (m,), finer than the log's, that begins so long after a cold start."""
    step = float(time[1] - time[0])
    torque = arm.torque(time + begin, motion)
    if logger.cutoff:
        low_pass = scipy.signal.butter(
            2, min(logger.cutoff, 0.4 / step), fs=1.0 / step, output="sos"
        )
        torque = scipy.signal.sosfilt(low_pass, torque - torque[0], axis=0) + torque[0]
    late = np.maximum(np.arange(len(time)) - round(logger.delay / step), 0)
    rows = slice(None, None, round(1.0 / (logger.rate * step)))
    position = motion.position[rows]
    velocity = motion.velocity[rows]
    torque = torque[late][rows]
    keep = np.exp(-1.0 / (_MEMORY * logger.rate))
    drive = np.sqrt(1.0 - keep**2) * random.standard_normal(torque.shape)
    coloured = scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0)
    white = random.standard_normal(torque.shape)
    torque = torque + logger.noise * arm.scale * np.sqrt(0.5) * (white + coloured)
    position = position + _POSITION_NOISE * random.standard_normal(position.shape)
    if logger.resolution:
        position = logger.resolution * np.rint(position / logger.resolution)
    noise = _VELOCITY_NOISE * arm.speed * random.standard_normal(velocity.shape)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "arm.urdf"
        path.write_text(arm.text, encoding="utf-8")
        robot = Robot.from_urdf(path, locked=arm.locked)
    return JointLog(
        robot=robot,
        time=time[rows],
        position=position,
        velocity=velocity + noise if logger.has_velocity else None,
        torque=torque,
        rated_payload=_RATED_PAYLOAD,
    )


class Drawn(NamedTuple):
    """What a seed draws: its description, what is fitted, and what is predicted."""

    case: str
    fitted: JointLog
    predicted: JointLog


def drawn(seed: int) -> Drawn:
    """Draw an arm, its motions and their logs."""
    random = np.random.default_rng([seed, 7])
    name, arm = drawn_arm(random)
    n = arm.robot.nv
    logger = Logger(
        rate=float(random.choice([50, 100, 125, 200, 250, 500, 1000])),
        delay=float(random.choice([0.0, 0.0, 0.002, 0.008])),
        cutoff=float(random.choice([0.0, 0.0, 15.0])),
        resolution=float(random.choice([0.0, 1e-4, 5e-4])),
        noise=float(random.choice([0.005, 0.02, 0.05])),
        has_velocity=bool(random.random() < 0.5),
    )
    duration = min(float(random.choice([8.0, 15.0, 30.0, 60.0])), _MOST_ROWS / logger.rate)
    kind = str(random.choice(list(MOTIONS)))
    other = str(random.choice(["fourier", "point to point"])) if random.random() < 0.5 else ""
    standing = {0: n - 1, 1: 2, 2: 2}.get(int(random.integers(12)), 0)
    still = random.choice(n, standing, replace=False).tolist()
    fine = 8 if logger.rate <= 250.0 else 1

    def log(kind: str, duration: float, still: Sequence[int], begin: float) -> JointLog:
        # The filters of motion and torque swing at the ends, which are no part of the log.
        beside = round(_BESIDE * logger.rate)
        count = round(duration * logger.rate)
        time = np.arange((count + 2 * beside) * fine) / (logger.rate * fine)
        motion = drawn_motion(random, arm, kind, time, still)
        whole = logged(random, arm, motion, time, logger, begin)
        return whole.rows(slice(beside, beside + count))

    log_fitted = log(kind, duration, still, 0.0)
    case = f"{name}, {kind}, {duration:.3g} s, {logger.rate:g} Hz, {standing} stand"
    if other:
        return Drawn(f"{case}, to {other}", log_fitted, log(other, 0.5 * duration, (), 60.0))
    cut = round(FITTED_SHARE * log_fitted.n_rows)
    return Drawn(case, log_fitted.rows(slice(0, cut)), log_fitted.rows(slice(cut, None)))


def errors_of(draw: Drawn, *, averaging: bool = False) -> dict[str, Any]:
    """Errors [%] of hil and of ordinary fits, and the ratio of hil to the ordinary one.

    With `averaging`, `averaged` is the error of hil with averaged answers over that as it is.
    """
    with tempfile.TemporaryDirectory() as scratch:
        fitted = draw.fitted.imported(Path(scratch) / "fitted.mcap")
        predicted = draw.predicted.imported(Path(scratch) / "predicted.mcap")
        with watched() as seen:
            ours = identified(fitted, [predicted])
    robot = draw.fitted.pinocchio_model()
    fits = {"plain": plain_fit.fit, "plain + prior": plain_fit.fit_with_prior}
    if plain_fit.has_masses(robot):
        fits["nominal + friction"] = plain_fit.fit_friction
    errors = {"hil": ours.error}
    for name, fit in fits.items():
        torque = fit(robot, draw.fitted.measured).predicted_torque(draw.predicted.measured)
        errors[name] = plain_fit.relative_error(draw.predicted.torque, torque)
    result: dict[str, Any] = {name: round(100.0 * error, 2) for name, error in errors.items()}
    result["ratio"] = round(errors["hil"] / errors["plain"], 3)
    if averaging:
        result["averaged"] = round(seen.ratios()[ALL], 4)
    return result


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures over all seeds, the worst last."""
    ratios = np.array([row["ratio"] for row in rows if "ratio" in row])
    nominal = [row for row in rows if "nominal + friction" in row]
    behind = [row["seed"] for row in nominal if row["hil"] > row["nominal + friction"]]
    above = [row["seed"] for row in rows if row.get("ratio", 0.0) > ABOVE_PLAIN]
    return {
        "rows": list(rows),
        "refused": [row["seed"] for row in rows if "refused" in row],
        "mean_ratio": float(np.exp(np.log(np.maximum(ratios, 1e-6)).mean())),
        "worst_ratio": float(ratios.max()),
        "above_plain": above,
        "behind_nominal_friction": behind,
        **_averaged(rows),
    }


def _averaged(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The same figures with averaged answers, of rows that have them."""
    ratios = [row["ratio"] * row["averaged"] for row in rows if "averaged" in row]
    if not ratios:
        return {}
    return {
        "mean_averaged": float(np.exp(np.log(np.maximum(ratios, 1e-6)).mean())),
        "worst_averaged": max(ratios),
        "averaged_above_plain": sum(ratio > ABOVE_PLAIN for ratio in ratios),
    }


def main() -> None:
    """Print a line per seed, then the figures over all."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--averaging", action="store_true", help="averaged answers as well")
    options = parser.parse_args()
    rows = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        draw = drawn(seed)
        row: dict[str, Any] = {"seed": seed, "case": draw.case}
        try:
            row |= errors_of(draw, averaging=options.averaging)
        except (HilError, IdentificationError) as error:
            row["refused"] = str(error)
        rows.append(row)
        if not options.json:
            print("  ".join(f"{name} {value}" for name, value in row.items()), flush=True)
    show(summary(rows), only_json=True)


if __name__ == "__main__":
    main()
