"""Was least squares biased by noise in the regressor? A Durbin-Wu-Hausman test.

What the instruments do not explain of W, V = W - P_Z W, is added to the equation; its coefficients
are zero if least squares was not biased. Noise enters in the direction V pi only, so one column per
joint is added, V_j pi with pi by instrumental variables, and the n coefficients are tested together
with a covariance that leaves out one block of time at a time (Hotelling's F). With noise of
measurement alone they are minus the share of that column that is noise; a disturbance that moves
the arm may have either sign. Beside it, parameter by parameter: how far the two estimates are
apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.distributions import fisher_tail, student_limit
from identification.estimators.covariance import block_length, left_out, spread
from identification.estimators.instrumental import InstrumentalEstimate, solve_cross
from identification.factor.factor import NormalEquations, solve
from identification.factor.phases import PhaseFactor, merged
from identification.model.robot import RobotModel
from identification.validation.finding import joined

Array = NDArray[np.float64]

LEVEL: Final = 0.05
# Share of an axis's torque, RMS on the fitted motion: what models of industrial arms leave
# unexplained is 2 to 10 %, a bias of less does nobody harm.
MATTERS: Final = 0.005
# Below this share of the torque measured and instrument motion are the same but for rounding.
_SAME: Final = 1e-9


@dataclass(frozen=True, eq=False)
class EndogeneityTest:
    """Result of the test."""

    #: F of the hypothesis that least squares is not biased; NaN if there is nothing to test
    statistic: float
    p_value: float  #: probability of a larger one if the hypothesis is true, NaN likewise
    freedom: tuple[int, int]  #: degrees of freedom of the F
    #: of each joint's column (n,): minus the share of it that is noise of measurement; NaN where
    #: there is none
    coefficient: Array
    #: torque V pi that stands for what the instruments do not explain of the regressor, as a
    #: share of each joint's torque (n,), both as RMS
    noise: Array
    shift: Array  #: least squares less instrumental variables (p,)
    #: names of the parameters that differ by more than chance (all of them together 5 %)
    shifted: tuple[str, ...]
    #: torque that the two estimates predict differently on the fitted motion, as a share of each
    #: joint's torque (n,)
    predicted: Array
    words: str  #: the answer in words

    @property
    def biased(self) -> bool:
        """Whether least squares was biased, beyond what chance does one time in twenty."""
        return bool(self.p_value < LEVEL)

    @property
    def matters(self) -> bool:
        """Whether it was biased, and the torques of some axis are predicted differently for it."""
        return self.biased and bool(np.max(self.predicted, initial=0.0) >= MATTERS)


def endogeneity_test(
    model: RobotModel, factor: PhaseFactor, result: InstrumentalEstimate
) -> EndogeneityTest:
    """Test whether noise in the regressor has biased least squares, by the factor of a result."""
    used = np.asarray(factor.samples.any(axis=1))
    blocks, values = factor.weighted(result.weights)[used], result.estimate.values
    p, total = len(values), blocks.sum(axis=0)
    # V pi, what the instruments leave of W pi, as a combination of [Z | W | y].
    explained = solve(NormalEquations(total[:p, :p], total[:p, p : 2 * p] @ values, 0.0, 0)).values
    left_over = np.concatenate([-explained, values, [0.0]])
    noise = _share(factor, left_over)
    active = np.flatnonzero((noise > _SAME) & (result.weights > 0.0)).tolist()
    # Normal equations of y = W pi + C gamma by blocks, a column of C for each active joint.
    information = np.zeros((len(blocks), p + len(active), p + len(active)))
    moments = np.zeros((len(blocks), p + len(active)))
    information[:, :p, :p] = blocks[:, p : 2 * p, p : 2 * p]
    moments[:, :p] = blocks[:, p : 2 * p, -1]
    for k, joint in enumerate(active, start=p):
        place, products = factor.places(joint), np.zeros((len(blocks), 2 * p + 1))
        products[:, place] = result.weights[joint] * (factor.gram[joint][used] @ left_over[place])
        information[:, k, :p] = information[:, :p, k] = products[:, p : 2 * p]
        information[:, k, k] = products @ left_over
        moments[:, k] = products[:, -1]
    statistic, freedom, gamma, gamma_std = _wald(information, moments, len(active))
    coefficient = np.full(factor.n_joints, np.nan)
    coefficient[active] = gamma
    shift, shift_std, count = _shift(blocks)
    known = shift_std > 0.0
    critical = student_limit(LEVEL / (2 * max(1, int(known.sum()))), max(1, count - 1))
    beyond = np.flatnonzero(known & (np.abs(shift) > critical * shift_std))
    test = EndogeneityTest(
        statistic=statistic,
        p_value=float(fisher_tail(statistic, *freedom)) if np.isfinite(statistic) else np.nan,
        freedom=freedom,
        coefficient=coefficient,
        noise=noise,
        shift=shift,
        shifted=tuple(model.parameter_names[k] for k in beyond),
        predicted=_share(factor, np.concatenate([np.zeros(p), shift, [0.0]])),
        words="",
    )
    weak = f" The instruments are too weak for {joined(result.weak)}." if result.weak else ""
    significance = gamma / np.where(gamma_std > 0.0, gamma_std, np.inf)
    return replace(test, words=_words(test, significance, model.joint_names) + weak)


def _share(factor: PhaseFactor, combination: Array) -> Array:
    """RMS of a combination (2 p + 1,) of [Z | W | y] as a share of each joint's torque (n,)."""
    shares = np.zeros(factor.n_joints)
    for joint, gram in enumerate(factor.gram):
        own, total = combination[factor.places(joint)], gram.sum(axis=0)
        shares[joint] = np.sqrt(max(float(own @ total @ own), 0.0) / max(total[-1, -1], 1e-300))
    return shares


