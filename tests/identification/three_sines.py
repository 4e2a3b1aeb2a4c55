"""A motion of three sines on each joint, and noise of its torque."""

import numpy as np

from tests.identification.two_link import (
    sine_motion,
)

ARM_NOISE = np.array([3.0, 0.6])


def three_sines(seed, n=2, duration=12.0, step=0.005):
    time = np.arange(0.0, duration, step)
    rng = np.random.default_rng(seed)
    a = rng.uniform(0.2, 0.5, (3, n))
    w = rng.uniform(2.0, 9.0, (3, n))
    phase = rng.uniform(0.0, 6.0, (3, n))
    return sine_motion(time, a, w, phase)
