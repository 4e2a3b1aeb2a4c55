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
from sim_fixtures.arm import SimulatedDrift, SimulatedRipple
from sim_fixtures.plant import FRICTION_TOLERANCE, resolve_dry_friction
from sim_fixtures.servo import CurrentLoop, NominalModel, Servo
from tests.sim_fixtures.bench import CELL, DRIVE, FRICTIONLESS, TRUTH, frictionless, motor_matrix

Array = NDArray[np.float64]
START = np.array([0.2, -1.2, 2.5, 0.3, 1.0, 0.2])
STEP = 5e-4


def rigid_plant(truth: PlantTruth = TRUTH, **options) -> Plant:
    return Plant(ns16.urdf_text(), truth, position=START, **options)


def gravity_torque(plant: Plant) -> Array:
    return np.array(
        pin.computeGeneralizedGravity(plant.model, plant.model.createData(), plant.position)
    )


def steps(plant: Plant, count: int, torque: Array | None = None) -> Plant:
    """Step with this torque, or with that of gravity."""
    for _ in range(count):
        plant.step(gravity_torque(plant) if torque is None else torque, STEP)
    return plant


def swing(step: float) -> tuple[Plant, float]:
    """Let the arm fall freely for a second; return it and the largest error of its energy [J]."""
    plant = rigid_plant(FRICTIONLESS)
    before = plant.energy()
    worst = 0.0
    for _ in range(round(1.0 / step)):
        plant.step(np.zeros(6), step)
        worst = max(worst, abs(plant.energy() - before))
    return plant, worst


def test_energy_is_conserved_to_second_order_in_the_step() -> None:
    plant, worst = swing(STEP)
    upper = np.triu(pin.crba(plant.model, plant.model.createData(), plant.position))
    kinetic = 0.5 * plant.velocity @ (upper + np.triu(upper, 1).T) @ plant.velocity
    assert kinetic > 100.0  # the fall is a real one
    assert worst < 2e-5 * kinetic
    _, coarse = swing(2.0 * STEP)
    assert coarse / worst == pytest.approx(4.0, rel=0.2)


def test_inverse_dynamics_of_a_step_give_the_applied_torque() -> None:
    """At the middle of a step: applied torque = rigid bodies + friction."""
    plant = rigid_plant()
    rng = np.random.default_rng(3)
    plant.set_state(START, rng.uniform(0.3, 1.5, 6) * rng.choice([-1.0, 1.0], 6))
    torque = rng.uniform(-1.0, 1.0, 6) * [400.0, 600.0, 200.0, 30.0, 40.0, 30.0]
    data = plant.model.createData()
    smooth_steps = 0
    steady = np.zeros(6, dtype=bool)  # no kink in this joint's motion since the last step
    for _ in range(400):
        q = plant.position.copy()
        v = plant.velocity.copy()
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


class TestStandstill:
    def test_stiction_holds_a_resting_arm(self) -> None:
        plant = rigid_plant()
        push = 0.95 * TRUTH.coulomb * [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]
        steps(plant, 4000, gravity_torque(plant) + push)
        np.testing.assert_array_equal(plant.position, START)
        np.testing.assert_array_equal(plant.velocity, 0.0)
        np.testing.assert_allclose(plant.friction_torque, push, rtol=1e-9)

    def test_a_pushed_arm_comes_to_rest_and_stays_there(self) -> None:
        plant = rigid_plant()
        plant.set_state(START, [0.4, -0.3, 0.5, 1.0, -1.0, 2.0])
        crossings = np.zeros(6)
        for _ in range(4000):
            before = np.sign(plant.velocity)
            crossings += before * np.sign(steps(plant, 1).velocity) < 0.0
        np.testing.assert_array_equal(plant.velocity, 0.0)
        assert crossings.max() <= 1  # no chatter about zero
        at_rest = plant.position.copy()
        np.testing.assert_array_equal(steps(plant, 100).position, at_rest)

    def test_closed_brakes_stop_and_hold_the_arm(self) -> None:
        plant = rigid_plant(brake_torque=2000.0)
        plant.set_state(START, np.full(6, 2.0))
        plant.close_brakes(True)
        np.testing.assert_array_equal(steps(plant, 1000, np.zeros(6)).velocity, 0.0)
        plant.close_brakes(False)
        assert steps(plant, 20, np.zeros(6)).velocity.any()


def test_a_state_that_is_not_finite_is_an_error() -> None:
    with pytest.raises(PlantDiverged):
        steps(rigid_plant(), 10, np.full(6, np.nan))


def test_the_inertia_scale_applies_to_mass_moment_and_tensor() -> None:
    scale = np.array([1.2, 0.8, 1.1, 0.9, 1.15, 0.85])
    truths = TRUTH, replace(TRUTH, inertia_scale=scale)
    unscaled, scaled = (
        [body.toDynamicParameters() for body in list(rigid_plant(t).model.inertias)[1:]]
        for t in truths
    )
    np.testing.assert_allclose(scaled, scale[:, None] * unscaled, rtol=1e-12, atol=1e-14)


