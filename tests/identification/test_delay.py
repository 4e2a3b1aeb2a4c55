from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.delay import DelayEstimate, estimate_delays
from identification.delay_compensation import compensate
from identification.errors import IdentificationError, ShapeError
from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.preprocessing import Preprocessing
from identification.recording import Recording
from identification.smoothing_spline import low_pass
from tests.identification.simulated_ns16 import ns16_model, simulated_recording
from tests.identification.ur10_bag import ur10

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
STEP = 1e-3
PLANTED = np.array([0.37, -1.3])  # cycles


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))


@pytest.fixture(scope="module")
def truth(model: RobotModel) -> Array:
    standard = model.nominal.copy()
    standard[[10, 21]] = 0.4, 0.1  # rotors
    return np.concatenate([model.base.grouping @ standard, [4.0, 2.0, 1.5, 0.8]])


def motion(time: Array, speed: float = 1.0) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(12)
    a, w, phase = rng.uniform([[[0.2]], [[2.0]], [[0.0]]], [[[0.5]], [[9.0]], [[6.0]]], (3, 4, 2))
    w = w * speed
    angle = w * time[:, None, None] + phase
    return (
        (a * np.sin(angle)).sum(axis=1),
        (a * w * np.cos(angle)).sum(axis=1),
        (-a * w**2 * np.sin(angle)).sum(axis=1),
    )


def a_recording(
    model: RobotModel,
    truth: Array,
    delays: Array,  # s
    *,
    seed: int = 0,
    speed: float = 1.0,
    torque_noise: float = 1.0,
    position_noise: float = 2e-5,
    time: Array | None = None,
) -> Recording:
    if time is None:
        time = np.arange(6000) * STEP
    rng = np.random.default_rng(seed)
    torque = np.column_stack(
        [model.torque(truth, *motion(time - delays[j], speed))[:, j] for j in range(2)]
    )
    shape = torque.shape
    return Recording(
        time=time,
        position=motion(time, speed)[0] + position_noise * rng.standard_normal(shape),
        joint_names=model.joint_names,
        torque=torque + torque_noise * np.array([1.0, 0.2]) * rng.standard_normal(shape),
    )


def test_without_noise_each_axis_has_its_own_delay_to_a_fiftieth_of_a_cycle(
    model: RobotModel, truth: Array
) -> None:
    recording = a_recording(model, truth, PLANTED * STEP, torque_noise=0.0, position_noise=1e-8)
    assert estimate_delays(recording, model).cycles == pytest.approx(PLANTED, abs=0.02)


@pytest.fixture(scope="module")
def repeated(model: RobotModel, truth: Array) -> list[DelayEstimate]:
    return [
        estimate_delays(a_recording(model, truth, PLANTED * STEP, seed=seed), model)
        for seed in range(16)
    ]


def test_noise_on_torque_and_position_does_not_bias_the_delay(
    repeated: list[DelayEstimate],
) -> None:
    cycles = np.array([one.cycles for one in repeated])
    mean, scatter = cycles.mean(axis=0), cycles.std(axis=0, ddof=1)
    assert np.all(np.abs(mean - PLANTED) < 0.1)
    assert np.all(np.abs(mean - PLANTED) < 3.0 * scatter / np.sqrt(len(repeated)) + 0.02)


def test_the_standard_error_is_the_scatter_over_seeds(repeated: list[DelayEstimate]) -> None:
    scatter = np.std([one.delays for one in repeated], axis=0, ddof=1)
    claimed = np.sqrt(np.mean([one.std**2 for one in repeated], axis=0))
    # A standard deviation from 16 draws is itself known to 18 %.
    assert np.all(np.abs(np.log(claimed / scatter)) < 3 * 0.18)


@pytest.mark.parametrize("planted", [[-0.031, -0.0297], [0.04, 0.0421], [-0.045, 0.045]])
def test_a_delay_of_many_cycles_is_found_from_anywhere(
    model: RobotModel, truth: Array, planted: list[float]
) -> None:
    recording = a_recording(model, truth, np.array(planted))
    found = estimate_delays(recording, model)
    assert found.delays == pytest.approx(planted, abs=0.3e-3)
    assert not found.agree


