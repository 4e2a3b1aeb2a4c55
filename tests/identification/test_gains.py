from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from hil.identify.prepared import current_warnings
from identification.errors import IdentificationError
from identification.estimators.gains import (
    CurrentScale,
    GainMethod,
    Gains,
    identify_gains,
    scale_from_nominal,
)
from identification.factor.phases import PhaseFactor, gain_factor, joined
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.payload import Load, Payload
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from sim_fixtures.ns16 import load_truth, standard_parameters, urdf_text
from tests.identification.two_link import MODEL, a_motion, as_samples, coloured, sine_motion

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
LOAD = Payload(2.0, (0.03, 0.0, 0.45))
PLANTED = np.array([12.0, 5.0])  # N m / A
NOISE = np.array([0.3, 0.1])  # A
SEEDS = 100

# Lifts along gravity, then turns about it: an axis on which no payload weighs.
LIFT_AND_TURN = """<robot name="lift"><link name="base"/>
<joint name="lift" type="prismatic"><parent link="base"/><child link="column"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="500" velocity="3"/></joint>
<link name="column"><inertial><mass value="8"/>
<inertia ixx="0.2" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.05"/></inertial></link>
<joint name="turn" type="revolute"><parent link="column"/><child link="hand"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="50" velocity="6"/></joint>
<link name="hand"><inertial><mass value="3"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.03"/></inertial></link></robot>"""


def load_torque(model: RobotModel, payload: Payload, motion: Motion) -> Array:
    return Load(model.chain, model.gravity, payload).torque(*motion[1:4])


def two_link() -> tuple[RobotModel, Array]:
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))
    standard = model.nominal.copy()
    standard[[10, 21]] = 0.4, 0.1  # rotors
    return model, np.concatenate([model.base.grouping @ standard, [4.0, 2.0, 1.5, 0.8]])


def lively(n: int, *, count: int = 2000, step: float = 5e-3, speed: float = 1.0) -> Motion:
    time = np.arange(count) * step
    rng = np.random.default_rng(12)
    a, w, phase = rng.uniform([[[0.2]], [[2.0]], [[0.0]]], [[[0.5]], [[9.0]], [[6.0]]], (3, 4, n))
    w = w * speed
    return sine_motion(time, a, w, phase)


def samples_of(model: RobotModel, motion: Motion) -> Samples:
    return as_samples(model, motion, np.zeros_like(motion.position))


def factor_of(
    model: RobotModel,
    truth: Array,
    gains: Array,
    noise: Array,
    *,
    seed: int = 0,
    load: Payload | None = LOAD,
    motion: Motion | None = None,
    transmission: Array | None = None,
) -> PhaseFactor:
    """A recording without payload and one with it; currents are what carries the noise."""
    motion = lively(model.n_joints) if motion is None else motion
    samples, rng = samples_of(model, motion), np.random.default_rng(seed)
    torque = model.torque(truth, *motion[1:])
    turns = np.eye(model.n_joints) if transmission is None else transmission
    factors = []
    for payload in (None, load):
        joint = torque if payload is None else torque + load_torque(model, payload, motion)
        current = np.linalg.solve(turns.T, joint.T).T / gains
        current = current + noise * rng.standard_normal(current.shape)
        factors.append(
            gain_factor(model, samples, current, payload=payload, transmission=transmission)
        )
    return joined(factors)


