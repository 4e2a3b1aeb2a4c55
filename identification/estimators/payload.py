r"""Payload on the flange, from recordings without and with it.

One weighted least-squares problem over all recordings. The arm's parameters are shared, the ten
parameters of a body at the flange act in loaded recordings only, and each recording k has its own
offset and friction scale of every joint:

.. math:: \tau = W \pi + [\text{loaded}]\, L \beta + \delta_k + \varphi_k \odot f, \qquad
          f = W_f \hat\pi_f

The friction f is that of the previous iteration, with weak priors (:data:`DRIFT`) on the drifts.
The covariance is cluster-robust by time of the motion. The result is the physically consistent body
closest to the estimate; undetermined inertias are those of a reference body.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.distributions import fisher_tail
from identification.errors import IdentificationError
from identification.estimators.covariance import Clustered, cluster_covariance
from identification.factor.factor import NormalEquations, mark_undetermined, no_rows_message, solve
from identification.factor.phases import (
    FINE_BLOCK,
    PhaseFactor,
    add_grams,
    equal_runs,
    fine_blocks,
    samples_by_cell,
)
from identification.model.pseudo_inertia import (
    Body,
    body,
    inertial_from_pseudo,
    inertial_parameters,
    pseudo_inertia,
    pseudo_inertia_map,
)
from identification.model.regressor import LINK_SYMBOLS, RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

DRIFT: Final = 0.1
"""Prior standard deviation of the relative change of friction between recordings."""
_OFFSET: Final = 1.0  # prior standard deviation of offset changes, as a share of the friction
_BODY: Final = len(LINK_SYMBOLS)
_WEIGHT: Final = np.arange(6, _BODY)  # mass and first moment
_INERTIA: Final = np.arange(6)
_DIAGONAL: Final = [4, 7, 9]  # of a tensor, among `NAMES`
_ROUNDS: Final = 4  # iterations of weights and friction
_MOST_BLOCKS: Final = 500
# Longer blocks: with noise correlated over 50 ms nominal 95 % intervals cover 93 and 95 %,
# otherwise 90 and 93 %.
_STRETCH: Final = 2
_LEAST_NOISE: Final = 1e-6  # rounding of the Gram matrix, as a share of the torque
_PARTICIPATION: Final = 1e-3
_ROUNDING: Final = 1e-9
_UNDETERMINED: Final = 1e12  # variance of the undetermined part
_DENSITY: Final = 1000.0  # kg/m³, of the reference ball
# Different bodies: probability by chance, and share of the torque.
_LEAST_PROBABILITY: Final = 1e-4
_LEAST_SHARE: Final = 0.1
_OFF_DIAGONAL: Final = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])

NAMES: Final = ("mass", "cx", "cy", "cz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Figures of a body: mass, centre of mass, inertia tensor about it."""


def figures_of(carried: Body) -> Array:
    """Return the figures of a body (10,), as `NAMES`."""
    tensor = carried.inertia[np.triu_indices(3)]
    return np.concatenate([[carried.mass], carried.centre, tensor])


class PayloadError(IdentificationError):
    """The recordings do not determine a payload."""


