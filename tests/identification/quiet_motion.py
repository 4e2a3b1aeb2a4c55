"""Motion without contact."""

import numpy as np

from identification.arrays import Array
from tests.identification.two_link import (
    MODEL,
    as_samples,
    coloured,
    four_sines,
    truth,
)


def quiet(duration: float, seed: int, error: Array | float = 0.0):
    motion = four_sines(np.arange(0.0, duration, 0.005), 0.3)
    noise = coloured(np.random.default_rng(seed), len(motion.time), 0.005, 0.1)
    return as_samples(MODEL, motion, MODEL.torque(truth(), motion) + noise + error)
