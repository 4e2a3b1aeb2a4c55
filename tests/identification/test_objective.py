from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import Factor, RobotModel
from identification.excitation import Objective, information, log10_det
from identification.excitation.constraints import SAMPLE_PERIOD, midpoints, sampled
from planner import FourierSeries, JointLimits, plan
from planner.worker import load, pack

LIMITS = JointLimits([-2.5] * 2, [2.5] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
URDF = (Path(__file__).parent / "two_link.urdf").read_text(encoding="utf-8")
MODEL = RobotModel.from_urdf(URDF)
P = MODEL.n_parameters
WORST = {"log10_det": -np.inf, "coupling_index": np.inf}
seeds = st.integers(0, 999)


def some_motion(seed: int, n_via: int = 5):
    via = np.random.default_rng(seed).uniform(-2.4, 2.4, (n_via, 2))
    return plan(via, LIMITS, fly=0.5)


def rows_of(motion, *, moving: bool = False) -> np.ndarray:
    """Phi of one motion: a row per sample and joint, of all or of those that move."""
    rows = MODEL.regressor(*motion[1:]).dense(P).reshape(-1, P)
    return rows[MODEL.moving(motion.velocity).ravel()] if moving else rows


def share_of_period(motion) -> float:
    return float(motion.time[1] - motion.time[0]) / SAMPLE_PERIOD


def assert_measures(found: Mapping[str, float], columns: np.ndarray, n_samples: int) -> None:
    """Eqs. 9 and 5 from numpy's QR of Phi itself, which squares no condition number."""
    r = np.linalg.qr(columns, mode="r")
    determinant = 2.0 * np.log10(np.abs(np.diag(r))).sum() - r.shape[1] * math.log10(n_samples)
    inverse = np.linalg.inv(r)
    psi = inverse @ inverse.T
    deviation = np.sqrt(np.diag(psi))
    index = np.abs(np.triu(psi / deviation / deviation[:, None], 1)).sum()
    assert found["log10_det"] == pytest.approx(determinant, abs=1e-8)
    assert found["coupling_index"] == pytest.approx(index, rel=1e-8, abs=1e-12)


# What is judged.


@given(seed=seeds, chosen=st.sets(st.integers(0, P - 1), min_size=1))
@settings(max_examples=20, deadline=None)
def test_measures_are_of_the_chosen_weighted_columns(seed: int, chosen: set[int]) -> None:
    motion, random = midpoints(some_motion(seed)), np.random.default_rng(seed)
    order, weights = random.permutation(sorted(chosen)), random.uniform(0.1, 4.0, 2)
    columns = rows_of(motion)
    objective = Objective(MODEL, parameters=order)
    assert objective.n_parameters == len(chosen)
    assert_measures(objective.measures(motion), columns[:, order], motion.n_samples)
    weighted = np.tile(np.sqrt(weights), motion.n_samples)[:, None] * columns
    found = Objective(MODEL, joint_weights=weights).measures(motion)
    assert_measures(found, weighted, motion.n_samples)


def test_the_same_motion_is_judged_alike_in_any_company() -> None:
    motions = [midpoints(some_motion(seed, n_via)) for seed, n_via in enumerate((3, 40, 7, 90, 4))]
    alone = [Objective(RobotModel.from_urdf(URDF)).measures(m) for m in motions]
    objective = Objective(MODEL)
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 1, 3, 0, 4, 2, 2]):
        for k in order:
            assert objective.measures(motions[k]) == alone[k]  # to the last bit


def test_a_factor_of_the_same_samples_says_the_same() -> None:
    motion, weights = midpoints(some_motion(2)), np.array([2.0, 0.5])
    factor = Factor.from_samples(MODEL, motion, np.ones_like(motion.position))
    for objective, gram in (
        (Objective(MODEL, joint_weights=weights), factor.weighted(weights).A),
        (Objective(MODEL), information(factor)),
    ):
        np.testing.assert_allclose(objective.information(motion), gram, rtol=1e-12)


def test_criteria_are_the_measures_and_more() -> None:
    trajectory = some_motion(3)
    motion = midpoints(trajectory)
    criteria = Objective(MODEL).criteria(trajectory, SAMPLE_PERIOD)
    assert criteria.measures == tuple(Objective(MODEL).measures(motion).values())
    assert criteria.n_samples == motion.n_samples
    assert criteria.condition == pytest.approx(np.linalg.cond(rows_of(motion)), rel=1e-6)


@pytest.mark.parametrize("last", [[[1.0, 0.5], [-1.0, 0.5]], [[0.0, 0.5]]])
def test_a_joint_at_rest_is_worst_of_all(last: list[list[float]]) -> None:
    still = plan([[0.0, 0.5], *last], LIMITS)
    assert Objective(MODEL).measures(midpoints(still)) == WORST


# Sequential design.


def earlier_of(trajectory) -> dict:
    """Information of a motion sampled every SAMPLE_PERIOD, to the last digit."""
    motion = midpoints(trajectory)
    columns = rows_of(motion, moving=True)
    gram = share_of_period(motion) * columns.T @ columns
    return {"earlier": gram, "earlier_samples": motion.n_samples}