def _wald(
    information: Array, moments: Array, k: int
) -> tuple[float, tuple[int, int], Array, Array]:
    """F of the hypothesis that the last k coefficients are zero, and its degrees of freedom."""
    p = information.shape[1] - k
    solution = solve(NormalEquations(information.sum(axis=0), moments.sum(axis=0), 0.0, 0))
    # Merged until the scores of neighbours hardly correlate.
    length = block_length(moments - information @ solution.values)
    information, moments = merged(information, length), merged(moments, length)
    moved = spread(information, moments - information @ solution.values, solution.root)[:, p:]
    blocks = len(moments)
    freedom = (k, blocks - k)
    gamma = solution.values[p:]
    std = np.sqrt((moved**2).sum(axis=0))
    if k == 0 or freedom[1] < 1 or not solution.determined[p:].all():
        return np.nan, freedom, gamma, std
    squared = float(gamma @ np.linalg.solve(moved.T @ moved, gamma))
    return squared * freedom[1] / (k * (blocks - 1)), freedom, gamma, std


def _shift(blocks: Array) -> tuple[Array, Array, int]:
    """Least squares less instrumental variables (p,), its standard deviation, and the blocks."""
    p = blocks.shape[-1] // 2
    least, cross = blocks[:, p : 2 * p, p:], blocks[:, :p, p:]
    total = blocks.sum(axis=0)
    solution = solve(NormalEquations(total[p:-1, p:-1], total[p:-1, -1], 0.0, 0))
    instrumental = solve_cross(total)
    length = block_length(cross[:, :, -1] - cross[:, :, :-1] @ instrumental.values)
    moved = [
        left_out(part[:, :, :-1], part[:, :, -1] - part[:, :, :-1] @ values, right, left)
        for part, values, right, left in (
            (merged(least, length), solution.values, solution.root, solution.root),
            (merged(cross, length), *instrumental[:3]),
        )
    ]
    known = solution.determined & instrumental.determined
    spread = np.sqrt(((moved[0] - moved[1]) ** 2).sum(axis=0))
    shift = np.where(known, solution.values - instrumental.values, 0.0)
    return shift, np.where(known, spread, 0.0), len(moved[0])


def _words(test: EndogeneityTest, significance: Array, joints: Sequence[str]) -> str:
    """Put the answer in words, the columns' coefficients given in their standard deviations."""
    if np.isnan(test.p_value):
        return (
            "There is nothing to test: the instruments are the measured motion itself, or the"
            " recording is too short."
        )
    answer = "Nothing says that noise in the regressor has biased least squares"
    if test.matters:
        answer = "Least squares is biased by noise in the regressor"
    elif test.biased:
        answer = (
            "Noise in the regressor biases least squares measurably, but moves no axis's torque by"
            f" {MATTERS:.1%} or more: too small to matter"
        )
    worst = int(np.argmax(test.noise))
    text = (
        f"{answer} (F({test.freedom[0]}, {test.freedom[1]}) = {test.statistic:.2f},"
        f" p = {test.p_value:.2g}). What the instruments do not explain of it amounts to"
        f" {test.noise[worst]:.1%} of the torque of {joints[worst]}; the two estimates differ by up"
        f" to {float(np.max(test.predicted)):.1%} of an axis's torque"
    )
    if test.biased and test.shifted:
        text += f", beyond chance in {', '.join(test.shifted)}"
    if test.biased and significance[np.argmax(np.abs(significance))] > 0.0:
        text += (
            ". It does not act as noise of measurement does: a disturbance or error of the model"
            " that moves the arm is the likelier cause"
        )
    advice = " Use the instrumental variables, or less noisy positions." if test.matters else ""
    return f"{text}.{advice}"