def test_a_wrist_whose_friction_outweighs_its_inertia_may_have_two_delays() -> None:
    """Viscous friction a little later is viscous friction and less inertia: both fit."""
    arm = ns16_model()
    time = np.arange(0.0, 20.0, 0.004)
    rng = np.random.default_rng(100)
    sines = np.array([
        (rng.uniform(0.1, 1.2), rng.standard_normal(), rng.uniform(0.0, 2.0 * np.pi))
        for _ in range(30)
    ]).reshape(6, 5, 3)  # fmt: skip
    hertz, size, phase = sines.transpose(2, 1, 0)
    rate, size = 2.0 * np.pi * hertz, 0.35 * size / (1.0 + hertz)

    def moved(at: Array) -> tuple[Array, Array, Array]:
        angle = rate * at[:, None, None] + phase
        return (
            (size * np.sin(angle)).sum(axis=1),
            (size * rate * np.cos(angle)).sum(axis=1),
            (-size * rate**2 * np.sin(angle)).sum(axis=1),
        )

    values = np.zeros(arm.n_parameters)
    standard = arm.nominal.copy()
    standard[10::11] = 5.0, 5.0, 3.0, 0.2, 0.2, 0.1  # rotors
    values[: arm.base.rank] = arm.base.grouping @ standard
    for symbol, own in (("f0", (68, 108, 50, 9, 9, 5)), ("f1", (41, 63, 39, 3, 16, 9))):
        for joint, value in enumerate(own):
            values[arm.parameter_names.index(f"{symbol}_{joint + 1}")] = value
    planted = np.array([0.3, -0.7, 1.6, 2.4, 0.0, 5.2]) * 0.004
    noise = np.array([3.0, 3.0, 1.0, 0.1, 0.1, 0.1])
    for seed in range(3):
        draw = np.random.default_rng(seed)
        torque = np.column_stack(
            [arm.torque(values, *moved(time - late))[:, j] for j, late in enumerate(planted)]
        )
        recording = Recording(
            time=time,
            position=moved(time)[0] + 2e-6 * draw.standard_normal(torque.shape),
            joint_names=arm.joint_names,
            torque=torque + noise * draw.standard_normal(torque.shape),
        )
        found = estimate_delays(recording, arm, noise_variance=np.full(6, 4e-12))
        known = found.determined
        np.testing.assert_allclose(found.cycles[known], planted[known] / 0.004, atol=0.2)
        assert known.sum() >= 4
        assert not known[5]
        assert "explains its torque as well" in str(found.reasons[5])


def test_uneven_time_does_not_matter(model: RobotModel, truth: Array) -> None:
    rng = np.random.default_rng(5)
    time = np.cumsum(STEP * rng.uniform(0.4, 1.6, 6000))
    recording = a_recording(model, truth, PLANTED * STEP, time=time, torque_noise=0.3)
    assert estimate_delays(recording, model).delays == pytest.approx(PLANTED * STEP, abs=1e-4)


def test_the_delay_of_a_torque_that_was_filtered_before_it_was_logged(
    model: RobotModel, truth: Array
) -> None:

    time = np.arange(0.0, 8.0, 0.004)
    recording = a_recording(model, truth, np.full(2, 0.003), time=time, torque_noise=0.3)
    assert recording.torque is not None
    filtered = replace(recording, torque=low_pass(time, recording.torque, 8.0))
    found = estimate_delays(filtered, model, options=Preprocessing(torque_bandwidth=8.0))
    assert found.delays == pytest.approx([0.003, 0.003], abs=4e-4)


def test_a_slow_motion_does_not_determine_a_delay_and_it_says_why(
    model: RobotModel, truth: Array
) -> None:
    found = estimate_delays(a_recording(model, truth, np.zeros(2), speed=0.05), model)
    assert not found.determined.any()
    assert np.isnan(found.delays).all()
    assert np.isinf(found.std).all()
    np.testing.assert_array_equal(found.applied, 0.0)
    for line, name in zip(found.describe(), model.joint_names, strict=True):
        assert line.startswith(f"{name}: not determined; ")
        assert "cycles" in line or "longest" in line


