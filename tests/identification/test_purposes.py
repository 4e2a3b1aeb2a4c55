"""What a model is good for, on arms whose truth is planted."""

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from hil.payload.payload_run import flange_of
from identification.arrays import Array
from identification.factor.columns import standard_factor
from identification.factor.estimate import Estimate
from identification.factor.estimation_method import EstimationMethod
from identification.hypotheses.carried_load import find_load
from identification.model.flange import flange_motion, flange_name
from identification.model.friction import FrictionLaw
from identification.model.kinematics import chain_from_urdf, pinocchio_model
from identification.model.known_payload import Load, Payload
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.purposes.contact import contact, seen_force, seen_mass
from identification.purposes.gravity_error import (
    gravity_error,
    mixture_limit,
    torque_deviation,
    workspace,
)
from identification.purposes.purposes import gravity_compensation, single_parameters
from identification.purposes.quiet_torque import (
    BLOCK_SECONDS,
    FALSE_ALARM_PERIOD,
    once_in,
    slow_residuals,
)
from identification.purposes.simulation_error import HORIZON_SECONDS, flange_error
from identification.validation.purpose import Purpose
from identification.validation.purpose_messages import figure
from tests.identification.quiet_motion import quiet
from tests.identification.robots import random_urdf
from tests.identification.two_link import (
    MODEL,
    NOISE,
    URDF,
    P,
    four_sines,
    simulated,
    truth,
)


def an_estimate(values: Array | None = None, covariance: Array | None = None) -> Estimate:
    return Estimate(
        names=MODEL.parameter_names,
        units=MODEL.units,
        values=truth() if values is None else values,
        covariance=np.zeros((P, P)) if covariance is None else covariance,
        noise_std=NOISE,
        samples=np.full(2, 1000),
        method=EstimationMethod(),
        condition=1.0,
    )


def only(name: str, std: float) -> Array:
    covariance = np.zeros((P, P))
    k = MODEL.parameter_names.index(name)
    covariance[k, k] = std**2
    return covariance


POSTURES = workspace(np.full(2, -np.pi), np.full(2, np.pi))


# The flange


@pytest.mark.parametrize("seed", range(8))
def test_the_flange_moves_as_pinocchio_says(seed: int) -> None:
    urdf = random_urdf(seed)
    chain = chain_from_urdf(urdf)
    model = pinocchio_model(urdf)
    data = model.createData()
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (5, chain.n_joints))
    found = flange_motion(chain, q)
    frame = model.getFrameId(flange_name(chain), pin.FrameType.BODY)
    for row, position, jacobian in zip(q, found.position, found.jacobian, strict=True):
        at = pin.integrate(model, pin.neutral(model), row)
        expected = pin.computeFrameJacobian(
            model, data, at, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )[:3]
        pin.framesForwardKinematics(model, data, at)
        np.testing.assert_allclose(position, data.oMf[frame].translation, atol=1e-12)
        np.testing.assert_allclose(jacobian, expected, atol=1e-12)


WHEELS = "".join(
    f"""<link name="{name}"><inertial><mass value="1"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
    <joint name="{name}_joint" type="continuous"><parent link="base"/><child link="{name}"/>
      <axis xyz="0 1 0"/></joint>"""
    for name in ("wheel_left", "wheel_right")
)
MOBILE = RobotModel.from_urdf(
    URDF.replace("</robot>", f"{WHEELS}</robot>"), friction=FrictionLaw(third=None)
)


def test_a_wheel_is_no_flange() -> None:
    """Of a mobile robot, flange and payload are at the end of its arm, in any order of names."""
    chain = MOBILE.chain
    assert chain.joint_names[-1].startswith("wheel")
    assert flange_name(chain) == "lower"
    assert flange_of(MOBILE) == "lower"
    assert chain.joint_names[chain.frame(None).joint] == "elbow"
    arm = flange_motion(MODEL.chain, POSTURES)
    turned = np.pad(POSTURES, ((0, 0), (0, 2)), constant_values=0.7)
    robot = flange_motion(chain, turned)
    np.testing.assert_allclose(robot.position, arm.position)
    np.testing.assert_allclose(robot.jacobian[..., :2], arm.jacobian)
    assert not robot.jacobian[..., 2:].any()


