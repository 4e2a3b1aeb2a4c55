"""Criteria of motions, objective of a search, scale and Pareto front."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.excitation import CRITERIA, KINDS
from identification.excitation.constraints import SAMPLE_PERIOD, midpoints, sampled
from identification.excitation.criteria import (
    Criteria,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    log10_det,
)
from identification.excitation.errors import DesignError
from identification.excitation.objective import Objective
from identification.excitation.searches.scores import Front, Scale, Scores
from identification.model.robot import RobotModel
from planner import FourierSeries, JointLimits, plan
from sim_fixtures.ns16 import urdf_text
from tests.identification.searching import NS16_VELOCITY
from tests.identification.two_link import URDF

LIMITS = JointLimits([-2.5] * 2, [2.5] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
MODEL = RobotModel.from_urdf(URDF)
P = MODEL.n_parameters
seeds = st.integers(0, 999)


def some_motion(seed, n_via=5):
    via = np.random.default_rng(seed).uniform(-2.4, 2.4, (n_via, 2))
    return plan(via, LIMITS, fly=0.5)


def rows_of(motion):
    """Phi of one motion: a row per sample and joint."""
    return MODEL.regressor(*motion[1:]).dense(P).reshape(-1, P)


def assert_measures(found, columns, n_samples):
    """Eqs. 9 and 5 from numpy's QR of Phi itself, which squares no condition number."""
    r = np.linalg.qr(columns, mode="r")
    determinant = 2.0 * np.log10(np.abs(np.diag(r))).sum() - r.shape[1] * math.log10(n_samples)
    inverse = np.linalg.inv(r)
    psi = inverse @ inverse.T
    deviation = np.sqrt(np.diag(psi))
    index = np.abs(np.triu(psi / deviation / deviation[:, None], 1)).sum()
    assert found["log10_det"] == pytest.approx(determinant, abs=1e-8)
    assert found["coupling_index"] == pytest.approx(index, rel=1e-8, abs=1e-12)


class TestSamples:
    @given(seed=seeds, period=st.floats(1e-3, 5e-2))
    @settings(max_examples=50, deadline=None)
    def test_they_are_uniform_at_ends_or_in_the_middle(self, seed, period):
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
        ("length", "period", "steps"),
        [(16.0, 0.001, 16000), (16.0, 0.008, 2000), (8.008, 0.008, 1001)],
    )
    def test_whole_periods_get_no_further_sample(self, length, period, steps):
        """The paper's N is 2000; 8.008 s over 8 ms is more than 1001 by rounding."""
        swing = FourierSeries(np.zeros(2), np.ones((2, 1)), np.ones((2, 1)), length)
        assert sampled(swing, period).n_samples == steps + 1
        assert midpoints(swing, period).n_samples == steps


HAND = np.array([[2.0, 1.0], [1.0, 3.0]])  # det = 5, inverse [[3, -1], [-1, 2]] / 5


def random_columns(seed, rows=40, p=5):
    random = np.random.default_rng(seed)
    return random.normal(size=(rows, p)) @ random.normal(size=(p, p))


def gram_of(columns):
    return columns.T @ columns


class TestCriteria:
    def test_a_small_case_by_hand(self):
        found = Criteria.of_gram(HAND, 10)
        assert found.log10_det == pytest.approx(math.log10(5.0 / 10.0**2), abs=1e-14)
        assert found.coupling_index == pytest.approx(1.0 / math.sqrt(6.0), abs=1e-14)
        equation_7 = 0.7 * math.log10(5.0 / 100.0) + 0.3 * 1.0 * math.sqrt(6.0)
        assert found.fitness == pytest.approx(equation_7, rel=1e-13)
        assert fitness_eq7(*found.measures, 2, (1.0, 0.0)) == pytest.approx(found.log10_det)
        assert found.measures == (log10_det(HAND, 10), coupling_index(HAND))
        assert tuple(CRITERIA) == ("log10_det", "coupling_index")

    def test_a_determinant_beyond_floats_has_a_logarithm(self):
        gram = np.diag(np.full(58, 1e9))
        with np.errstate(over="ignore"):
            assert np.linalg.det(gram) == np.inf
        assert log10_det(gram, 1) == pytest.approx(9.0 * 58)

    @pytest.mark.parametrize(
        "gram",
        [
            np.diag([1.0, 0.0, 2.0]),  # a parameter without excitation
            np.array([[4.0, 2.0, 2.0], [2.0, 1.0, 1.0], [2.0, 1.0, 1.0]]),  # two equal columns
            np.full((3, 3), np.nan),
        ],
    )
    def test_a_singular_matrix_ranks_last(self, gram):
        expected = Criteria(-np.inf, np.inf, -np.inf, 10, np.inf, np.inf)
        assert Criteria.of_gram(gram, 10) == expected
        assert np.isnan(correlation(gram)).all()

    @pytest.mark.parametrize("p", [2, 5, 12])
    def test_fully_correlated_errors_reach_the_largest_coupling(self, p):
        assert coupling_index_max(58) == 1653.0
        together = np.linspace(1.0, 2.0, p) * (-1.0) ** np.arange(p)
        apart = 1e-7
        # the inverse of (t t' + e 1) by Sherman and Morrison
        gram = np.eye(p) - np.outer(together, together) / (apart + together @ together)
        assert coupling_index(gram) == pytest.approx(coupling_index_max(p), rel=1e-5)
        assert coupling_index(gram) <= coupling_index_max(p)

    @given(seed=st.integers(0, 99))
    def test_the_coupling_index_sums_the_correlations(self, seed):
        gram = gram_of(random_columns(seed))
        matrix = correlation(gram)
        assert np.array_equal(matrix, matrix.T)
        assert np.array_equal(np.diag(matrix), np.ones(5))
        assert np.abs(matrix).max() <= 1.0
        index = np.abs(np.triu(matrix, 1)).sum()
        assert coupling_index(gram) == pytest.approx(index, rel=1e-14)
        assert index <= coupling_index_max(5)


