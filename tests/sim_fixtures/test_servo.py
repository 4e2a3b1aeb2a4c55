"""The servo's loops and the current that flows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sim_fixtures import PlantTruth, ServoSettings, SettingError, SimulatedDrive, ns16
from sim_fixtures.servo import INERTIA_CYCLES, CurrentLoop, NominalModel, Servo

GRAVITY = (0.0, 0.0, -9.81)
POSTURE = [0.2, -1.2, 2.5, 0.3, 1.0, 0.2]


@pytest.fixture
def make_servo(drive: SimulatedDrive, truth: PlantTruth) -> Callable[..., Servo]:
    def make(resolution: float = 0.0, **gains: Any) -> Servo:
        settings = ServoSettings(**gains)
        model = NominalModel(
            ns16.urdf_text(), truth, gravity=GRAVITY, error=settings.model_error,
            rng=np.random.default_rng(2),
        )  # fmt: skip
        servo = Servo(drive, model, settings, period=0.001, current_resolution=resolution)
        servo.start_at(drive.motor_revolutions(POSTURE))
        return servo

    return make


def hold(servo: Servo) -> list[float]:
    return servo.advance(servo.target, [0.0] * 6)


def test_a_servo_at_rest_asks_for_the_model_current_alone(make_servo: Callable[..., Servo]) -> None:
    servo = make_servo()
    assert hold(servo) == servo.model_current
    assert servo.model_current[1] != 0.0  # gravity


def test_an_error_of_position_calls_for_current_that_reduces_it(
    make_servo: Callable[..., Servo],
) -> None:
    servo = make_servo()
    target = [p + 0.01 for p in servo.measured]
    servo.advance(target, [0.0] * 6)
    current = np.array(servo.advance(target, [0.0] * 6))
    assert np.all(current > servo.model_current)  # positive current turns a motor forward


def test_the_integral_takes_over_what_stays(make_servo: Callable[..., Servo]) -> None:
    servo = make_servo()
    target = [p + 0.01 for p in servo.measured]
    first, *_, last = [servo.advance(target, [0.0] * 6) for _ in range(50)]
    assert np.all(np.array(last) > np.array(first))


def test_within_the_deadband_nothing_is_integrated(
    make_servo: Callable[..., Servo], drive: SimulatedDrive
) -> None:
    servo = make_servo()
    target = [p + 2.0 / drive.encoder_counts for p in servo.measured]
    currents = [servo.advance(target, [0.0] * 6) for _ in range(50)]
    settled = currents[INERTIA_CYCLES + 1]  # the gains are those of the new posture by then
    np.testing.assert_allclose(currents[-1], settled, rtol=1e-12)


def test_current_stays_within_its_limit_and_does_not_wind_up(
    make_servo: Callable[..., Servo], drive: SimulatedDrive
) -> None:
    servo = make_servo()
    home = list(servo.measured)
    far = [p + 20.0 for p in home]
    for _ in range(500):
        current = servo.advance(far, [0.0] * 6)
        assert np.all(np.abs(current) <= drive.current_limit)
    assert current == list(drive.current_limit)
    servo.advance(home, [0.0] * 6)
    back = np.array(servo.advance(home, [0.0] * 6))
    assert np.all(back < 0.5 * np.array(drive.current_limit))


def test_target_currents_come_in_steps(make_servo: Callable[..., Servo]) -> None:
    servo = make_servo(resolution=0.005)
    steps = np.array(hold(servo)) / 0.005
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_the_model_is_wrong_by_five_to_ten_per_cent(
    drive: SimulatedDrive, truth: PlantTruth
) -> None:
    model = NominalModel(
        ns16.urdf_text(), truth, gravity=GRAVITY, error=(0.05, 0.10), rng=np.random.default_rng(3)
    )
    off = np.abs(model.rotor_inertia / truth.rotor_inertia - 1.0)
    assert np.all((off >= 0.05) & (off <= 0.10))
    exact = NominalModel(
        ns16.urdf_text(), truth, gravity=GRAVITY, error=(0.0, 0.0), rng=np.random.default_rng(3)
    )
    q, qd, qdd = np.array(POSTURE), np.ones(6), np.full(6, 2.0)
    truly = exact.torque(q, qd, qdd)
    error = np.abs(model.torque(q, qd, qdd) - truly).max() / np.abs(truly).max()
    assert 0.01 < error < 0.5


def test_without_errors_the_model_is_the_plants(truth: PlantTruth) -> None:
    import pinocchio as pin

    exact = NominalModel(
        ns16.urdf_text(), truth, gravity=GRAVITY, error=(0.0, 0.0), rng=np.random.default_rng(3)
    )
    plain = pin.buildModelFromXML(ns16.urdf_text())
    q, qd, qdd = np.array(POSTURE), np.ones(6), np.full(6, 2.0)
    rigid = pin.rnea(plain, plain.createData(), q, qd, qdd) + truth.rotor_inertia * qdd
    np.testing.assert_allclose(exact.torque(q, qd, qdd), rigid + truth.friction(qd), rtol=1e-12)
    inertia = np.diag(pin.crba(plain, plain.createData(), q)) + truth.rotor_inertia
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


@pytest.mark.parametrize(
    "gains",
    [{"position_gain": 0.0}, {"current_lag": -1.0}, {"model_error": (0.2, 0.1)}],
)
def test_impossible_gains_are_refused(gains: dict[str, Any]) -> None:
    with pytest.raises(SettingError):
        ServoSettings(**gains)
