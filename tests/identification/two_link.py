"""A planted arm of two links, a motion of it, and recordings with noise whose truth is known."""

from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples


def sine_motion(time, size, pace, phase, centre=0.0):
    """Sums of sines about a centre, of sizes, paces and phases (k, n) or (n,)."""
    a, w, phases = np.broadcast_arrays(*map(np.atleast_2d, (size, pace, phase)))
    angle = w * time[:, None, None] + phases
    return Motion(
        time,
        centre + (a * np.sin(angle)).sum(axis=1),
        (a * w * np.cos(angle)).sum(axis=1),
        (-a * w**2 * np.sin(angle)).sum(axis=1),
    )


def as_samples(model, motion, torque, **changes):
    """Samples of a motion without gaps, smoothed by nothing; where a joint moves its row counts."""
    fields = {
        "usable": model.moving(motion.velocity),
        "segments": (slice(0, len(motion.time)),),
        "origin": 0.0,
        "position_bandwidth": np.full(model.n_joints, np.inf),
    }
    return Samples(motion, torque, **(fields | changes))


URDF = (Path(__file__).parent / "two_link.urdf").read_text()
MODEL = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))
P = MODEL.n_parameters
NOISE = np.array([3.0, 0.2])
"""Standard deviation of the torque noise of each joint [N·m]."""


def values_of(model, friction=(), rotors=0.0):
    """Parameters (p,) of the description's bodies, with rotors and friction."""
    standard = model.nominal
    standard[model.layout.rotors] = rotors
    return np.concatenate([model.base.grouping @ standard, *np.atleast_2d(friction)])


def truth():
    """The planted parameters (p,)."""
    return values_of(MODEL, [4.0, 2.0, 1.5, 0.8], (0.4, 0.1))


def simulated(model, values, motion, noise=0.0, seed=0, **changes):
    """Samples of an arm with these parameters, with white noise of each joint [N·m]."""
    torque = model.torque(values, motion)
    torque += noise * np.random.default_rng(seed).standard_normal(torque.shape)
    return as_samples(model, motion, torque, **changes)


def one_sine(time, size=(0.9, 1.2), phase=(0.3, 1.1), **named):
    """One sine for each joint, with reversals at other times; `held_elbow` lets the second rest."""
    if named.pop("held_elbow", False):
        size = (size[0], 0.0)
    return sine_motion(time, np.array(size), np.array([2.1, 3.7]), np.array(phase), **named)


def four_sines(time, speed=1.0, *, n=2, seed=12, size=1.0):
    """Four sines for each of n joints."""
    rng = np.random.default_rng(seed)
    a, w, phase = rng.uniform([[[0.2]], [[2.0]], [[0.0]]], [[[0.5]], [[9.0]], [[6.0]]], (3, 4, n))
    return sine_motion(time, size * a, w * speed, phase)


def a_motion(duration=10.0, step=0.005):
    """Four sines for each joint, from time zero."""
    return four_sines(np.arange(0.0, duration, step))


def recording(error, motion):
    """What the planted arm's torques were in a motion, with an error (m, 2) [N·m]."""
    torque = MODEL.torque(truth(), motion) + error
    return as_samples(MODEL, motion, torque, origin=float(motion.time[0]))


def gaussian(rng, motion):
    """White noise of standard deviation NOISE."""
    return NOISE * rng.standard_normal((len(motion.time), 2))


def coloured(rng, length, step, correlation):
    """First-order noise of standard deviation NOISE, correlated over a time [s]; 0 for white."""
    r = np.exp(-step / correlation) if correlation else 0.0
    start = rng.standard_normal((1, 2)) * r
    white = np.sqrt(1.0 - r**2) * rng.standard_normal((length, 2))
    return NOISE * lfilter([1.0], [1.0, -r], white, axis=0, zi=start)[0]
