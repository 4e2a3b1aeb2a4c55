"""Studies of many seeds (coverage of intervals, excitations, payloads), and real recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from benchmarks.gains import coverage as gain_coverage
from benchmarks.identification_study import Covered, coverage, recorded, study
from benchmarks.payload import coverage as payload_coverage
from benchmarks.real_data import ESTIMATORS, Case, error, load_case, splits_of
from identification.estimators.least_squares import estimate
from identification.factor.factor import Factor
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.samples import Samples, prepare

pytestmark = pytest.mark.long

Array = NDArray[np.float64]


def pinocchios_torque(urdf: str, samples: Samples, weights: Array) -> Array:
    """Torque of the usable rows that the fit with these joint weights (n,) predicts.

    It shares nothing with the package: pinocchio's regressor with rotors, Coulomb, viscous and
    offset, and numpy's lstsq. The columns are many more than the motion determines; the solution is
    that of least norm, which the predicted torque does not depend on.
    """
    robot = pin.buildModelFromXML(urdf)
    usable = samples.usable
    data = robot.createData()
    n = samples.motion.n_joints
    joint = np.arange(n)
    table = np.zeros((samples.motion.n_samples, n, 14 * n))
    for k, row in enumerate(samples.motion.states()):
        table[k, :, : 10 * n] = pin.computeJointTorqueRegressor(robot, data, *row)
    qd, qdd = samples.motion.velocity, samples.motion.acceleration
    for block, columns in enumerate((qdd, np.sign(qd), qd, np.ones_like(qd)), 10):
        table[:, joint, block * n + joint] = columns
    table = table[usable]
    length = np.linalg.norm(table, axis=0)
    # What only rounding has put there must not be scaled up to a column.
    acting = length > 1e-10 * length.max()
    table = table[:, acting] / length[acting]
    scale = np.broadcast_to(np.sqrt(weights), usable.shape)[usable]
    solution = np.linalg.lstsq(scale[:, None] * table, scale * samples.torque[usable], rcond=1e-10)
    return np.asarray(table @ solution[0])


def require_same_fit(model: RobotModel, urdf: str, samples: Samples, weights: Array) -> None:
    """Least squares is what numpy makes of pinocchio's regressor."""
    expected = pinocchios_torque(urdf, samples, weights)
    values = estimate(model, Factor.of(model, samples), weights).values
    ours = model.torque(values, samples.motion)[samples.usable]
    assert np.abs(ours - expected).max() < 1e-6 * np.sqrt(np.mean(expected**2))


P = 58
SEEDS = 400
NAMES = [f"p{k}" for k in range(P)]


def rows(reported: float) -> list[Covered]:
    """Estimates of standard deviation 1 that report another."""
    values = np.random.default_rng(3).standard_normal((SEEDS, P))
    half = np.full(P, 1.96 * reported)
    return [Covered(row, half, half / 2.0) for row in values]


class TestCoverage:
    # 58 x 400 draws: the standard deviation of the mean is 0.14 %.
    @pytest.mark.parametrize(("reported", "share"), [(1.0, 0.95), (0.5, 0.673)])
    def test_it_is_that_of_normal_errors(self, reported: float, share: float) -> None:
        table = coverage(rows(reported), np.zeros(P), NAMES)
        assert table["coverage"] == pytest.approx(share, abs=0.012)
        assert table["reported_over_actual"] == pytest.approx(reported, abs=0.03)
        assert reported < 1.0 or table["classical_coverage"] == pytest.approx(0.673, abs=0.012)


def test_the_fit_of_a_simulated_recording_is_pinocchios() -> None:
    sources = recorded(7)
    urdf = study()[0].urdf
    assert sources.noise_variance is not None and sources.torque_variance is not None
    law = FrictionLaw(third=None, offset=True, standstill=0.1)
    model = RobotModel.from_urdf(urdf, friction=law)
    (source,) = sources.training
    samples = prepare(source.recording, model, noise_variance=sources.noise_variance)
    weights = 1.0 / sources.torque_variance
    require_same_fit(model, urdf, samples, weights)


class TestPayload:
    """Loads on a simulated NS 16, friction drifting by 4 % between the recordings."""

    def test_a_few_loads_are_weighed_within_two_percent(self) -> None:
        """Of 8 with 95 %, fewer than 5 inside come once in some hundred times, of one figure."""
        coverage = payload_coverage(range(1000, 1008))
        assert coverage.worst < 0.02
        assert min(*coverage.covered.values(), coverage.moment_covered) >= 0.5

    @pytest.mark.slow
    @pytest.mark.parametrize(("pairs", "within"), [(1, 0.95), (8, 0.99)])
    def test_of_200_loads_intervals_hold_90_to_99_percent(self, pairs: int, within: float) -> None:
        """Up to eight pairs bring the masses within 1 %."""
        coverage = payload_coverage(range(200), pairs)
        assert coverage.within_one_percent >= within
        for figure, share in {**coverage.covered, "moment": coverage.moment_covered}.items():
            assert 0.90 <= share <= 0.99, figure


class TestGains:
    """Torque constants from a known load, friction drifting by 4 % between the recordings."""

    @pytest.mark.parametrize("how", [{}, {"duration": 8.0}, {"drift": 0.0, "other_motions": True}])
    def test_intervals_of_a_few_pairs_hold_the_truth(self, how: dict[str, Any]) -> None:
        """Of 72 with 95 %, fewer than 61 inside come once in 500 times."""
        coverage = gain_coverage(range(1000, 1012), **how)
        assert coverage.determined > 0.95
        assert coverage.covered >= 61 / 72

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "how", [{}, {"duration": 8.0}, {"drift": 0.0}, {"other_motions": True}]
    )
    def test_of_200_pairs_intervals_hold_93_to_98_percent(self, how: dict[str, Any]) -> None:
        coverage = gain_coverage(range(200), **how)
        assert 0.93 <= coverage.covered <= 0.98


@pytest.fixture(scope="module")
def ur10(shared_data: Path) -> Case:
    return load_case(shared_data / "ur10_unisa")


@pytest.fixture(scope="module")
def tx40(shared_data: Path) -> Case:
    return load_case(shared_data / "tx40")


def wls(case: Case, model: RobotModel, kind: str) -> float:
    fitted, predicted, _ = case.prepared(model, splits_of(case.recording)[kind])
    return error(model, ESTIMATORS["wls"](model, fitted), predicted)


def test_ur10_is_predicted_as_well_as_it_can_be(ur10: Case) -> None:
    model = list(ur10.models().values())[-1]
    assert wls(ur10, model, "held_out") <= 0.068
    assert wls(ur10, model, "in_sample") <= 0.0515


def test_the_coupling_of_the_tx40_explains_its_wrist(tx40: Case) -> None:
    models = tx40.models()
    with_it = wls(tx40, models["quadratic_friction, with coupling"], "in_sample")
    without = wls(tx40, models["quadratic_friction, without coupling"], "in_sample")
    assert with_it <= 0.109
    assert without > 1.2 * with_it


@pytest.mark.parametrize("weighted", [False, True])
def test_the_fit_of_a_real_recording_is_pinocchios(ur10: Case, weighted: bool) -> None:
    model = RobotModel.from_urdf(ur10.urdf, friction=FrictionLaw(third=None, offset=True))
    samples = prepare(ur10.recording, model)
    weights = np.array([3.0, 0.5, 2.0, 10.0, 20.0, 7.0]) if weighted else np.ones(6)
    require_same_fit(model, ur10.urdf, samples, weights)