@dataclass(frozen=True, eq=False)
class Run:
    """Reduced recording."""

    name: str
    phase: PhaseFactor  # parameters of the arm, of the body (10), and offsets of the joints (n)
    loaded: bool  # whether the arm carried the body

    @classmethod
    def of(
        cls, name: str, model: RobotModel, samples: Samples, frame: str | None, *, loaded: bool
    ) -> Run:
        """Reduce a recording of an arm without payload; the body is at a frame or the last joint.

        Raises:
            ModelError: the description has no such frame, or it is fixed to the base.
        """
        joint, rotation, translation = model.chain.frame(frame)
        moved, p = _moved(rotation, translation), model.n_parameters
        plan = RegressorPlan.of_bodies(model.chain, model.gravity, joint)
        blocks, columns = samples.regressor(model)
        loads = plan.evaluate(*samples.motion[1:4])
        index = fine_blocks(samples)
        grams, places = [], []
        for j, block in enumerate(blocks):
            load = loads.blocks[j] @ moved[loads.columns[j]]
            beside = np.column_stack([load, np.ones(len(block))])
            rows = [block, samples.as_measured(j, beside), samples.torque[:, [j]]]
            table = np.concatenate(rows, axis=1).T
            table[:, ~samples.usable[:, j]] = 0.0
            gram = np.zeros((int(index[-1]) + 1, len(table), len(table)))
            add_grams(gram, table, equal_runs(index))
            grams.append(gram)
            own = p + np.arange(load.shape[1])
            places.append(np.concatenate([columns[j], own, [p + _BODY + j]]))
        names = (
            *model.parameter_names,
            *LINK_SYMBOLS,
            *(f"offset of {joint}" for joint in model.joint_names),
        )
        counts = samples_by_cell(index, samples.usable)
        return cls(name, PhaseFactor(tuple(grams), tuple(places), counts, names), loaded)


@dataclass(frozen=True, eq=False)
class Difference:
    """Recording with another payload than the first of its kind."""

    run: Run
    reference: Run
    mass: float  # mass difference [kg]


@dataclass(frozen=True, eq=False)
class PayloadEstimate:
    """Payload of the arm at a frame."""

    parameters: Array  # about the frame's origin (10,), as `LINK_SYMBOLS`, unconstrained
    covariance: Array  # (10, 10), cluster-robust; infinite variance if undetermined
    interval_factor: float  # standard deviations in half a 95 % interval
    body: Body | None  # closest consistent body; None without significant mass
    # 95 % intervals of `NAMES` (10, 2), including `body`; infinite if undetermined
    intervals: Array
    # mass times distance of centre from the frame's origin [kg m], and interval
    moment: tuple[float, float, float]
    undetermined: tuple[str, ...]  # undetermined figures, those of the reference body
    contradicted: bool  # whether no consistent body fits the recordings to their noise
    method: str  # description of the covariance


def identify_payload(
    model: RobotModel, runs: Sequence[Run], box: tuple[float, float, float] | None = None
) -> PayloadEstimate:
    """Estimate the body that the loaded recordings carry and the bare ones do not.

    `box`: edges of the uniform reference body [m] along the axes of the frame; None: a point.

    Raises:
        PayloadError: undetermined mass, or negative mass.
        IdentificationError: no usable row.
    """
    found = _body_estimate(model, runs)
    values, factor = found.values, found.factor
    mass, low, high = found.mass
    if not np.isfinite(high):
        raise PayloadError(
            "the motion does not separate the mass from other parameters; record one that moves"
            " more axes, with the wrist in many poses"
        )
    if high < 0.0:
        raise PayloadError(
            f"the bare recordings carry {-mass:.3g} kg more than the loaded ones; check whether"
            " they are interchanged"
        )
    intervals = np.tile([-np.inf, np.inf], (_BODY, 1))
    intervals[0] = max(0.0, low), high
    estimate = PayloadEstimate(
        parameters=values,
        covariance=found.full_covariance,
        interval_factor=factor,
        body=None,
        intervals=intervals,
        moment=found.moment,
        undetermined=NAMES[1:],
        contradicted=False,
        method=found.words,
    )
    if low <= 0.0:
        return estimate
    reference = _reference(mass, box)
    intervals[1:4] = found.centre_intervals
    to_centre = _moved(np.eye(3), -values[6:9] / mass)[_INERTIA]
    middle, halves = to_centre @ values, factor * found.std(to_centre)
    lower, upper = _off_centre(mass, (intervals[1:4, 1] - intervals[1:4, 0]) / 2.0)
    intervals[4:] = np.column_stack([middle - halves - lower, middle + halves + upper])
    intervals[_DIAGONAL] = np.maximum(intervals[_DIAGONAL], 0.0)
    width, usual = (intervals[:, 1] - intervals[:, 0]) / 2.0, mass * reference.tensor
    open_ended = width > np.repeat([np.inf, reference.inertia], [4, 6])
    open_ended[1:4] = np.isinf(width[1:4])
    open_ended[4:] &= (intervals[4:, 0] <= usual) & (usual <= intervals[4:, 1])
    consistent, misfit = _closest_body(found, reference)
    figures = figures_of(consistent)[:, None]
    intervals[:, :1] = np.minimum(intervals[:, :1], figures)
    intervals[:, 1:] = np.maximum(intervals[:, 1:], figures)
    chance = _tail_probability(misfit, len(found.determined), found.blocks - len(found.determined))
    return replace(
        estimate,
        body=consistent,
        undetermined=tuple(np.array(NAMES)[open_ended].tolist()),
        contradicted=chance < _LEAST_PROBABILITY,
    )


