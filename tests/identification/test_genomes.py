import json
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from identification.excitation.collision.bodies import Box, Workspace
from identification.excitation.collision.checker import CollisionChecker
from identification.excitation.constraints import check_motion
from identification.excitation.criteria import Criteria
from identification.excitation.errors import DesignError
from identification.excitation.excitation import Excitation
from identification.excitation.genomes import SineGenome, ViaPointGenome
from planner import FourierSeries, JointLimits, WorkerProcess, check_limits, plan, plan_moves
from sim_fixtures.ns16 import urdf_text
from tests.identification.searching import NS16_HOME as HOME
from tests.identification.searching import NS16_LIMITS as LIMITS

OPEN = ViaPointGenome(LIMITS, n_via=6, slowest=0.3)
CLOSED = ViaPointGenome(LIMITS, n_via=4, fly=0.7, slowest=0.2, range_share=0.9, home=HOME)
BARE = SineGenome(LIMITS, length=20.0)
RAMPED = SineGenome(
    LIMITS, length=15.0, harmonics=2, ramp=2.0, offset=HOME, fastest=np.full(6, 2.0)
)
GENOMES = pytest.mark.parametrize(
    "genome", [OPEN, CLOSED, BARE, RAMPED], ids=lambda g: repr(g)[:20]
)


def some_genes(genome, rows, seed=5):
    return np.random.default_rng(seed).random((rows, genome.n_genes))


def bits(motion):
    if isinstance(motion, FourierSeries):
        return motion.amplitude.tobytes() + motion.frequency.tobytes()
    return b"".join(array.tobytes() for array in motion.knots + motion.coefficients)


class TestGenomes:
    @GENOMES
    def test_motions_do_not_depend_on_batch_and_process(self, genome):
        genes = some_genes(genome, 5)
        together = [bits(motion) for motion in genome.motions(genes)]
        assert [bits(genome.motions(genes[[k]])[0]) for k in range(5)] == together
        with WorkerProcess(timeout=60.0) as child:
            assert [bits(motion) for motion in child.call(genome.motions, genes)] == together

    @GENOMES
    def test_a_first_population_is_uniform_and_its_seed_decides_it(self, genome):
        assert (OPEN.n_genes, CLOSED.n_genes) == (
            6 * 6 + 6,
            4 * 6 + 6,
        )  # points and speeds; no home
        assert BARE.n_genes == 6 * 3 * 2  # W = 3 amplitudes and frequencies
        genes = genome.sample(np.random.default_rng(7), 50)
        assert genes.shape == (50, genome.n_genes)
        assert kstest(genes.ravel(), "uniform").pvalue > 0.001
        np.testing.assert_array_equal(genome.sample(np.random.default_rng(7), 50), genes)
        assert not np.array_equal(genome.sample(np.random.default_rng(8), 50), genes)


class TestViaPoints:
    @pytest.mark.parametrize("genome", [OPEN, CLOSED])
    def test_genes_reach_the_ends_of_range_and_speed(self, genome):
        lower, upper = LIMITS.lower, LIMITS.upper
        spare = (1.0 - genome.range_share) / 2.0 * (upper - lower)
        own = slice(None) if genome.home is None else slice(1, -1)
        for gene, end, share in ((0.0, lower + spare, genome.slowest), (1.0, upper - spare, 1.0)):
            points, speed = genome.decode(np.full((1, genome.n_genes), gene))
            np.testing.assert_array_equal(points[0, own], np.tile(end, (genome.n_via, 1)))
            np.testing.assert_array_equal(speed, np.full((1, 6), share))

    @pytest.mark.parametrize("genome", [OPEN, CLOSED])
    def test_motions_are_those_of_the_planner(self, genome):
        genes = some_genes(genome, 6)
        for motion, points, speed in zip(genome.motions(genes), *genome.decode(genes), strict=True):
            check_limits(motion, LIMITS.scaled(velocity=speed))
            alone = plan(points, LIMITS, speed=speed, fly=genome.fly)
            times = np.linspace(0.0, alone.duration, 300)
            for ours, theirs in zip(motion.sample(times), alone.sample(times), strict=True):
                np.testing.assert_array_equal(ours, theirs)


# Via points among obstacles


@pytest.fixture(scope="module")
def checker():
    return CollisionChecker(urdf_text(), Workspace(margin=0.05))


class TestObstacles:
    @pytest.mark.parametrize("home", [HOME, None], ids=["closed", "open"])
    def test_paths_of_a_first_population_are_free(self, checker, home):
        genome = ViaPointGenome(LIMITS, n_via=5, home=home, checker=checker)
        points, _ = genome.decode(genome.sample(np.random.default_rng(2), 12))
        for path in points:
            for start, end in pairwise(path):
                steps = int(np.ceil(np.max(np.abs(end - start)) / 0.1)) + 1
                assert checker.clear(np.linspace(start, end, steps + 1)).all()

    def test_a_population_without_free_space(self, checker):
        everywhere = Workspace(boxes=(Box((-0.5, -0.5, 0.3), (0.5, 0.5, 3.0)),), margin=0.0)
        blocked = CollisionChecker(urdf_text(), everywhere)
        genome = ViaPointGenome(LIMITS, n_via=1, home=HOME, checker=blocked)
        genes = genome.sample(np.random.default_rng(1), 2)
        assert genes.shape == (2, 12)
        assert all(check_motion(m, LIMITS, checker=blocked) for m in genome.motions(genes))