def test_the_cell_file_has_the_default_sizes_of_effects() -> None:
    for name, size in vars(UnmodelledEffects.default_sizes(6)).items():
        np.testing.assert_array_equal(CELL["simulation"][name], size, err_msg=name)


def test_ripple_has_two_periods_per_motor_turn() -> None:
    ripple = SimulatedRipple(np.array([5.0, 2.0]), np.random.default_rng(1))
    turns = np.linspace(0.0, 1.0, 401)
    torque = np.array([ripple.torque([t, t]) for t in turns])
    np.testing.assert_allclose(np.abs(torque).max(axis=0), [5.0, 2.0], rtol=1e-3)
    np.testing.assert_allclose(torque[:201], torque[200:], atol=1e-9)
    np.testing.assert_allclose(torque[:-1].mean(axis=0), 0.0, atol=1e-9)


def test_friction_falls_from_cold_to_hot_by_the_stated_share() -> None:
    drift = SimulatedDrift(0.08, 2)
    cold = drift.scale(np.zeros(2), 0.001)
    np.testing.assert_allclose(cold, 1.04, rtol=1e-6)
    previous = cold
    for _ in range(3000):  # half an hour; one joint races, the other rests
        factor = drift.scale(np.array([1e6, 0.0]), 6.0)
        assert factor[0] <= previous[0]
        previous = factor
    np.testing.assert_allclose(factor, [0.96, 1.04], rtol=1e-4)


SOFT = (1.0e-6, 1.0e-6, 2.5e-6, 0.0, 0.0, 0.0)


def elastic(
    truth: PlantTruth = TRUTH, compliance: tuple[float, ...] = SOFT, **options
) -> ElasticPlant:
    return ElasticPlant(
        ns16.urdf_text(), truth, elasticity=compliance, step=STEP, position=START, **options
    )


class TestElasticGears:
    def test_springs_carry_gravity_from_the_start(self) -> None:
        plant = elastic()
        gravity = pin.computeGeneralizedGravity(plant.model, plant.model.createData(), START)
        np.testing.assert_allclose(plant.motor_position - START, gravity * SOFT, atol=1e-15)
        np.testing.assert_allclose(steps(plant, 200, gravity).position, START, atol=1e-9)

    def test_a_stiff_gear_is_a_rigid_one(self) -> None:
        stiff = elastic(compliance=(5e-8, 5e-8, 0.0, 0.0, 0.0, 0.0))
        rigid = rigid_plant()
        for k in range(1000):
            torque = np.array([900.0, -300.0, 0.0, 5.0, 15.0, 8.0]) * np.sin(0.01 * k)
            steps(stiff, 1, torque)
            steps(rigid, 1, torque)
        assert np.abs(rigid.velocity).max() > 0.3
        np.testing.assert_allclose(stiff.velocity, rigid.velocity, atol=2e-2)
        np.testing.assert_allclose(stiff.position, rigid.position, atol=2e-3)

    def test_damped_springs_lose_energy_and_never_gain_it(self) -> None:
        plant = elastic(FRICTIONLESS)
        start = plant.energy()
        energies = [steps(plant, 1, np.zeros(6)).energy() for _ in range(2000)]
        assert plant.velocity @ plant.velocity > 1.0  # it did swing
        assert max(energies) < start + 0.01  # J; of some hundred in motion
        assert start - 20.0 < energies[-1] < start

    def test_a_struck_link_rings_at_the_frequency_of_its_spring(self) -> None:
        """Motor held by its brake, link free: an oscillator with the link's own inertia."""
        plant = elastic(compliance=(1e-6, 0.0, 0.0, 0.0, 0.0, 0.0), brake_torque=1e5)
        plant.close_brakes(True)
        plant.set_state(START, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
        swing = [steps(plant, 1, np.zeros(6)).position[0] - START[0] for _ in range(1000)]
        inertia = pin.crba(plant.model, plant.model.createData(), START)[0, 0]
        crossings = np.nonzero(np.diff(np.sign(swing)) != 0)[0]
        period = 2.0 * np.mean(np.diff(crossings)) * STEP
        assert 2.0 * np.pi / period == pytest.approx(np.sqrt(1e6 / inertia), rel=0.02)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), push=st.floats(0.01, 100.0))
