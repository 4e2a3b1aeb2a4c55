"""The package's own way through a real recording, and an independent one beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.real_data import ESTIMATORS, Case, error, load_case, splits_of
from identification.estimators.least_squares import estimate
from identification.factor.factor import Factor
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.samples import prepare
from tests.benchmarks import by_pinocchio


@pytest.fixture(scope="module")
def ur10(shared_data: Path) -> Case:
    return load_case(shared_data / "ur10_unisa")


@pytest.fixture(scope="module")
def tx40(shared_data: Path) -> Case:
    return load_case(shared_data / "tx40")


def wls(one: Case, model: RobotModel, kind: str) -> float:
    fitted, predicted, _ = one.prepared(model, splits_of(one.recording)[kind])
    return error(model, ESTIMATORS["wls"](model, fitted), predicted)


def test_ur10_is_predicted_as_well_as_it_can_be(ur10: Case) -> None:
    model = list(ur10.models().values())[-1]
    assert wls(ur10, model, "held_out") <= 0.068
    assert wls(ur10, model, "in_sample") <= 0.0515


def test_the_parts_of_a_split_do_not_overlap(ur10: Case) -> None:
    splits = splits_of(ur10.recording)
    for kind, share in (("held_out", 0.7), ("held_out_first", 0.7)):
        fitted, predicted = splits[kind]
        assert not np.isin(fitted.time, predicted.time).any()
        assert fitted.n_samples + predicted.n_samples == ur10.recording.n_samples
        assert fitted.n_samples / ur10.recording.n_samples == pytest.approx(share, abs=1e-3)


def test_the_coupling_of_the_tx40_explains_its_wrist(tx40: Case) -> None:
    models = tx40.models()
    with_it = wls(tx40, models["quadratic_friction, with coupling"], "in_sample")
    without = wls(tx40, models["quadratic_friction, without coupling"], "in_sample")
    assert with_it <= 0.109
    assert without > 1.2 * with_it


@pytest.mark.parametrize("weighted", [False, True])
def test_least_squares_is_what_numpy_makes_of_pinocchios_regressor(
    ur10: Case, weighted: bool
) -> None:
    model = RobotModel.from_urdf(ur10.urdf, friction=FrictionLaw(third=None, offset=True))
    samples = prepare(ur10.recording, model)
    weights = np.array([3.0, 0.5, 2.0, 10.0, 20.0, 7.0]) if weighted else np.ones(6)
    expected = by_pinocchio.fitted_torque(ur10.urdf, samples, weights)
    values = estimate(model, Factor.of(model, samples), weights).values
    ours = model.torque(values, *samples.motion[1:])[samples.usable]
    assert np.abs(ours - expected).max() < 1e-6 * np.sqrt(np.mean(expected**2))