class TestSines:
    def test_genes_at_their_ends_reach_the_papers_bounds(self):
        room = np.minimum(LIMITS.upper - HOME, HOME - LIMITS.lower)
        for gene, side, rates in (
            (0.0, -1.0, np.full(6, 2 * np.pi / 15.0)),
            (1.0, 1.0, np.full(6, 2)),
        ):
            amplitude, frequency = RAMPED.decode(np.full((1, RAMPED.n_genes), gene))
            for sine in range(2):
                np.testing.assert_array_equal(amplitude[0, :, sine], side * room / 2)
                np.testing.assert_array_equal(frequency[0, :, sine], rates)
        amplitude, frequency = BARE.decode(np.ones(BARE.n_genes))
        half = (LIMITS.upper - LIMITS.lower) / 2.0
        np.testing.assert_allclose(amplitude[0], np.tile(half[:, None] / 3.0, 3), rtol=1e-15)
        largest = np.sqrt(LIMITS.acceleration / half)
        np.testing.assert_allclose(frequency[0], np.tile(largest[:, None], 3), rtol=1e-15)
        np.testing.assert_allclose(BARE.frequency_range[0], 0.314, atol=5e-4)  # Table 1, for 20 s
        assert not np.any(RAMPED.motions(np.full((1, RAMPED.n_genes), 0.5))[0].amplitude)

    @pytest.mark.parametrize(
        ("name", "setting"),
        [
            ("harmonics", {"harmonics": 0}),
            ("offset", {"offset": LIMITS.lower}),
            ("offset", {"offset": HOME[:5]}),
            ("slowest", {"slowest": np.zeros(6)}),
            ("slowest", {"slowest": np.full(6, 5.0)}),
            ("slowest", {"slowest": np.full(6, np.nan)}),
            ("slowest", {"length": 1.0}),  # one period is faster than the limits allow
        ],
    )
    def test_settings_outside_their_range_are_refused(self, name, setting):
        with pytest.raises(DesignError) as refusal:
            SineGenome(LIMITS, **{"length": 20.0, **setting})
        assert refusal.value.name == name


ROOMY = JointLimits(
    lower=np.array([-2.0, -1.0, -3.0]),
    upper=np.array([2.0, 1.5, 3.0]),
    velocity=np.array([1.0, 2.0, 3.0]),
    acceleration=np.array([4.0, 5.0, 9.0]),
    jerk=np.array([40.0, 50.0, 90.0]),
)


def planned(seed, fly=0.5):
    random = np.random.default_rng(seed)
    points = random.uniform(ROOMY.lower, ROOMY.upper, (5, 3))
    speed = random.uniform(0.2, 1.0, 3)
    return Excitation(
        trajectory=plan(points, ROOMY, speed=speed, fly=fly),
        criteria=Criteria(*random.normal(size=3).tolist(), 700, 1e5, 12.25),
        method="b",
        seed=seed,
        tried=12,
        rejected={"duration": 3, "collision": 1},
        via_points=points,
        speed=speed,
        fly=fly,
    )


def sines(seed):
    random = np.random.default_rng(seed)
    amplitude, frequency = random.uniform(0.1, 1.0, (2, 3, 2))
    return Excitation(
        trajectory=FourierSeries(np.zeros(3), amplitude, frequency, 20.0, 2.0),
        criteria=Criteria(*random.normal(size=3).tolist(), 2501),
        method="a",
        seed=seed,
        tried=100,
        rejected={},
    )


def through_json(excitation):
    return Excitation.from_dict(json.loads(json.dumps(excitation.to_dict())))


class TestExcitation:
    @given(
        make=st.sampled_from([planned, lambda seed: planned(seed, 0.0), sines]),
        seed=st.integers(0, 2**32 - 1),
    )
    @settings(max_examples=30, deadline=None)
    def test_it_is_restored_bit_for_bit(self, make, seed):
        excitation = make(seed)
        restored = through_json(excitation)
        assert restored.to_dict() == excitation.to_dict()
        assert restored.criteria == excitation.criteria
        assert type(restored.trajectory) is type(excitation.trajectory)
        assert bits(restored.trajectory) == bits(excitation.trajectory)
        if restored.via_points is not None:  # its moves plan to the motion bit for bit
            again = plan_moves(restored.via_points[0], restored.moves, ROOMY)
            assert again.trajectory.to_dict() == excitation.trajectory.to_dict()

    def test_data_without_method_are_restored(self):
        excitation = planned(5)
        old = excitation.to_dict()
        del old["method"]
        for name in ("condition", "scaled_condition"):
            del old["criteria"][name]
        restored = Excitation.from_dict(old)
        assert restored.method == "random"
        assert (restored.criteria.condition, restored.criteria.scaled_condition) == (None, None)
        assert restored.criteria.log10_det == excitation.criteria.log10_det
        np.testing.assert_array_equal(restored.via_points, excitation.via_points)

    @pytest.mark.parametrize(
        "damage",
        [
            {"trajectory": {"type": "fourier_series"}},
            {"trajectory": sines(1).trajectory.to_dict() | {"amplitude": [[10**400], [1]]}},
            {"criteria": {**sines(1).to_dict()["criteria"], "beauty": 1.0}},
            {"criteria": asdict(sines(1).criteria) | {"log10_det": "x"}},
            {"seed": "first"},
            {"rejected": {"limits": "many"}},
            {"via_points": None},
        ],
    )
    def test_invalid_data_are_refused(self, damage):
        with pytest.raises(ValueError, match="not an excitation"):
            Excitation.from_dict({**planned(1).to_dict(), **damage})