def test_an_axis_that_stands_takes_the_delay_of_the_others(model: RobotModel, truth: Array) -> None:
    time = np.arange(6000) * STEP
    keep = np.array([1.0, 0.0])
    q = motion(time)[0] * keep
    late = [part * keep for part in motion(time - 0.0007)]
    rng = np.random.default_rng(1)
    recording = Recording(
        time=time,
        position=q + 1e-6 * rng.standard_normal(q.shape),
        joint_names=model.joint_names,
        torque=model.torque(truth, *late) + 0.1 * rng.standard_normal(q.shape),
    )
    found = estimate_delays(recording, model)
    assert found.reasons == (None, "the axis does not move")
    assert found.applied == pytest.approx([7e-4, 7e-4], abs=1e-4)


def test_compensated_currents_belong_to_their_positions(model: RobotModel, truth: Array) -> None:
    delays = PLANTED * STEP
    late = a_recording(model, truth, delays, torque_noise=0.0, position_noise=0.0)
    time = late.time
    gap = np.zeros(len(time), dtype=np.bool_)
    gap[2500] = True
    torn = replace(late, gap_before=gap)
    there = compensate(torn, delays)
    assert there.torque is not None
    exact = model.torque(truth, *motion(there.time))
    velocity = motion(there.time)[1]
    clear = np.abs(velocity) > 0.1  # Coulomb friction jumps between samples
    assert np.abs(there.torque - exact)[clear].max() < 2e-3
    assert len(there.segments()) == 2
    # nothing was read across the gap: the samples beside it that would need it are gone
    assert there.n_samples == torn.n_samples - 2 * 3


def test_compensating_by_nothing_changes_nothing(model: RobotModel, truth: Array) -> None:
    recording = a_recording(model, truth, np.zeros(2))
    same = compensate(recording, [0.0, 0.0])
    assert recording.torque is not None
    np.testing.assert_array_equal(same.torque, recording.torque)
    np.testing.assert_array_equal(same.time, recording.time)


def test_what_cannot_be_compensated_is_refused(model: RobotModel, truth: Array) -> None:
    recording = a_recording(model, truth, np.zeros(2))
    with pytest.raises(ShapeError, match="delays"):
        compensate(recording, [0.1])
    with pytest.raises(IdentificationError, match="shorter than the delay"):
        compensate(recording, [100.0, 0.0])


def test_the_delay_of_the_simulated_cell_is_recovered_within_a_tenth_of_a_cycle() -> None:
    """Encoder noise goes round the servo loop here, so torque and position noise correlate."""
    model = ns16_model()
    found, planted = [], 0.0
    for seed in (3, 4):
        recording, planted = simulated_recording(8.0, seed=seed)
        found.append(estimate_delays(recording, model))
    for one in found:
        known = one.determined
        assert known.sum() >= 4
        assert one.common / one.cycle == pytest.approx(planted, abs=0.1)
        apart = np.abs(one.cycles[known] - planted)
        assert np.all(apart < 0.1 + 2.0 * one.std[known] / one.cycle)


@pytest.mark.slow
def test_the_smoothed_torque_of_a_real_ur10_does_not_tell_its_delay(shared_data: Path) -> None:
    """Its effort has come through a low-pass of 2 Hz; a number here would be an invention."""
    model, recording = ur10(shared_data)
    found = estimate_delays(recording, model)
    assert not found.determined.any()
    np.testing.assert_array_equal(found.applied, 0.0)


def test_axes_of_one_controller_agree_on_one_delay(model: RobotModel, truth: Array) -> None:
    found = [
        estimate_delays(a_recording(model, truth, np.full(2, 1.6e-3), seed=seed), model)
        for seed in range(4)
    ]
    assert all(one.agree for one in found)
    assert np.mean([one.common for one in found]) == pytest.approx(1.6e-3, abs=5e-5)
    assert all(one.common_std <= one.std.min() for one in found)
