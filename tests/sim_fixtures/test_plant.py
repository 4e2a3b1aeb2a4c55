"""The simulated arm: plant, servo loops and gears."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_fixtures import (
    ElasticPlant,
    Plant,
    PlantDiverged,
    PlantTruth,
    ServoSettings,
    SettingError,
    SimulatedDrive,
    UnmodelledEffects,
    ns16,
)
from sim_fixtures.arm import FrictionDrift, TorqueRipple
from sim_fixtures.plant import TOLERANCE, resolve_dry_friction
from sim_fixtures.servo import CurrentLoop, NominalModel, Servo
from tests.sim_fixtures.bench import CELL, DRIVE, FRICTIONLESS, TRUTH, motor_matrix

Array = NDArray[np.float64]
START = np.array([0.2, -1.2, 2.5, 0.3, 1.0, 0.2])
STEP = 5e-4


def full_inertia(plant: Plant) -> Array:
    upper = np.triu(pin.crba(plant.model, plant.model.createData(), plant.position))
    return upper + np.triu(upper, 1).T


def gravity_torque(plant: Plant) -> Array:
    return np.array(
        pin.computeGeneralizedGravity(plant.model, plant.model.createData(), plant.position)
    )


def swing(truth: PlantTruth, step: float, duration: float = 1.0) -> tuple[Plant, float]:
    """Let the arm fall freely; return it and the largest error of its energy [J]."""
    plant = Plant(ns16.urdf_text(), truth, position=START)
    before, worst = plant.energy(), 0.0
    for _ in range(round(duration / step)):
        plant.step(np.zeros(6), step)
        worst = max(worst, abs(plant.energy() - before))
    return plant, worst


def test_energy_is_conserved_to_second_order_in_the_step() -> None:
    plant, worst = swing(FRICTIONLESS, STEP)
    kinetic = 0.5 * plant.velocity @ full_inertia(plant) @ plant.velocity
    assert kinetic > 100.0  # the fall is a real one
    assert worst < 2e-5 * kinetic
    _, coarse = swing(FRICTIONLESS, 2.0 * STEP)
    assert coarse / worst == pytest.approx(4.0, rel=0.2)


def test_inverse_dynamics_of_a_step_give_the_applied_torque() -> None:
    """At the middle of a step: applied torque = rigid bodies + friction."""
    plant = Plant(ns16.urdf_text(), TRUTH, position=START)
    rng = np.random.default_rng(3)
    plant.set_state(START, rng.uniform(0.3, 1.5, 6) * rng.choice([-1.0, 1.0], 6))
    torque = rng.uniform(-1.0, 1.0, 6) * [400.0, 600.0, 200.0, 30.0, 40.0, 30.0]
    data = plant.model.createData()
    smooth_steps = 0
    steady = np.zeros(6, dtype=bool)  # no kink in this joint's motion since the last step
    for _ in range(400):
        q, v = plant.position.copy(), plant.velocity.copy()
        plant.step(torque, STEP)
        middle = 0.5 * (q + plant.position), 0.5 * (v + plant.velocity)
        rigid = pin.rnea(plant.model, data, *middle, plant.acceleration)
        straight = v * plant.velocity > 0.0
        error = np.abs(rigid + plant.friction_torque - torque)
        if straight.all() and steady.all():
            smooth_steps += 1
            assert error.max() < 2e-3  # N m, of some hundred
            np.testing.assert_allclose(
                plant.friction_torque, TRUTH.friction(middle[1]), rtol=1e-3, atol=0.0
            )
        assert error.max() < 0.5  # also where a joint stops, turns or starts
        steady = straight
    assert smooth_steps > 50


def test_rotors_count_as_armature() -> None:
    with_rotors = Plant(ns16.urdf_text(), FRICTIONLESS, position=START)
    without = Plant(ns16.urdf_text(), PlantTruth.frictionless(np.zeros(6)), position=START)
    difference = full_inertia(with_rotors) - full_inertia(without)
    np.testing.assert_allclose(difference, np.diag(TRUTH.rotor_inertia), atol=1e-12)
    torque = gravity_torque(with_rotors) + 10.0
    for plant in (with_rotors, without):
        plant.step(torque, 1e-6)
        np.testing.assert_allclose(
            plant.acceleration, np.linalg.solve(full_inertia(plant), np.full(6, 10.0)), rtol=1e-4
        )


def test_stiction_holds_a_resting_arm() -> None:
    plant = Plant(ns16.urdf_text(), TRUTH, position=START)
    push = 0.95 * TRUTH.coulomb * [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]
    torque = gravity_torque(plant) + push
    for _ in range(4000):
        plant.step(torque, STEP)
    np.testing.assert_array_equal(plant.position, START)
    np.testing.assert_array_equal(plant.velocity, 0.0)
    np.testing.assert_allclose(plant.friction_torque, push, rtol=1e-9)


def test_an_axis_breaks_loose_just_above_its_coulomb_torque() -> None:
    for joint in range(6):
        for factor, moves in ((0.999, False), (1.02, True)):
            plant = Plant(ns16.urdf_text(), TRUTH, position=START)
            torque = gravity_torque(plant)
            torque[joint] += factor * TRUTH.coulomb[joint]
            for _ in range(10):
                plant.step(torque, STEP)
            assert bool(plant.velocity[joint] > 0.0) is moves, (joint, factor)


def test_a_pushed_arm_comes_to_rest_and_stays_there() -> None:
    plant = Plant(ns16.urdf_text(), TRUTH, position=START)
    plant.set_state(START, [0.4, -0.3, 0.5, 1.0, -1.0, 2.0])
    crossings = np.zeros(6)
    for _ in range(4000):
        before = np.sign(plant.velocity)
        plant.step(gravity_torque(plant), STEP)
        crossings += before * np.sign(plant.velocity) < 0.0
    np.testing.assert_array_equal(plant.velocity, 0.0)
    assert crossings.max() <= 1  # no chatter about zero
    at_rest = plant.position.copy()
    for _ in range(100):
        plant.step(gravity_torque(plant), STEP)
    np.testing.assert_array_equal(plant.position, at_rest)


def test_closed_brakes_stop_and_hold_the_arm() -> None:
    plant = Plant(ns16.urdf_text(), TRUTH, position=START, brake_torque=2000.0)
    plant.set_state(START, np.full(6, 2.0))
    plant.close_brakes(True)
    for _ in range(1000):
        plant.step(np.zeros(6), STEP)
    np.testing.assert_array_equal(plant.velocity, 0.0)
    plant.close_brakes(False)
    for _ in range(20):
        plant.step(np.zeros(6), STEP)
    assert plant.velocity.any()


def test_a_state_that_is_not_finite_is_an_error() -> None:
    plant = Plant(ns16.urdf_text(), TRUTH, position=START)
    with pytest.raises(PlantDiverged):
        for _ in range(10):
            plant.step(np.full(6, np.nan), STEP)


def test_the_inertia_scale_applies_to_mass_moment_and_tensor() -> None:
    scale = np.array([1.2, 0.8, 1.1, 0.9, 1.15, 0.85])
    truths = TRUTH, replace(TRUTH, inertia_scale=scale)
    unscaled, scaled = (
        [body.toDynamicParameters() for body in list(Plant(ns16.urdf_text(), t).model.inertias)[1:]]
        for t in truths
    )
    np.testing.assert_allclose(scaled, scale[:, None] * unscaled, rtol=1e-12, atol=1e-14)


def test_the_cell_file_has_the_default_sizes_of_effects() -> None:
    for name, size in vars(UnmodelledEffects.default_sizes(6)).items():
        np.testing.assert_array_equal(CELL["simulation"][name], size, err_msg=name)


def test_ripple_repeats_twice_per_motor_turn_with_the_stated_amplitude() -> None:
    ripple = TorqueRipple(np.array([5.0, 2.0]), np.random.default_rng(1))
    turns = np.linspace(0.0, 1.0, 401)
    torque = np.array([ripple.torque([t, t]) for t in turns])
    np.testing.assert_allclose(np.abs(torque).max(axis=0), [5.0, 2.0], rtol=1e-3)
    np.testing.assert_allclose(torque[:201], torque[200:], atol=1e-9)
    np.testing.assert_allclose(torque[:-1].mean(axis=0), 0.0, atol=1e-9)


def test_friction_falls_from_cold_to_hot_by_the_stated_share() -> None:
    drift = FrictionDrift(0.08, 2)
    cold = drift.scale(np.zeros(2), 0.001)
    np.testing.assert_allclose(cold, 1.04, rtol=1e-6)
    previous = cold
    for _ in range(3000):  # half an hour; one joint races, the other rests
        factor = drift.scale(np.array([1e6, 0.0]), 6.0)
        assert factor[0] <= previous[0]
        previous = factor
    np.testing.assert_allclose(factor, [0.96, 1.04], rtol=1e-4)


SOFT = (1.0e-6, 1.0e-6, 2.5e-6, 0.0, 0.0, 0.0)


def elastic(truth: PlantTruth, compliance: tuple[float, ...] = SOFT) -> ElasticPlant:
    return ElasticPlant(ns16.urdf_text(), truth, elasticity=compliance, step=STEP, position=START)


def test_springs_carry_gravity_from_the_start() -> None:
    plant = elastic(TRUTH)
    gravity = pin.computeGeneralizedGravity(plant.model, plant.model.createData(), START)
    np.testing.assert_allclose(plant.motor_position - START, gravity * SOFT, atol=1e-15)
    for _ in range(200):
        plant.step(gravity, STEP)
    np.testing.assert_allclose(plant.position, START, atol=1e-9)


def test_a_stiff_gear_is_a_rigid_one() -> None:
    stiff = elastic(TRUTH, (5e-8, 5e-8, 0.0, 0.0, 0.0, 0.0))
    rigid = Plant(ns16.urdf_text(), TRUTH, position=START)
    for k in range(1000):
        torque = np.array([900.0, -300.0, 0.0, 5.0, 15.0, 8.0]) * np.sin(0.01 * k)
        stiff.step(torque, STEP)
        rigid.step(torque, STEP)
    assert np.abs(rigid.velocity).max() > 0.3
    np.testing.assert_allclose(stiff.velocity, rigid.velocity, atol=2e-2)
    np.testing.assert_allclose(stiff.position, rigid.position, atol=2e-3)


def test_damped_springs_lose_energy_and_never_gain_it() -> None:
    plant = elastic(FRICTIONLESS)
    start = plant.energy()
    energies = []
    for _ in range(2000):
        plant.step(np.zeros(6), STEP)
        energies.append(plant.energy())
    assert plant.velocity @ plant.velocity > 1.0  # it did swing
    assert max(energies) < start + 0.01  # J; of some hundred in motion
    assert start - 20.0 < energies[-1] < start


def test_a_struck_link_rings_at_the_frequency_of_its_spring() -> None:
    """Motor held by its brake, link free: an oscillator with the link's own inertia."""
    plant = ElasticPlant(
        ns16.urdf_text(), TRUTH, elasticity=(1e-6, 0.0, 0.0, 0.0, 0.0, 0.0), step=STEP,
        position=START, brake_torque=1e5,
    )  # fmt: skip
    plant.close_brakes(True)
    plant.set_state(START, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    swing = []
    for _ in range(1000):
        plant.step(np.zeros(6), STEP)
        swing.append(plant.position[0] - START[0])
    inertia = pin.crba(plant.model, plant.model.createData(), START)[0, 0]
    crossings = np.nonzero(np.diff(np.sign(swing)) != 0)[0]
    period = 2.0 * np.mean(np.diff(crossings)) * STEP
    assert 2.0 * np.pi / period == pytest.approx(np.sqrt(1e6 / inertia), rel=0.02)


def random_inverse_inertia(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), push=st.floats(0.01, 100.0))
def test_friction_holds_what_it_can_and_opposes_what_slides(seed: int, n: int, push: float) -> None:
    rng = np.random.default_rng(seed)
    inverse = random_inverse_inertia(rng, n)
    coulomb = rng.uniform(0.0, 50.0, n) * rng.integers(0, 2, n)
    free = STEP * push * rng.normal(size=n)
    guess = rng.uniform(-60.0, 60.0, n)
    result = resolve_dry_friction(free.tolist(), inverse, coulomb.tolist(), STEP, guess.tolist())
    velocity, torque = np.array(result.velocity), np.array(result.torque)

    slack = 10.0 * TOLERANCE * (coulomb.max() + 1.0)
    assert np.all(np.abs(torque) <= coulomb)
    sliding = velocity != 0.0
    np.testing.assert_allclose(torque[sliding], (coulomb * np.sign(velocity))[sliding], atol=slack)
    # momentum: what friction did not take away is still there
    balance = free - STEP * inverse @ torque - velocity
    np.testing.assert_allclose(balance, 0.0, atol=STEP * np.abs(inverse).sum() * slack)


