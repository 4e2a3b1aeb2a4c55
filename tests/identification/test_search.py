"""Searches, their scores, and journals of scores."""

import errno
import io
import os
import signal
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from identification.excitation import KINDS
from identification.excitation.constraints import CurrentModel, check_motion, midpoints
from identification.excitation.criteria import columns, coupling_index_max
from identification.excitation.errors import JournalError, NoFeasibleMotionError
from identification.excitation.genomes import SineGenome
from identification.excitation.messages import violation_text
from identification.excitation.searches import journal
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.methods import METHODS, SearchMethod
from identification.excitation.searches.population import (
    ROW_LENGTH,
    Front,
    Population,
    Scores,
    SearchSettings,
    unplanned,
)
from identification.excitation.searches.search import search
from identification.excitation.violation import excess_by_kind
from planner import FourierSeries, JointLimits, check_limits
from planner.errors import LimitExceeded
from tests.identification.searching import LIMITS, bits, faulty, problem

pytestmark = pytest.mark.long

SETTINGS = SearchSettings(population=12, generations=4, seed=3)


class RecordingPopulation(Population):
    """Population that records and caches all scores, and can be interrupted."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._known = {}
        self.begin()

    def begin(self, interrupted_after=None):
        self.genes = []
        self.rows = []
        self.interrupted_after = interrupted_after
        return self

    def score(self, genes, scored=None):
        if len(self.genes) == self.interrupted_after:
            raise KeyboardInterrupt
        new = {row.tobytes(): row for row in genes if row.tobytes() not in self._known}
        if new:
            rows = super().score(np.array(list(new.values())), scored).rows
            self._known.update(zip(new, rows, strict=True))
        self.genes.append(genes.copy())
        self.rows.append(np.array([self._known[row.tobytes()] for row in genes]))
        return Scores.of_rows(self.rows[-1])

    @property
    def everything(self):
        return Scores.of_rows(np.concatenate(self.rows))


class Stop:
    """Stop request after a number of calls."""

    def __init__(self, after):
        self.left = after

    def __call__(self):
        self.left -= 1
        return self.left < 0


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """Make the genomes of these tests importable in child processes."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


@pytest.fixture(scope="module")
def shared():
    with RecordingPopulation(problem()) as population:
        yield population


@pytest.fixture
def population(shared):
    return shared.begin()


def asked(method, **others):
    return replace(SETTINGS, method=method, **others)


def fitness_of(settings, scores):
    """Return the fitness of each method."""
    size, coupled = columns(scores.measures, ("log10_det", "coupling_index")).T
    if settings.method == "a":
        return size
    first, second = settings.weights
    if settings.method == "gradient":
        return first * size - second * coupled
    return first * size + second * coupling_index_max(13) / coupled


