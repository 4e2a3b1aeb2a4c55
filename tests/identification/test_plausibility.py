"""Parameters that no machine has are named: by their signs, and by what held-out motion says."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.estimators.covariance import with_block_covariance
from identification.factor.factor import Estimate, Factor, estimate, joint_weights
from identification.factor.phases import PhaseFactor
from identification.model.coupling import Coupling
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.consistency import ConsistencyCheck, check_consistency
from identification.validation.plausibility import Implausible, implausibilities
from tests.identification.test_essential import NOISE, a_motion, samples_of
from tests.identification.two_link import MODEL, URDF, sine_motion

Array = NDArray[np.float64]


def parameters(model: RobotModel = MODEL, **changes: float) -> Array:
    """The arm of the description with rotors and friction; standard or friction ones changed."""
    standard = dict(zip(model.standard_names, model.nominal, strict=True))
    standard |= {"I1m": 0.4, "I2m": 0.1}
    names = model.parameter_names[model.base.rank :]
    friction = dict(zip(names, [4, 2, 1.5, 0.8, 1.0, 1.0], strict=False))
    for name, value in changes.items():
        (friction if name in friction else standard)[name] = value
    return np.concatenate([model.base.grouping @ list(standard.values()), list(friction.values())])


def known(values: Array, model: RobotModel = MODEL, std: float = 0.01) -> Estimate:
    """Values that are known to a share of themselves."""
    return Estimate(
        names=model.parameter_names, units=model.units, values=values,
        covariance=np.diag((std * np.maximum(np.abs(values), 0.1)) ** 2), noise_std=np.ones(2),
        samples=np.full(2, 1000), method="", condition=10.0,
    )  # fmt: skip


def with_value(name: str, value: float, std: float = 0.01) -> Estimate:
    """Of the arm, but for one base parameter or friction coefficient."""
    values = parameters()
    values[MODEL.parameter_names.index(name)] = value
    return replace(known(parameters(), std=std), values=values)


def signs(found: Estimate, model: RobotModel = MODEL, *, error: float = 0.1) -> Implausible:
    amplitude, rate = np.array([0.9, 1.2]), np.array([2.1, 3.7])
    motion = sine_motion(np.arange(2000) * 2e-3, amplitude, rate, np.array([0.3, 1.1]))
    return implausibilities(
        model,
        found,
        Factor.from_samples(model, motion, np.zeros((2000, 2))),
        np.full(2, error),
        position=motion.position[::100],
        speed=np.abs(motion.velocity).max(axis=0),
    )


class TestSigns:
    @pytest.mark.parametrize(
        ("found", "words"),
        [
            (with_value("f0_1", -4.0), "Coulomb friction of shoulder is negative"),
            (with_value("f1_2", -1.0), "friction of elbow is"),
            (with_value("I2m", -0.1), "I2m is negative"),
            # The shoulder's whole inertia, a group that no rule on single parameters covers.
            (with_value("I1yy", -3.0), "inertia seen by shoulder is negative"),
        ],
    )
    def test_those_that_nature_does_not_make_are_named(self, found: Estimate, words: str) -> None:
        assert any(words in offence for offence in signs(found).impossible)

    def test_those_within_their_uncertainty_are_no_offence(self) -> None:
        """Nor are friction that falls from 2 to 1.3 N·m, and parameters that nothing determines."""
        unknown = with_value("I2m", -0.1)
        index = unknown.names.index("I2m")
        covariance = unknown.covariance.copy()
        covariance[index, index] = np.inf
        assert signs(replace(unknown, covariance=covariance)) == Implausible((), ())
        assert signs(with_value("I2m", -0.1, std=1.0)) == Implausible((), ())
        assert signs(with_value("f1_2", -0.15)).impossible == ()
        assert signs(known(parameters())) == Implausible((), ())

    def test_those_smaller_than_the_error_are_doubtful(self) -> None:
        found = signs(with_value("I2m", -0.01), error=5.0)
        assert found.impossible == ()
        assert any("I2m is negative" in words for words in found.doubtful)

    def test_a_coupled_motor_that_drives_is_named(self) -> None:
        coupling = Coupling(np.array([[1.0, 0.0], [0.5, 1.0]]), inertia=False)
        coupled = RobotModel.from_urdf(URDF, friction=MODEL.friction.laws[0], coupling=coupling)
        arm = partial(parameters, coupled)
        (words,) = signs(known(arm(f1_m2=-1.0), coupled), coupled).impossible
        assert words.startswith("friction f1_m2 of motor 2 is negative: -1")
        assert signs(known(arm(), coupled), coupled) == Implausible((), ())


def runs(**changes: float) -> list[Samples]:
    return [samples_of(MODEL, parameters(**changes), a_motion(k), NOISE, k) for k in (1, 2)]


def checked(recordings: list[Samples]) -> ConsistencyCheck:
    training, unseen = (PhaseFactor.from_samples(MODEL, run) for run in recordings)
    weights = joint_weights(training.total)
    free = with_block_covariance(estimate(MODEL, training.total, weights), training, weights)
    return check_consistency(MODEL, training.total, unseen.total, free, weights=weights)


class TestConsistencyCheck:
    """What physical consistency costs on held-out motion, and which bound is in the way."""

    def test_a_machine_costs_nothing(self) -> None:
        found = checked(runs())
        assert abs(found.cost) < 0.001
        assert not found.costly and not found.impossible
        assert found.bounds == () and np.all(found.room > 0.5)
        assert "a possible machine predicts as well" in found.sentence

    def test_costs_are_those_of_the_predictions(self) -> None:
        recordings = runs(I2m=-0.1)
        found, run = checked(recordings), recordings[1]
        torque = np.where(run.usable, run.torque, 0.0)
        both = found.consistent.estimate.values, found.consistent.unconstrained.values
        errors = [
            torque - np.where(run.usable, MODEL.torque(one, *run.motion[1:]), 0.0) for one in both
        ]
        ours, free = (np.linalg.norm(one) / np.linalg.norm(torque) for one in errors)
        assert found.cost == pytest.approx(ours - free, rel=1e-6)
        size = np.linalg.norm(torque, axis=0)
        ours, free = (np.linalg.norm(one, axis=0) / size for one in errors)
        np.testing.assert_allclose(found.held_out_rise, ours - free, rtol=1e-6)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"I2m": -0.6}, "elbow"),
            ({"f0_2": -2.0}, "Coulomb friction of elbow would be negative"),
            ({"f1_1": -1.5}, "viscous friction of shoulder would be negative"),
        ],
    )
    def test_what_no_machine_has_is_named_with_its_joint(
        self, change: dict[str, float], words: str
    ) -> None:
        found = checked(runs(**change))
        assert found.costly and words in found.sentence
        assert any(words in bound for bound in found.bounds)

    def test_a_torque_of_the_wrong_sign_is_no_machine(self) -> None:
        found = checked([replace(run, torque=run.torque * [-1.0, 1.0]) for run in runs()])
        assert found.impossible and "shoulder" in found.sentence
        assert found.sentence.startswith("no machine fits these parameters")

    def test_a_link_thinner_than_nothing_is_at_the_edge(self) -> None:
        """The second moment of the elbow's link about its own centre is made negative."""
        found = checked(runs(I2yy=0.05, I2m=0.0))
        assert found.room[1] < 0.01
        assert any("link of elbow" in bound for bound in found.bounds)
