r"""What an identification of drive gains needs of the samples: Gram matrices of [W | t | i].

Motor side, so that each row has the noise of one current only: with the motors' angles per joint
angle M, joint torque is :math:`\tau = M^T (K i)`, hence motor m obeys

.. math:: K_m i_m = \bigl[M^{-T} W\bigr]_m \pi + \bigl[M^{-T} \tau_p\bigr]_m

with :math:`\tau_p` the torque of the known payload, zero in a recording without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.factor.phases import FINE_BLOCK
from identification.model.payload import Load, Payload
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

_MOST_BLOCKS: Final = 400


@dataclass(frozen=True, eq=False)
class GainFactor:
    """Gram matrices of [W | t | i] in blocks of time, one per motor; recordings add up.

    Attributes:
        gram: (B, n, p + 2, p + 2).
        rows: (B, n).
        parameter_names: of the p columns of W.
    """

    gram: Array
    rows: NDArray[np.intp]
    parameter_names: tuple[str, ...]

    @classmethod
    def from_samples(
        cls,
        model: RobotModel,
        samples: Samples,
        motor_current: Array,
        *,
        payload: Payload | None = None,
        transmission: Array | None = None,
    ) -> GainFactor:
        """Reduce a recording.

        Args:
            model: the robot without payload.
            samples: its motion, and which rows count; its torque is not used. A motor's row
                counts where the rows of all joints it acts on count.
            motor_current: (m, n) [A], in the rows of the samples.
            payload: what the robot carried.
            transmission: motors' angles per joint angle (n, n); identity: motors are joints, and
                gains include the gear ratio.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        n, p, m = model.n_joints, model.n_parameters, len(samples.motion.time)
        turns = np.eye(n) if transmission is None else np.asarray(transmission, dtype=np.float64)
        if turns.shape != (n, n):
            raise ShapeError("transmission", turns.shape, f"({n}, {n})")
        if motor_current.shape != (m, n):
            raise ShapeError("motor_current", motor_current.shape, f"({m}, {n})")
        blocks, columns = samples.regressor(model)
        load = _load(model, payload, samples)
        edges = _block_edges(samples.motion.time)
        count = len(edges) - 1
        gram, rows = np.zeros((count, n, p + 2, p + 2)), np.zeros((count, n), dtype=np.intp)
        for motor, share in enumerate(np.linalg.inv(turns).T):
            acting = np.flatnonzero(share).tolist()
            counts = np.asarray(samples.usable[:, acting].all(axis=1))
            table = np.zeros((m, p + 2))
            for joint in acting:
                table[:, columns[joint]] += share[joint] * blocks[joint]
                table[:, p] += share[joint] * samples.as_measured(joint, load[:, [joint]])[:, 0]
            table[:, p + 1] = motor_current[:, motor]
            table[~counts] = 0.0
            for b, (start, stop) in enumerate(pairwise(edges)):
                part = table[start:stop]
                gram[b, motor] = part.T @ part
                rows[b, motor] = np.count_nonzero(counts[start:stop])
        return cls(gram, rows, model.parameter_names)

    def __add__(self, other: GainFactor) -> GainFactor:
        """Return the factor of both recordings; their blocks stay apart.

        Raises:
            IdentificationError: they belong to different models.
        """
        if self.parameter_names != other.parameter_names or self.n_motors != other.n_motors:
            raise IdentificationError("gain factors of different models cannot be added")
        return GainFactor(
            np.concatenate([self.gram, other.gram]),
            np.concatenate([self.rows, other.rows]),
            self.parameter_names,
        )

    @property
    def n_motors(self) -> int:
        """Number n of motors."""
        return int(self.gram.shape[1])

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return len(self.parameter_names)


def _load(model: RobotModel, payload: Payload | None, samples: Samples) -> Array:
    """Known torque (m, n): of what was carried, of springs and balancers."""
    known = model.elements.known(samples.motion.position)
    if payload is None:
        return known
    return known + Load(model.chain, model.gravity, payload).torque(*samples.motion[1:4])


def _block_edges(time: Array) -> NDArray[np.intp]:
    width = max(FINE_BLOCK, float(time[-1] - time[0]) / _MOST_BLOCKS)
    index = np.floor((time - time[0]) / width + 1e-9).astype(np.intp)
    return np.searchsorted(index, np.arange(index[-1] + 2))