def test_the_torque_of_a_payload_is_the_difference_pinocchio_sees() -> None:
    model = RobotModel.from_urdf(urdf_text())
    load = Payload(7.0, (0.05, -0.02, 0.11), (0.03, 0.002, -0.001, 0.04, 0.003, 0.05))
    motion = lively(6, count=20)
    plain = pin.buildModelFromXML(urdf_text())
    loaded = pin.buildModelFromXML(urdf_text())
    xx, xy, xz, yy, yz, zz = load.inertia
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    loaded.inertias[6] += pin.Inertia(load.mass, np.array(load.centre), tensor)
    difference = [
        pin.rnea(loaded, loaded.createData(), *state) - pin.rnea(plain, plain.createData(), *state)
        for state in zip(*motion[1:4], strict=True)
    ]
    np.testing.assert_allclose(load_torque(model, load, motion), difference, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", ["weighted", "total"])
def test_without_noise_the_planted_gains_come_back(method: GainMethod) -> None:
    model, truth = two_link()
    gains = identify_gains(
        factor_of(model, truth, PLANTED, np.zeros(2)), model.joint_names, method=method
    )
    assert gains.values == pytest.approx(PLANTED, rel=1e-6)
    assert gains.parameters == pytest.approx(truth, rel=1e-4, abs=1e-4)


@pytest.fixture(scope="module", params=["weighted", "total"])
def many(request: pytest.FixtureRequest) -> list[Gains]:
    model, truth = two_link()
    return [
        identify_gains(
            factor_of(model, truth, PLANTED, NOISE, seed=seed),
            model.joint_names,
            method=request.param,
        )
        for seed in range(SEEDS)
    ]


def test_95_percent_intervals_hold_the_truth_95_times_in_a_hundred(many: list[Gains]) -> None:
    inside = [np.abs(one.values - PLANTED) <= one.interval_factor * one.std for one in many]
    # Of 100 draws with 95 %, fewer than 89 come once in two hundred times; too wide shows below.
    covered = np.sum(inside, axis=0)
    assert np.all(covered >= 89)
    scatter = np.std([one.values for one in many], axis=0, ddof=1)
    claimed = np.sqrt(np.mean([one.std**2 for one in many], axis=0))
    # A standard deviation from 100 draws is itself known to 7 %.
    assert np.all(np.abs(np.log(claimed / scatter)) < 3 * 0.07)


def test_noise_of_the_currents_does_not_shrink_the_gains(many: list[Gains]) -> None:
    values = np.array([one.values for one in many])
    error = values.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    assert np.all(np.abs(values.mean(axis=0) - PLANTED) < 3.0 * error)


def test_plain_least_squares_would_shrink_them() -> None:
    """What the module says of the linear equation, by brute force on the stacked rows."""
    model, truth = two_link()
    motion, rng = lively(2), np.random.default_rng(1)
    torque = model.torque(truth, *motion[1:])
    load = load_torque(model, LOAD, motion)
    dense = model.regressor(*motion[1:]).dense(model.n_parameters)
    noise, rows, wanted = 10.0 * NOISE, [], []
    for extra in (np.zeros_like(load), load):
        current = (torque + extra) / PLANTED + noise * rng.standard_normal(torque.shape)
        for j in range(2):
            columns = np.zeros((len(current), 2))
            columns[:, j] = current[:, j]
            rows.append(np.column_stack([columns, -dense[:, j]]))
            wanted.append(extra[:, j])
    plain = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0][:2]
    assert np.all(plain < 0.9 * PLANTED)
    ours = identify_gains(
        factor_of(model, truth, PLANTED, noise, seed=1), model.joint_names, worst_relative_std=0.2
    )
    assert np.all(np.abs(ours.values - PLANTED) < 3.0 * ours.std)


def test_both_methods_agree_within_their_errors() -> None:
    model, truth = two_link()
    factor = factor_of(model, truth, PLANTED, NOISE, seed=5)
    one, other = (
        identify_gains(factor, model.joint_names, method=m) for m in ("weighted", "total")
    )
    assert np.all(np.abs(one.values - other.values) < one.std)


@pytest.mark.parametrize("method", ["weighted", "total"])
def test_an_axis_along_gravity_that_the_payload_does_not_load_is_named(method: GainMethod) -> None:
    model = RobotModel.from_urdf(LIFT_AND_TURN, friction=FrictionLaw(third=None))
    standard = model.nominal.copy()
    standard[[10, 21]] = 2.0, 0.05
    truth = np.concatenate([model.base.grouping @ standard, [20.0, 3.0, 15.0, 1.0]])
    on_its_axis = Payload(4.0, (0.0, 0.0, 0.1))
    factor = factor_of(model, truth, PLANTED, NOISE, load=on_its_axis)
    gains = identify_gains(factor, model.joint_names, method=method)
    assert gains.reasons[0] is None
    assert gains.values[0] == pytest.approx(PLANTED[0], abs=4.0 * gains.std[0])
    assert gains.determined.tolist() == [True, False]
    assert np.isnan(gains.values[1])
    assert np.isinf(gains.std[1])
    assert gains.reasons[1] == "the payload does not load it, and nothing else fixes its scale"
    line = gains.describe()[1]
    assert line.startswith("turn: gain not determined; the payload does not load it")
    assert not any(character.isdigit() for character in line)


def test_a_payload_beside_that_axis_determines_it_by_its_inertia() -> None:
    model = RobotModel.from_urdf(LIFT_AND_TURN, friction=FrictionLaw(third=None))
    standard = model.nominal.copy()
    standard[[10, 21]] = 2.0, 0.05
    truth = np.concatenate([model.base.grouping @ standard, [20.0, 3.0, 15.0, 1.0]])
    factor = factor_of(model, truth, PLANTED, NOISE, load=Payload(4.0, (0.2, 0.0, 0.1)))
    gains = identify_gains(factor, model.joint_names)
    assert np.all(np.abs(gains.values - PLANTED) < 4.0 * gains.std)


