from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import Factor, Motion, RobotModel
from identification.excitation.constraints import SAMPLE_PERIOD, midpoints, sampled
from identification.excitation.criteria import coupling_index, information, log10_det
from identification.excitation.objective import Objective
from planner import FourierSeries, JointLimits, plan
from planner.worker import load, pack

LIMITS = JointLimits([-2.5] * 2, [2.5] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
MODEL = RobotModel.from_urdf((Path(__file__).parent / "two_link.urdf").read_text(encoding="utf-8"))
P = MODEL.n_parameters
seeds = st.integers(0, 999)


def some_motion(seed: int, n_via: int = 5):
    via = np.random.default_rng(seed).uniform(-2.4, 2.4, (n_via, 2))
    return plan(via, LIMITS, fly=0.5)


def rows_of(motion) -> np.ndarray:
    """Phi of one motion: a row per sample and joint."""
    return MODEL.regressor(*motion[1:]).dense(P).reshape(-1, P)


def spelled_out(columns: np.ndarray, n_samples: int) -> tuple[float, float]:
    """Eqs. 9 and 5 from numpy's QR of Phi itself, which squares no condition number."""
    r = np.linalg.qr(columns, mode="r")
    determinant = 2.0 * np.log10(np.abs(np.diag(r))).sum() - r.shape[1] * math.log10(n_samples)
    inverse = np.linalg.inv(r)
    psi = inverse @ inverse.T
    deviation = np.sqrt(np.diag(psi))
    return determinant, np.abs(np.triu(psi / deviation / deviation[:, None], 1)).sum()


# What is judged.


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_the_measures_are_those_of_the_stacked_regressor(seed: int) -> None:
    motion = midpoints(some_motion(seed))
    determinant, index = spelled_out(rows_of(motion), motion.n_samples)
    found = Objective(MODEL).measures(motion)
    assert found.log10_det == pytest.approx(determinant, abs=1e-8)
    assert found.coupling_index == pytest.approx(index, rel=1e-8)


def test_a_motion_is_judged_alike_to_the_last_bit_alone_or_in_any_company() -> None:
    motions = [midpoints(some_motion(seed, n_via)) for seed, n_via in enumerate((3, 40, 7, 90, 4))]
    alone = [Objective(RobotModel.from_urdf(_urdf())).measures(m) for m in motions]
    objective = Objective(MODEL)
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 1, 3, 0, 4, 2, 2]):
        for k in order:
            assert objective.measures(motions[k]) == alone[k]


def test_a_factor_of_the_same_samples_gives_the_same_information() -> None:
    motion = midpoints(some_motion(2))
    factor = Factor.from_samples(MODEL, motion, np.ones_like(motion.position))
    objective = Objective(MODEL, joint_weights=np.array([2.0, 0.5]))
    gram = factor.weighted(np.array([2.0, 0.5])).A
    np.testing.assert_allclose(objective.information(motion), gram, rtol=1e-12)
    np.testing.assert_allclose(
        Objective(MODEL).information(motion), information(factor), rtol=1e-12
    )
    assert objective.n_samples(motion) == motion.n_samples
    found = objective.measures(motion)
    assert found.log10_det == pytest.approx(log10_det(gram, motion.n_samples), abs=1e-9)
    assert found.coupling_index == pytest.approx(coupling_index(gram), rel=1e-9)


def test_criteria_are_the_measures_and_more() -> None:
    trajectory = some_motion(3)
    motion = midpoints(trajectory)
    criteria = Objective(MODEL).criteria(trajectory, SAMPLE_PERIOD)
    found = Objective(MODEL).measures(motion)
    assert (criteria.log10_det, criteria.coupling_index) == found
    assert criteria.n_samples == motion.n_samples
    columns = rows_of(motion)
    assert criteria.condition == pytest.approx(np.linalg.cond(columns), rel=1e-6)
    unit = columns / np.linalg.norm(columns, axis=0)
    assert criteria.scaled_condition == pytest.approx(np.linalg.cond(unit), rel=1e-6)


