from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.factor.factor import Estimate, Factor
from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.validation.plausibility import Implausible, implausibilities
from tests.identification.two_link import sine_motion

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF)


@pytest.fixture(scope="module")
def estimate(model: RobotModel) -> Estimate:
    standard = model.nominal.copy()
    standard[[10, 21]] = 0.4, 0.1  # rotors
    return estimate_of(
        model, np.concatenate([model.base.grouping @ standard, [4, 2, 1.5, 0.8, 0, 0]])
    )


def estimate_of(model: RobotModel, values: Array) -> Estimate:
    """Values that are known to one per cent."""
    return Estimate(
        names=model.parameter_names,
        units=model.units,
        values=values,
        covariance=np.diag((0.01 * np.maximum(np.abs(values), 0.1)) ** 2),
        noise_std=np.ones(2),
        samples=np.full(2, 1000),
        method="",
        condition=10.0,
    )


def a_motion() -> Motion:
    time = np.arange(2000) * 2e-3
    amplitude, rate = np.array([0.9, 1.2]), np.array([2.1, 3.7])
    return sine_motion(time, amplitude, rate, np.array([0.3, 1.1]))


def found(model: RobotModel, estimate: Estimate, *, error: float = 0.1) -> Implausible:
    motion = a_motion()
    return implausibilities(
        model,
        estimate,
        Factor.from_samples(model, motion, np.zeros((2000, 2))),
        np.full(2, error),
        position=motion.position[::100],
        speed=np.abs(motion.velocity).max(axis=0),
    )


def with_value(estimate: Estimate, name: str, value: float) -> Estimate:
    values = estimate.values.copy()
    values[estimate.names.index(name)] = value
    return replace(estimate, values=values)


def test_a_real_arm_is_plausible(model: RobotModel, estimate: Estimate) -> None:
    assert found(model, estimate) == Implausible((), ())


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("f0_1", -4.0, "Coulomb friction of shoulder is negative"),
        ("f1_2", -1.0, "friction of elbow is"),
        ("I2m", -0.1, "I2m is negative"),
    ],
)
def test_signs_that_nature_does_not_make_are_named(
    model: RobotModel, estimate: Estimate, name: str, value: float, words: str
) -> None:
    impossible = found(model, with_value(estimate, name, value)).impossible
    assert any(words in offence for offence in impossible)


def test_friction_that_falls_a_little_with_speed_is_possible(
    model: RobotModel, estimate: Estimate
) -> None:
    # 2 N·m at rest, 1.3 at top speed.
    assert found(model, with_value(estimate, "f1_2", -0.15)).impossible == ()


def test_an_inertia_that_gives_energy_is_named(model: RobotModel, estimate: Estimate) -> None:
    # The shoulder's whole inertia, a group that no sign rule on single parameters covers.
    impossible = found(model, with_value(estimate, "I1yy", -3.0)).impossible
    assert any("inertia seen by shoulder is negative" in offence for offence in impossible)


def test_a_wrong_sign_within_its_uncertainty_is_no_offence(
    model: RobotModel, estimate: Estimate
) -> None:
    vague = replace(estimate, covariance=1e4 * estimate.covariance)
    assert found(model, with_value(vague, "I2m", -0.1)) == Implausible((), ())


def test_a_wrong_sign_smaller_than_the_prediction_error_is_only_doubtful(
    model: RobotModel, estimate: Estimate
) -> None:
    offences = found(model, with_value(estimate, "I2m", -0.01), error=5.0)
    assert offences.impossible == ()
    assert any("I2m is negative" in doubt for doubt in offences.doubtful)


def test_nothing_is_said_about_parameters_the_data_do_not_determine(
    model: RobotModel, estimate: Estimate
) -> None:
    covariance = estimate.covariance.copy()
    index = estimate.names.index("I2m")
    covariance[index, index] = np.inf
    unknown = replace(with_value(estimate, "I2m", -0.1), covariance=covariance)
    assert found(model, unknown) == Implausible((), ())


def test_a_coupled_motor_that_drives_is_named() -> None:
    coupled = RobotModel.from_urdf(
        URDF,
        friction=FrictionLaw(third=None),
        coupling=Coupling(np.array([[1.0, 0.0], [0.5, 1.0]]), inertia=False),
    )
    standard = coupled.nominal
    standard[coupled.layout.rotors] = 0.4, 0.1
    friction = np.array([4.0, 2.0, 1.5, 0.8, 1.0, -1.0])
    values = np.concatenate([coupled.base.grouping @ standard, friction])
    estimate = estimate_of(coupled, values)
    (words,) = found(coupled, estimate).impossible
    assert words.startswith("friction f1_m2 of motor 2 is negative: -1")
    assert found(coupled, with_value(estimate, "f1_m2", 1.0)) == Implausible((), ())