class TestChoice:
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("weights", [(0.7, 0.3), (0.0, 1.0)])
    def test_the_largest_fitness_is_chosen(self, population, method, weights):
        """Determinant, eq. 7, or weighted sum of both measures."""
        chosen = asked(method, weights=weights)
        design = search(population, chosen)
        fitness = fitness_of(chosen, population.everything)
        best = np.concatenate(population.genes)[np.argmax(fitness)]
        assert best.tobytes() == design.genes.tobytes()

    def test_a_method_is_a_row_of_the_table(self, population, monkeypatch):
        """Its fitness is of criteria by name, and its front compares in them, in this order."""
        names = ("coupling_index", "log10_det")
        row = SearchMethod("", "", lambda values, *_: -values["coupling_index"], names)
        monkeypatch.setitem(METHODS, "decoupled", row)
        design = search(population, asked("decoupled"))
        everything = population.everything
        coupled = columns(everything.measures, ("coupling_index",))[everything.usable, 0]
        assert design.front.measure("coupling_index")[design.chosen] == coupled.min()
        assert np.all(np.diff(design.front.measure("log10_det")) < 0.0)

    @pytest.mark.parametrize("method", METHODS)
    def test_the_front_is_not_dominated_and_has_the_chosen_motion(self, population, method):
        design = search(population, asked(method))
        best = Front.of(np.concatenate(population.genes), population.everything)
        assert design.front.measures.tolist() == best.measures.tolist()
        np.testing.assert_array_equal(design.front.genes[design.chosen], design.genes)

    @pytest.mark.parametrize("method", METHODS)
    def test_the_gradient_is_never_worse(self, population, method):
        """From the best motion of the genetic search, whose front stays as it was."""
        first = search(population, asked(method))
        chosen = asked(method, gradient=6)
        improved = search(population, chosen)
        assert improved.excitation.tried > first.excitation.tried
        assert bits(first)["front"] == bits(improved)["front"]
        assert improved.origin == first.chosen
        assert improved.origin_criteria == first.excitation.criteria
        before, after = (
            fitness_of(chosen, population.problem.score(design.genes[None]))[0]
            for design in (first, improved)
        )
        assert after >= before
        assert (improved.chosen is None) == (after > before)

    def test_sums_of_sines_are_searched_like_via_points(self):
        """Method A of the paper, eq. 8, with a ramp so that it can be run."""
        sines = problem(SineGenome(LIMITS, length=6.0, ramp=1.0))
        with Population(sines) as population:
            design = search(population, asked("a"))
        assert isinstance(design.excitation.trajectory, FourierSeries)
        assert design.excitation.method == "a"
        assert not check_motion(design.excitation.trajectory, LIMITS)


def journal_of(file, chosen):
    return Journal(file, {"settings": asdict(chosen)})


class TestRun:
    @pytest.mark.parametrize("method", METHODS)
    def test_a_seed_determines_every_bit(self, population, method, capsys):
        """With any number of processes, whatever the generator that everybody shares."""
        chosen = asked(method, gradient=2)
        np.random.seed(1)  # noqa: NPY002
        first = search(population, chosen)
        between = np.random.get_state()  # noqa: NPY002
        np.random.seed(2)  # noqa: NPY002
        again = search(population, chosen, progress=lambda _: np.random.random(3))  # noqa: NPY002
        assert bits(again) == bits(first)
        np.random.seed(1)  # noqa: NPY002
        np.testing.assert_array_equal(np.random.get_state()[1], between[1])  # noqa: NPY002
        assert capsys.readouterr() == ("", "")
        if method == "gradient":
            with Population(problem(), workers=3) as three:
                assert bits(search(three, chosen)) == bits(first)

    @pytest.mark.parametrize(
        ("method", "stop", "interrupt"),
        [("b", 1, None), ("a", 3, None), ("b", 6, None), ("gradient", 6, None)]
        + [("gradient", 99, after) for after in (0, 2, 6)],
    )
    def test_resumed_it_equals_an_uninterrupted_one(self, population, method, stop, interrupt):
        """After a request to stop, or an interrupt that loses one generation."""
        chosen = asked(method, gradient=4)
        whole = bits(search(population, chosen))
        sizes = [len(genes) for genes in population.genes]
        file = io.BytesIO()
        first = population.begin(interrupt)
        try:
            half = search(first, chosen, journal=journal_of(file, chosen), stop=Stop(stop))
            assert not half.complete and half.generations == min(stop, 4)
        except KeyboardInterrupt:
            assert len(population.genes) == interrupt
        done = len(population.genes)
        journal = journal_of(file, chosen)
        resumed = search(population.begin(), chosen, journal=journal)
        assert bits(resumed) == whole and resumed.complete
        assert journal.recalled == sum(sizes[:done])
        assert [len(genes) for genes in population.genes] == sizes[done:]

    def test_a_motion_that_crashes_its_process_does_not_win(self, population):
        small = asked("b", population=6, generations=1)
        best = search(population, small).genes[0]
        crashing = faulty(crash=(best - 0.01, best + 0.01))
        with Population(problem(crashing), workers=2) as others:
            design = search(others, small)
        assert design.excitation.rejected == {"planning": 1}
        assert abs(design.genes[0] - best) > 0.01

    def test_a_search_without_new_motions_ends_as_exhausted(self, population):
        design = search(population, asked("b", population=2, crossover=0.0, mutation=0.0))
        assert design.complete and design.exhausted
        assert design.generations == 1
        assert design.excitation.tried == 2