class TestMeasures:
    @given(seed=seeds, chosen=st.sets(st.integers(0, P - 1), min_size=1))
    @settings(max_examples=20, deadline=None)
    def test_they_are_of_the_chosen_columns(self, seed, chosen):
        motion, random = midpoints(some_motion(seed)), np.random.default_rng(seed)
        order = random.permutation(sorted(chosen))
        columns = rows_of(motion)
        objective = Objective(MODEL, parameters=order)
        assert objective.n_parameters == len(chosen)
        assert_measures(objective.measures(motion), columns[:, order], motion.n_samples)
        assert_measures(Objective(MODEL).measures(motion), columns, motion.n_samples)

    def test_criteria_are_the_measures_and_more(self):
        trajectory = some_motion(3)
        motion = midpoints(trajectory)
        criteria = Objective(MODEL).criteria(trajectory, SAMPLE_PERIOD)
        assert criteria.measures == tuple(Objective(MODEL).measures(motion).values())
        assert criteria.n_samples == motion.n_samples
        columns = rows_of(motion)
        unit = columns / np.linalg.norm(columns, axis=0)
        assert criteria.condition == pytest.approx(np.linalg.cond(columns), rel=1e-6)
        assert criteria.scaled_condition == pytest.approx(np.linalg.cond(unit), rel=1e-6)

    def test_criteria_agree_at_8_ms_and_1_ms(self):
        """Section 3.2 on a planned motion of six joints through eight points."""
        velocity, model = NS16_VELOCITY, RobotModel.from_urdf(urdf_text())
        limits = JointLimits([-2.8] * 6, [2.8] * 6, velocity, velocity / 0.3, velocity / 0.3 / 0.1)
        via = np.random.default_rng(0).uniform(-2.7, 2.7, (8, 6))
        motion = plan(via, limits, speed=0.5, fly=0.5)
        coarse, fine = (Objective(model).criteria(motion, period) for period in (0.008, 0.001))
        assert fine.n_samples == pytest.approx(8 * coarse.n_samples, rel=0.01)
        # From one random motion to the next they spread by 12 and by 9: a thousandth, a fiftieth.
        assert coarse.log10_det == pytest.approx(fine.log10_det, abs=0.012)
        assert coarse.coupling_index == pytest.approx(fine.coupling_index, abs=0.18)
        raw = [c.log10_det + 58 * math.log10(c.n_samples) for c in (coarse, fine)]
        assert raw[1] - raw[0] == pytest.approx(58 * math.log10(8), abs=0.1)  # without the scaling


RANDOM_MOTIONS = Scale((20.0, 150.0), (10.0, 30.0))
HALF = (0.5, 0.5)


def scores_of(log10_det, coupling_index, *, duration=5.0, excess=0.0):
    """Scores with one excess, of collisions."""
    measures = np.array([log10_det, coupling_index], dtype=float).T.reshape(-1, 2)
    broken = np.zeros((len(measures), len(KINDS)))
    broken[:, KINDS.index("collision")] = excess
    return Scores(measures, np.full(len(measures), duration, dtype=float), broken)


def front_of(log10_det, coupling_index):
    genes = np.arange(len(log10_det), dtype=float)[:, None]
    return Front.of(genes, scores_of(log10_det, coupling_index))


def same(a, b):
    return all(map(np.array_equal, vars(a).values(), vars(b).values()))


# Few different values, so that ties and duplicates are the rule: log10 det, coupling index,
# duration, two genes, and whether it is feasible.
motions = st.lists(
    st.tuples(
        *(st.integers(*ends) for ends in ((0, 5), (0, 5), (1, 2), (0, 2), (0, 2))), st.booleans()
    ),
    max_size=40,
)