def test_a_joint_slides_on_when_its_coulomb_torque_grows_a_little() -> None:
    """A guess just short of the bound must not pass for a torque that holds."""
    result = resolve_dry_friction([1.0], np.eye(1), [10.0 * (1.0 + 1e-9)], STEP, [10.0])
    assert result.velocity[0] > 0.9


GRAVITY = (0.0, 0.0, -9.81)
POSTURE = [0.2, -1.2, 2.5, 0.3, 1.0, 0.2]


def nominal(low: float, high: float) -> NominalModel:
    rng = np.random.default_rng(3)
    return NominalModel(ns16.urdf_text(), TRUTH, gravity=GRAVITY, error=(low, high), rng=rng)


def make_servo(resolution: float = 0.0) -> Servo:
    settings = ServoSettings()
    model = nominal(*settings.model_error)
    servo = Servo(DRIVE, model, settings, period=0.001, current_resolution=resolution)
    servo.start_at(DRIVE.motor_revolutions(POSTURE))
    return servo


def hold(servo: Servo) -> list[float]:
    return servo.advance(servo.target, [0.0] * 6)


def test_the_current_of_a_servo_at_rest_is_that_of_the_model() -> None:
    servo = make_servo()
    assert hold(servo) == servo.model_current
    assert servo.model_current[1] != 0.0  # gravity


