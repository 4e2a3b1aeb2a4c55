"""A load on a simulated NS 16 weighed: `python -m benchmarks.payload --seeds 200 --pairs 8`.

Torques are pinocchio's. Every seed has a load of its own (4 to 16 kg), a motion of 16 s
(`--duration`) that is recorded without and with it, in ABBA order until the interval of the mass is
narrow enough, and noise that is half white and half correlated over 50 ms. The friction of every
joint differs by 4 % (standard deviation) between any two recordings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import NDArray

from benchmarks import parser_of, show
from identification.estimators.payload_estimate import NAMES, figures_of, identify_payload
from identification.estimators.payload_problem import Run
from identification.model.friction import FrictionLaw
from identification.model.pseudo_inertia import Body
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Samples, prepare
from sim_fixtures.ns16 import urdf_text

Array = NDArray[np.float64]

DRIFT: Final = 0.04
ENOUGH: Final = 0.0076
"""Half the 95 % interval of the mass, relative, at which recording ends."""
_RATE: Final = 250.0  # Hz
_DURATION: Final = 16.0  # s
_NOISE: Final = 0.014  # of a torque's own scatter
_POSITION_NOISE: Final = 1e-5  # rad
_CORRELATED: Final = 0.05  # s
_ROTOR: Final = np.array([7.6, 24.6, 10.5, 0.25, 0.30, 0.12])
_COULOMB: Final = np.array([68.0, 108.0, 50.0, 9.2, 8.9, 5.1])
_VISCOUS: Final = np.array([41.0, 63.0, 39.0, 3.3, 16.4, 8.9])
_SPEED: Final = np.array([2.7, 2.7, 2.9, 6.2, 6.1, 9.5])
_CENTRE: Final = np.array([0.0, -1.2, 2.0, 0.0, 1.0, 0.0])
_ROOM: Final = np.array([1.5, 0.7, 0.9, 2.0, 0.9, 2.5])


@dataclass(frozen=True)
class Coverage:
    """How well loads are weighed.

    Attributes:
        seeds: number of loads.
        pairs: of recordings, their mean.
        mass_error: relative error of the mass, its root mean square.
        within_one_percent: share of the masses.
        covered: by figure, how often its 95 % interval held the truth.
        moment_covered: the same of mass times distance.
        half_width: by figure, the median of half its interval.
        worst: largest relative error of a mass.
    """

    seeds: int
    pairs: float
    mass_error: float
    within_one_percent: float
    covered: dict[str, float]
    moment_covered: float
    half_width: dict[str, float]
    worst: float


def load_of(seed: int) -> Body:
    """A uniform box of 4 to 16 kg, up to 0.25 m off the flange."""
    rng = np.random.default_rng([seed, 1])
    mass = rng.uniform(4.0, 16.0)
    edges = rng.uniform(0.08, 0.3, 3)
    centre = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.05, 0.25)])
    turned = pin.Quaternion(*_unit(rng.standard_normal(4))).matrix()
    tensor = mass / 12.0 * (np.eye(3) * (edges**2).sum() - np.diag(edges**2))
    return Body(mass, centre, turned @ tensor @ turned.T)


def arm_model() -> RobotModel:
    """The arm as it is fitted."""
    return RobotModel.from_urdf(urdf_text(), friction=FrictionLaw(third=None, offset=True))


def runs_of(
    seed: int,
    model: RobotModel,
    *,
    loads: tuple[Body | None, ...] | None = None,
    drift: float = DRIFT,
    pace: float = 1.0,
    duration: float = _DURATION,
) -> list[Run]:
    """Recordings, reduced.

    Args:
        seed: of load, motion, drift and noise.
        model: to reduce them with.
        loads: what is carried in each recording; by default nothing and then that of the seed.
        drift: of the friction, its standard deviation.
        pace: of the motion.
        duration: of it [s].
    """
    loads = (None, load_of(seed)) if loads is None else loads
    recordings = recordings_of(
        seed, model.joint_names, loads, drift=drift, pace=pace, duration=duration
    )
    return [
        Run.of(f"run {k}", model, samples_of(recording, model), None, loaded=load is not None)
        for k, (recording, load) in enumerate(zip(recordings, loads, strict=True), 1)
    ]


def samples_of(recording: Recording, model: RobotModel) -> Samples:
    """A recording, smoothed with the known noise of its positions."""
    return prepare(recording, model, noise_variance=np.full(6, _POSITION_NOISE**2))


def recordings_of(
    seed: int,
    joint_names: tuple[str, ...],
    loads: tuple[Body | None, ...],
    *,
    drift: float = DRIFT,
    pace: float = 1.0,
    duration: float = _DURATION,
    other_motions: bool = False,
) -> Iterator[Recording]:
    """Recordings of one motion, or of a motion each, with the loads; see :func:`runs_of`."""
    rng = np.random.default_rng([seed, 2])
    time = np.arange(round(duration * _RATE)) / _RATE
    q, qd, qdd = _motion(rng, time, pace)
    for k, load in enumerate(loads):
        if k and other_motions:
            q, qd, qdd = _motion(rng, time, pace)
        arm = pin.buildModelFromXML(urdf_text())
        arm.armature = _ROTOR
        if load is not None:
            arm.appendBodyToJoint(6, pin.Inertia(*load), pin.SE3.Identity())
        data = arm.createData()
        torque = np.array([pin.rnea(arm, data, *row) for row in zip(q, qd, qdd, strict=True)])
        friction = _COULOMB * np.tanh(qd / 1e-3) + _VISCOUS * qd
        torque += (1.0 + drift * rng.standard_normal(6)) * friction
        torque += _NOISE * torque.std(axis=0) * _noise(rng, torque.shape)
        yield Recording(
            time=time,
            position=q + _POSITION_NOISE * rng.standard_normal(q.shape),
            joint_names=joint_names,
            torque=torque,
        )


def coverage(seeds: range, most_pairs: int = 1, duration: float = _DURATION) -> Coverage:
    """Weigh the load of every seed by at most so many pairs of recordings."""
    inside = []
    moments = []
    errors = []
    halves = []
    pairs = []
    model = arm_model()
    for seed in seeds:
        load = load_of(seed)
        order = tuple(load if k % 4 in (1, 2) else None for k in range(2 * most_pairs))
        for pair in range(1, most_pairs + 1):
            runs = runs_of(seed, model, loads=order[: 2 * pair], duration=duration)
            payload = identify_payload(model, runs)
            low, high = payload.intervals[0]
            if (high - low) / 2.0 <= ENOUGH * payload.parameters[9]:
                break
        pairs.append(pair)
        truth = figures_of(load)
        intervals = payload.intervals
        inside.append((intervals[:, 0] <= truth) & (truth <= intervals[:, 1]))
        halves.append((intervals[:, 1] - intervals[:, 0]) / 2.0)
        moment = load.mass * float(np.linalg.norm(load.centre))
        moments.append(payload.moment[1] <= moment <= payload.moment[2])
        assert payload.body is not None
        errors.append(payload.body.mass / load.mass - 1.0)
    error = np.array(errors)
    return Coverage(
        seeds=len(seeds),
        pairs=float(np.mean(pairs)),
        mass_error=float(np.sqrt(np.mean(error**2))),
        within_one_percent=float(np.mean(np.abs(error) < 0.01)),
        covered=dict(zip(NAMES, np.mean(inside, axis=0).tolist(), strict=True)),
        moment_covered=float(np.mean(moments)),
        half_width=dict(zip(NAMES, np.median(halves, axis=0).tolist(), strict=True)),
        worst=float(np.abs(error).max()),
    )


def _motion(rng: np.random.Generator, time: Array, pace: float) -> tuple[Array, Array, Array]:
    """Five sines a joint between 0.1 and 1 Hz, up to 60 % of the largest speeds."""
    rate = 2.0 * np.pi * pace * rng.uniform(0.1, 1.0, (5, 6))
    size = rng.standard_normal((5, 6)) / rate
    phase = rng.uniform(0.0, 2.0 * np.pi, (5, 6))
    angle = rate * time[:, None, None] + phase
    wave = size * np.sin(angle)
    slope = size * rate * np.cos(angle)
    fastest = np.abs(slope.sum(axis=1)).max(axis=0) / (0.6 * pace * _SPEED)
    shrink = 1.0 / np.maximum(fastest, np.abs(wave.sum(axis=1)).max(axis=0) / _ROOM)
    bend = -(wave * rate**2).sum(axis=1)
    return _CENTRE + shrink * wave.sum(axis=1), shrink * slope.sum(axis=1), shrink * bend


def _noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Of unit variance, half of it correlated (m, n)."""
    keep = np.exp(-1.0 / (_CORRELATED * _RATE))
    slow = scipy.signal.lfilter(
        [np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(shape), axis=0
    )
    return np.asarray(np.sqrt(0.5) * (rng.standard_normal(shape) + slow))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def main() -> None:
    """Print coverage and errors."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--pairs", type=int, default=1, help="at most, bare and loaded")
    parser.add_argument("--duration", type=float, default=_DURATION, help="of a motion [s]")
    options = parser.parse_args()
    summary = coverage(range(options.seeds), options.pairs, options.duration)
    show(asdict(summary), only_json=options.json)


if __name__ == "__main__":
    main()
