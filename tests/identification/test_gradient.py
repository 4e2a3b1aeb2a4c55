"""Gradient of a motion's criteria by its genes, and the improvement that uses it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import RobotModel
from identification.excitation.constraints import CurrentModel, midpoints, sampled
from identification.excitation.criteria import (
    CRITERIA,
    SENSE,
    SMALL_CORRELATION,
    Given,
    Objective,
    correlation,
    log10_det,
)
from identification.excitation.motion_precision import Precision, Quantities
from identification.excitation.searches import search as search_module
from identification.excitation.searches.bundle_method import Ascent, _Cut, _step, improve
from identification.excitation.searches.local_change import LocalChange
from identification.excitation.searches.population import Population, Scores, SearchSettings
from identification.excitation.searches.search import search
from identification.excitation.searches.sensitivity import Linearisation, gene_slopes
from identification.model.coupling import Coupling
from identification.model.motion import Motion
from planner import PlannerError
from tests.identification.searching import bits, problem
from tests.identification.two_link import URDF

pytestmark = pytest.mark.long

WEIGHTS = np.array([0.75, -0.25])
SMALL_SHARE = Coupling(np.array([[1.0, 0.0], [0.03, 1.0]]))
SETTINGS = SearchSettings(
    method="gradient", population=12, generations=2, seed=3, weights=(0.75, 0.25), gradient=8
)


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """Make the genomes of these tests importable in child processes."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


def fitness(scores: Scores) -> np.ndarray:
    return scores.measures @ WEIGHTS


def limited(problem_):
    """The problem with currents limited to the median of random motions."""
    model = problem_.objective.model
    currents = CurrentModel(
        model,
        np.abs(np.random.default_rng(4).standard_normal(model.n_parameters)),
        np.eye(2),
        np.ones(2),
        np.ones(2),
    )
    genes = problem_.genome.sample(np.random.default_rng(5), 40)
    loads = [
        currents.loads(midpoints(motion)).max(axis=0) for motion in problem_.genome.motions(genes)
    ]
    currents = replace(currents, current_limit=np.median(loads, axis=0))
    return replace(problem_, constraints=replace(problem_.constraints, currents=currents))


@pytest.fixture(scope="module")
def population():
    with Population(limited(problem())) as population:
        yield population


@pytest.fixture(scope="module")
def start(population):
    """Genes and scores of the best feasible one of 60 random motions."""
    genes = population.problem.genome.sample(np.random.default_rng(5), 60)
    scores = population.score(genes)
    best = int(np.argmax(np.where(scores.usable, fitness(scores), -np.inf)))
    assert scores.usable[best]
    return genes[best], scores.take(best)


def test_slopes_are_derivatives_by_the_information():
    random = np.random.default_rng(1)
    root = random.standard_normal((40, 13)) * np.geomspace(0.1, 30.0, 13)
    gram = root.T @ root
    change = random.standard_normal((13, 13))
    change = 1e-6 * (change + change.T)
    objective = problem().objective
    values = {"log10_det": lambda gram: log10_det(gram, 40), "coupling_index": smoothed_coupling}
    for weights, name in zip(np.eye(len(SENSE)), CRITERIA, strict=True):
        above, below = (values[name](gram + sign * change) for sign in (1.0, -1.0))
        expected = np.sum(objective.slope(gram, weights) * change)
        np.testing.assert_allclose((above - below) / 2.0, expected, rtol=1e-5)


def smoothed_coupling(gram):
    """I_c without the kinks at correlations of zero."""
    return np.hypot(correlation(gram)[np.tril_indices(len(gram), -1)], SMALL_CORRELATION).sum()