def test_current_stays_within_its_limit_and_does_not_wind_up() -> None:
    servo = make_servo()
    home = list(servo.measured)
    far = [p + 20.0 for p in home]
    for _ in range(500):
        current = servo.advance(far, [0.0] * 6)
        assert np.all(np.abs(current) <= DRIVE.current_limit)
    assert current == list(DRIVE.current_limit)
    servo.advance(home, [0.0] * 6)
    back = np.array(servo.advance(home, [0.0] * 6))
    assert np.all(back < 0.5 * np.array(DRIVE.current_limit))


def test_the_model_is_wrong_by_five_to_ten_per_cent() -> None:
    model, exact = nominal(0.05, 0.10), nominal(0.0, 0.0)
    off = np.abs(model.rotor_inertia / TRUTH.rotor_inertia - 1.0)
    assert np.all((off >= 0.05) & (off <= 0.10))
    q, qd, qdd = np.array(POSTURE), np.ones(6), np.full(6, 2.0)
    true = exact.torque(q, qd, qdd)
    assert 0.01 < np.abs(model.torque(q, qd, qdd) - true).max() / np.abs(true).max() < 0.5
    rigid = pin.buildModelFromXML(ns16.urdf_text())
    torque = pin.rnea(rigid, rigid.createData(), q, qd, qdd) + TRUTH.rotor_inertia * qdd
    np.testing.assert_allclose(true, torque + TRUTH.friction(qd), rtol=1e-12)
    inertia = np.diag(pin.crba(rigid, rigid.createData(), q)) + TRUTH.rotor_inertia
    np.testing.assert_allclose(exact.diagonal_inertia(q), inertia, rtol=1e-12)


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_the_current_follows_with_the_stated_lag_whatever_the_substeps(substeps: int) -> None:
    """Area above a step response is the time constant."""
    lag, period = 0.0007, 0.001
    loop = CurrentLoop(1, lag=lag, substep=period / substeps, delay_substeps=0)
    missing = 0.0
    for _ in range(50 * substeps):
        missing += (1.0 - loop.substep([1.0], [0.0])[0]) * period / substeps
    assert missing == pytest.approx(lag, rel=1e-12)


