"""A torque that comes and goes with the turning of a motor: cogging, gear teeth, run-out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.preprocessing import Samples
from identification.residual_blocks import BlockMean, BlockSums, block_index

Array = NDArray[np.float64]

# Per motor turn: eccentricity 1; strain wave gears 2; pole pairs and slots of servo motors beyond.
HARMONICS: Final = (1, 2, 3, 4, 6)
# Of the worst of five: about one chance in a thousand, with an amplitude of two components.
_SIGMAS: Final = 4.1


@dataclass(frozen=True, eq=False)
class Ripple:
    """Residual of n joints that follows the angle of their motors.

    Attributes:
        parts: mean cosine and sine part of each of `HARMONICS` (n, H, 2) [N·m or N].
    """

    parts: BlockMean

    @property
    def amplitude(self) -> Array:
        """Amplitude per joint and harmonic (n, H) [N·m or N], NaN where not seen."""
        return np.asarray(np.hypot(self.parts.mean[..., 0], self.parts.mean[..., 1]))

    @property
    def rms(self) -> Array:
        """Root mean square of what all harmonics explain (n,) [N·m or N], noise taken off."""
        squares = 0.5 * (self.parts.mean**2 - self.parts.std**2).sum(axis=-1)
        return np.asarray(np.sqrt(np.maximum(np.nansum(np.nan_to_num(squares), axis=-1), 0.0)))

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether some harmonic of a joint stands out (n,)."""
        std = np.sqrt(np.mean(self.parts.std**2, axis=-1))
        return np.asarray((np.nan_to_num(self.amplitude) > _SIGMAS * np.nan_to_num(std)).any(-1))

    def strongest(self, joint: int) -> int:
        """Periods per motor turn of a joint's largest harmonic."""
        return HARMONICS[int(np.nan_to_num(self.amplitude[joint]).argmax())]


def ripple_sums(samples: Samples, residual: Array, motor_from_joint: Array) -> BlockSums:
    """Sums of a recording's residual (m, n) times cosine and sine, by block: (B, n, H, 2).

    The phase is that of the motor's angle about its zero joint angles; the same in every
    recording, as long as nobody takes the gear apart.
    """
    block = block_index(samples)
    count = int(block[-1]) + 1
    n = residual.shape[1]
    values, weights = np.zeros((2, count, n, len(HARMONICS), 2))
    motor = samples.motion.position @ motor_from_joint.T
    for joint in range(n):
        rows = samples.usable[:, joint]
        left, inside = residual[rows, joint], block[rows]
        for h, harmonic in enumerate(HARMONICS):
            angle = harmonic * motor[rows, joint]
            for part, wave in enumerate((np.cos(angle), np.sin(angle))):
                values[:, joint, h, part] = np.bincount(inside, left * wave, count)
                weights[:, joint, h, part] = np.bincount(inside, wave**2, count)
    return BlockSums(values, weights)