def test_a_motion_that_leaves_a_joint_at_rest_is_worst_of_all() -> None:
    still = plan([[0.0, 0.5], [1.0, 0.5], [-1.0, 0.5]], LIMITS)
    assert Objective(MODEL).measures(midpoints(still)) == (-np.inf, np.inf)


# Essential parameters and weights.


@given(seed=seeds, chosen=st.sets(st.integers(0, P - 1), min_size=1))
@settings(max_examples=20, deadline=None)
def test_essential_parameters_are_the_whole_model(seed: int, chosen: set[int]) -> None:
    motion = midpoints(some_motion(seed))
    kept = np.random.default_rng(seed).permutation(sorted(chosen))
    objective = Objective(MODEL, parameters=kept)
    determinant, index = spelled_out(rows_of(motion)[:, kept], motion.n_samples)
    found = objective.measures(motion)
    assert objective.n_parameters == len(chosen)
    assert found.log10_det == pytest.approx(determinant, abs=1e-8)
    assert found.coupling_index == pytest.approx(index, rel=1e-8, abs=1e-12)


def test_weights_scale_the_rows_of_their_joint() -> None:
    motion = midpoints(some_motion(4))
    weights = np.array([4.0, 0.09])
    columns = np.tile(np.sqrt(weights), motion.n_samples)[:, None] * rows_of(motion)
    found = Objective(MODEL, joint_weights=weights).measures(motion)
    determinant, index = spelled_out(columns, motion.n_samples)
    assert found.log10_det == pytest.approx(determinant, abs=1e-8)
    assert found.coupling_index == pytest.approx(index, rel=1e-8)


def test_equal_weights_shift_the_determinant_and_decouple_nothing() -> None:
    motion = midpoints(some_motion(5))
    plain = Objective(MODEL).measures(motion)
    found = Objective(MODEL, joint_weights=np.array([100.0, 100.0])).measures(motion)
    assert found.log10_det == pytest.approx(plain.log10_det + 2.0 * P, abs=1e-9)
    assert found.coupling_index == pytest.approx(plain.coupling_index, rel=1e-9)


# Sequential design.


def moving_rows_of(motion) -> np.ndarray:
    """Phi of one motion, without the rows of joints that stand."""
    return rows_of(motion)[MODEL.moving(motion.velocity).ravel()]


def earlier_of(trajectory) -> tuple[np.ndarray, int]:
    """Information of a motion sampled every SAMPLE_PERIOD, to the last digit."""
    motion = midpoints(trajectory)
    columns = moving_rows_of(motion)
    step = (motion.time[1] - motion.time[0]) / SAMPLE_PERIOD
    return step * columns.T @ columns, motion.n_samples


def part_of(motion, count: int) -> Motion:
    return motion.rows(slice(count))


@given(seed=seeds, repetitions=st.integers(1, 30))
@settings(max_examples=20, deadline=None)
def test_information_of_earlier_archives_and_of_each_repetition_adds(
    seed: int, repetitions: int
) -> None:
    before, after = midpoints(some_motion(seed)), midpoints(some_motion(seed + 1000))
    earlier, n_earlier = earlier_of(some_motion(seed))
    objective = Objective(
        MODEL, earlier=earlier, earlier_samples=n_earlier, repetitions=repetitions
    )
    parts = [before, *[after] * repetitions]
    stacked = np.concatenate(
        [
            np.sqrt((part.time[1] - part.time[0]) / SAMPLE_PERIOD) * moving_rows_of(part)
            for part in parts
        ]
    )
    determinant, index = spelled_out(stacked, n_earlier)
    found = objective.measures(after)
    assert found.log10_det == pytest.approx(determinant, abs=1e-8)
    assert found.coupling_index == pytest.approx(index, rel=1e-8)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_two_motions_tell_more_than_either(seed: int) -> None:
    before, after = some_motion(seed), some_motion(seed + 1000)
    earlier, n_earlier = earlier_of(before)
    both = Objective(MODEL, earlier=earlier, earlier_samples=n_earlier).information(
        midpoints(after)
    )
    for one in (earlier, earlier_of(after)[0]):
        assert_more(both, one)
        assert log10_det(both, 1) > log10_det(one, 1)