@pytest.mark.parametrize("kind", ["alone", "beside-earlier-recordings", "for-a-precision"])
def test_the_gradient_predicts_changes_of_the_criteria(population, start, kind):
    """In random directions, along which no kink of the interpolator lies."""
    genes, _ = start
    problem_ = population.problem
    random = np.random.default_rng(2)
    objective = problem_.objective
    weights = WEIGHTS
    if kind == "beside-earlier-recordings":
        root = random.standard_normal((13, 40))
        objective = replace(objective, given=Given(root @ root.T / 40.0, 2.0))
    if kind == "for-a-precision":
        weights = None
        wanted = Precision(Quantities(np.eye(13), np.ones(13)), np.ones(2), np.eye(13))
        objective = replace(objective, precision=wanted)
    problem_ = replace(problem_, objective=objective)
    sensitivity = problem_.sensitivity(genes, weights)
    gradient = gene_slopes(problem_, sensitivity, genes, np.arange(len(genes)))[:, 0]

    def value(row):
        (motion,) = problem_.genome.motions(row[None])
        assert not isinstance(motion, PlannerError)
        if weights is None:
            sampled = midpoints(motion, 1e-3)
            return -np.log(objective.precision.criterion(objective.precise_information(sampled)))
        return weights @ objective.criteria(motion, 1e-3).measures

    changes = 1e-3 * random.standard_normal((12, len(genes)))
    expected = [(value(genes + d) - value(genes - d)) / 2.0 for d in changes]
    assert np.corrcoef(changes @ gradient, expected)[0, 1] > 0.95


@pytest.mark.parametrize(
    ("coupling", "joint"),
    [(None, 1), (Coupling(np.array([[1.0, 0.0], [1.0, 1.0]])), 1), (SMALL_SHARE, 0)],
    ids=["of-its-own-motor", "beside-a-coupled-motor", "a-small-share-of-a-motor"],
)
def test_slopes_of_slow_moves_are_not_smoothed(coupling, joint):
    """A joint that hardly moves between some points: by their differences friction turns."""
    problem_ = replace(
        problem(replace(problem().genome, n_via=10)),
        objective=Objective(RobotModel.from_urdf(URDF, coupling=coupling)),
    )
    weights = np.array([1.0, 0.0])  # no I_c, whose slopes are smoothed
    slow = np.arange(6 + joint, 16 + joint, 2)  # coordinates of the joint in five points

    def value(row):
        (motion,) = problem_.genome.motions(row[None])
        return weights @ problem_.objective.criteria(motion, 1e-3).measures

    def errors():
        for seed in range(8):
            random = np.random.default_rng(seed)
            genes = problem_.genome.sample(random, 1)[0]
            genes[slow] = 0.3 + 0.01 * random.random(5)
            sensitivity = problem_.sensitivity(genes, weights)
            slopes = gene_slopes(problem_, sensitivity, genes, slow)[:, 0]
            changes = 1e-4 * np.eye(len(genes))[slow]
            expected = [(value(genes + d) - value(genes - d)) / 2e-4 for d in changes]
            yield np.linalg.norm(slopes - expected) / np.linalg.norm(expected)

    assert np.median(list(errors())) < 0.15


