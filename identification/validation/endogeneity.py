"""Durbin-Wu-Hausman test: whether noise in the regressor has biased least squares.

V = W - P_Z W, the part of W that the instruments do not explain, is added to the equation; its
coefficients are zero without bias. Noise enters in the direction V pi only, so one column V_j pi
per joint is added, with pi by instrumental variables, and the n coefficients are tested together
with a covariance over blocks of time (Hotelling's F). For measurement noise a coefficient is minus
the share of noise in its column; a disturbance that moves the arm may have either sign.
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
# Share of an axis's torque (RMS); models of industrial arms have errors of 2 to 10 %.
MATTERS: Final = 0.005
_SAME: Final = 1e-9  # share of the torque below which measured and instrument motion are equal


@dataclass(frozen=True, eq=False)
class EndogeneityTest:
    """Result of the test."""

    statistic: float  #: F of the hypothesis of no bias; NaN if untested
    p_value: float  #: probability of a larger F without bias, NaN likewise
    freedom: tuple[int, int]  #: degrees of freedom of the F
    noise: Array  #: torque V pi as a share of each joint's torque (n,), both RMS
    shift: Array  #: least squares minus instrumental variables (p,)
    shifted: tuple[str, ...]  #: parameters that differ significantly (5 % over all)
    predicted: Array  #: difference of the predicted torques as a share of each joint's torque (n,)
    words: str  #: result as sentences

    @property
    def biased(self) -> bool:
        """Whether least squares was biased significantly (5 %)."""
        return bool(self.p_value < LEVEL)

    @property
    def matters(self) -> bool:
        """Whether the bias changes the predicted torque of some axis noticeably."""
        return self.biased and bool(np.max(self.predicted, initial=0.0) >= MATTERS)


def endogeneity_test(
    model: RobotModel, factor: PhaseFactor, result: InstrumentalEstimate
) -> EndogeneityTest:
    """Test by the factor of an instrumental estimate whether least squares was biased."""
    used = np.asarray(factor.samples.any(axis=1))
    blocks, values = factor.weighted(result.weights)[used], result.estimate.values
    p, total = len(values), blocks.sum(axis=0)
    # V pi as a combination of [Z | W | y].
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
    statistic, freedom = _wald(information, moments, len(active))
    shift, shift_std, count = _shift(blocks)
    known = shift_std > 0.0
    critical = student_limit(LEVEL / (2 * max(1, int(known.sum()))), max(1, count - 1))
    beyond = np.flatnonzero(known & (np.abs(shift) > critical * shift_std))
    test = EndogeneityTest(
        statistic=statistic,
        p_value=float(fisher_tail(statistic, *freedom)) if np.isfinite(statistic) else np.nan,
        freedom=freedom,
        noise=noise,
        shift=shift,
        shifted=tuple(model.parameter_names[k] for k in beyond),
        predicted=_share(factor, np.concatenate([np.zeros(p), shift, [0.0]])),
        words="",
    )
    weak = f" The instruments are too weak for {joined(result.weak)}." if result.weak else ""
    return replace(test, words=_words(test, model.joint_names) + weak)


def _share(factor: PhaseFactor, combination: Array) -> Array:
    """Return the RMS of combinations (2 p + 1,) of [Z | W | y] per torque RMS of joints (n,)."""
    shares = np.zeros(factor.n_joints)
    for joint, gram in enumerate(factor.gram):
        own, total = combination[factor.places(joint)], gram.sum(axis=0)
        shares[joint] = np.sqrt(max(float(own @ total @ own), 0.0) / max(total[-1, -1], 1e-300))
    return shares


def _wald(information: Array, moments: Array, k: int) -> tuple[float, tuple[int, int]]:
    """Return F of the hypothesis that the last k coefficients are zero, its degrees of freedom."""
    p = information.shape[1] - k
    solution = solve(NormalEquations(information.sum(axis=0), moments.sum(axis=0), 0.0, 0))
    # Merged until neighbouring scores are nearly uncorrelated.
    length = block_length(moments - information @ solution.values)
    information, moments = merged(information, length), merged(moments, length)
    moved = spread(information, moments - information @ solution.values, solution.root)[:, p:]
    blocks = len(moments)
    freedom = (k, blocks - k)
    gamma = solution.values[p:]
    if k == 0 or freedom[1] < 1 or not solution.determined[p:].all():
        return np.nan, freedom
    squared = float(gamma @ np.linalg.solve(moved.T @ moved, gamma))
    return squared * freedom[1] / (k * (blocks - 1)), freedom


def _shift(blocks: Array) -> tuple[Array, Array, int]:
    """Return least squares minus instrumental variables (p,), its deviation, and the blocks."""
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


def _words(test: EndogeneityTest, joints: Sequence[str]) -> str:
    if np.isnan(test.p_value):
        return (
            "The bias of least squares was not tested: the instruments equal the measured motion,"
            " or the recording is too short."
        )
    answer = "Noise in the regressor does not bias least squares significantly"
    if test.matters:
        answer = "Least squares is biased by noise in the regressor"
    elif test.biased:
        answer = (
            "Noise in the regressor biases least squares, but changes no axis's torque by"
            f" {MATTERS:.1%} or more: negligible"
        )
    worst = int(np.argmax(test.noise))
    text = (
        f"{answer} (F({test.freedom[0]}, {test.freedom[1]}) = {test.statistic:.2f},"
        f" p = {test.p_value:.2g}). The part of it that the instruments do not explain is"
        f" {test.noise[worst]:.1%} of the torque of {joints[worst]}; the two estimates differ by up"
        f" to {float(np.max(test.predicted)):.1%} of an axis's torque"
    )
    if test.biased and test.shifted:
        text += f", significantly in {', '.join(test.shifted)}"
    advice = " Use the instrumental variables, or less noisy positions." if test.matters else ""
    return f"{text}.{advice}"
