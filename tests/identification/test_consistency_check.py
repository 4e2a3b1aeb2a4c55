"""What physical consistency costs on held-out motion, and which bound is in the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.estimators.covariance import with_block_covariance
from identification.factor.factor import estimate, joint_weights
from identification.factor.phases import PhaseFactor
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.consistency import ConsistencyCheck, check_consistency
from tests.identification.test_essential import NOISE, a_motion, samples_of

Array = NDArray[np.float64]


def parameters(model: RobotModel, **changes: float) -> Array:
    """The arm of the description with rotors and friction; standard or friction ones changed."""
    standard = dict(zip(model.standard_names, model.nominal, strict=True))
    standard |= {"I1m": 0.4, "I2m": 0.1}
    friction = dict(zip(model.parameter_names[model.base.rank :], [4, 2, 1.5, 0.8], strict=True))
    for name, value in changes.items():
        (friction if name in friction else standard)[name] = value
    return np.concatenate([model.base.grouping @ list(standard.values()), list(friction.values())])


def runs(model: RobotModel, values: Array) -> list[Samples]:
    return [samples_of(model, values, a_motion(k), NOISE, k) for k in (1, 2)]


def checked(model: RobotModel, recordings: list[Samples]) -> ConsistencyCheck:
    training, unseen = (PhaseFactor.from_samples(model, run) for run in recordings)
    weights = joint_weights(training.total)
    free = with_block_covariance(estimate(model, training.total, weights), training, weights)
    return check_consistency(model, training.total, unseen.total, free, weights=weights)


def test_a_machine_costs_nothing(model: RobotModel) -> None:
    found = checked(model, runs(model, parameters(model)))
    assert abs(found.cost) < 0.001
    assert not found.costly
    assert not found.impossible
    assert found.bounds == ()
    assert "a possible machine predicts as well" in found.sentence


def test_costs_are_those_of_the_predictions(model: RobotModel) -> None:
    recordings = runs(model, parameters(model, I2m=-0.1))
    found = checked(model, recordings)
    run = recordings[1]
    torque = np.where(run.usable, run.torque, 0.0)
    relative = {}
    for name, values in (
        ("consistent", found.consistent.estimate.values),
        ("free", found.consistent.unconstrained.values),
    ):
        error = torque - np.where(run.usable, model.torque(values, *run.motion[1:]), 0.0)
        relative[name] = np.linalg.norm(error) / np.linalg.norm(torque)
        relative[name + " joints"] = np.linalg.norm(error, axis=0) / np.linalg.norm(torque, axis=0)
    assert found.cost == pytest.approx(relative["consistent"] - relative["free"], rel=1e-6)
    np.testing.assert_allclose(
        found.held_out_rise, relative["consistent joints"] - relative["free joints"], rtol=1e-6
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"I2m": -0.6}, "elbow"),
        ({"f0_2": -2.0}, "Coulomb friction of elbow would be negative"),
        ({"f1_1": -1.5}, "viscous friction of shoulder would be negative"),
    ],
)
def test_what_no_machine_has_is_named_with_its_joint(
    model: RobotModel, change: dict[str, float], words: str
) -> None:
    found = checked(model, runs(model, parameters(model, **change)))
    assert found.costly
    assert words in found.sentence
    assert any(words in bound for bound in found.bounds)


def test_a_torque_of_the_wrong_sign_is_no_machine(model: RobotModel) -> None:
    turned = [
        replace(run, torque=run.torque * [-1.0, 1.0]) for run in runs(model, parameters(model))
    ]
    found = checked(model, turned)
    assert found.impossible
    assert found.sentence.startswith("no machine fits these parameters")
    assert "shoulder" in found.sentence


def test_a_link_thinner_than_nothing_is_at_the_edge(model: RobotModel) -> None:
    """The second moment of the elbow's link about its own centre is made negative."""
    found = checked(model, runs(model, parameters(model, I2yy=0.05, I2m=0.0)))
    assert found.room[1] < 0.01
    assert any("link of elbow" in bound for bound in found.bounds)
    possible = checked(model, runs(model, parameters(model)))
    assert np.all(possible.room > 0.5)