def test_a_part_that_takes_longer_counts_more_often(population, start):
    """By a fiftieth: its samples 51 times beside the others 50 times, against 49 times."""
    genes, _ = start
    problem_ = population.problem
    sensitivity = problem_.sensitivity(genes, np.array([1.0, 0.0]))
    (motion,) = problem_.genome.motions(genes[None])
    count = len(sensitivity.time)
    part = slice(count // 4, count // 2)
    step = sensitivity.duration / count
    enter, left = part.start * step, part.stop * step

    class Longer(LocalChange):
        """The same states, as if a gene changed nothing but the time."""

        def states(self, time):
            return np.array(motion.sample(time))

    slopes = sensitivity.slopes(Longer(motion, 0.0, enter, left, (left - enter) / 50.0), 1.0)

    def value(times):
        repeated = np.full(count, 50)
        repeated[part] = times
        states = np.repeat(sensitivity.states, repeated, axis=1)
        return problem_.objective.measures(
            Motion(np.arange(states.shape[1], dtype=float), *states)
        )["log10_det"]

    assert slopes[0] == pytest.approx(0.5 * (value(51) - value(49)), rel=1e-3)
    assert slopes[1] == -(left - enter) / 50.0


@pytest.mark.parametrize("home", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize("n_via", [2, 3, 9])
@pytest.mark.parametrize("fly", [0.0, 0.5, 1.0])
def test_a_via_point_changes_only_the_moves_around_it(home, n_via, fly):
    """Planned as a whole, the motion is the same before them, and after them only later."""
    problem_ = limited(problem())
    limits = problem_.genome.limits
    middle = 0.5 * (limits.lower + limits.upper) if home else None
    genome = replace(problem_.genome, n_via=n_via, fly=fly, home=middle)
    genes = genome.sample(np.random.default_rng(n_via), 1)[0]
    sensitivity = replace(problem_, genome=genome).sensitivity(genes, WEIGHTS)
    assert sensitivity.moves is not None
    which = np.arange(genome.n_point_genes)
    rows = np.repeat(genes[None], len(which), axis=0)
    rows[which, which] += np.where(genes[which] > 0.5, -0.03, 0.03)
    changes = list(sensitivity.moves.changed(genome, rows, which))
    assert n_via < 9 or min(change.length for change in changes) < 0.7 * sensitivity.duration
    for change, motion in zip(changes, genome.motions(rows), strict=True):
        assert motion.duration == pytest.approx(sensitivity.duration + change.later, rel=1e-12)
        part = (sensitivity.time >= change.enter) & (sensitivity.time <= change.left)
        expected = sensitivity.states.copy()
        expected[:, part] = change.states(sensitivity.time[part])
        stretch = 1.0 + change.later / change.length
        time = np.where(
            part, change.enter + stretch * (sensitivity.time - change.enter), sensitivity.time
        )
        time[sensitivity.time > change.left] += change.later
        np.testing.assert_allclose(np.array(motion.sample(time)), expected, rtol=1e-7, atol=1e-7)


def test_margins_are_those_of_duration_and_currents(population, start):
    """Of each peak of each load, at the samples by which the motion is checked."""
    genes, _ = start
    linear_model = population.linearise(genes, WEIGHTS)
    (motion,) = population.problem.genome.motions(genes[None])
    constraints = population.problem.constraints
    np.testing.assert_allclose(
        linear_model.left[0], 0.999 * constraints.max_duration - motion.duration
    )
    loads = constraints.currents.loads(sampled(motion, population.problem.period))
    assert loads.max() > 0.75
    peaks = [
        load
        for column in loads.T
        for before, load, after in zip([-1.0, *column], column, [*column[1:], -1.0], strict=False)
        if load > 0.75 and load > before and load >= after
    ]
    np.testing.assert_allclose(np.sort(linear_model.left[1:]), np.sort(0.999 - np.array(peaks)))
    assert linear_model.rows.shape == (len(linear_model.left), len(genes))


@pytest.mark.parametrize("seed", [1, 2])
def test_slopes_of_a_load_are_those_of_its_peak(population, seed):
    """Of motions whose largest load is not at a reversal, where friction jumps."""
    problem_ = population.problem
    genes = problem_.genome.sample(np.random.default_rng(seed), 4)[3]
    linear_model = population.linearise(genes, WEIGHTS)
    peak = 1 + int(np.argmin(linear_model.left[1:]))

    def most(row):
        (motion,) = problem_.genome.motions(row[None])
        return problem_.constraints.currents.loads(sampled(motion, 1e-3)).max()

    steps = np.where(genes > 0.5, -1e-4, 1e-4)
    rows = genes + np.diag(steps)
    expected = [(most(genes) - most(row)) / step for row, step in zip(rows, steps, strict=True)]
    np.testing.assert_allclose(linear_model.rows[peak], expected, atol=0.1)


def test_a_step_backs_off_from_the_bounds():
    """By a share of what the box would change of each margin, unless no step can."""
    gradient = np.array([1.0, 0.0])
    genes = np.full(2, 0.5)

    def step(rows, left, backoff):
        slopes = Linearisation(gradient, np.array(rows), np.array(left))
        return _step([_Cut(genes, 0.0, slopes)], genes, 0.0, 0.1, backoff)[0]

    bound = [[-1.0, 0.0]], [0.05]
    np.testing.assert_allclose(step(*bound, 0.0), [0.05, 0.0], atol=1e-6)
    np.testing.assert_allclose(step(*bound, 0.3), [0.02, 0.0], atol=1e-6)
    np.testing.assert_allclose(step([[-1.0, 0.0]], [0.0], 0.3), [-0.03, 0.0], atol=1e-6)
    opposed = [[-1.0, 0.0], [1.0, 0.0]], [0.0, 0.0]
    np.testing.assert_allclose(step(*opposed, 0.3), np.zeros(2), atol=1e-6)


class Watched:
    """The ascent of a population; records what it scores and where it takes the slopes."""

    def __init__(self, population, stop_after=99):
        self.population = population
        self.left = stop_after
        self.scored = []
        self.centres = []

    def ascent(self):
        def score(genes):
            self.scored.append(self.population.score(genes))
            return self.scored[-1]

        def linearise(genes, _):
            self.centres.append(genes)
            return self.population.linearise(genes, WEIGHTS)

        def stop():
            self.left -= 1
            return self.left < 0

        return Ascent(score, linearise, fitness, stop)


def test_an_improvement_is_feasible_and_beats_random_motions(population, start):
    genes, scores = start
    better, better_scores = improve(Watched(population).ascent(), genes, scores, 15)
    assert better_scores.usable[0]
    np.testing.assert_array_equal(population.score(better[None]).rows, better_scores.rows)
    random = population.score(population.problem.genome.sample(np.random.default_rng(6), 300))
    most = np.max(np.where(random.usable, fitness(random), -np.inf))
    assert fitness(better_scores)[0] > max(most, fitness(scores)[0])


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_stopped_early_the_motion_is_valid_and_not_worse(population, start, steps):
    genes, scores = start
    watched = Watched(population, steps)
    better, better_scores = improve(watched.ascent(), genes, scores, 15)
    assert len(watched.scored) == steps
    assert better_scores.usable[0] and fitness(better_scores)[0] >= fitness(scores)[0]
    if steps == 0:
        assert better.tobytes() == genes.tobytes()


def test_the_number_of_processes_changes_no_bit(population):
    with Population(population.problem, workers=3) as three:
        assert bits(search(three, SETTINGS)) == bits(search(population, SETTINGS))


def test_the_gradient_improves_the_short_search(population):
    short = search(population, replace(SETTINGS, gradient=0))
    design = search(population, SETTINGS)
    assert design.chosen is None and design.origin_criteria == short.excitation.criteria
    before, after = (np.array(each.excitation.criteria.measures) for each in (short, design))
    assert WEIGHTS @ after > WEIGHTS @ before


def test_several_starts_share_half_of_the_steps(monkeypatch, population):
    """Each has an eighth of 32; the best of the four has the other half."""
    taken = []

    def recorded(ascent, genes, scores, steps):
        improved = improve(ascent, genes, scores, min(steps, 1))
        taken.append((genes.tobytes(), fitness(scores)[0], steps, improved[0].tobytes()))
        return improved

    monkeypatch.setattr(search_module, "improve", recorded)
    design = search(population, replace(SETTINGS, gradient=32, starts=4))
    assert [steps for _, _, steps, _ in taken] == [4, 4, 4, 4, 16]
    starts = [start for start, *_ in taken[:4]]
    assert len(set(starts)) == 4
    assert taken[0][1] == max(value for _, value, _, _ in taken[:4])
    assert taken[4][0] in {end for *_, end in taken[:4]}
    assert design.genes.tobytes() == taken[4][3]


def test_the_first_generation_has_motions_near_home():
    genome = replace(problem().genome, home=np.array([1.0, -1.0]))
    genes = genome.sample(np.random.default_rng(1), 4)
    drawn = genome.contracted(genes, (1.0, 0.5))
    np.testing.assert_array_equal(drawn[::2], genes[::2])
    points, nearer = (genome.decode(rows)[0][1::2] for rows in (genes, drawn))
    np.testing.assert_allclose(nearer - genome.home, 0.5 * (points - genome.home), atol=1e-12)
    assert drawn[:, 6:].tobytes() == genes[:, 6:].tobytes(), "speeds stay"