def genes(count, n_genes=8, seed=0):
    return np.random.default_rng(seed).random((count, n_genes))


def same(scores, others):
    return scores.rows.tobytes() == others.rows.tobytes()


@pytest.fixture(scope="module")
def scorers():
    with Population(problem()) as scorers:
        yield scorers


def currents(limit):
    model = problem().objective.model
    values = np.random.default_rng(2).uniform(0.1, 1.0, model.n_parameters)
    return CurrentModel(model, values, np.eye(2), np.ones(2), np.full(2, limit), uncertainty=0.2)


class TestScores:
    def test_they_do_not_depend_on_processes_batch_and_order(self, scorers):
        rows = genes(37)
        expected = scorers.score(rows)
        assert same(scorers.problem.score(rows), expected)
        with Population(scorers.problem, workers=3) as three:
            assert same(three.score(rows), expected)
        order = np.random.default_rng(1).permutation(37)
        assert scorers.score(rows[order]).rows.tobytes() == expected.rows[order].tobytes()
        alone = [scorers.score(rows[k : k + 1]).rows for k in range(3)]
        assert np.concatenate(alone).tobytes() == expected.rows[:3].tobytes()

    def test_unplannable_genes_are_worst_with_a_violation(self, scorers):
        rows = genes(3)
        rows[1, 0] = 1.0
        with Population(problem(faulty(refuse=(0.999, 1.0)))) as refusing:
            scores = refusing.score(rows)
            (violation,) = refusing.violations(rows[1])
            assert refusing.violations(rows[0]) == ()
        np.testing.assert_array_equal(scores.feasible, [True, False, True])
        np.testing.assert_array_equal(scores.rows[1], unplanned())
        np.testing.assert_array_equal(unplanned()[:4], [-np.inf, np.inf, np.inf, np.nan])
        assert violation.kind == "planning" and "planning failed" in violation_text(violation)
        with Population(problem(faulty(crash=(0.0, 1.0)))) as crashing:
            (violation,) = crashing.violations(rows[0])
        assert violation.kind == "planning" and "signal 6" in violation_text(violation)

    def test_a_killed_process_changes_nothing(self, scorers):
        rows = genes(2)
        expected = scorers.score(rows[:1]), scorers.evaluate(rows[0], 0.01)[1]
        for pid in (child.pid for child in scorers._children):
            os.kill(pid, signal.SIGKILL)
        assert same(scorers.score(rows[:1]), expected[0])
        os.kill(scorers._children[0].pid, signal.SIGKILL)
        assert scorers.evaluate(rows[0], 0.01)[1] == expected[1]
        os.kill(scorers._children[0].pid, signal.SIGKILL)
        assert scorers.violations(rows[0]) == ()

    def test_excess_is_that_of_the_violations_by_kind(self, scorers):
        """Scores agree with the violations of the final check."""
        slower = replace(LIMITS, velocity=0.8 * LIMITS.velocity)
        asked = problem(max_duration=2.0, limits=slower, currents=currents(20.0))
        rows = genes(16, seed=5)
        scores = asked.score(rows)
        for k, motion in enumerate(asked.genome.motions(rows)):
            assert (scores.excess[k, KINDS.index("duration")] > 0.0) == (motion.duration > 2.0)
            try:
                check_limits(motion, slower)
                fast = False
            except LimitExceeded:
                fast = True
            assert (scores.excess[k, KINDS.index("joint limit")] > 0.0) == fast
            assert {each.kind for each in asked.violations(rows[k])} == {
                KINDS[j] for j in np.flatnonzero(scores.excess[k])
            }
            last = check_motion(motion, slower, currents=asked.constraints.currents)
            last_excess = excess_by_kind([each for each in last if each.kind != "duration"])
            others = np.array(KINDS) != "duration"
            np.testing.assert_array_equal(scores.excess[k, others], last_excess[others])
            measures = asked.objective.measures(midpoints(motion, asked.period))
            assert scores.measures[k].tolist() == list(measures.values())
        assert set(np.flatnonzero(scores.excess.any(axis=0))) >= {1, 2, 5}
        # constraints decide what is feasible, not what is measured
        np.testing.assert_array_equal(scores.measures, scorers.score(rows).measures)