def test_friction_holds_what_it_can_and_opposes_what_slides(seed: int, n: int, push: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    inverse = root @ root.T + 0.1 * np.eye(n)
    coulomb = rng.uniform(0.0, 50.0, n) * rng.integers(0, 2, n)
    free = STEP * push * rng.normal(size=n)
    guess = rng.uniform(-60.0, 60.0, n)
    result = resolve_dry_friction(free.tolist(), inverse, coulomb.tolist(), STEP, guess.tolist())
    velocity = np.array(result.velocity)
    torque = np.array(result.torque)

    slack = 10.0 * FRICTION_TOLERANCE * (coulomb.max() + 1.0)
    assert np.all(np.abs(torque) <= coulomb)
    sliding = velocity != 0.0
    np.testing.assert_allclose(torque[sliding], (coulomb * np.sign(velocity))[sliding], atol=slack)
    # momentum: what friction did not take away is still there
    balance = free - STEP * inverse @ torque - velocity
    np.testing.assert_allclose(balance, 0.0, atol=STEP * np.abs(inverse).sum() * slack)


def test_a_joint_slides_on_when_coulomb_torque_grows_a_little() -> None:
    """A guess just short of the bound must not pass for a torque that holds."""
    result = resolve_dry_friction([1.0], np.eye(1), [10.0 * (1.0 + 1e-9)], STEP, [10.0])
    assert result.velocity[0] > 0.9


POSTURE = [0.2, -1.2, 2.5, 0.3, 1.0, 0.2]


def nominal(*error: float) -> NominalModel:
    rng = np.random.default_rng(3)
    return NominalModel(ns16.urdf_text(), TRUTH, gravity=(0.0, 0.0, -9.81), error=error, rng=rng)


@pytest.fixture
def servo() -> Servo:
    settings = ServoSettings()
    model = nominal(*settings.model_error)
    servo = Servo(DRIVE, model, settings, period=0.001, current_resolution=0.0)
    servo.start_at(DRIVE.motor_revolutions(POSTURE))
    return servo


def test_current_at_rest_is_limited_and_without_wind_up(servo: Servo) -> None:
    assert servo.advance(servo.target, [0.0] * 6) == servo.model_current
    assert servo.model_current[1] != 0.0  # gravity
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
    model = nominal(0.05, 0.10)
    exact = nominal(0.0, 0.0)
    off = np.abs(model.rotor_inertia / TRUTH.rotor_inertia - 1.0)
    assert np.all((off >= 0.05) & (off <= 0.10))
    q = np.array(POSTURE)
    qd = np.ones(6)
    qdd = np.full(6, 2.0)
    true = exact.torque(q, qd, qdd)
    assert 0.01 < np.abs(model.torque(q, qd, qdd) - true).max() / np.abs(true).max() < 0.5
    rigid = pin.buildModelFromXML(ns16.urdf_text())
    torque = pin.rnea(rigid, rigid.createData(), q, qd, qdd) + TRUTH.rotor_inertia * qdd
    np.testing.assert_allclose(true, torque + TRUTH.friction(qd), rtol=1e-12)
    inertia = np.diag(pin.crba(rigid, rigid.createData(), q)) + TRUTH.rotor_inertia
    np.testing.assert_allclose(exact.diagonal_inertia(q), inertia, rtol=1e-12)


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_the_current_follows_with_the_stated_lag(substeps: int) -> None:
    """Area above a step response is the time constant."""
    lag = 0.0007
    period = 0.001
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


@given(q=angles, currents=numbers)
def test_drive_follows_its_formulas_and_their_inverse(
    q: list[float], currents: list[float]
) -> None:
    controller = np.array(q) * DRIVE.joint_sign + DRIVE.joint_offset
    expected = motor_matrix(DRIVE) @ controller + DRIVE.calibration
    np.testing.assert_allclose(DRIVE.motor_revolutions(q), expected, rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(DRIVE.joint_angles(DRIVE.motor_revolutions(q)), q, atol=1e-12)
    np.testing.assert_allclose(DRIVE.joint_speeds(DRIVE.motor_speeds(q)), q, atol=1e-12)
    # power at the motors is power at the joints
    motor_torque = np.array(currents) * DRIVE.torque_constant
    motor_speed = 2.0 * pi * np.array(DRIVE.motor_speeds(q))
    joint_power = np.dot(DRIVE.joint_torques(currents), q)
    assert joint_power == pytest.approx(motor_torque @ motor_speed, rel=1e-10, abs=1e-6)
    torques = DRIVE.joint_torques(DRIVE.currents(currents))
    np.testing.assert_allclose(torques, currents, rtol=1e-12, atol=1e-10)


def test_encoders_read_whole_counts() -> None:
    positions = [0.1, -2.34567, 57.0000001, 3.0, -0.00001, 12.5]
    read = np.array(DRIVE.encoder(positions, [0.0] * 6))
    counts = read * DRIVE.encoder_counts
    np.testing.assert_array_equal(counts, np.round(counts))
    assert np.abs(read - positions).max() <= 0.5 / DRIVE.encoder_counts
    shifted = np.array(DRIVE.encoder(positions, [2.0] * 6))
    np.testing.assert_allclose((shifted - read) * DRIVE.encoder_counts, 2.0, atol=1e-6)


SIMPLE = frictionless(np.ones(6))
NO_ROTORS = frictionless(np.zeros(6))
NO_WRIST = ((1.0, 1.0),) * 7


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Plant(ns16.urdf_text(), frictionless((1.0, 1.0))), "6 degrees of"),
        (lambda: replace(SIMPLE, coulomb=-np.ones(6)), "coulomb"),
        (lambda: elastic(NO_ROTORS, (1e-6,) * 6), "rotor_inertia"),
        (lambda: elastic(SIMPLE, (0.0, 0.0, 0.0, 0.0, 0.0, 1e-8)), "resonances below"),
        (lambda: SimulatedDrive(*NO_WRIST, 4096, k54=0.1), "below six"),
    ],
)
def test_impossible_values_are_refused_by_name(make, text) -> None:
    with pytest.raises(SettingError, match=text):
        make()