def test_a_delay_shifts_the_current_by_whole_substeps() -> None:
    loop = CurrentLoop(1, lag=0.0, substep=0.0005, delay_substeps=3)
    flowing = [loop.substep([1.0], [0.0])[0] for _ in range(5)]
    assert flowing == [0.0, 0.0, 0.0, 1.0, 1.0]
    loop.cut()
    assert loop.substep([1.0], [0.0])[0] == 0.0


angles = st.lists(st.floats(-7.0, 7.0), min_size=6, max_size=6)
numbers = st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6)


@given(q=angles)
def test_motor_positions_follow_the_formulas(q: list[float]) -> None:
    controller = np.array(q) * DRIVE.joint_sign + DRIVE.joint_offset
    expected = motor_matrix(DRIVE) @ controller + DRIVE.calibration
    np.testing.assert_allclose(DRIVE.motor_revolutions(q), expected, rtol=1e-12, atol=1e-11)


@given(q=angles)
def test_motor_to_joint_undoes_joint_to_motor(q: list[float]) -> None:
    np.testing.assert_allclose(DRIVE.joint_angles(DRIVE.motor_revolutions(q)), q, atol=1e-12)
    np.testing.assert_allclose(DRIVE.joint_speeds(DRIVE.motor_speeds(q)), q, atol=1e-12)


