from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import Factor, RobotModel, ShapeError
from identification.excitation.criteria import coupling_index, information, log10_det
from identification.excitation.errors import DesignError
from identification.excitation.objective import Objective
from identification.excitation.sampling import SAMPLE_PERIOD, midpoints, sampled
from planner import FourierSeries, JointLimits, plan
from planner.remote import load, pack

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
    assert found.torque is None


def test_the_torque_comes_from_the_same_pass() -> None:
    motion = midpoints(some_motion(1, n_via=30))
    values = np.random.default_rng(1).normal(size=P)
    found = Objective(MODEL).measures(motion, values)
    expected = rows_of(motion) @ values
    np.testing.assert_allclose(found.torque, expected.reshape(-1, 2), rtol=1e-9, atol=1e-9)
    assert found[:2] == Objective(MODEL).measures(motion)[:2]


def test_a_motion_is_judged_alike_to_the_last_bit_alone_or_in_any_company() -> None:
    motions = [midpoints(some_motion(seed, n_via)) for seed, n_via in enumerate((3, 40, 7, 90, 4))]
    alone = [Objective(RobotModel.from_urdf(_urdf())).measures(m)[:2] for m in motions]
    objective = Objective(MODEL)
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 1, 3, 0, 4, 2, 2]):
        for k in order:
            assert objective.measures(motions[k])[:2] == alone[k]


def test_a_factor_of_the_same_samples_gives_the_same_information() -> None:
    motion = midpoints(some_motion(2))
    factor = Factor.from_samples(MODEL, motion, np.ones_like(motion.position))
    objective = Objective(MODEL, joint_weights=np.array([2.0, 0.5]))
    gram, n = objective.gram(factor), objective.n_samples(motion.n_samples)
    assert n == motion.n_samples
    found = objective.measures(motion)
    assert found.log10_det == pytest.approx(log10_det(gram, n), abs=1e-9)
    assert found.coupling_index == pytest.approx(coupling_index(gram), rel=1e-9)
    np.testing.assert_array_equal(Objective(MODEL).gram(factor), information(factor))


def test_criteria_are_the_measures_and_more() -> None:
    trajectory = some_motion(3)
    motion = midpoints(trajectory)
    criteria = Objective(MODEL).criteria(trajectory, SAMPLE_PERIOD)
    found = Objective(MODEL).measures(motion)
    assert (criteria.log10_det, criteria.coupling_index) == found[:2]
    assert criteria.n_samples == motion.n_samples
    columns = rows_of(motion)
    assert criteria.condition == pytest.approx(np.linalg.cond(columns), rel=1e-6)
    unit = columns / np.linalg.norm(columns, axis=0)
    assert criteria.scaled_condition == pytest.approx(np.linalg.cond(unit), rel=1e-6)


def test_a_motion_that_leaves_a_joint_at_rest_is_worst_of_all() -> None:
    still = plan([[0.0, 0.5], [1.0, 0.5], [-1.0, 0.5]], LIMITS)
    assert Objective(MODEL).measures(midpoints(still))[:2] == (-np.inf, np.inf)


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


def earlier_of(trajectory) -> tuple[np.ndarray, int]:
    motion = midpoints(trajectory)
    columns = rows_of(motion)
    return columns.T @ columns, motion.n_samples


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
    stacked = np.concatenate([rows_of(before), *[rows_of(after)] * repetitions])
    n = n_earlier + repetitions * after.n_samples
    found = objective.measures(after)
    # The step of the samples is 8 ms less what makes it divide the motion: at most one part in
    # the number of samples, which the information of the earlier motion is scaled by.
    room = P * math.log10(1.0 + 1.0 / after.n_samples)
    assert found.log10_det == pytest.approx(spelled_out(stacked, n)[0], abs=room)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_two_motions_tell_more_than_either(seed: int) -> None:
    earlier, n_earlier = earlier_of(some_motion(seed))
    factor = Factor.from_samples(
        MODEL, motion := midpoints(some_motion(seed + 1000)), np.zeros_like(motion.position)
    )
    both = Objective(MODEL, earlier=earlier, earlier_samples=n_earlier).gram(factor)
    for one in (earlier, information(factor)):
        # More in every direction: no combination of parameters gets less certain.
        scale = np.sqrt(np.diag(both))
        assert np.linalg.eigvalsh((both - one) / scale / scale[:, None])[0] >= -1e-12
        assert log10_det(both, 1) > log10_det(one, 1)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_what_is_known_already_decides_nothing_anymore(seed: int) -> None:
    """With all directions but one known for certain, that one alone ranks the motions."""
    random = np.random.default_rng(seed)
    motions = [midpoints(some_motion(1000 * seed + k)) for k in range(3)]
    grams = [rows_of(m).T @ rows_of(m) for m in motions]
    scale = np.sqrt(np.diag(grams[0]))
    v = random.normal(size=P)
    v /= np.linalg.norm(v)
    known = (np.eye(P) - np.outer(v, v)) * scale * scale[:, None] * 1e9
    objective = Objective(MODEL, earlier=known, earlier_samples=10**9)
    found = [objective.measures(m).log10_det for m in motions]
    # det(A + G) -> det(A') (u' G u) for A without the direction u (Schur complement), per N.
    u = v / scale
    alone = [math.log10(u @ gram @ u) for gram in grams]
    steps = [SAMPLE_PERIOD / (m.time[1] - m.time[0]) for m in motions]
    expected = [a + (P - 1) * math.log10(s) for a, s in zip(alone, steps, strict=True)]
    expected = [
        e - P * math.log10((1e9 * s + m.n_samples) / 1e9)
        for e, s, m in zip(expected, steps, motions, strict=True)
    ]
    for k in (1, 2):
        assert found[k] - found[0] == pytest.approx(expected[k] - expected[0], abs=1e-3)