def test_the_load_on_unseen_motion_hangs_on_the_arm() -> None:
    """A mobile robot's arm carries it, not one of its wheels."""
    motions = [four_sines(np.arange(0.0, 10.0, 0.005), n=4, seed=seed) for seed in (1, 2)]
    values = MOBILE.base.grouping @ MOBILE.nominal
    values = np.concatenate([values, np.full(MOBILE.n_parameters - len(values), 1.0)])
    carried = Load(MOBILE.chain, MOBILE.gravity, Payload(2.0, (0.1, 0.0, 0.3)))
    free, loaded = (
        simulated(MOBILE, values, motion, noise=np.full(4, 0.05), seed=seed)
        for seed, motion in enumerate(motions)
    )
    loaded = replace(loaded, torque=loaded.torque + carried.torque(loaded.motion))
    factors = [standard_factor(MOBILE, [samples]) for samples in (free, loaded)]
    load = find_load(MOBILE, [free], [loaded], *factors)
    assert load.explained > 0.99
    assert load.mass == pytest.approx(2.0, rel=0.02)


# Gravity


def test_the_gravity_torque_scatters_like_that_of_drawn_arms() -> None:
    root = np.random.default_rng(4).normal(size=(P, P))
    covariance = root @ root.T
    q = POSTURES[:4]
    std = torque_deviation(MODEL, an_estimate(covariance=covariance), q)
    draws = np.random.default_rng(5).multivariate_normal(np.zeros(P), covariance, 20_000)
    rest = Motion.at_rest(q)
    # of pinocchio's convention alone: the torque is linear in the parameters
    columns = np.stack([MODEL.torque(unit, rest) for unit in np.eye(P)], axis=-1)
    np.testing.assert_allclose(std, (columns @ draws.T).std(axis=-1), rtol=0.03)


def test_nineteen_in_twenty_errors_are_smaller() -> None:
    std = np.array([0.0, 0.5, 1.0, 4.0])
    limit = mixture_limit(std, 0.95)
    draws = np.random.default_rng(6).normal(size=(400_000, 4)) * std
    assert np.mean(np.abs(draws) < limit) == pytest.approx(0.95, abs=0.002)
    assert mixture_limit(np.zeros(3), 0.95) == 0.0
    assert mixture_limit(np.append(np.ones(9), np.inf), 0.95) == np.inf


@pytest.mark.parametrize(("times", "good"), [(0.9, True), (1.1, False)])
def test_gravity_errors_are_held_against_dry_friction(times: float, good: bool) -> None:
    # of the first joint Coulomb friction is 4 N·m; an offset of that uncertainty is the same in
    # every posture
    law = replace(FrictionLaw(third=None), offset=True)
    model = RobotModel.from_urdf(URDF, friction=law)
    values = np.concatenate([truth(), [0.0, 0.0]])
    k = model.parameter_names.index("fo_1")
    covariance = np.zeros((len(values), len(values)))
    covariance[k, k] = (times * 4.0 / 1.96) ** 2
    estimate = replace(
        an_estimate(),
        names=model.parameter_names,
        units=model.units,
        values=values,
        covariance=covariance,
    )
    purpose = gravity_compensation(model, estimate, POSTURES)
    assert purpose.joints == pytest.approx([times * 4.0, 0.0], rel=1e-3)
    assert purpose.joint_limits == pytest.approx([4.0, 2.0])
    assert purpose.good is good


def test_without_dry_friction_gravity_is_reported_and_not_judged() -> None:
    values = truth()
    values[MODEL.parameter_names.index("f0_2")] = -0.3
    purpose = gravity_compensation(MODEL, an_estimate(values, only("f0_2", 0.1)), POSTURES)
    assert purpose.good is None
    assert purpose.missing == "no dry friction"


def test_torques_without_gravity_say_nothing_of_its_compensation() -> None:
    weightless = MODEL.under_gravity((0.0, 0.0, 0.0))
    purpose = gravity_compensation(weightless, an_estimate(), POSTURES)
    assert (purpose.good, purpose.figure, purpose.missing) == (None, None, "no gravity")


