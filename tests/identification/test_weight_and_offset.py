"""A prismatic axis along gravity: its weight and the offset of its friction are one parameter."""

from __future__ import annotations

import numpy as np
import pytest

from identification import Factor, FrictionLaw, Preprocessing, Recording, RobotModel, prepare
from identification.estimators.prior import body_prior, nominal_ratio, posterior_values
from identification.hypotheses.diagnosis import UNEXPLAINED, unexplained_share
from identification.hypotheses.scores import score_of
from identification.model.motion import Motion

LAW = FrictionLaw(offset=True, third=None)
DOWN = (0.0, 0.0, -9.81)
LIFT = """<robot name="lift"><link name="base"/>
<link name="slide"><inertial><mass value="5"/><origin xyz="0 0 0"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><mass value="2"/><origin xyz="0.2 0 0"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="z" type="prismatic"><parent link="base"/><child link="slide"/><axis xyz="0 0 1"/>
<limit lower="0" upper="1" effort="9" velocity="9"/></joint>
<joint name="turn" type="revolute"><parent link="slide"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""


def model(gravity=DOWN, law: FrictionLaw = LAW, *, rotor_inertia: bool = True) -> RobotModel:
    return RobotModel.from_urdf(LIFT, gravity=gravity, friction=law, rotor_inertia=rotor_inertia)


def test_weight_and_offset_are_one_parameter_beside_the_inertia() -> None:
    lift = model()
    expressions = dict(zip(lift.parameter_names, lift.expressions(), strict=True))
    assert "I1m" not in expressions
    assert expressions["m1"] == "m1 + m2 + I1m"
    assert expressions["fo_1"] == "fo_1 - 9.81 I1m"


def test_every_mass_rotor_and_offset_has_its_parameters() -> None:
    """The force of a rotor inertia and of an offset is in the span, and the columns independent."""
    lift = model()
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 200, 2))
    motion = Motion.of_states(q, qd, qdd)
    columns = np.array([lift.torque(row, motion)[:, 0] for row in np.eye(lift.n_parameters)])
    of_joint = columns[np.abs(columns).max(axis=1) > 0.0].T
    assert np.linalg.matrix_rank(of_joint) == of_joint.shape[1]
    force = 7.0 * (qdd[:, 0] + 9.81) + 0.8 * qdd[:, 0] + 30.0  # mass, rotor, offset
    values = np.zeros(lift.n_parameters)
    values[lift.parameter_names.index("m1")] = 7.8
    values[lift.parameter_names.index("fo_1")] = 30.0 - 9.81 * 0.8
    assert lift.torque(values, motion)[:, 0] == pytest.approx(force)


@pytest.mark.parametrize(
    ("gravity", "rotor_inertia"), [((9.81, 0.0, 0.0), True), (DOWN, False), ((0, 0, 0), True)]
)
def test_elsewhere_the_offset_is_a_parameter_of_its_own(gravity, rotor_inertia) -> None:
    lift = model(gravity, rotor_inertia=rotor_inertia)
    assert "fo_1" in lift.parameter_names
    assert not lift.base.lumped


def test_the_rotor_inertia_is_separate_without_an_offset() -> None:
    """Also where the law is changed later; asymmetric friction has an offset."""
    lift = model(law=FrictionLaw(third=None))
    assert "I1m" in lift.parameter_names
    for changes in ({"offset": True}, {"asymmetric": True}):
        changed = lift.with_friction(**changes)
        assert "I1m" not in changed.parameter_names
        assert changed.with_friction(offset=False, asymmetric=False).parameter_names == (
            lift.parameter_names
        )


def recorded(rotor: float) -> tuple[Recording, Motion]:
    """The described arm with a rotor inertia [kg] on the axis that lifts it, and its motion."""
    lift = model()
    time = np.arange(0.0, 10.0, 0.01)
    angle = np.outer(time, [1.3, 2.1]) + np.array([0.0, 1.0])
    q = 0.3 * np.sin(angle) + 0.1 * np.sin(2.7 * angle)
    velocity = np.gradient(q, time, axis=0, edge_order=2)
    acceleration = np.gradient(velocity, time, axis=0, edge_order=2)
    motion = Motion.of_states(q, velocity, acceleration)
    values = np.zeros(lift.n_parameters)
    values[: lift.base.rank] = lift.base.grouping @ lift.nominal
    torque = lift.torque(values, motion) + 0.4 * np.sign(velocity)
    torque[:, 0] += rotor * acceleration[:, 0] + 3.0
    torque += 0.01 * np.random.default_rng(0).standard_normal(torque.shape)
    return Recording(time, q, ("z", "turn"), torque), motion


def lifted(rotor: float) -> Factor:
    recording, motion = recorded(rotor)
    assert recording.torque is not None
    return Factor.from_samples(model(), motion, recording.torque)


@pytest.mark.parametrize("rotor", [0.0, 30.0, 2000.0])
def test_the_prior_allows_a_rotor_in_the_mass_it_lifts(rotor: float) -> None:
    """Also one of hundreds of times that mass, as of a spindle; its weight is none."""
    lift = model()
    factor = lifted(rotor)
    prior = body_prior(lift, factor, wide_rotors=True).gaussian
    values, _ = posterior_values(factor, prior)
    mass = values[lift.parameter_names.index("m1")]
    offset = values[lift.parameter_names.index("fo_1")]
    assert mass == pytest.approx(7.0 + rotor, rel=0.01)
    assert offset == pytest.approx(3.0 - 9.81 * rotor, rel=0.01, abs=0.5)


@pytest.mark.parametrize("rotor", [0.0, 30.0, 2000.0])
def test_the_nominal_torque_is_compared_without_such_a_rotor(rotor: float) -> None:
    lift = model()
    scale, std = nominal_ratio(lift, lifted(rotor))
    assert scale == pytest.approx(1.0, abs=max(0.02, 3.0 * std))


def test_a_torque_that_a_heavy_rotor_explains_is_explained() -> None:
    """What is believed of the arm does not predict it."""
    samples = prepare(recorded(2000.0)[0], model(), options=Preprocessing(14.0))
    score = score_of(model(), samples)
    assert score.overall > UNEXPLAINED
    assert unexplained_share(model(), samples, score) < 0.02
