r"""The constant delay between a torque or current channel and the positions, axis by axis.

The torque of axis j was logged d_j later than the position it belongs to:

.. math:: \tau_j(t) = W_j\bigl(q, \dot q, \ddot q\bigr)(t - d_j)\,\pi + e_j(t)

The regressor is evaluated on the smoothing spline at shifted times, so that a delay may be any
fraction of a cycle. Profiles of the residual find each axis's valley
(:mod:`identification.delay_grid`); Gauss-Newton steps on parameters and delays together, with the
columns :math:`-d\tau_j/dt`, find its floor. An axis that has another valley no less deep, as far as
the noise tells, or none before the end of the range, is not determined.
Parameters and delays are estimated jointly because they can be taken for one another: a delayed
acceleration looks like viscous friction when the motion has one frequency only.

Noise on the positions alone does not bias the delay: the smoother is symmetric in time, and what
is left of the noise is uncorrelated with its own derivative. In closed loop the servo answers that
noise with torque, and the two are correlated. Hence the positions are smoothed more than for a
fit, which takes such noise out of the accelerations' slope: see `DELAY_BANDWIDTH`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.covariance import block_length, spread
from identification.delay_grid import DelayGrid
from identification.estimation import Solution, estimate, solve
from identification.factor import Factor, NormalEquations
from identification.model import RobotModel
from identification.motion import Motion
from identification.noise import difference_variance
from identification.phase_factor import FINE_BLOCK
from identification.preprocessing import Preprocessing, Samples, prepare
from identification.quantiles import normal_limit, student_limit
from identification.recording import Recording
from identification.smoothing_spline import ORDER, SmoothingSpline, fit_smoothing_spline

Array = NDArray[np.float64]

LONGEST_DELAY: Final = 0.05  # s, either way
# On the simulated NS 16 (true delay 0.2 cycles of 1 ms, encoder noise in the loop, six axes moving
# at 0.5 to 3 Hz) the mean over seeds is 0.04 to 0.16 at 40 Hz, 0.16 to 0.21 at 15 Hz; at 10 Hz the
# wrist's own motion is being smoothed away, and it is 0.18 to 0.44.
DELAY_BANDWIDTH: Final = 15.0  # Hz
# Half a 95 % interval; else a delay cannot be told from that of the neighbouring cycle.
WIDEST_INTERVAL: Final = 0.5  # cycles
# Robot torques have little above 20 Hz: valleys of the profile are wider than this.
_PROFILE_STEP: Final = 0.005  # s
_PROFILE_ROWS: Final = 4000
_ITERATIONS: Final = 15
_VALLEYS: Final = 3  # that are gone down into
# Valleys whose residual variances differ by less are told apart by what the model gets wrong. An
# axis whose viscous friction outweighs its inertia has two: f1 qd(t - d) is f1 qd - d f1 qdd. On
# simulated NS 16 wrists with no other error than a smoother's, the wrong one was deeper by 1 %.
_MODEL_ERROR: Final = 0.05
# Reversals are what tells a delay; at 15 Hz half a period is more than one at a fit's 40 Hz.
_REVERSAL_PERIODS: Final = 0.5
_CONVERGED, _OF_STD = 1e-3, 0.02  # step: cycles, or this small beside what noise does
_DIFFERENCE: Final = 0.05  # cycles, of the numerical time derivative
_MOST_BLOCKS: Final = 400


@dataclass(frozen=True, eq=False)
class DelayEstimate:
    """Delays of the torque behind the position, n axes.

    Attributes:
        joint_names: (n,).
        delays: (n,) [s], NaN where the data do not determine it.
        std: standard deviations, cluster-robust (n,) [s]; infinite likewise.
        cycle: the usual step of the clock [s].
        common: mean of the determined delays by inverse variance [s], NaN without any.
        common_std: its standard deviation [s].
        reasons: per axis why its delay is not determined, None where it is.
        interval_factor: standard deviations in half a 95 % interval.
    """

    joint_names: tuple[str, ...]
    delays: Array
    std: Array
    cycle: float
    common: float
    common_std: float
    reasons: tuple[str | None, ...]
    interval_factor: float

    @property
    def cycles(self) -> Array:
        """Delays in cycles (n,), NaN where not determined."""
        return np.asarray(self.delays / self.cycle)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which axes the data say something about (n,)."""
        return np.isfinite(self.delays)

    @property
    def applied(self) -> Array:
        """Delays to compensate (n,) [s].

        An axis whose own is not determined takes the common one if the others agree on it, else
        none.
        """
        fallback = self.common if self.determined.any() and self.agree else 0.0
        return np.where(self.determined, self.delays, fallback)

    @property
    def agree(self) -> bool:
        """Whether one common delay explains all determined ones, at 5 % for all of them together.

        The intervals are widened for the number of comparisons (Bonferroni).
        """
        known = self.determined
        several = normal_limit(0.025 / max(1, int(np.count_nonzero(known)))) / normal_limit(0.025)
        apart = np.abs(self.delays[known] - self.common)
        return bool(np.all(apart <= several * self.interval_factor * self.std[known]))

    def describe(self) -> list[str]:
        """One line per axis, in words."""
        lines = []
        for j, name in enumerate(self.joint_names):
            reason = self.reasons[j]
            if reason is not None:
                lines.append(f"{name}: not determined; {reason}")
                continue
            half = self.interval_factor * self.std[j]
            lines.append(
                f"{name}: {self.delays[j] * 1e3:.3f} ms ± {half * 1e3:.3f} ms"
                f" ({self.delays[j] / self.cycle:.2f} ± {half / self.cycle:.2f} cycles)"
            )
        return lines


