"""The consistent estimate where drives are coupled or friction has more than three terms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from identification import Factor, FrictionLaw, Motion, RobotModel
from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.export.urdf import NotConsistentError, not_in_urdf, write_urdf
from identification.factor.factor import estimate
from identification.model.coupling import Coupling
from sim_fixtures.ns16 import standard_parameters, urdf_text
from tests.identification.two_link import sine_motion

Array = NDArray[np.float64]

TWO_LINK = (Path(__file__).parent / "two_link.urdf").read_text()
TURNS = np.array([[1.0, 0.0], [0.5, 1.0]])


def lively(n: int, seed: int, samples: int = 1500) -> Motion:
    rng = np.random.default_rng(seed)
    time = np.arange(samples) * 4e-3
    size = rng.uniform(0.2, 0.6, (5, n))
    pace = rng.uniform(0.5, 6.0, (5, n))
    return sine_motion(time, size, pace, rng.uniform(0.0, 6.0, (5, n)))


def fitted(model: RobotModel, truth: Array, noise: float, seed: int = 1) -> ConsistentEstimate:
    motion = lively(model.n_joints, seed)
    torque = model.torque(truth, *motion[1:])
    rms = np.sqrt((torque**2).mean(axis=0))
    torque += noise * rms * np.random.default_rng(seed).standard_normal(torque.shape)
    factor = Factor.from_samples(model, motion, torque)
    return consistent_estimate(model, factor, estimate(model, factor))


def two_link(coupling_inertia: float) -> tuple[RobotModel, Array]:
    model = RobotModel.from_urdf(
        TWO_LINK, friction=FrictionLaw(third=None), coupling=Coupling(TURNS)
    )
    standard = model.nominal
    standard[model.layout.rotors] = 0.4, 0.1
    standard[model.layout.couplings] = coupling_inertia
    friction = np.full(len(model.friction.terms), 0.8)
    return model, np.concatenate([model.base.grouping @ standard, friction])


def test_a_possible_coupling_costs_nothing() -> None:
    model, truth = two_link(0.12)
    found = fitted(model, truth, noise=0.01)
    assert found.status == "optimal"
    assert np.linalg.eigvalsh(model.layout.rotor_matrix(found.standard))[0] > 0.0
    assert found.cost < 1e-4


@pytest.mark.parametrize("size", [0.6, -0.6])
def test_couplings_larger_than_the_rotors_are_taken_back(size: float) -> None:
    model, truth = two_link(size)
    found = fitted(model, truth, noise=0.01)
    eigenvalues = np.linalg.eigvalsh(model.layout.rotor_matrix(found.standard))
    assert eigenvalues[0] >= -1e-12
    assert np.all(found.margin > 0.0)


def test_the_coupled_ns16_is_possible_and_written_without_what_a_urdf_cannot_hold() -> None:
    wrist = np.eye(6)
    wrist[4, 3], wrist[5, 4], wrist[5, 3] = -0.2, -0.3, 0.16
    model = RobotModel.from_urdf(
        urdf_text(), friction=FrictionLaw(third=None), coupling=Coupling(wrist)
    )
    known = standard_parameters()
    standard = np.array([known.get(name, 0.0) for name in model.standard_names])
    standard[model.layout.couplings] = -0.03, 0.01, -0.02
    random = np.random.default_rng(0)
    friction = random.uniform(1.0, 9.0, len(model.friction.terms))
    truth = np.concatenate([model.base.grouping @ standard, friction])
    found = fitted(model, truth, noise=0.02)
    assert found.status == "optimal"
    assert np.linalg.eigvalsh(model.layout.rotor_matrix(found.standard))[0] > 0.0
    assert found.cost < 1e-3
    assert np.all(found.friction > 0.0)
    write_urdf(urdf_text(), model, found.standard, found.friction)
    assert not_in_urdf(model) == (
        "rotor inertias", "coupling inertias", "friction of coupled motors",
    )  # fmt: skip


def test_impossible_coupling_inertias_are_not_written() -> None:
    model, _ = two_link(0.0)
    standard = model.nominal
    standard[model.layout.rotors] = 0.4, 0.1
    standard[model.layout.couplings] = 0.3
    with pytest.raises(NotConsistentError, match="coupling"):
        write_urdf(TWO_LINK, model, standard)


def test_friction_by_direction_and_at_low_speed_only_takes_energy() -> None:
    """Planted against nature: more viscous difference than viscosity, less friction at rest."""
    law = FrictionLaw(third=None, asymmetric=True, stribeck=0.3)
    model = RobotModel.from_urdf(TWO_LINK, friction=law)
    planted = {"f0": 1.0, "f1": 0.3, "fd": 0.6, "fs": -2.0, "fo": 0.2}
    friction = np.array([planted[term.symbol] for term in model.friction.terms])
    truth = np.concatenate([model.base.grouping @ model.nominal, friction])
    found = fitted(model, truth, noise=0.01)
    tolerance = 1e-12
    for own in model.friction.table(found.friction):
        assert own["f0"] >= 0.0
        assert own["f0"] + own["fs"] >= -tolerance
        assert abs(own["fd"]) <= own["f1"] + tolerance
    # And what nature makes comes back.
    planted |= {"f1": 0.9, "fs": 0.7}
    friction = np.array([planted[term.symbol] for term in model.friction.terms])
    truth[model.base.rank :] = friction
    np.testing.assert_allclose(fitted(model, truth, noise=0.0).friction, friction, rtol=0.02)