class TestInfeasibleMotions:
    def test_a_search_gets_from_them_to_feasible_ones(self, population):
        """Infeasible motions are ranked by their excess."""
        random = population.problem.score(np.random.default_rng(5).random((400, 8)))
        bound = float(np.quantile(random.duration, 0.005))
        seen = []
        with Population(problem(max_duration=bound)) as narrow:
            design = search(narrow, asked("b", generations=25, mutation=0.1), progress=seen.append)
        assert seen[0].feasible == 0
        assert design.excitation.trajectory.duration <= bound
        excitation = design.excitation
        assert excitation.rejected["duration"] == excitation.tried - seen[-1].feasible
        assert np.all(design.front.duration <= bound)

    def test_the_error_has_the_smallest_violations(self, shared):
        slow = JointLimits(
            LIMITS.lower,
            LIMITS.upper,
            LIMITS.velocity * [1.0, 0.2],
            LIMITS.acceleration,
            LIMITS.jerk,
        )
        with RecordingPopulation(problem(limits=slow, max_duration=0.5)) as impossible:
            with pytest.raises(NoFeasibleMotionError) as caught:
                search(impossible, asked("gradient"))
            scores = impossible.everything
        error = caught.value
        assert error.tried == len(scores.duration)
        assert error.rejected == {
            "joint limit": int(np.count_nonzero(scores.excess[:, 1])),
            "duration": error.tried,
        }
        assert not error.stopped
        duration = error.nearest["duration"]
        assert (duration.value, duration.bound) == (scores.duration.min(), 0.5)
        limit = error.nearest["joint limit"]
        assert limit.bound == slow.velocity[1]
        assert limit.value > limit.bound
        assert limit.excess == scores.excess[scores.excess[:, 1] > 0.0, 1].min()
        for part in (f"none of {error.tried}", "joint limit", "velocity", f"at {limit.time:.3f} s"):
            assert part in str(error)

    def test_an_early_stop_is_reported(self, population):
        with pytest.raises(NoFeasibleMotionError, match=r"no motion was tried.*stopped") as caught:
            search(population, asked("a"), stop=lambda: True)
        assert (caught.value.tried, caught.value.stopped) == (0, True)
        assert population.genes == []
        with (
            Population(problem(max_duration=0.5)) as impossible,
            pytest.raises(NoFeasibleMotionError, match=r"none of 12 .*stopped before its end"),
        ):
            search(impossible, asked("a"), stop=Stop(1))

    def test_motions_that_excite_too_little_are_no_result(self):
        """The elbow rests: all constraints are satisfied, its friction is not excited."""
        with Population(problem(faulty(elbow_at_rest=True))) as population:
            for method in METHODS:
                with pytest.raises(NoFeasibleMotionError, match="without excitation") as caught:
                    search(population, asked(method, generations=2))
                assert caught.value.unexciting == caught.value.tried
                assert caught.value.rejected == {}


SEARCH = {"settings": {"seed": 1, "population": 4}, "cell": {"urdf": "a"}}


def generation(seed, count=4):
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, ROW_LENGTH))
    rows[1] = unplanned()
    return random.random((count, 8)), Scores.of_rows(rows)