@given(qd=angles, currents=numbers)
def test_power_at_the_motors_is_power_at_the_joints(qd: list[float], currents: list[float]) -> None:
    motor_torque = np.array(currents) * DRIVE.torque_constant
    motor_speed = 2.0 * pi * np.array(DRIVE.motor_speeds(qd))
    joint_power = np.dot(DRIVE.joint_torques(currents), qd)
    assert joint_power == pytest.approx(motor_torque @ motor_speed, rel=1e-10, abs=1e-6)


@given(torques=numbers)
def test_joint_torques_invert_currents(torques: list[float]) -> None:
    np.testing.assert_allclose(
        DRIVE.joint_torques(DRIVE.currents(torques)), torques, rtol=1e-12, atol=1e-10
    )


def test_encoders_read_whole_counts() -> None:
    positions = [0.1, -2.34567, 57.0000001, 3.0, -0.00001, 12.5]
    read = np.array(DRIVE.encoder(positions, [0.0] * 6))
    counts = read * DRIVE.encoder_counts
    np.testing.assert_array_equal(counts, np.round(counts))
    assert np.abs(read - positions).max() <= 0.5 / DRIVE.encoder_counts
    shifted = np.array(DRIVE.encoder(positions, [2.0] * 6))
    np.testing.assert_allclose((shifted - read) * DRIVE.encoder_counts, 2.0, atol=1e-6)


SIMPLE = PlantTruth.frictionless(np.ones(6))
NO_ROTORS = PlantTruth.frictionless(np.zeros(6))
NO_WRIST = ((1.0, 1.0),) * 7


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Plant(ns16.urdf_text(), PlantTruth.frictionless((1.0, 1.0))), "6 degrees of"),
        (lambda: replace(SIMPLE, coulomb=-np.ones(6)), "coulomb"),
        (lambda: elastic(NO_ROTORS, (1e-6,) * 6), "rotor_inertia"),
        (lambda: elastic(SIMPLE, (0.0, 0.0, 0.0, 0.0, 0.0, 1e-8)), "resonances below"),
        (lambda: SimulatedDrive(*NO_WRIST, 4096, k54=0.1), "below six"),
    ],
)
def test_impossible_values_are_refused_by_name(make, text) -> None:
    with pytest.raises(SettingError, match=text):
        make()
