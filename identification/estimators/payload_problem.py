"""The joint problem of recordings without and with a body, see :mod:`.payload_estimate`.

Its unknowns are of arm and body, and drifts of each recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.covariance import Clustered, cluster_covariance
from identification.estimators.torque_scale import scale_sensitivity
from identification.factor.blocks import FINE_BLOCK, count_by_block
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import MIN_NOISE, Factor, no_rows_message
from identification.factor.normal_equations import MAX_UNDETERMINED_SHARE, NormalEquations, solve
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.pseudo_inertia import inertial_from_pseudo, pseudo_inertia_map
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

FRICTION_DRIFT_STD: Final = 0.1
"""Prior standard deviation of the relative change of friction between recordings."""
OFFSET_STD_SHARE: Final = 1.0
"""Prior standard deviation of offset changes, as a share of the friction."""
N_BODY_PARAMETERS: Final = len(LINK_SYMBOLS)
_WEIGHTING_ROUNDS: Final = 4  # iterations of weights and friction
_MAX_BLOCKS: Final = 500
# Longer blocks: with noise correlated over 50 ms nominal 95 % intervals cover 93 and 95 %,
# otherwise 90 and 93 %.
BLOCK_STRETCH: Final = 2
AXIS_ROUNDING: Final = 1e-9


@dataclass(frozen=True, eq=False)
class Run:
    """Reduced recording."""

    name: str
    factor: Factor  # parameters of the arm, of the body (10), and offsets of the joints (n)
    loaded: bool  # whether the arm carried the body

    @classmethod
    def of(
        cls, name: str, model: RobotModel, samples: Samples, frame: str | None, *, loaded: bool
    ) -> Run:
        """Reduce a recording of an arm without payload.

        Args:
            name: of the recording.
            model: of the arm.
            samples: of the recording.
            frame: of the body; by default the last joint.
            loaded: whether the arm carried it.

        Raises:
            ModelError: the description has no such frame, or it is fixed to the base.
        """
        joint, rotation, translation = model.chain.frame(frame)
        moved = about_frame(rotation, translation)
        p = model.n_parameters
        plan = RegressorPlan.of_bodies(model.chain, model.gravity, joint)
        blocks, columns = samples.regressor(model)
        loads = plan.evaluate(samples.motion.kinematics())
        index = samples.blocks(FINE_BLOCK)
        tables = []
        places = []
        for j, block in enumerate(blocks):
            load = loads.blocks[j] @ moved[loads.columns[j]]
            beside = np.column_stack([load, np.ones(len(block))])
            rows = [block, samples.as_measured(j, beside), samples.torque[:, [j]]]
            tables.append(np.concatenate(rows, axis=1).T)
            tables[-1][:, ~samples.usable[:, j]] = 0.0
            body_columns = p + np.arange(load.shape[1])
            places.append(np.concatenate([columns[j], body_columns, [p + N_BODY_PARAMETERS + j]]))
        names = (
            *model.parameter_names,
            *LINK_SYMBOLS,
            *(f"offset of {joint}" for joint in model.joint_names),
        )
        counts = count_by_block(index, samples.usable)
        factor = Factor.of_rows([(index, tables)], counts, tuple(places), names)
        return cls(name, factor, loaded)


@dataclass(frozen=True, eq=False)
class KnownArm:
    """Parameters of an arm without payload, as an earlier identification left them.

    It stands for bare recordings: friction of the loaded ones may have drifted from it.
    """

    values: Array  #: (p,)
    information: Array  #: inverse of their covariance (p, p)
    sensitivity: Array  #: change per relative change of each joint's torques (p, n)

    @classmethod
    def of(cls, factor: Factor, estimate: Estimate, prior: Array, design_effect: float) -> KnownArm:
        """Return the posterior of a factor and a prior.

        The covariance from few blocks cannot be inverted, so its information is that of the rows
        that count, and of the prior.

        Args:
            factor: of the recordings of the arm.
            estimate: from it.
            prior: its information (p, p).
            design_effect: rows that count as one.
        """
        weights = inverse_variance(estimate.noise_std**2) / design_effect
        information = factor.weighted(weights).A + prior
        scale = 1.0 / np.sqrt(np.diag(information))
        unit = np.linalg.inv(information * scale[:, None] * scale)
        sensitivity = scale_sensitivity(factor, weights, unit * scale[:, None] * scale)
        return cls(estimate.values, information, sensitivity)


# Joint index in one run, Gram matrices (B, c + 1, c + 1), and indices of the unknowns.
_Rows = tuple[int, Array, NDArray[np.intp]]


class BodyFit(NamedTuple):
    """Solution of the joint problem, and its part of the body."""

    values: Array  # (r,)
    root: Array  # of the inverse information, determined part (r, k)
    scale: Array  # length of each column (r,)
    covariance: Array  # (r, r)
    sensitivity: Array  # change per relative change of each joint's torques (r, n)
    clustered: Clustered
    part: NDArray[np.intp]  # places of the unknowns among those of the problem (r,)

    def interval_factors(self, rows: Array) -> Array:
        """Return standard deviations in half a 95 % interval of functions (d, r) of them."""
        whole = np.zeros((len(rows), len(self.clustered.root)))
        whole[:, self.part] = rows
        return self.clustered.interval_factors(whole)

    @property
    def determined(self) -> Array:
        """Determined combinations (d, r) of the unknowns, in comparable units."""
        scale = np.where(self.scale > 0.0, self.scale, 1.0)
        lost, axes = np.linalg.eigh(np.eye(len(scale)) - self.root @ self.root.T)
        axes = np.where(np.abs(axes) < AXIS_ROUNDING, 0.0, axes)
        return np.asarray(axes[:, lost < MAX_UNDETERMINED_SHARE**2].T * scale)


class _Problem:
    """Unknowns of all recordings together: arm, body, and drifts of each joint and recording.

    The arm's p parameters, r of the body of which `shape` (10, r) gives all ten, then offsets and
    friction scales.

    Attributes:
        rows: of each joint in all recordings (n,).
        part: places of the body's unknowns (r,).
        width: number of unknowns.

    Raises:
        IdentificationError: no usable row.
    """

    def __init__(
        self, model: RobotModel, runs: Sequence[Run], shape: Array, arm: KnownArm | None
    ) -> None:
        self.rows = np.sum([run.factor.samples for run in runs], axis=0)
        if not self.rows.any():
            raise IdentificationError(no_rows_message(model))
        n = model.n_joints
        p = model.n_parameters
        r = shape.shape[1]
        self._runs = runs
        self._shape = shape
        self._of_arm = p
        self.part = np.arange(p, p + r)
        # Offsets and friction scales of the runs (R, 2, n).
        self._drifts = p + r + np.arange(2 * n * len(runs)).reshape(len(runs), 2, n)
        self.width = p + r + self._drifts.size
        self._expected = np.zeros(self.width)
        self._information = np.zeros((self.width, self.width))
        if arm is not None:
            self._expected[:p] = arm.values
            self._information[:p, :p] = arm.information

    def grams(self, friction: Array, length: int | None = None) -> list[_Rows]:
        """Return Gram matrices over the unknowns, with the friction (p,) of the last iteration.

        Of blocks of this length, by default of one block for each recording.
        """
        grams = []
        for k, run in enumerate(self._runs):
            factor = run.factor.merged(length or max(1, len(run.factor)))
            for joint, (gram, columns) in enumerate(
                zip(factor.matrices, factor.columns, strict=True)
            ):
                c = len(columns)
                mapping = np.zeros((c + 1, self.width + 1))
                mapping[c, -1] = 1.0
                of_arm = np.flatnonzero(columns < self._of_arm)
                mapping[of_arm, columns[of_arm]] = 1.0
                mapping[of_arm, self._drifts[k, 1, joint]] = friction[columns[of_arm]]
                mapping[c - 1, self._drifts[k, 0, joint]] = 1.0
                if run.loaded and c - 1 > len(of_arm):
                    mapping[len(of_arm) : len(of_arm) + N_BODY_PARAMETERS, self.part] = self._shape
                used = np.flatnonzero(mapping.any(axis=0))
                small = mapping[:, used]
                grams.append((joint, small.T @ gram @ small, used))
        return grams

    def prior(self, grams: Sequence[_Rows], weights: Array) -> Array:
        """Return the information on the unknowns, of known arm, offsets and friction scales."""
        n = len(weights)
        squares = np.zeros(n)
        for joint, gram, places in grams:
            at = np.flatnonzero(np.isin(places, self._drifts[:, 1, joint]))
            squares[joint] += gram[:, at, at].sum()
        noise = np.divide(1.0, weights, out=np.zeros(n), where=weights > 0.0)
        level = OFFSET_STD_SHARE**2 * np.maximum(squares / np.maximum(self.rows, 1), noise)
        prior = np.zeros(self.width)
        prior[self._drifts[:, 0]] = np.divide(1.0, level, out=np.zeros(n), where=level > 0.0)
        prior[self._drifts[:, 1]] = 1.0 / FRICTION_DRIFT_STD**2
        return np.asarray(self._information + np.diag(prior))

    def blocks(self, grams: Sequence[_Rows], weights: Array) -> Array:
        """Return weighted Gram matrices of all joints and runs (B, width + 1, width + 1)."""
        count = max(len(gram) for _, gram, _ in grams)
        whole = np.zeros((count, self.width + 1, self.width + 1))
        for joint, gram, places in grams:
            whole[: len(gram), places[:, None], places] += weights[joint] * gram
        return whole

    def equations(self, total: Array, prior: Array) -> NormalEquations:
        """Return the normal equations of a weighted Gram matrix with a prior."""
        return NormalEquations(
            total[:-1, :-1] + prior, total[:-1, -1] + self._information @ self._expected
        )


def fit_body(
    model: RobotModel, runs: Sequence[Run], shape: Array, arm: KnownArm | None = None
) -> BodyFit:
    """Solve the joint problem for the r unknowns of the body.

    Args:
        model: of the arm.
        runs: the recordings.
        shape: ten parameters of the body by its unknowns (10, r).
        arm: what is known of it.

    Raises:
        IdentificationError: no usable row.
    """
    problem = _Problem(model, runs, shape, arm)
    p = model.n_parameters
    weights = np.ones(model.n_joints)
    friction = np.zeros(p)
    for _ in range(_WEIGHTING_ROUNDS):
        grams = problem.grams(friction)
        total = problem.blocks(grams, weights)[0]
        values = solve(problem.equations(total, problem.prior(grams, weights))).values
        weights = _weights(grams, values, problem.rows)
        friction = np.where(model.friction_columns, values[:p], 0.0)
    length = max(1, -(-max(len(run.factor) for run in runs) // _MAX_BLOCKS))
    grams = problem.grams(friction, length)
    # The prior is not scaled; the data are, by the design effect of coloured noise.
    effect = 1.0
    for _ in range(2):
        scaled = weights / effect
        prior = problem.prior(grams, scaled)
        blocks = problem.blocks(grams, scaled)
        equations = problem.equations(blocks.sum(axis=0), prior)
        solution = solve(equations)
        scores = blocks[:, :-1] @ np.append(-solution.values, 1.0)
        clustered = cluster_covariance(
            blocks[:, :-1, :-1], scores, solution, prior, length * FINE_BLOCK, BLOCK_STRETCH
        )
        effect *= max(1.0, clustered.design_effect)
    scale = np.sqrt(np.diag(equations.A))
    basis = solution.root * np.where(scale > 0.0, scale, 1.0)[:, None]
    pulls = np.zeros((problem.width, model.n_joints))
    for joint, gram, places in grams:
        pulls[places[:-1], joint] += scaled[joint] * gram.sum(axis=0)[:-1, -1]
    if arm is not None:
        pulls[:p] += arm.information @ arm.sensitivity
    part = problem.part
    return BodyFit(
        values=solution.values[part],
        root=basis[part] / np.linalg.norm(basis, axis=0),
        scale=scale[part],
        covariance=clustered.covariance[np.ix_(part, part)],
        sensitivity=solution.root[part] @ (solution.root.T @ pulls),
        clustered=clustered,
        part=part,
    )


def _weights(grams: Sequence[_Rows], values: Array, rows: NDArray[np.intp]) -> Array:
    """Return inverse variances of the residuals (n,), zero without rows."""
    squares = np.zeros(len(rows))
    torque = np.zeros(len(rows))
    augmented = np.append(-values, 1.0)
    for joint, gram, places in grams:
        total = gram.sum(axis=0)
        run_values = augmented[places]
        squares[joint] += run_values @ total @ run_values
        torque[joint] += total[-1, -1]
    squares = np.maximum(squares, MIN_NOISE**2 * torque)
    return np.divide(rows, squares, out=np.zeros(len(rows)), where=squares > 0.0)


def about_frame(rotation: Array, translation: Array) -> Array:
    """Return the map of inertial parameters (10, 10) to a frame in which theirs has this pose."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return np.asarray(inertial_from_pseudo(pose @ pseudo_inertia_map() @ pose.T).T)