def estimate_delays(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),  # noqa: B008 - frozen
    longest: float = LONGEST_DELAY,
    bandwidth: float = DELAY_BANDWIDTH,
) -> DelayEstimate:
    """Estimate by how much each axis's torque lags its position.

    Args:
        recording: with torque, joints in the model's order.
        model: the robot.
        noise_variance: of the positions (n,), see :func:`identification.preprocessing.smooth`.
        options: what the torque has come through; its delay is not used.
        longest: delays are sought up to this one, either way [s].
        bandwidth: widest one of the smoothed positions here [Hz].

    Raises:
        RecordingError: see :func:`identification.preprocessing.prepare`.
        IdentificationError: no usable row.
    """
    narrow = replace(options, torque_delay=0.0, reversal_periods=_REVERSAL_PERIODS)
    narrow = replace(narrow, rigid_bandwidth=min(bandwidth, options.rigid_bandwidth))
    problem = _Problem.of(recording, model, noise_variance, narrow)
    grid = problem.grid(longest)
    start = grid.delays[grid.start()]
    p = model.n_parameters
    for _ in range(_VALLEYS):
        delays, blocks, solution = _gauss_newton(problem, start, longest)
        best = problem.factor(delays, grid.stride)
        rival = grid.rivals(best, estimate(model, best).noise_std, delays)
        better = rival.ratio < 0.0
        if not better.any():
            break
        start = np.where(better, rival.delays, delays)
    covariance, factor = blocks.covariance(solution.values, solution.root)
    std = np.sqrt(np.diag(covariance)[p:])
    std[~solution.determined[p:]] = np.inf
    # Residuals that are not white tell valleys apart less well, by as much as delays.
    effect = np.diag(covariance)[p:] / np.maximum(np.diag(solution.inverse)[p:], 1e-300)
    enough = np.maximum(factor**2 * np.maximum(effect, 1.0), _MODEL_ERROR * blocks.rows)
    as_good = rival.ratio < enough
    reasons = tuple(
        _why_not(int(rows), factor * s / problem.cycle, abs(delay) >= longest, other)
        for rows, s, delay, other in zip(
            blocks.rows, std, delays, np.where(as_good, rival.delays, np.nan), strict=True
        )
    )
    known = np.array([reason is None for reason in reasons])
    common, common_std = _common(delays, covariance[p:, p:], known)
    return DelayEstimate(
        joint_names=model.joint_names,
        delays=np.where(known, delays, np.nan),
        std=np.where(known, std, np.inf),
        cycle=problem.cycle,
        common=common,
        common_std=common_std,
        reasons=reasons,
        interval_factor=factor,
    )