def front_of_motions(rows):
    table = np.array(rows, dtype=float).reshape(-1, 6)
    size, coupled, duration, *_, feasible = table.T
    scores = scores_of(size, coupled, duration=duration, excess=np.where(feasible > 0, 0.0, 0.1))
    return Front.of(table[:, 3:5], scores)


BENT = ([90.0, 104.0, 104.5, 105.0], [60.0, 61.0, 80.0, 100.0])
FAR_END = ([-300.0, 90.0, 104.0, 104.5, 105.0], [59.9, 60.0, 64.0, 80.0, 100.0])


class TestFront:
    @given(motions)
    def test_it_is_what_brute_force_finds(self, rows):
        feasible = [row for row in rows if row[5]]
        nondominated = {
            (c, d)
            for d, c, *_ in feasible
            if not any((e >= d and f <= c) and (e > d or f < c) for e, f, *_ in feasible)
        }
        expected = [
            min((t, g, h) for d, c, t, g, h, _ in feasible if (c, d) == pair)
            for pair in sorted(nondominated)
        ]
        front = front_of_motions(rows)
        found = zip(front.measure("coupling_index"), front.measure("log10_det"), strict=True)
        assert list(found) == sorted(nondominated)
        assert [tuple(row) for row in np.column_stack((front.duration, front.genes))] == expected

    @given(motions, motions, motions, st.randoms(use_true_random=False))
    def test_it_does_not_depend_on_order(self, a, b, c, random):
        shuffled = a + b + c
        random.shuffle(shuffled)
        whole = front_of_motions(shuffled)
        parts = [front_of_motions(part) for part in (a, b, c)]
        assert same(parts[0].merge(parts[1]).merge(parts[2]), whole)
        assert same(parts[2].merge(parts[0].merge(parts[1])), whole)
        assert same(whole.merge(whole), whole)
        assert same(whole.merge(Front.empty(2)), whole)

    def test_motions_without_excitation_are_left_out(self):
        assert front_of([-np.inf, 50.0], [np.inf, 100.0]).measures.tolist() == [[50.0, 100.0]]

    @pytest.mark.parametrize(
        ("size", "coupled", "scale", "knee"),
        [
            ([50.0], [100.0], None, 50.0),
            # Of two: nine units of the determinant against three of the coupling, in spreads.
            ([100.0, 109.0], [80.0, 83.0], RANDOM_MOTIONS, 109.0),
            ([100.0, 100.9], [80.0, 110.0], RANDOM_MOTIONS, 100.0),
            (*BENT, None, 104.0),
            (*FAR_END, RANDOM_MOTIONS, 104.0),
            (*FAR_END, None, 90.0),  # all lie above the chord from an extreme motion
            # Without a motion better than the median the whole front counts.
            ([5.0, 10.0, 11.0], [151.0, 152.0, 170.0], RANDOM_MOTIONS, 10.0),
        ],
    )
    def test_the_knee_is_the_corner_of_the_front(self, size, coupled, scale, knee):
        front = front_of(size, coupled)
        assert front.measure("log10_det")[front.knee(scale)] == knee


@pytest.fixture
def random_motions():
    random = np.random.default_rng(4)
    return random.normal(19.0, 8.0, 200), random.normal(148.0, 25.0, 200)


class TestScale:
    def test_it_counts_from_the_median_in_quartiles(self, random_motions):
        scale = Scale.of(scores_of(*random_motions))
        median = [np.median(values) for values in random_motions]
        assert scale.fitness(median, HALF) == pytest.approx(0.0, abs=1e-12)
        size, coupled = (np.quantile(values, (0.25, 0.75)) for values in random_motions)
        for weights in ((1.0, 0.0), (0.0, 1.0)):
            worse, better = scale.fitness([[size[0], coupled[1]], [size[1], coupled[0]]], weights)
            assert better - worse == pytest.approx(1.0)
        worst = scale.fitness([[-np.inf, np.inf], [-1e4, 1653.0]], HALF)
        assert worst[0] == -np.inf < worst[1]

    def test_it_uses_feasible_motions_if_there_are_enough(self, random_motions):
        size, coupled = random_motions
        expected = Scale.of(scores_of(size, coupled))
        broken = np.arange(300) < 100
        far = np.append(np.full(100, -500.0), size), np.append(np.full(100, 1000.0), coupled)
        assert Scale.of(scores_of(*far, excess=broken)) == expected
        assert Scale.of(scores_of(size, coupled, excess=np.arange(200) < 195)) == expected
        holes = np.append(size, -np.inf), np.append(coupled, np.inf)
        assert Scale.of(scores_of(*holes)) == expected

    @pytest.mark.parametrize("count", [0, 1, 5])
    def test_it_needs_different_motions(self, count):
        with pytest.raises(DesignError, match="random motions"):
            Scale.of(scores_of(np.full(count, 20.0), np.full(count, 150.0)))