def assert_more(gram: np.ndarray, other: np.ndarray) -> None:
    """More in every direction: no combination of parameters gets less certain."""
    scale = np.sqrt(np.diag(gram))
    assert np.linalg.eigvalsh((gram - other) / scale / scale[:, None])[0] >= -1e-12


@given(seed=seeds, share=st.floats(0.05, 0.95), repetitions=st.integers(1, 30))
@settings(max_examples=40, deadline=None)
def test_whoever_says_more_of_everything_never_counts_for_less(
    seed: int, share: float, repetitions: int
) -> None:
    """A motion and its beginning: per second the beginning may say more, in all it does not."""
    earlier, n_earlier = earlier_of(some_motion(seed))
    motion = midpoints(some_motion(seed + 1000))
    beginning = part_of(motion, max(2, round(share * motion.n_samples)))
    known = {"earlier": 30.0 * earlier, "earlier_samples": 30 * n_earlier}
    objective = Objective(MODEL, **known, repetitions=repetitions)
    assert_more(objective.information(motion), objective.information(beginning))
    nothing = log10_det(known["earlier"], known["earlier_samples"])
    less, more = (objective.measures(m).log10_det for m in (beginning, motion))
    assert nothing - 1e-9 <= less <= more + 1e-9
    often = Objective(MODEL, **known, repetitions=repetitions + 1)
    assert often.measures(motion).log10_det > more


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_what_is_known_already_decides_nothing_anymore(seed: int) -> None:
    """With all directions but one known for certain, that one alone ranks the motions."""
    random = np.random.default_rng(seed)
    motions = [some_motion(1000 * seed + k) for k in range(3)]
    grams = [earlier_of(m)[0] for m in motions]
    scale = np.sqrt(np.diag(grams[0]))
    v = random.normal(size=P)
    v /= np.linalg.norm(v)
    known = (np.eye(P) - np.outer(v, v)) * scale * scale[:, None] * 1e9
    objective = Objective(MODEL, earlier=known, earlier_samples=1000)
    found = [objective.measures(midpoints(m)).log10_det for m in motions]
    # det(A + G) -> det(A') (u' G u) for A without the direction u (Schur complement).
    u = v / scale
    alone = [math.log10(u @ gram @ u) for gram in grams]
    for k in (1, 2):
        assert found[k] - found[0] == pytest.approx(alone[k] - alone[0], abs=1e-3)


def test_rows_of_standing_joints_count_beside_earlier_ones_only() -> None:
    motion = midpoints(plan([[0.0, 0.5], [1.0, 0.5], [-1.0, 0.5]], LIMITS))  # the elbow stands
    zero = np.zeros((P, P))
    alone = Objective(MODEL).information(motion)
    beside = Objective(MODEL, earlier=zero, earlier_samples=1).information(motion)
    step = (motion.time[1] - motion.time[0]) / SAMPLE_PERIOD
    shoulder = np.where(np.arange(2 * motion.n_samples) % 2 == 0, 1.0, 0.0)
    shoulder *= MODEL.moving(motion.velocity).ravel()
    columns = rows_of(motion)
    np.testing.assert_allclose(
        beside, step * (columns * shoulder[:, None]).T @ columns, rtol=1e-9, atol=1e-9
    )
    assert np.trace(alone) > np.trace(beside) / step  # the paper's criteria see all rows


def test_repetitions_alone_change_nothing() -> None:
    motion = midpoints(some_motion(6))
    once, often = (Objective(MODEL, repetitions=r).measures(motion) for r in (1, 30))
    assert once == often