def mass_difference(model: RobotModel, runs: Sequence[Run]) -> tuple[float, float, float]:
    """Return the mass difference of loaded to bare recordings [kg], and its 95 % interval.

    Raises:
        IdentificationError: no usable row.
    """
    return _body_estimate(model, runs).mass


def find_difference(model: RobotModel, runs: Sequence[Run]) -> Difference | None:
    """Return the recording with the largest difference to the first of its kind, if significant.

    Raises:
        IdentificationError: no usable row.
    """
    first = {kind: next((r for r in runs if r.loaded == kind), None) for kind in (False, True)}
    others = [run for run in runs if run not in first.values()]
    if not others:
        return None
    carried = [[run.loaded for run in runs], *([run is other for run in runs] for other in others)]
    fit = _fit(model, runs, carried, [np.eye(_BODY)] * len(carried))
    found: list[tuple[float, Difference]] = []
    for other, part in zip(others, fit.bodies[1:], strict=True):
        reference = first[other.loaded]
        assert reference is not None
        weight = part[_WEIGHT]
        delta, own = fit.values[weight], fit.clustered.covariance[np.ix_(weight, weight)]
        known = np.flatnonzero(np.isfinite(np.diag(own)))
        squares = float(delta[known] @ np.linalg.pinv(own[np.ix_(known, known)]) @ delta[known])
        chance = _tail_probability(squares, len(known), fit.clustered.blocks - len(known))
        share = _torque_share(model, other, delta, fit.values[fit.bodies[0]][_WEIGHT], fit.weights)
        if chance < _LEAST_PROBABILITY / len(others) and share > _LEAST_SHARE:
            found.append((squares, Difference(other, reference, float(delta[-1]))))
    return max(found, key=lambda one: one[0])[1] if found else None


# Joint index in one run, Gram matrices (B, c + 1, c + 1), and indices of the unknowns.
_Rows = tuple[int, Array, NDArray[np.intp]]


class _Fit(NamedTuple):
    """Solution of the joint problem."""

    values: Array  # of all unknowns
    bodies: list[NDArray[np.intp]]  # indices of each body's parameters
    root: Array  # of the inverse information, determined part
    scale: Array  # length of each column
    clustered: Clustered  # covariance
    weights: Array  # inverse variances of the joints (n,)

    def determined(self, part: NDArray[np.intp]) -> Array:
        """Return determined combinations (r, k) of k unknowns, in comparable units."""
        scale = np.where(self.scale > 0.0, self.scale, 1.0)
        basis = self.root * scale[:, None]
        basis = basis[part] / np.linalg.norm(basis, axis=0)
        lost, axes = np.linalg.eigh(np.eye(len(part)) - basis @ basis.T)
        axes = np.where(np.abs(axes) < _ROUNDING, 0.0, axes)
        return np.asarray(axes[:, lost < _PARTICIPATION**2].T * scale[part])


