from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers import DriveTrain, DriveTrainError

pytestmark = pytest.mark.safety

TURN = 2.0 * np.pi
FIELDS = {
    "gear_ratio": [-120.0, 150.0, -110.0, 90.0, 80.0, -60.0],
    "calibration": [0.5, -1.25, 2.0, 0.0, 0.25, -0.75],
    "joint_sign": [-1.0, 1.0, -1.0, -1.0, 1.0, -1.0],
    "joint_offset": [0.0, 0.1, -np.pi / 2, 0.0, np.pi / 2, -0.3],
    "torque_constant": [0.4, 0.5, 0.45, 0.2, 0.21, 0.15],
    "current_limit": [20.0, 20.0, 16.0, 8.0, 8.0, 6.0],
}
COUPLING = {"k54": 0.01, "k64": 0.002, "k65": 0.03}


def build(**changes) -> DriveTrain:
    fields = {name: np.array(value) for name, value in FIELDS.items()}
    return DriveTrain(**{**fields, **COUPLING, **changes})


def vectors(limit):
    return arrays(np.float64, 6, elements=st.floats(-limit, limit))


@st.composite
def drive_trains(draw):
    ratio = draw(arrays(np.float64, 6, elements=st.floats(5.0, 300.0)))
    sign = st.sampled_from([-1.0, 1.0])
    k = [draw(st.floats(-0.5, 0.5)) for _ in range(3)]
    return build(
        gear_ratio=ratio * draw(arrays(np.float64, 6, elements=sign)),
        joint_sign=draw(arrays(np.float64, 6, elements=sign)),
        calibration=draw(vectors(100.0)),
        joint_offset=draw(vectors(3.2)),
        torque_constant=draw(arrays(np.float64, 6, elements=st.floats(0.05, 2.0))),
        k54=k[0],
        k64=k[1],
        k65=k[2],
    )


def by_the_published_formulas(train: DriveTrain, q):
    """Motor revolutions axis by axis, as the wire's description prints them."""
    kr = train.gear_ratio
    cal = train.calibration
    a = train.joint_sign * q + train.joint_offset
    p = kr * a / TURN + cal
    p[4] = kr[4] * (a[4] - train.k54 * a[3]) / TURN + cal[4]
    last = a[5] - train.k65 * a[4] + (train.k65 * train.k54 - train.k64) * a[3]
    p[5] = kr[5] * last / TURN + cal[5]
    return p


@given(drive_trains(), vectors(7.0))
def test_motor_revolutions_follow_the_published_formulas(train, q):
    np.testing.assert_allclose(
        train.motor_revolutions(q), by_the_published_formulas(train, q), rtol=1e-12, atol=1e-11
    )


@given(drive_trains(), vectors(10.0), st.sampled_from([0.001, 0.002]))
def test_inverse_conversions(train, x, period):
    per_cycle = train.motor_revolutions_per_cycle(x, period)
    for back in (
        train.joint_position(train.motor_revolutions(x)),
        train.joint_velocity(per_cycle, period),
        train.motor_current(train.joint_torque(x)),
    ):
        np.testing.assert_allclose(back, x, atol=1e-10)


@given(drive_trains(), vectors(3.0), vectors(5.0))
def test_velocity_on_the_wire_is_the_step_of_the_position(train, q, qd):
    period = 0.002
    step = train.motor_revolutions(q) - train.motor_revolutions(q - qd * period)
    np.testing.assert_allclose(train.motor_revolutions_per_cycle(qd, period), step, atol=1e-11)


@given(drive_trains(), vectors(20.0), vectors(5.0))
def test_power_is_the_same_on_both_sides(train, current, qd):
    motor_velocity = train.motor_from_joint @ qd
    electrical = (train.torque_constant * current) @ motor_velocity
    mechanical = train.joint_torque(current) @ qd
    scale = np.abs(train.torque_constant * current) @ np.abs(motor_velocity) + 1.0
    assert abs(electrical - mechanical) <= 1e-12 * scale


def test_many_samples_at_once_equal_one_at_a_time():
    train = build()
    rng = np.random.default_rng(1)
    q = rng.uniform(-2, 2, (7, 6))
    for method in (
        train.motor_revolutions,
        train.joint_position,
        train.joint_torque,
        train.motor_current,
    ):
        np.testing.assert_allclose(method(q), [method(row) for row in q], rtol=1e-13)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gear_ratio", [1.0, 0.0, 1.0, 1.0, 1.0, 1.0]),
        ("calibration", [0.0, 0.0]),
        ("calibration", [0.0, 0.0, np.nan, 0.0, 0.0, 0.0]),
        ("joint_sign", [1.0, 1.0, 0.5, 1.0, 1.0, 1.0]),
        ("torque_constant", [1.0, 1.0, -1.0, 1.0, 1.0, 1.0]),
        ("current_limit", [1.0, 1.0, 0.0, 1.0, 1.0, 1.0]),
    ],
)
def test_invalid_drive_train_names_its_field(field, value):
    with pytest.raises(DriveTrainError) as caught:
        build(**{field: np.array(value)})
    assert caught.value.field == field
    with pytest.raises(DriveTrainError):  # coupling without a wrist
        DriveTrain(*(np.array(FIELDS[name][:5]) for name in FIELDS), k54=0.1)