def _gauss_newton(
    problem: _Problem, delays: Array, longest: float
) -> tuple[Array, _Blocks, Solution]:
    """Delays (n,) of least weighted residual, and the last linear problem with its solution."""
    p = problem.model.n_parameters
    fit = estimate(problem.model, problem.factor(delays))
    values = fit.values
    weights = np.nan_to_num(fit.noise_std, nan=np.inf) ** -2.0
    for _ in range(_ITERATIONS):
        blocks = problem.linearised(delays, values, weights)
        solution = solve(blocks.total())
        values, step = solution.values[:p], solution.values[p:]
        step = np.clip(step, -_PROFILE_STEP, _PROFILE_STEP)
        before, delays = delays, np.clip(delays + step, -longest, longest)
        small = np.maximum(
            _CONVERGED * problem.cycle, _OF_STD * np.sqrt(np.diag(solution.inverse)[p:])
        )
        if np.all(np.abs(delays - before) <= small):
            break
    return delays, blocks, solution


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Weighted normal equations of parameters and delay steps, block by block of time."""

    gram: Array  # (B, p + n + 1, p + n + 1)
    rows: NDArray[np.intp]  # (n,)

    def total(self) -> NormalEquations:
        total = self.gram.sum(axis=0)
        return NormalEquations(
            total[:-1, :-1], total[:-1, -1], float(total[-1, -1]), int(self.rows.sum())
        )

    def covariance(self, values: Array, root: Array) -> tuple[Array, float]:
        """Cluster-robust covariance, and the factor of half a 95 % interval."""
        gram = self.gram[self.gram[:, -1, -1] > 0.0]
        augmented = np.append(-values, 1.0)
        length = block_length(gram[:, :-1] @ augmented)
        gram = np.add.reduceat(gram, np.arange(0, len(gram), length), axis=0)
        moved = spread(gram[:, :-1, :-1], gram[:, :-1] @ augmented, root)
        covariance = np.asarray(moved.T @ moved)
        return covariance, float(student_limit(0.025, max(1, len(gram) - 1)))


@dataclass(frozen=True, eq=False)
class _Problem:
    """A recording that can be read at any delay.

    Rows count by the motion, not by the torque: at another delay the same stretches of motion
    are compared with other samples of the torque.
    """

    model: RobotModel
    samples: Samples
    splines: tuple[SmoothingSpline | None, ...]
    cycle: float

    @classmethod
    def of(
        cls,
        recording: Recording,
        model: RobotModel,
        noise_variance: Array | None,
        options: Preprocessing,
    ) -> _Problem:
        samples = prepare(recording, model, noise_variance=noise_variance, options=options)
        splines = tuple(
            _fitted(recording, segment, noise_variance, options.rigid_bandwidth)
            if samples.usable[segment].any()
            else None
            for segment in samples.segments
        )
        return cls(model, samples, splines, float(np.median(np.diff(recording.time))))

    def motion(self, delay: float) -> Motion:
        """Motion at all instants less the delay, at rest where there is none."""
        time, shape = self.samples.motion.time, self.samples.torque.shape
        q, qd, qdd = self.samples.motion.position.copy(), np.zeros(shape), np.zeros(shape)
        for segment, spline in zip(self.samples.segments, self.splines, strict=True):
            if spline is not None:
                inside = time[segment]
                at = np.clip(inside - delay, inside[0], inside[-1])
                q[segment], qd[segment], qdd[segment] = spline(at), spline(at, 1), spline(at, 2)
        return Motion(time, q, qd, qdd)

    def usable(self, joint: int, delay: float) -> NDArray[np.bool_]:
        """Rows (m,) whose motion, a delay earlier, counts."""
        time, counts = self.samples.motion.time, self.samples.usable[:, joint]
        usable = np.zeros(len(time), dtype=np.bool_)
        for segment in self.samples.segments:
            inside = time[segment]
            at = inside - delay
            nearest = np.searchsorted(inside, at + 0.5 * self.cycle) - 1
            within = (at >= inside[0]) & (at <= inside[-1])
            usable[segment] = within & counts[segment][np.clip(nearest, 0, len(inside) - 1)]
        return usable

    def grid(self, longest: float) -> DelayGrid:
        """Factors of all axes over common delays."""
        count = max(1, int(np.ceil(longest / _PROFILE_STEP)))
        delays = np.linspace(-longest, longest, 2 * count + 1)
        stride = 1
        if self.samples.torque_bandwidth is None:
            stride = max(1, len(self.samples.motion.time) // _PROFILE_ROWS)
        factors = [self._common_factor(float(delay), stride) for delay in delays]
        gram = np.array([factor.gram for factor in factors])
        return DelayGrid(delays, gram, np.array([factor.samples for factor in factors]), stride)

    def _common_factor(self, delay: float, stride: int) -> Factor:
        thin = slice(None, None, stride)
        motion, samples = self.motion(delay), self.samples
        usable = np.column_stack([self.usable(j, delay) for j in range(self.model.n_joints)])
        if samples.torque_bandwidth is not None:
            return replace(samples, motion=motion, usable=usable).factor(self.model)
        thinned = motion.rows(thin)
        return Factor.from_samples(self.model, thinned, samples.torque[thin], usable[thin])

    def factor(self, delays: Array, stride: int = 1) -> Factor:
        """Each axis at its own delay (n,), of all rows or one in so many."""
        result = Factor.zero(self.model)
        for joint, delay in enumerate(delays):
            one = self._common_factor(float(delay), stride)
            result.gram[joint], result.samples[joint] = one.gram[joint], one.samples[joint]
        return result

    def linearised(self, delays: Array, values: Array, weights: Array) -> _Blocks:
        """Normal equations in the parameters and in further delays, about these (n,)."""
        model, samples = self.model, self.samples
        n, p = model.n_joints, model.n_parameters
        time = samples.motion.time
        width = max(FINE_BLOCK, float(time[-1] - time[0]) / _MOST_BLOCKS)
        block = np.floor((time - time[0]) / width).astype(np.intp)
        edges = np.searchsorted(block, np.arange(block[-1] + 2))
        gram = np.zeros((len(edges) - 1, p + n + 1, p + n + 1))
        rows = np.zeros(n, dtype=np.intp)
        for joint, delay in enumerate(delays):
            columns, usable = self._columns(joint, float(delay), values)
            rows[joint], columns = np.count_nonzero(usable), np.where(usable[:, None], columns, 0.0)
            place = np.concatenate([model.plan.columns[joint], [p + joint, p + n]])
            for b in range(len(gram)):
                part = columns[edges[b] : edges[b + 1]]
                gram[b][np.ix_(place, place)] += weights[joint] * (part.T @ part)
        return _Blocks(gram, rows)

    def _columns(self, joint: int, delay: float, values: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Columns [W_j | -dtau_j/dt | tau_j] (m, c_j + 2) and which rows count (m,)."""
        half = _DIFFERENCE * self.cycle
        model, samples = self.model, self.samples
        block = model.regressor(*self.motion(delay)[1:]).blocks[joint]
        # d/dd of tau(t - d): later delay, earlier motion.
        slope = [
            model.torque(values, *self.motion(delay + side)[1:])[:, joint] for side in (half, -half)
        ]
        table = np.column_stack([block, (slope[0] - slope[1]) / (2.0 * half)])
        table = samples.as_measured(joint, table)
        return np.column_stack([table, samples.torque[:, joint]]), self.usable(joint, delay)