def test_a_second_counts_alike_however_densely_it_is_sampled() -> None:
    trajectory = some_motion(7, n_via=12)
    earlier, n_earlier = earlier_of(trajectory)
    objective = Objective(MODEL, earlier=earlier, earlier_samples=n_earlier)
    alone = log10_det(earlier, n_earlier)
    for period in (SAMPLE_PERIOD, 0.001):
        both = objective.criteria(trajectory, period)
        assert both.n_samples == n_earlier
        # Both rates see the same motion, but for the last sample and some at each reversal.
        room = P * 4.0 / n_earlier
        assert both.log10_det == pytest.approx(alone + P * math.log10(2.0), abs=room)
        assert both.coupling_index == pytest.approx(coupling_index(earlier), rel=4.0 / n_earlier)


def test_an_objective_travels_to_another_process_and_judges_alike() -> None:
    earlier, n_earlier = earlier_of(some_motion(9))
    objective = Objective(
        MODEL,
        parameters=np.arange(1, P),
        joint_weights=np.array([1.0, 3.0]),
        earlier=earlier,
        earlier_samples=n_earlier,
        repetitions=3,
    )
    motion = midpoints(some_motion(10))
    expected = objective.measures(motion)  # also fills what the objective keeps for itself
    assert load(pack(objective)).measures(motion) == expected


# Samples.

periods = st.floats(1e-3, 5e-2)


@given(seed=seeds, period=periods)
@settings(max_examples=50, deadline=None)
def test_samples_for_checks_are_uniform_and_reach_both_ends(seed: int, period: float) -> None:
    trajectory = some_motion(seed)
    motion = sampled(trajectory, period)
    steps = np.diff(motion.time)
    assert motion.time[0] == 0.0
    assert motion.time[-1] == trajectory.duration
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert steps[0] <= period * (1.0 + 1e-6)
    assert steps[0] > period * (1.0 - 1.0 / len(steps)) - 1e-12  # no denser than needed
    for series, expected in zip(motion[1:4], trajectory.sample(motion.time), strict=True):
        np.testing.assert_array_equal(series, expected)


@given(seed=seeds, period=periods)
@settings(max_examples=50, deadline=None)
def test_samples_for_criteria_lie_in_the_middle_of_those_steps(seed: int, period: float) -> None:
    trajectory = some_motion(seed)
    ends, motion = sampled(trajectory, period), midpoints(trajectory, period)
    middle = 0.5 * (ends.time[1:] + ends.time[:-1])
    np.testing.assert_allclose(motion.time, middle, rtol=1e-12)
    assert np.all(motion.velocity[[0, -1]] != 0.0)  # neither end, where nothing moves
    for series, expected in zip(motion[1:4], trajectory.sample(motion.time), strict=True):
        np.testing.assert_array_equal(series, expected)


def test_a_duration_of_whole_periods_is_sampled_at_the_period() -> None:
    swing = FourierSeries(np.zeros(2), np.ones((2, 1)), np.ones((2, 1)), length=16.0, ramp=1.0)
    np.testing.assert_allclose(sampled(swing, 0.001).time, np.arange(16001) * 0.001, rtol=1e-12)
    assert midpoints(swing, 0.008).n_samples == 2000  # the paper's N


def test_rounding_of_a_duration_of_whole_periods_costs_no_further_sample() -> None:
    length = 1001 * 0.008
    swing = FourierSeries(np.zeros(2), np.ones((2, 1)), np.ones((2, 1)), length)
    assert swing.duration / 0.008 > 1001.0
    assert sampled(swing, 0.008).n_samples == 1002
    assert midpoints(swing, 0.008).n_samples == 1001


def test_a_motion_that_goes_nowhere_has_a_sample_and_excites_nothing() -> None:
    nowhere = plan([[0.5, 0.5], [0.5, 0.5]], LIMITS)
    assert nowhere.duration == 0.0
    assert Objective(MODEL).measures(midpoints(nowhere)) == (-np.inf, np.inf)


def _urdf() -> str:
    return (Path(__file__).parent / "two_link.urdf").read_text(encoding="utf-8")