def test_repetitions_alone_change_nothing() -> None:
    motion = midpoints(some_motion(6))
    once, often = (Objective(MODEL, repetitions=r).measures(motion) for r in (1, 30))
    assert once == often


def test_a_second_of_an_earlier_archive_counts_as_a_second_of_the_motion_at_any_rate() -> None:
    # The same motion again: twice the information in twice the samples is the same per sample.
    trajectory = some_motion(7, n_via=12)
    earlier, n_earlier = earlier_of(trajectory)
    objective = Objective(MODEL, earlier=earlier, earlier_samples=n_earlier)
    for period in (SAMPLE_PERIOD, 0.001):
        plain = Objective(MODEL).criteria(trajectory, period)
        both = objective.criteria(trajectory, period)
        assert both.n_samples == pytest.approx(2 * plain.n_samples, rel=2.0 / n_earlier)
        # Both rates see the same motion, but for the last sample and one at each reversal.
        assert both.log10_det == pytest.approx(plain.log10_det, abs=P * 4.0 / n_earlier)
        assert both.coupling_index == pytest.approx(plain.coupling_index, rel=4.0 / n_earlier)


# What is refused.


@pytest.mark.parametrize(
    "given_",
    [
        {"parameters": np.zeros((2, 2), dtype=np.intp)},
        {"joint_weights": np.ones(3)},
        {"earlier": np.eye(P + 1), "earlier_samples": 5},
    ],
)
def test_arrays_of_another_robot_are_refused(given_: dict) -> None:
    with pytest.raises(ShapeError) as refusal:
        Objective(MODEL, **given_)
    assert refusal.value.name == next(iter(given_))


@pytest.mark.parametrize(
    ("name", "given_"),
    [
        ("parameters", {"parameters": []}),
        ("parameters", {"parameters": [0, 1, 1]}),
        ("parameters", {"parameters": [-1, 2]}),
        ("parameters", {"parameters": [0, P]}),
        ("joint_weights", {"joint_weights": [1.0, 0.0]}),
        ("joint_weights", {"joint_weights": [1.0, np.nan]}),
        ("earlier", {"earlier": np.full((P, P), np.nan), "earlier_samples": 5}),
        ("earlier_samples", {"earlier": np.eye(P)}),
        ("earlier_samples", {"earlier_samples": 5}),
        ("repetitions", {"repetitions": 0}),
    ],
)
def test_values_that_mean_nothing_are_refused_by_name(name: str, given_: dict) -> None:
    with pytest.raises(DesignError) as refusal:
        Objective(MODEL, **given_)
    assert refusal.value.name == name


def test_values_of_another_model_are_refused() -> None:
    with pytest.raises(ShapeError, match="values"):
        Objective(MODEL).measures(midpoints(some_motion(8)), np.ones(P + 1))


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
    for series, expected in zip(motion[1:], trajectory.sample(motion.time), strict=True):
        np.testing.assert_array_equal(series, expected)


@given(seed=seeds, period=periods)
@settings(max_examples=50, deadline=None)
def test_samples_for_criteria_lie_in_the_middle_of_those_steps(seed: int, period: float) -> None:
    trajectory = some_motion(seed)
    ends, motion = sampled(trajectory, period), midpoints(trajectory, period)
    middle = 0.5 * (ends.time[1:] + ends.time[:-1])
    np.testing.assert_allclose(motion.time, middle, rtol=1e-12)
    assert np.all(motion.velocity[[0, -1]] != 0.0)  # neither end, where nothing moves
    for series, expected in zip(motion[1:], trajectory.sample(motion.time), strict=True):
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
    assert Objective(MODEL).measures(midpoints(nowhere))[:2] == (-np.inf, np.inf)


def _urdf() -> str:
    return (Path(__file__).parent / "two_link.urdf").read_text(encoding="utf-8")