def _fitted(
    recording: Recording, segment: slice, variance: Array | None, widest: float
) -> SmoothingSpline | None:
    time, measured = recording.time[segment], recording.position[segment]
    if len(time) < 2 * ORDER:
        return None
    if variance is None:
        variance = difference_variance(time, measured)
    rounding = (np.finfo(np.float64).eps * np.abs(measured).max(axis=0)) ** 2
    tolerance = np.maximum(variance, np.maximum(rounding, 1e-40))
    return fit_smoothing_spline(time, measured, tolerance, widest=widest)


def _why_not(rows: int, half_interval: float, at_edge: bool, other: float) -> str | None:
    if rows == 0:
        return "the axis does not move"
    if not np.isfinite(half_interval):
        return "the motion does not tell a delay from the other parameters"
    if at_edge:
        return "the residual still falls at the longest delay that was tried"
    if half_interval > WIDEST_INTERVAL:
        return (
            f"the 95 % interval would be ± {half_interval:.2g} cycles: the torque changes too"
            " slowly, or has too much noise"
        )
    if np.isfinite(other):
        return f"a delay of {other * 1e3:.1f} ms explains its torque as well"
    return None


def _common(delays: Array, covariance: Array, known: NDArray[np.bool_]) -> tuple[float, float]:
    if not known.any():
        return float("nan"), float("inf")
    covariance = covariance[np.ix_(known, known)]
    weight = 1.0 / np.diag(covariance)
    weight /= weight.sum()
    return float(weight @ delays[known]), float(np.sqrt(weight @ covariance @ weight))