def opened(file):
    return Journal(file, SEARCH)


def written(count):
    """Return a journal of some generations, and its lengths, first without any."""
    file = io.BytesIO()
    opened_journal = opened(file)
    lengths = [len(file.getvalue())]
    for seed in range(count):
        opened_journal.record(*generation(seed))
        lengths.append(len(file.getvalue()))
    return file, lengths


def known(file):
    """Return the number of generations in a journal, each bit for bit."""
    opened_journal = opened(file)
    count = 0
    while (scores := opened_journal.recall(generation(count)[0])) is not None:
        assert scores.rows.tobytes() == generation(count)[1].rows.tobytes()
        count += 1
    return count


class TestRecall:
    def test_a_truncated_journal_loses_one_generation(self):
        file, lengths = written(3)
        content = file.getvalue()
        assert known(io.BytesIO(content)) == 3
        for length in {*range(0, lengths[0], 7), *range(lengths[2], len(content), 31), *lengths}:
            truncated = io.BytesIO(content[:length])
            count = known(truncated)
            assert count == sum(length >= end for end in lengths[1:])
            opened(truncated).record(*generation(count))
            assert known(truncated) == count + 1

    def test_records_after_a_damaged_one_are_dropped(self):
        file, lengths = written(4)
        for offset in range(lengths[1], lengths[2], 97):
            damaged = bytearray(file.getvalue())
            damaged[offset] ^= 0x10
            again = io.BytesIO(bytes(damaged))
            opened_journal = opened(again)
            recalled = [opened_journal.recall(generation(seed)[0]) is not None for seed in range(4)]
            assert recalled == [True, False, False, False]
            assert opened_journal.damaged == lengths[4] - lengths[1]
            opened_journal.record(*generation(1))
            assert known(again) == 2


class FullDisk(io.BytesIO):
    """A file with partial writes, and errors while there is no room."""

    room = True

    def write(self, content):
        if not self.room:
            super().write(bytes(content)[:50])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(bytes(content)[:1000])


class TestWriting:
    def test_a_record_that_the_disk_refuses_is_left_out(self):
        file = FullDisk()
        opened_journal = opened(file)
        opened_journal.record(*generation(0))
        file.room = False
        opened_journal.record(*generation(7))
        assert opened_journal.error is not None and opened_journal.error.errno == errno.ENOSPC
        assert known(io.BytesIO(file.getvalue())) == 1
        file.room = True
        opened_journal.record(*generation(1))
        assert opened_journal.error is None
        assert known(io.BytesIO(file.getvalue())) == 2


FIRST_LINE = b"hil search journal 2\n"


class TestOtherFiles:
    @pytest.mark.parametrize(
        ("other", "message"),
        [
            ({"settings": {"seed": 2, "population": 4}}, "settings seed was 1, is 2"),
            ({"cell": {"urdf": "b"}}, "cell urdf was 'a', is 'b'"),
            ({"earlier": {"x.mcap": "00"}}, "earlier x.mcap was None, is '00'"),
            ({}, "versions pymoo was .*, is '0.5.0'"),
        ],
    )
    def test_the_journal_of_another_search_is_refused(self, monkeypatch, other, message):
        """Or of another release."""
        file, _ = written(1)
        before = file.getvalue()
        if not other:
            ours = journal.versions()
            monkeypatch.setattr(journal, "versions", lambda: {**ours, "pymoo": "0.5.0"})
        with pytest.raises(JournalError, match=message):
            Journal(file, SEARCH | other)
        assert file.getvalue() == before

    @pytest.mark.parametrize("content", [b"x", FIRST_LINE + b"{}" * 50, FIRST_LINE])
    def test_another_file_is_refused_and_unchanged(self, content):
        file = io.BytesIO(content + b" ")
        with pytest.raises(JournalError):
            opened(file)
        assert file.getvalue() == content + b" "