def _fit(
    model: RobotModel, runs: Sequence[Run], carried: list[list[bool]], shapes: list[Array]
) -> _Fit:
    """Solve the joint problem."""
    rows = np.sum([run.phase.samples.sum(axis=0) for run in runs], axis=0)
    if not rows.any():
        raise IdentificationError(no_rows_message(model))
    p, n = model.n_parameters, model.n_joints
    edges = p + np.cumsum([0, *(shape.shape[1] for shape in shapes)])
    bodies = [np.arange(a, b) for a, b in pairwise(edges.tolist())]
    width = int(edges[-1]) + 2 * n * len(runs)
    drifts = int(edges[-1]) + np.arange(2 * n * len(runs)).reshape(len(runs), 2, n)
    layout = _Layout(width, bodies, shapes, carried, drifts)
    weights, friction, values = np.ones(n), np.zeros(p), np.zeros(width)
    totals = [run.phase.merged(max(1, len(run.phase))) for run in runs]
    for _ in range(_ROUNDS):
        problem = layout.rows(model, totals, friction)
        prior = layout.prior(problem, weights, rows)
        values = solve(_normal(layout.total(problem, weights)[0], prior)).values
        weights = _weights(problem, values, rows)
        friction = np.where(model.friction_columns, values[:p], 0.0)
    length = max(1, -(-max(len(run.phase) for run in runs) // _MOST_BLOCKS))
    problem = layout.rows(model, [run.phase.merged(length) for run in runs], friction)
    # The prior is not scaled; the data are, by the design effect of coloured noise.
    effect = 1.0
    for _ in range(2):
        own = weights / effect
        prior = layout.prior(problem, own, rows)
        blocks = layout.total(problem, own)
        equations = _normal(blocks.sum(axis=0), prior)
        solution = solve(equations)
        scores = blocks[:, :-1] @ np.append(-solution.values, 1.0)
        clustered = cluster_covariance(
            blocks[:, :-1, :-1], scores, solution, prior, length * FINE_BLOCK, _STRETCH
        )
        effect *= max(1.0, clustered.design_effect)
    scale = np.sqrt(np.diag(equations.A))
    return _Fit(solution.values, bodies, solution.root, scale, clustered, weights)


class _Layout(NamedTuple):
    """Order of the unknowns: arm, bodies, then offsets and friction scales by run."""

    width: int  # number of unknowns
    bodies: list[NDArray[np.intp]]  # places of each body's
    shapes: list[Array]  # ten parameters by unknowns of each (10, r)
    carried: list[list[bool]]  # runs of each
    drifts: NDArray[np.intp]  # indices of offsets and friction scales (R, 2, n)

    def rows(
        self, model: RobotModel, phases: Sequence[PhaseFactor], friction: Array
    ) -> list[_Rows]:
        """Return Gram matrices over the unknowns, with the friction (p,) that is scaled."""
        p, found = model.n_parameters, []
        for k, phase in enumerate(phases):
            for joint, (gram, columns) in enumerate(zip(phase.gram, phase.columns, strict=True)):
                c = len(columns)
                mapping = np.zeros((c + 1, self.width + 1))
                mapping[c, -1] = 1.0
                arm = np.flatnonzero(columns < p)
                mapping[arm, columns[arm]] = 1.0
                mapping[arm, self.drifts[k, 1, joint]] = friction[columns[arm]]
                mapping[c - 1, self.drifts[k, 0, joint]] = 1.0
                if c - 1 > len(arm):
                    ten = slice(len(arm), len(arm) + _BODY)
                    for part, shape, acts in zip(
                        self.bodies, self.shapes, self.carried, strict=True
                    ):
                        if acts[k]:
                            mapping[ten, part] = shape
                used = np.flatnonzero(mapping.any(axis=0))
                small = mapping[:, used]
                found.append((joint, small.T @ gram @ small, used))
        return found

    def prior(self, problem: Sequence[_Rows], weights: Array, rows: NDArray[np.intp]) -> Array:
        """Return the information on each unknown (width,), of offsets and friction scales."""
        n = self.drifts.shape[2]
        squares = np.zeros(n)
        for joint, gram, places in problem:
            at = np.flatnonzero(np.isin(places, self.drifts[:, 1, joint]))
            squares[joint] += gram[:, at, at].sum()
        noise = np.divide(1.0, weights, out=np.zeros(n), where=weights > 0.0)
        level = np.maximum(squares / np.maximum(rows, 1), noise)
        prior = np.zeros(self.width)
        prior[self.drifts[:, 0]] = np.divide(
            1.0, _OFFSET**2 * level, out=np.zeros(n), where=level > 0.0
        )
        prior[self.drifts[:, 1]] = 1.0 / DRIFT**2
        return prior

    def total(self, problem: Sequence[_Rows], weights: Array) -> Array:
        """Return weighted Gram matrices of all joints and runs (B, width + 1, width + 1)."""
        count = max(len(gram) for _, gram, _ in problem)
        whole = np.zeros((count, self.width + 1, self.width + 1))
        for joint, gram, places in problem:
            whole[: len(gram), places[:, None], places] += weights[joint] * gram
        return whole


def _normal(total: Array, prior: Array) -> NormalEquations:
    return NormalEquations(total[:-1, :-1] + np.diag(prior), total[:-1, -1], total[-1, -1], 0)


def _weights(problem: Sequence[_Rows], values: Array, rows: NDArray[np.intp]) -> Array:
    """Return inverse variances of the residuals (n,), zero without rows."""
    squares, torque = np.zeros(len(rows)), np.zeros(len(rows))
    augmented = np.append(-values, 1.0)
    for joint, gram, places in problem:
        total, own = gram.sum(axis=0), augmented[places]
        squares[joint] += own @ total @ own
        torque[joint] += total[-1, -1]
    squares = np.maximum(squares, _LEAST_NOISE**2 * torque)
    return np.divide(rows, squares, out=np.zeros(len(rows)), where=squares > 0.0)


class _BodyEstimate(NamedTuple):
    """Ten parameters of a body, as far as they are determined."""

    values: Array  # (10,)
    determined: Array  # determined combinations (r, 10)
    spread: Array  # covariance of those (r, r)
    factor: float  # standard deviations in half a 95 % interval
    blocks: int  # of time
    words: str  # how

    def covariance(self, rows: Array) -> Array:
        """Return the covariance of functions (k, 10) of the parameters, determined part (k, k)."""
        own = rows @ np.linalg.pinv(self.determined)
        return np.asarray(own @ self.spread @ own.T)

    def _undetermined_part(self, rows: Array) -> tuple[Array, Array]:
        """Return the undetermined part of functions (k, 10), and the functions, in equal units."""
        scale = np.linalg.norm(self.determined, axis=0)
        scale = np.where(scale > 0.0, scale, 1.0)
        seen = rows @ np.linalg.pinv(self.determined) @ self.determined
        return (rows - seen) / scale, rows / scale

    def std(self, rows: Array) -> Array:
        """Return standard deviations of functions (k, 10), infinite if undetermined."""
        lost, scaled = self._undetermined_part(rows)
        known = np.linalg.norm(lost, axis=1) < _PARTICIPATION * np.linalg.norm(scaled, axis=1)
        return np.where(known, np.sqrt(np.diag(self.covariance(rows))), np.inf)

    def principal(self, rows: Array) -> tuple[Array, Array]:
        """Return uncorrelated combinations (k, 10) of k functions, and half intervals (k,)."""
        lost, scaled = self._undetermined_part(rows)
        lost = lost / max(float(np.linalg.norm(scaled)), np.finfo(np.float64).tiny)
        variance, axes = np.linalg.eigh(self.covariance(rows) + _UNDETERMINED * lost @ lost.T)
        return axes.T @ rows, self.factor * np.sqrt(np.maximum(variance, 0.0))

    @property
    def full_covariance(self) -> Array:
        """Covariance of the parameters (10, 10), with infinite variances."""
        covariance = self.covariance(np.eye(_BODY))
        mark_undetermined(covariance, np.isfinite(self.std(np.eye(_BODY))))
        return covariance

    @property
    def mass(self) -> tuple[float, float, float]:
        """Mass and its interval [kg], infinite if undetermined."""
        value, half = float(self.values[9]), self.factor * float(self.std(np.eye(_BODY)[[9]])[0])
        return value, value - half, value + half

    @property
    def moment(self) -> tuple[float, float, float]:
        """Length of the first moment and its interval [kg m]."""
        first = self.values[6:9]
        length = float(np.linalg.norm(first))
        row = np.zeros((1, _BODY))
        row[0, 6:9] = first / length if length > 0.0 else 1.0 / np.sqrt(3.0)
        half = self.factor * float(self.std(row)[0])
        return length, max(0.0, length - half), length + half

    @property
    def centre_intervals(self) -> Array:
        """95 % intervals of the centre (3, 2), a ratio (Fieller 1954)."""
        known = np.isfinite(self.std(np.eye(_BODY)))
        covariance = self.factor**2 * self.covariance(np.eye(_BODY))
        first, mass = self.values[6:9], self.values[9]
        a = mass**2 - covariance[9, 9]
        b = first * mass - covariance[9, 6:9]
        c = first**2 - np.diag(covariance)[6:9]
        root = np.where(known[6:9], np.sqrt(np.maximum(b**2 - a * c, 0.0)), np.inf)
        return np.column_stack([(b - root) / a, (b + root) / a])


def _body_estimate(model: RobotModel, runs: Sequence[Run]) -> _BodyEstimate:
    """Estimate the body of the loaded runs, of least norm where undetermined."""
    carried = [[run.loaded for run in runs]]
    fit = _fit(model, runs, carried, [np.eye(_BODY)])
    determined: Array = fit.determined(fit.bodies[0])
    if len(determined) < _BODY:
        fit = _fit(model, runs, carried, [np.asarray(np.linalg.pinv(determined))])
    else:
        determined = np.eye(_BODY)
    part = fit.bodies[0]
    return _BodyEstimate(
        values=np.linalg.pinv(determined) @ fit.values[part],
        determined=determined,
        spread=fit.clustered.covariance[np.ix_(part, part)],
        factor=fit.clustered.interval_factor,
        blocks=fit.clustered.blocks,
        words=fit.clustered.words,
    )


def _off_centre(mass: float, reach: Array) -> tuple[Array, Array]:
    """Return how much smaller and larger a tensor may be (6,), (6,) by centre errors (3,)."""
    with np.errstate(invalid="ignore"):
        products = mass * np.nan_to_num(np.outer(reach, reach), nan=np.inf, posinf=np.inf)
    xx, xy, xz, yy, yz, zz = products[np.triu_indices(3)]
    off_diagonal = np.array([0.0, xy, xz, 0.0, yz, 0.0])
    return off_diagonal + np.array([yy + zz, 0.0, 0.0, xx + zz, 0.0, xx + yy]), off_diagonal


class _ReferenceBody(NamedTuple):
    """Body that replaces what the motion does not determine."""

    tensor: Array  # about its centre, per kg (6,) [m²]
    inertia: float  # limit [kg m²]
    length: float  # limit [m]


def _reference(mass: float, box: tuple[float, float, float] | None) -> _ReferenceBody:
    """Return the reference: a point, with limits of a water ball of its mass, or a box."""
    if box is None:
        radius = (3.0 * mass / (4.0 * np.pi * _DENSITY)) ** (1.0 / 3.0)
        return _ReferenceBody(np.zeros(6), 0.4 * mass * radius**2, radius)
    x, y, z = (edge**2 / 12.0 for edge in box)
    tensor = np.array([y + z, 0.0, 0.0, x + z, 0.0, x + y])
    return _ReferenceBody(tensor, mass * float(tensor.max()), max(box) / 2.0)


def _closest_body(found: _BodyEstimate, reference: _ReferenceBody) -> tuple[Body, float]:
    """Return the consistent body closest to an estimate, and their squared distance."""
    import cvxpy  # slow import (0.3 s)

    cp: Any = cvxpy
    values = found.values
    size = np.sqrt(np.diag(found.spread))
    variance, vectors = np.linalg.eigh(found.spread / np.outer(size, size))
    rows = (vectors.T / np.sqrt(variance)[:, None] / size) @ found.determined
    centre = values[6:9] / values[9]
    about = _moved(np.eye(3), -centre)[_INERTIA]
    about[:, 9] -= reference.tensor
    about *= np.sqrt(_OFF_DIAGONAL)[:, None]
    # Scaled by the reference, or by what the recordings show significantly.
    along, half = found.principal(about)
    about /= np.sqrt(np.max((along @ values) ** 2 - half**2, initial=reference.inertia**2))
    # In units of the reference.
    mass, length = values[9], max(reference.length, float(np.linalg.norm(centre)))
    units = mass * np.repeat([length**2, length, 1.0], [6, 3, 1])
    x = cp.Variable(_BODY)
    entries = pseudo_inertia_map().reshape(_BODY, 16).T @ x
    matrix = cp.reshape(entries, (4, 4), order="C")
    error = cp.sum_squares((rows * units) @ x - rows @ values)
    prior = cp.sum_squares((about * units) @ x)
    problem = cp.Problem(cp.Minimize(error + prior), [matrix >> 0.0, x[9] >= 1e-3])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the status reports inaccuracy
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.error.SolverError as failure:
            raise PayloadError(f"no consistent body was found: {failure}") from failure
    if problem.status not in ("optimal", "optimal_inaccurate") or x.value is None:
        raise PayloadError(f"no consistent body was found: the solver ended with {problem.status}")
    near = body(np.asarray(x.value) * units)
    second = pseudo_inertia(inertial_parameters(Body(near.mass, np.zeros(3), near.inertia)))
    size, axes = np.linalg.eigh(second)  # within the solver's tolerance some are negative
    inside = inertial_from_pseudo((axes * np.maximum(size, 0.0)) @ axes.T)
    consistent = Body(near.mass, near.centre, body(inside).inertia)
    miss = rows @ (inertial_parameters(consistent) - values)
    return consistent, float(miss @ miss)


def _tail_probability(squares: float, dimensions: int, spare: int) -> float:
    """Return the probability of a larger squared distance, by Hotelling's T² over few blocks."""
    if spare < 1:
        return 1.0
    blocks = spare + dimensions
    return float(fisher_tail(squares * spare / (dimensions * blocks), dimensions, spare))


def _torque_share(model: RobotModel, run: Run, delta: Array, whole: Array, weights: Array) -> float:
    """Return the RMS torque of the weight of one body over that of another, in a run."""
    p = model.n_parameters
    squares = np.zeros(2)
    for weight, gram, columns in zip(weights, run.phase.gram, run.phase.columns, strict=True):
        at = np.flatnonzero((columns >= p + 6) & (columns < p + _BODY))
        if at.size:
            own = weight * gram[:, at[:, None], at].sum(axis=0)
            squares += delta @ own @ delta, whole @ own @ whole
    return float(np.sqrt(squares[0] / max(squares[1], np.finfo(np.float64).tiny)))


def _moved(rotation: Array, translation: Array) -> Array:
    """Return the map of inertial parameters (10, 10) to a frame in which theirs has this pose."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return np.asarray(inertial_from_pseudo(pose @ pseudo_inertia_map() @ pose.T).T)
