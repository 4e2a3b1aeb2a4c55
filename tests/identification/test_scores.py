"""The front of scored motions, its knee, and the scale that measures are weighed in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.excitation import KINDS, DesignError, Front, Scale, Scores

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
    found = zip(front.measure("coupling_index"), front.measure("log10_det"), strict=True)
    assert list(found) == sorted(unbeaten)
    assert [tuple(row) for row in np.column_stack((front.duration, front.genes))] == expected


@given(motions, motions, motions, st.randoms(use_true_random=False))
def test_a_front_is_of_the_set_of_motions_alone(a, b, c, random):
    shuffled = a + b + c
    random.shuffle(shuffled)
    whole = front_of_motions(shuffled)
    parts = [front_of_motions(part) for part in (a, b, c)]
    assert same(parts[0].merge(parts[1]).merge(parts[2]), whole)
    assert same(parts[2].merge(parts[0].merge(parts[1])), whole)
    assert same(whole.merge(whole), whole)
    assert same(whole.merge(Front.empty(2)), whole)


def test_motions_without_excitation_are_left_out():
    assert front_of([-np.inf, 50.0], [np.inf, 100.0]).measures.tolist() == [[50.0, 100.0]]


def test_an_empty_front_has_no_knee():
    with pytest.raises(ValueError, match="empty"):
        front_of([-np.inf], [np.inf]).knee()


BENT = ([90.0, 104.0, 104.5, 105.0], [60.0, 61.0, 80.0, 100.0])
FAR_END = ([-300.0, 90.0, 104.0, 104.5, 105.0], [59.9, 60.0, 64.0, 80.0, 100.0])


@pytest.mark.parametrize(
    ("size", "coupled", "scale", "knee"),
    [
        ([50.0], [100.0], None, 50.0),
        # Of two: nine units of the determinant against three of the coupling, 0.9 and 0.1 spreads.
        ([100.0, 109.0], [80.0, 83.0], RANDOM_MOTIONS, 109.0),
        ([100.0, 100.9], [80.0, 110.0], RANDOM_MOTIONS, 100.0),
        (*BENT, None, 104.0),
        (*FAR_END, RANDOM_MOTIONS, 104.0),
        (*FAR_END, None, 90.0),  # everything lies above the chord from one silly motion
        # Where nothing beats the median random motion the whole front counts.
        ([5.0, 10.0, 11.0], [151.0, 152.0, 170.0], RANDOM_MOTIONS, 10.0),
    ],
)
def test_the_knee_is_the_corner_of_the_front(size, coupled, scale, knee):
    front = front_of(size, coupled)
    assert front.measure("log10_det")[front.knee(scale)] == knee


@pytest.mark.parametrize("units", [(1.0, 1.0), (7.0, 0.1)])
def test_the_knee_of_a_quarter_circle_is_half_way(units):
    angle = np.radians(np.arange(0.0, 91.0, 5.0))
    size, coupled = 100.0 + 10.0 * np.sin(angle), 70.0 + 40.0 * (1.0 - np.cos(angle))
    front = front_of(units[0] * size - 300.0, units[1] * coupled)
    expected = units[1] * (70 + 40 * (1 - np.sqrt(0.5)))
    assert front.measure("coupling_index")[front.knee()] == pytest.approx(expected)


@pytest.fixture
def random_motions():
    random = np.random.default_rng(4)
    return random.normal(19.0, 8.0, 200), random.normal(148.0, 25.0, 200)


def test_a_scale_counts_from_the_median_in_quartiles(random_motions):
    scale = Scale.of(scores_of(*random_motions))
    median = [np.median(values) for values in random_motions]
    assert scale.fitness(median, HALF) == pytest.approx(0.0, abs=1e-12)
    size, coupled = (np.quantile(values, (0.25, 0.75)) for values in random_motions)
    for weights in ((1.0, 0.0), (0.0, 1.0)):
        worse, better = scale.fitness([[size[0], coupled[1]], [size[1], coupled[0]]], weights)
        assert better - worse == pytest.approx(1.0)
    worst = scale.fitness([[-np.inf, np.inf], [-1e4, 1653.0]], HALF)
    assert worst[0] == -np.inf < worst[1]


@given(st.floats(-300, 300), st.floats(0.0, 1.0))
def test_units_of_parameters_do_not_change_the_fitness(shift, first):
    random = np.random.default_rng(4)
    measures = np.column_stack((random.normal(19.0, 8.0, 60), random.normal(148.0, 25.0, 60)))
    found = [
        Scale.of(scores_of(*(measures + by).T)).fitness(measures + by, (first, 1.0 - first))
        for by in ((0.0, 0.0), (shift, 0.0))
    ]
    np.testing.assert_allclose(*found, rtol=0, atol=1e-10)


def test_only_feasible_motions_count_where_there_are_enough(random_motions):
    size, coupled = random_motions
    expected = Scale.of(scores_of(size, coupled))
    broken = np.arange(300) < 100
    far = np.append(np.full(100, -500.0), size), np.append(np.full(100, 1000.0), coupled)
    assert Scale.of(scores_of(*far, excess=broken)) == expected
    assert Scale.of(scores_of(size, coupled, excess=np.arange(200) < 195)) == expected
    holes = np.append(size, -np.inf), np.append(coupled, np.inf)
    assert Scale.of(scores_of(*holes)) == expected


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_scale_needs_different_motions(count):
    with pytest.raises(DesignError, match="random motions"):
        Scale.of(scores_of(np.full(count, 20.0), np.full(count, 150.0)))
