"""Torque of one state after the other: as the regressor's, and at the speed of pinocchio."""

import pickle

import numpy as np
import pytest

from identification.errors import ModelError
from identification.model.coupling import Coupling
from identification.model.elements import TorqueRipple, TorsionSpring
from identification.model.friction import FrictionLaw
from identification.model.known_payload import Payload
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.model.single_state import SingleStateTorque
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import one_joint, random_urdf
from tests.identification.two_link import URDF as TWO_LINK

WRIST = np.eye(6)
WRIST[5, 4] = 0.5
NAMES = [f"joint_{j}" for j in range(1, 7)]
ARMS = {
    "two links": (TWO_LINK, {}),
    "no rotors": (TWO_LINK, {"rotor_inertia": False}),
    "six joints": (urdf_text(), {}),
    "another gravity": (urdf_text(), {"gravity": (3.0, -2.0, 8.0)}),
    "locked": (urdf_text(), {"locked": {"joint_3": 0.7}}),
    "coupled motors": (urdf_text(), {"coupling": Coupling(WRIST)}),
    "payload": (urdf_text(), {"payload": Payload(7.0, (0.1, -0.2, 0.3))}),
    "all friction": (
        urdf_text(),
        {
            "friction": FrictionLaw(
                asymmetric=True, stribeck=0.1, third="cubic", load=True, offset=True
            ),
            "payload": Payload(7.0, (0.1, -0.2, 0.3)),
        },
    ),
    "different friction": (
        urdf_text(),
        {"joint_friction": {"joint_2": FrictionLaw(tanh=0.05, third=None, load=True)}},
    ),
    "springs and ripple": (
        urdf_text(),
        {
            "friction": FrictionLaw(load=True),
            "elements": [
                TorsionSpring("joint_2", 0.3, identified=True),
                TorsionSpring("joint_3", -0.2, stiffness=300.0),
                TorqueRipple("joint_3", (1, 2), (("joint_3", 100.0),)),
            ],
        },
    ),
    **{f"random {seed}": (random_urdf(seed), {}) for seed in range(6)},
}


def some_states(n):
    return np.random.default_rng(2).normal(size=(3, 20, n))


@pytest.mark.parametrize("name", ARMS)
def test_a_state_has_the_torque_of_the_regressor(name):
    """Of parameters near those of the description, for which bodies may not exist."""
    urdf, options = ARMS[name]
    model = RobotModel.from_urdf(urdf, **options)
    values = np.random.default_rng(1).normal(size=model.n_parameters)
    values[: model.base.rank] *= 0.5
    values[: model.base.rank] += model.base.grouping @ model.nominal
    torque = SingleStateTorque(model, values)
    q, v, a = some_states(model.n_joints)
    motion = Motion.of_states(q, v, a)
    expected = model.torque(values, motion) + model.load_torque(motion)
    found = [torque(*state) for state in zip(q, v, a, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * np.abs(expected).max())


def test_it_can_be_pickled():
    model = RobotModel.from_urdf(TWO_LINK)
    torque = SingleStateTorque(model, np.arange(1.0, model.n_parameters + 1.0))
    q, v, a = some_states(2)[:, 0]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(torque))(q, v, a), torque(q, v, a))


def test_a_mass_that_no_body_has_is_refused():
    """A slider's inertia is its mass, and its rotor's."""
    model = RobotModel.from_urdf(one_joint("prismatic", "0 0 1"), rotor_inertia=False)
    values = np.full(model.n_parameters, -1.0)
    with pytest.raises(ModelError, match="positive masses"):
        SingleStateTorque(model, values)


def test_a_rotor_of_nothing_but_rounding_is_at_its_bound():
    model = RobotModel.from_urdf(TWO_LINK)
    standard = model.nominal
    standard[model.layout.rotors] = [1e-12, 0.02]
    assert model.layout.rotors_at_bound(standard).tolist() == [True, False]
    alone = RobotModel.from_urdf(TWO_LINK, rotor_inertia=False)
    assert not alone.layout.rotors_at_bound(alone.nominal).any()