def test_what_the_motion_does_not_determine_is_an_infinite_error() -> None:
    covariance = np.diag(
        np.where([name.startswith("mc") for name in MODEL.parameter_names], np.inf, 1.0)
    )
    error, _ = gravity_error(MODEL, an_estimate(covariance=covariance), POSTURES)
    assert np.isinf(error).any()


# Contact and payload


def exceeded(peaks: Array, limit: Array) -> Array:
    return (
        np.count_nonzero(peaks > limit, axis=0) / (BLOCK_SECONDS * len(peaks)) * FALSE_ALARM_PERIOD
    )


@cache
@cache
def peaks_of(duration: float, seed: int) -> Array:
    (part,) = slow_residuals(MODEL, truth(), [quiet(duration, seed)])
    size = np.abs(part.torque)
    rows = round(BLOCK_SECONDS / 0.005)
    return size[: len(size) // rows * rows].reshape(-1, rows, 2).max(axis=1)


@pytest.mark.long
@pytest.mark.parametrize("duration", [15.0, 60.0, 400.0])
def test_a_threshold_holds_its_rate(duration: float) -> None:
    later = peaks_of(4000.0, 99)
    rates = []
    for seed in range(12):
        limit = once_in(FALSE_ALARM_PERIOD, peaks_of(duration, seed))
        assert limit is not None
        rates.append(exceeded(later, limit))
    # once in its time on average; of a few seconds it errs to the larger side
    assert 0.15 < np.mean(rates) < 1.5


def test_too_short_a_motion_has_no_threshold() -> None:
    assert once_in(FALSE_ALARM_PERIOD, np.ones((4, 2))) is None


def test_the_force_exceeds_a_threshold_in_most_directions() -> None:
    model = RobotModel.from_urdf(random_urdf(3), friction=FrictionLaw(third=None))
    n = model.n_joints
    postures = workspace(np.full(n, -1.0), np.full(n, 1.0))
    threshold = np.linspace(1.0, 2.0, n)
    force = seen_force(model, threshold, postures)
    jacobian = flange_motion(model.chain, postures).jacobian
    direction = np.random.default_rng(1).normal(size=(len(postures), 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    torque = np.abs(np.einsum("mi,min->mn", force * direction, jacobian))
    assert np.mean(np.any(torque > threshold, axis=1)) == pytest.approx(0.95, abs=0.03)


def test_a_joint_that_did_not_move_shows_neither_force_nor_mass() -> None:
    """Its residual is zero throughout: what it would feel of a contact is not known."""
    model = RobotModel.from_urdf(random_urdf(3), friction=FrictionLaw(third=None))
    n = model.n_joints
    postures = workspace(np.full(n, -1.0), np.full(n, 1.0))
    deaf, still = np.ones((2, n))
    deaf[1], still[1] = 1e3, 0.0
    with np.errstate(all="raise"):
        force = seen_force(model, still, postures)
        assert force == pytest.approx(seen_force(model, deaf, postures), rel=1e-9)
        assert seen_force(model, np.zeros(n), postures) == np.inf
    (part,) = slow_residuals(MODEL, truth(), [quiet(60.0, 1)])
    with np.errstate(all="raise"):
        mass = seen_mass(MODEL, [part._replace(torque=part.torque * [1.0, 0.0])])
    # The flange is on the axis of the second joint, which feels no mass there.
    assert mass == pytest.approx(seen_mass(MODEL, [part]), rel=1e-6)


def test_a_mass_above_the_smallest_is_seen_and_one_below_is_not() -> None:
    quiet_parts = slow_residuals(MODEL, truth(), [quiet(60.0, 1)])
    mass = seen_mass(MODEL, quiet_parts)
    assert mass is not None
    load = Load(
        MODEL.chain, MODEL.gravity, Payload(1.0, (0.0, 0.0, 0.0), frame=flange_name(MODEL.chain))
    )
    motion = quiet(60.0, 2).motion
    for times, seen in ((0.3, False), (3.0, True)):
        carried = quiet(60.0, 2, times * mass * load.torque(motion))
        (part,) = slow_residuals(MODEL, truth(), [carried])
        unit = load.torque(part.motion)
        variance = (quiet_parts[0].torque ** 2).mean(axis=0)
        rows = round(BLOCK_SECONDS / 0.005)
        product = (part.torque * unit / variance).sum(axis=1)[: len(unit) // rows * rows]
        square = (unit**2 / variance).sum(axis=1)[: len(product)]
        block = product.reshape(-1, rows).sum(axis=1) / square.reshape(-1, rows).sum(axis=1)
        assert (np.median(np.abs(block)) > mass) == seen


def test_thresholds_need_unseen_motion() -> None:
    assert contact(MODEL, [], POSTURES) is None
    assert seen_mass(MODEL, []) is None


# Simulation


@pytest.mark.parametrize("seed", [1, 2])
def test_a_wrong_arm_leaves_its_path_as_pinocchio_integrates_it(seed: int) -> None:
    """Independent: pinocchio's forward dynamics, small steps, the feedback and the friction."""
    values = truth()
    model = pin.buildModelFromXML(URDF)
    rotor = np.array([0.4, 0.1])
    viscous = np.array([1.5, 0.8])
    motion = four_sines(np.arange(0.0, 4.0, 0.001), 0.5, seed=seed)
    wrong = 1.05 * values
    samples = simulated(MODEL, wrong, motion)
    expected = []
    inertia = pin.crba(model, model.createData(), np.zeros(2)) + np.diag(rotor)
    alone = np.diag(inertia)
    rate = 2.0 * np.pi
    torque = samples.torque
    for start in range(200, 3700, 150):
        q, v = motion.position[start].copy(), motion.velocity[start].copy()
        data = model.createData()
        for row in range(start, start + round(HORIZON_SECONDS / 0.001)):
            back = rate**2 * alone * (motion.position[row] - q) + 2.0 * rate * alone * (
                motion.velocity[row] - v
            )
            friction = np.array([4.0, 2.0]) * np.sign(motion.velocity[row]) + viscous * v
            bias = pin.rnea(model, data, q, v, np.zeros(2))
            mass = pin.crba(model, data, q) + np.diag(rotor)
            mass = np.triu(mass) + np.triu(mass, 1).T
            v = v + 0.001 * np.linalg.solve(mass, torque[row] + back - friction - bias)
            q = q + 0.001 * v
        ends = flange_motion(MODEL.chain, np.array([q, motion.position[start + 200]])).position
        expected.append(np.linalg.norm(ends[0] - ends[1]))
    found = flange_error(MODEL, values, [samples])
    assert found is not None
    assert found == pytest.approx(np.sqrt(np.mean(np.square(expected))), rel=0.25)


def test_the_true_arm_stays_on_its_path() -> None:
    motion = four_sines(np.arange(0.0, 4.0, 0.001), 0.5)
    found = flange_error(MODEL, truth(), [simulated(MODEL, truth(), motion)])
    assert found is not None
    assert found < 1e-4


# Parameters


def test_parameters_are_counted_by_how_well_they_are_known() -> None:
    values = np.ones(P)
    covariance = np.diag(np.full(P, 4.0))
    covariance[0, 0] = 0.05**2
    covariance[1, 1] = 0.3**2
    covariance[2, 2] = np.inf
    purpose = single_parameters(an_estimate(values, covariance))
    assert purpose.figure == 1
    assert purpose.references == {"roughly": 1, "not": P - 2}


@pytest.mark.parametrize(
    ("friction", "held_by"),
    [
        (0.2, "dry friction 0.20 N·m"),
        (3.8e-11, "no dry friction"),
        (1e-3, "dry friction 0.0010 N·m"),
    ],
)
def test_dry_friction_at_its_bound_is_called_none(friction: float, held_by: str) -> None:
    purpose = Purpose("gravity", False, 4.0, 1.0, joints=(0.8,), joint_limits=(friction,))
    assert figure(purpose, ["one"]) == f"one off by 0.80 N·m, {held_by}"


def test_a_smallest_force_has_the_rate_of_its_false_alarms() -> None:
    purpose = Purpose("contact", None, 8.6, unit="N", references={"period": 60.0})
    assert figure(purpose, []) == "from 8.6 N, one false alarm in 60 s"
