"""The front of scored motions, its knee, and the scale that measures are weighed in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.excitation.constraints import KINDS
from identification.excitation.errors import DesignError
from identification.excitation.searches.scores import Front, Scale, Scores

RANDOM_MOTIONS = Scale(20.0, 10.0, 150.0, 30.0)


def scores_of(log10_det, coupling_index, *, duration=None, excess=None):
    size = np.array(log10_det, dtype=float)
    return Scores(
        log10_det=size,
        coupling_index=np.array(coupling_index, dtype=float),
        duration=np.full(len(size), 5.0) if duration is None else np.array(duration, dtype=float),
        excess=np.zeros((len(size), len(KINDS))) if excess is None else excess,
    )


def front_of(log10_det, coupling_index):
    genes = np.arange(len(log10_det), dtype=float)[:, None]
    return Front.of(genes, scores_of(log10_det, coupling_index))


def contents(front):
    return np.column_stack((front.coupling_index, front.log10_det, front.duration, front.genes))


def same(a, b):
    return np.array_equal(contents(a), contents(b))


# Few different values, so that ties and duplicates are the rule.
motions = st.lists(
    st.tuples(
        st.integers(0, 5),  # log10 det
        st.integers(0, 5),  # coupling index
        st.integers(1, 2),  # duration
        st.integers(0, 2),  # a gene
        st.integers(0, 2),  # another
        st.booleans(),  # feasible
    ),
    max_size=40,
)


def front_of_motions(rows):
    table = np.array(rows, dtype=float).reshape(-1, 6)
    excess = np.zeros((len(table), len(KINDS)))
    excess[:, 3] = np.where(table[:, 5] > 0.0, 0.0, 0.1)
    scores = scores_of(table[:, 0], table[:, 1], duration=table[:, 2], excess=excess)
    return Front.of(table[:, 3:5], scores)


@given(motions)
def test_the_front_is_what_brute_force_finds(rows):
    feasible = [row for row in rows if row[5]]
    unbeaten = {
        (c, d)
        for d, c, *_ in feasible
        if not any((e >= d and f <= c) and (e > d or f < c) for e, f, *_ in feasible)
    }
    expected = [
        min((t, g, h) for d, c, t, g, h, _ in feasible if (c, d) == pair)
        for pair in sorted(unbeaten)
    ]
    front = front_of_motions(rows)
    found = list(zip(front.coupling_index, front.log10_det, strict=True))
    assert found == sorted(unbeaten)
    assert [tuple(row) for row in np.column_stack((front.duration, front.genes))] == expected


@given(motions, st.randoms(use_true_random=False))
def test_the_order_of_the_motions_changes_nothing(rows, random):
    shuffled = list(rows)
    random.shuffle(shuffled)
    assert same(front_of_motions(rows), front_of_motions(shuffled))


@given(motions, motions, motions)
def test_merging_is_the_front_of_everything_in_whatever_order(a, b, c):
    whole = front_of_motions(a + b + c)
    parts = [front_of_motions(part) for part in (a, b, c)]
    assert same(parts[0].merge(parts[1]).merge(parts[2]), whole)
    assert same(parts[0].merge(parts[1].merge(parts[2])), whole)
    assert same(parts[2].merge(parts[0]).merge(parts[1]), whole)
    assert same(whole.merge(whole), whole)


@given(motions)
def test_nothing_merged_changes_nothing(rows):
    front = front_of_motions(rows)
    assert same(front.merge(Front.empty(2)), front)


def test_along_the_front_both_measures_rise():
    random = np.random.default_rng(1)
    front = front_of(random.normal(100, 5, 500), random.normal(90, 5, 500))
    assert len(front) > 2
    assert np.all(np.diff(front.coupling_index) > 0)
    assert np.all(np.diff(front.log10_det) > 0)


def test_motions_that_leave_a_parameter_unexcited_are_left_out():
    front = front_of([-np.inf, 50.0], [np.inf, 100.0])
    assert front.log10_det.tolist() == [50.0]


def test_a_front_of_nothing_feasible_is_empty_and_has_no_knee():
    front = front_of([-np.inf], [np.inf])
    assert len(front) == 0
    with pytest.raises(ValueError, match="empty"):
        front.knee()


def test_one_motion_is_its_own_knee():
    assert front_of([50.0], [100.0]).knee() == 0


def test_of_two_motions_the_knee_is_the_better_balanced_one():
    # Nine units of the determinant against three of the coupling: 0.9 of a spread against 0.1.
    assert front_of([100.0, 109.0], [80.0, 83.0]).knee(RANDOM_MOTIONS) == 1
    assert front_of([100.0, 100.9], [80.0, 110.0]).knee(RANDOM_MOTIONS) == 0


def test_the_knee_of_a_bent_front_is_its_corner():
    front = front_of([90.0, 104.0, 104.5, 105.0], [60.0, 61.0, 80.0, 100.0])
    assert front.log10_det[front.knee()] == 104.0


def test_the_knee_of_a_quarter_circle_is_half_way():
    angle = np.radians(np.arange(0.0, 91.0, 5.0))
    front = front_of(100.0 + 10.0 * np.sin(angle), 70.0 + 40.0 * (1.0 - np.cos(angle)))
    assert front.coupling_index[front.knee()] == pytest.approx(70 + 40 * (1 - np.sqrt(0.5)))


def test_the_knee_does_not_depend_on_units():
    angle = np.radians(np.arange(0.0, 91.0, 5.0))
    size, coupled = 100.0 + np.sin(angle) ** 0.7, 70.0 + 9.0 * (1.0 - np.cos(angle))
    assert front_of(size, coupled).knee() == front_of(7.0 * size - 300.0, 0.1 * coupled).knee()


def test_one_silly_motion_at_the_end_does_not_decide():
    bent = ([90.0, 104.0, 104.5, 105.0], [60.0, 64.0, 80.0, 100.0])
    silly = ([-300.0, *bent[0]], [59.9, *bent[1]])
    chosen = front_of(*silly)
    assert chosen.log10_det[chosen.knee(RANDOM_MOTIONS)] == 104.0
    # Without knowing what random motions reach, it does: everything lies above its chord.
    assert chosen.log10_det[chosen.knee()] != 104.0


def test_where_nothing_beats_the_median_random_motion_the_whole_front_counts():
    front = front_of([5.0, 10.0, 11.0], [151.0, 152.0, 170.0])
    assert front.knee(RANDOM_MOTIONS) == front.knee() == 1


HALF = (0.5, 0.5)


def sampled_scores(log10_det, coupling_index, *, infeasible=0):
    excess = np.zeros((len(log10_det), len(KINDS)))
    excess[:infeasible, 3] = 1.0
    return scores_of(log10_det, coupling_index, excess=excess)


@pytest.fixture
def random_motions():
    random = np.random.default_rng(4)
    return random.normal(19.0, 8.0, 200), random.normal(148.0, 25.0, 200)


def test_the_median_random_motion_is_worth_nothing(random_motions):
    scale = Scale.of(sampled_scores(*random_motions))
    median = [np.median(values) for values in random_motions]
    assert scale.fitness(*median, HALF) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 1.0)])
def test_from_the_worse_to_the_better_quarter_is_one_unit_in_either_measure(
    random_motions, weights
):
    scale = Scale.of(sampled_scores(*random_motions))
    size, coupled = (np.quantile(values, (0.25, 0.75)) for values in random_motions)
    better = scale.fitness(size[1], coupled[0], weights)
    worse = scale.fitness(size[0], coupled[1], weights)
    assert better - worse == pytest.approx(1.0)


@given(st.floats(-300, 300), st.floats(0.0, 1.0))
def test_other_units_of_the_parameters_do_not_change_the_fitness(shift, first):
    random = np.random.default_rng(4)
    size, coupled = random.normal(19.0, 8.0, 60), random.normal(148.0, 25.0, 60)
    weights = (first, 1.0 - first)
    plain = Scale.of(sampled_scores(size, coupled)).fitness(size, coupled, weights)
    shifted = Scale.of(sampled_scores(size + shift, coupled)).fitness(
        size + shift, coupled, weights
    )
    np.testing.assert_allclose(shifted, plain, rtol=0, atol=1e-10)


def test_a_larger_determinant_and_less_coupling_are_better(random_motions):
    scale = Scale.of(sampled_scores(*random_motions))
    worse, larger, less_coupled = scale.fitness([50.0, 51.0, 50.0], [90.0, 90.0, 89.0], HALF)
    assert larger > worse
    assert less_coupled > worse


def test_a_motion_that_leaves_a_parameter_unexcited_is_worst(random_motions):
    scale = Scale.of(sampled_scores(*random_motions))
    assert scale.fitness([-np.inf, -1e4], [np.inf, 1653.0], HALF)[0] == -np.inf


def test_only_feasible_motions_count_where_there_are_enough(random_motions):
    size, coupled = random_motions
    mixed = sampled_scores(
        np.concatenate((np.full(100, -500.0), size)),
        np.concatenate((np.full(100, 1000.0), coupled)),
        infeasible=100,
    )
    assert Scale.of(mixed) == Scale.of(sampled_scores(size, coupled))


def test_where_hardly_any_is_feasible_all_that_could_be_judged_count(random_motions):
    assert Scale.of(sampled_scores(*random_motions, infeasible=195)) == Scale.of(
        sampled_scores(*random_motions)
    )


def test_motions_that_do_not_exist_do_not_count(random_motions):
    size, coupled = random_motions
    holes = sampled_scores(np.append(size, -np.inf), np.append(coupled, np.inf))
    assert Scale.of(holes) == Scale.of(sampled_scores(size, coupled))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_scale_needs_different_motions(count):
    with pytest.raises(DesignError, match="random motions"):
        Scale.of(sampled_scores(np.full(count, 20.0), np.full(count, 150.0)))