@given(seed=seeds, repetitions=st.integers(1, 30))
@settings(max_examples=20, deadline=None)
def test_earlier_archives_and_repetitions_add_up(seed: int, repetitions: int) -> None:
    earlier = earlier_of(some_motion(seed))
    before, after = midpoints(some_motion(seed)), midpoints(some_motion(seed + 1000))
    objective = Objective(MODEL, **earlier, repetitions=repetitions)
    stacked = np.concatenate(
        [
            np.sqrt(share_of_period(part)) * rows_of(part, moving=True)
            for part in (before, *[after] * repetitions)
        ]
    )
    assert_measures(objective.measures(after), stacked, earlier["earlier_samples"])


def assert_more(gram: np.ndarray, other: np.ndarray) -> None:
    """More in every direction: no combination of parameters gets less certain."""
    scale = np.sqrt(np.diag(gram))
    assert np.linalg.eigvalsh((gram - other) / scale / scale[:, None])[0] >= -1e-12


@given(seed=seeds, share=st.floats(0.05, 0.95), repetitions=st.integers(1, 30))
@settings(max_examples=40, deadline=None)
def test_more_of_everything_never_counts_for_less(
    seed: int, share: float, repetitions: int
) -> None:
    """A motion and its beginning: per second the beginning may say more, in all it does not."""
    known = earlier_of(some_motion(seed))
    known = {name: 30 * value for name, value in known.items()}
    motion = midpoints(some_motion(seed + 1000))
    beginning = motion.rows(slice(max(2, round(share * motion.n_samples))))
    objective = Objective(MODEL, **known, repetitions=repetitions)
    assert_more(objective.information(motion), objective.information(beginning))
    assert_more(objective.information(beginning), known["earlier"])
    nothing = log10_det(known["earlier"], known["earlier_samples"])
    less, more = (objective.measures(m)["log10_det"] for m in (beginning, motion))
    assert nothing - 1e-9 <= less <= more + 1e-9
    often = Objective(MODEL, **known, repetitions=repetitions + 1)
    assert often.measures(motion)["log10_det"] > more


def test_rows_at_rest_are_left_out_beside_earlier_ones_only() -> None:
    motion = midpoints(plan([[0.0, 0.5], [1.0, 0.5], [-1.0, 0.5]], LIMITS))  # the elbow rests
    alone = Objective(MODEL).information(motion)
    beside = Objective(MODEL, earlier=np.zeros((P, P)), earlier_samples=1).information(motion)
    columns = rows_of(motion, moving=True)
    assert len(columns) <= motion.n_samples
    expected = share_of_period(motion) * columns.T @ columns
    np.testing.assert_allclose(beside, expected, rtol=1e-9, atol=1e-9)
    assert np.trace(alone) > np.trace(beside) / share_of_period(motion)


def test_repetitions_alone_change_nothing() -> None:
    motion = midpoints(some_motion(6))
    once, often = (Objective(MODEL, repetitions=r).measures(motion) for r in (1, 30))
    assert once == often


def test_a_second_counts_alike_at_any_sampling() -> None:
    trajectory = some_motion(7, n_via=12)
    known = earlier_of(trajectory)
    n_earlier = known["earlier_samples"]
    alone = log10_det(known["earlier"], n_earlier)
    for period in (SAMPLE_PERIOD, 0.001):
        both = Objective(MODEL, **known).criteria(trajectory, period)
        assert both.n_samples == n_earlier
        # Both rates see the same motion, but for the last sample and some at each reversal.
        room = P * 4.0 / n_earlier
        assert both.log10_det == pytest.approx(alone + P * math.log10(2.0), abs=room)


def test_an_objective_judges_alike_in_another_process() -> None:
    known = earlier_of(some_motion(9))
    weights = np.array([1.0, 3.0])
    objective = Objective(MODEL, np.arange(1, P), weights, **known, repetitions=3)
    motion = midpoints(some_motion(10))
    expected = objective.measures(motion)  # also fills what the objective caches
    assert load(pack(objective)).measures(motion) == expected


# Samples.


@given(seed=seeds, period=st.floats(1e-3, 5e-2))
@settings(max_examples=50, deadline=None)
def test_samples_are_uniform_at_ends_or_in_the_middle(seed: int, period: float) -> None:
    trajectory = some_motion(seed)
    ends, middles = sampled(trajectory, period), midpoints(trajectory, period)
    steps = np.diff(ends.time)
    assert (ends.time[0], ends.time[-1]) == (0.0, trajectory.duration)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert steps[0] <= period * (1.0 + 1e-6)
    assert steps[0] > period * (1.0 - 1.0 / len(steps)) - 1e-12  # no denser than needed
    np.testing.assert_allclose(middles.time, 0.5 * (ends.time[1:] + ends.time[:-1]), rtol=1e-12)
    assert np.all(middles.velocity[[0, -1]] != 0.0)  # neither end, where nothing moves
    for motion in (ends, middles):
        for series, expected in zip(motion[1:4], trajectory.sample(motion.time), strict=True):
            np.testing.assert_array_equal(series, expected)


@pytest.mark.parametrize(
    ("length", "period", "steps"), [(16.0, 0.001, 16000), (16.0, 0.008, 2000), (8.008, 0.008, 1001)]
)
def test_whole_periods_get_no_further_sample(length: float, period: float, steps: int) -> None:
    """The paper's N is 2000; 8.008 s over 8 ms is more than 1001 by rounding."""
    swing = FourierSeries(np.zeros(2), np.ones((2, 1)), np.ones((2, 1)), length)
    assert sampled(swing, period).n_samples == steps + 1
    assert midpoints(swing, period).n_samples == steps