# Motors' angles per joint angle with a coupled wrist, as the NS 16 has it.
TURNS = np.diag([-116.0, 116.0, -106.0, -50.0, 51.5, -33.0]) @ (
    np.eye(6) + np.array([[0.0] * 6] * 4 + [[0, 0, 0, -0.03, 0, 0], [0, 0, 0, 0.021, -0.035, 0]])
)
CONSTANTS = np.array([1.10, 1.10, 0.75, 0.36, 0.42, 0.42])
NS16_LOAD = Payload(16.0, (0.10, 0.05, 0.25), (0.1, 0.0, 0.0, 0.1, 0.0, 0.05))


def ns16() -> tuple[RobotModel, Array]:
    model = RobotModel.from_urdf(urdf_text(), friction=FrictionLaw(third=None))
    planted, named = load_truth(), standard_parameters()
    # The named figures are of the DH frames; the URDF holds the same bodies.
    standard = model.nominal.copy().reshape(6, -1)
    standard[:, -1] = [named[f"I{j}m"] for j in range(1, 7)]
    base = model.base.grouping @ standard.reshape(-1)
    return model, np.concatenate([base, planted.coulomb, planted.viscous])


@pytest.mark.parametrize("method", ["weighted", "total"])
def test_the_torque_constants_of_a_coupled_ns16(method: GainMethod) -> None:
    model, truth = ns16()
    factor = factor_of(
        model, truth, CONSTANTS, np.full(6, 0.05), load=NS16_LOAD, transmission=TURNS
    )
    gains = identify_gains(factor, model.joint_names, method=method)
    assert gains.determined.all()
    assert np.all(np.abs(gains.values - CONSTANTS) < 4.0 * gains.std)
    assert np.all(gains.std < 0.02 * CONSTANTS)


def test_on_a_slow_ns16_the_first_axis_is_not_determined_the_loaded_ones_are() -> None:
    model, truth = ns16()
    slow = lively(6, speed=0.03, count=6000, step=0.02)
    factor = factor_of(
        model, truth, CONSTANTS, np.full(6, 0.05), load=NS16_LOAD, motion=slow, transmission=TURNS
    )
    gains = identify_gains(factor, model.joint_names)
    assert not gains.determined[0]
    assert gains.determined[[1, 2]].all()
    assert "joint_1: gain not determined" in gains.describe()[0]
    assert np.all(np.abs(gains.values - CONSTANTS)[1:3] < 4.0 * gains.std[1:3])


def test_recordings_add_up_in_any_order() -> None:
    model, truth = two_link()
    one = factor_of(model, truth, PLANTED, NOISE, seed=1)
    other = factor_of(model, truth, PLANTED, NOISE, seed=2)
    there = identify_gains(one + other, model.joint_names)
    back = identify_gains(other + one, model.joint_names)
    assert there.values == pytest.approx(back.values, rel=1e-9)
    single = identify_gains(one, model.joint_names)
    assert np.all(there.std < single.std)


def test_without_a_known_payload_it_refuses() -> None:
    model, truth = two_link()
    factor = factor_of(model, truth, PLANTED, NOISE, load=None)
    with pytest.raises(IdentificationError, match="no recording has a known payload"):
        identify_gains(factor, model.joint_names)


GAINS = np.array([12.0, 3.0])  # N·m/A


def scale(signs: tuple[float, float]) -> CurrentScale:
    """Gains from currents of the nominal arm with rotors and friction, times signs."""
    motion = a_motion()
    values = np.concatenate([MODEL.base.grouping @ MODEL.nominal, [4.0, 2.0, 1.5, 0.8]])
    noise = 0.1 * coloured(np.random.default_rng(0), len(motion.time), 5e-3, 0.0)
    torque = MODEL.torque(values, *motion[1:]) + noise
    return scale_from_nominal(MODEL, [motion], [torque / (GAINS * np.array(signs))])


@pytest.mark.parametrize("signs", [(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_a_current_of_the_wrong_sign_is_named(signs: tuple[float, float]) -> None:
    found = scale(signs)
    np.testing.assert_allclose(found.values, GAINS * signs, rtol=0.02)
    np.testing.assert_array_equal(found.turned, np.array(signs) < 0.0)
    negative = [text for text in current_warnings(MODEL.joint_names, found) if "negative" in text]
    assert len(negative) == any(found.turned)
    for name, turned in zip(MODEL.joint_names, found.turned, strict=True):
        assert any(name in text for text in negative) == turned


def test_a_gain_that_is_not_known_is_not_turned() -> None:
    unknown = CurrentScale(
        np.array([-1.0, 2.0]), np.array([np.inf, 0.1]), np.zeros(2, dtype=np.bool_)
    )
    assert not unknown.turned.any()
