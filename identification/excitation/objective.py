"""What a motion is to be good at: which parameters it excites, and what is known already."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.criteria import Criteria, log10_det_and_coupling
from identification.excitation.errors import DesignError
from identification.excitation.sampling import SAMPLE_PERIOD, midpoints
from identification.factor import Factor
from identification.model import RobotModel
from identification.motion import Motion
from identification.regressor import joint_arrays
from planner import Trajectory

Array = NDArray[np.float64]


class Measures(NamedTuple):
    """What a search needs to know of one motion.

    Attributes:
        log10_det: log10 of det / N^p, -inf where a parameter is not excited.
        coupling_index: I_c, inf where a parameter is not excited.
        torque: nominal joint torque (m, n) [N·m, N], None without nominal values.
    """

    log10_det: float
    coupling_index: float
    torque: Array | None


@dataclass(frozen=True, eq=False)
class Objective:
    """Judges motions by the information on a model's parameters.

    The paper's criteria are those of all parameters, unweighted (section 3.1) and without
    anything known before. For a sequential design the information of earlier archives is added
    to that of the new motion, which then does best where the earlier ones said least.

    Attributes:
        model: the robot, with p parameters.
        parameters: indices of the essential ones (e,): the others are taken to be zero, so that
            their columns are left out. None for all.
        joint_weights: 1 / variance of each joint's torque (n,). None leaves joints unweighted.
        earlier: Gram matrix (p, p) of earlier archives, all parameters, weighted alike, and as
            if sampled every SAMPLE_PERIOD: one of 1 kHz is to be divided by 8. It is scaled to
            the sampling of each motion, so that a second of either counts alike.
        earlier_samples: N, the time samples in it, at the same rate.
        repetitions: how often the new motion is going to be run. It matters beside `earlier`
            only: repeating everything changes neither criterion (section 3.2).

    Raises:
        ShapeError: an array does not have the shape it should have.
        DesignError: values that mean nothing.
    """

    model: RobotModel
    parameters: NDArray[np.intp] | None = None
    joint_weights: Array | None = None
    earlier: Array | None = None
    earlier_samples: int = 0
    repetitions: int = 1

    def __post_init__(self) -> None:
        n, p = self.model.n_joints, self.model.n_parameters
        if self.parameters is not None:
            self._set("parameters", np.asarray(self.parameters, dtype=np.intp))
            _check_indices(np.asarray(self.parameters), p)
        for name, shape in (("joint_weights", (n,)), ("earlier", (p, p))):
            if (given := getattr(self, name)) is not None:
                array = np.asarray(given, dtype=np.float64)
                if array.shape != shape:
                    raise ShapeError(name, array.shape, str(shape))
                if not np.all(np.isfinite(array)):
                    raise DesignError(name, "not finite", "finite numbers")
                self._set(name, array)
        if self.joint_weights is not None and not np.all(self.joint_weights > 0.0):
            raise DesignError("joint_weights", self.joint_weights.tolist(), "above 0")
        if self.repetitions < 1:
            raise DesignError("repetitions", self.repetitions, "1 or more")
        if self.earlier_samples < 0 or (self.earlier is None) != (self.earlier_samples == 0):
            raise DesignError(
                "earlier_samples", self.earlier_samples, "the samples in `earlier`, 0 without it"
            )

    @property
    def n_parameters(self) -> int:
        """Number e of parameters that are judged: the p of the coupling index's maximum."""
        return self.model.n_parameters if self.parameters is None else len(self.parameters)

    def gram(self, factor: Factor, period: float = SAMPLE_PERIOD) -> Array:
        """Return the information (e, e) on the essential parameters, earlier archives included.

        Args:
            factor: of the new motion.
            period: between its samples [s].
        """
        each = factor.gram[:, :-1, :-1]
        weights = self.joint_weights
        new: Array = each.sum(axis=0) if weights is None else np.tensordot(weights, each, axes=1)
        return self._with_earlier(new, period)

    def n_samples(self, new: int, period: float = SAMPLE_PERIOD) -> int:
        """Return N of :meth:`gram` for a motion of `new` time samples, `period` [s] apart."""
        if self.earlier is None:
            return new
        return self.repetitions * new + round(SAMPLE_PERIOD / period * self.earlier_samples)

    def measures(self, motion: Motion, values: Array | None = None) -> Measures:
        """Judge a sampled motion in one pass over its regressor.

        Args:
            motion: m samples, uniform in time; `midpoints` of a planned motion.
            values: nominal values (p,) of all parameters; the torque is computed from them.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        new, torque = self._reduced(motion, values)
        step = _step(motion)
        gram, n = self._with_earlier(new, step), self.n_samples(motion.n_samples, step)
        return Measures(*log10_det_and_coupling(gram, n), torque)

    def criteria(self, trajectory: Trajectory, period: float) -> Criteria:
        """Return all criteria of a planned motion, in N = duration / `period` samples."""
        motion = midpoints(trajectory, period)
        new, _ = self._reduced(motion, None)
        step = _step(motion)
        return Criteria.of_gram(
            self._with_earlier(new, step), self.n_samples(motion.n_samples, step)
        )

    def _reduced(self, motion: Motion, values: Array | None) -> tuple[Array, Array | None]:
        """Return the weighted Gram matrix (p, p), and the torque (m, n) if values are given."""
        model = self.model
        n, p = model.n_joints, model.n_parameters
        if values is not None and np.shape(values) != (p,):
            raise ShapeError("values", np.shape(values), f"({p},)")
        states = joint_arrays(
            n,
            position=motion.position,
            velocity=motion.velocity,
            acceleration=motion.acceleration,
        )
        columns = model.plan.columns
        sums = [np.zeros((len(used), len(used))) for used in columns]
        torque = None if values is None else np.empty((n, len(states[0])))
        for part, rows in model.plan.chunks(*states):
            for joint, block in enumerate(rows):
                sums[joint] += block @ block.T
                if torque is not None and values is not None:
                    np.matmul(values[columns[joint]], block, out=torque[joint, part])
        total = np.zeros((p, p))
        weights = np.ones(n) if self.joint_weights is None else self.joint_weights
        for joint, place in enumerate(self._places):
            total[place] += weights[joint] * sums[joint]
        return total, None if torque is None else torque.T

    def _with_earlier(self, new: Array, period: float) -> Array:
        total = new
        if self.earlier is not None:
            total = self.repetitions * new + SAMPLE_PERIOD / period * self.earlier
        return total if self.parameters is None else total[np.ix_(self.parameters, self.parameters)]

    @cached_property
    def _places(self) -> list[tuple[NDArray[np.intp], ...]]:
        """Where each joint's columns stand in the Gram matrix."""
        return [np.ix_(used, used) for used in self.model.plan.columns]

    def _set(self, name: str, array: NDArray[np.generic]) -> None:
        object.__setattr__(self, name, array)


def _step(motion: Motion) -> float:
    """Return the time between samples that are uniform in time [s]."""
    steps = max(1, motion.n_samples - 1)
    return float(motion.time[-1] - motion.time[0]) / steps or SAMPLE_PERIOD


def _check_indices(indices: NDArray[np.intp], p: int) -> None:
    """Refuse what is no set of parameters.

    Raises:
        ShapeError: not a row of indices.
        DesignError: none, one twice, or one that does not exist.
    """
    if indices.ndim != 1:
        raise ShapeError("parameters", indices.shape, "(e,)")
    unique = np.unique(indices)
    if len(unique) == 0 or len(unique) < len(indices) or unique[0] < 0 or unique[-1] >= p:
        raise DesignError("parameters", indices.tolist(), f"different indices from 0 to {p - 1}")
