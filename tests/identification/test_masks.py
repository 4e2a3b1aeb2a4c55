from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.masks import (
    END_PERIODS,
    LONGEST_END,
    REVERSAL,
    SATURATED,
    STANDSTILL,
    TORN,
    flat_topped,
    mask_rows,
)
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare

Array = NDArray[np.float64]
URDF = (Path(__file__).parent / "two_link.urdf").read_text()
TIME = np.arange(4000) * 1e-3
EVERYWHERE = np.ones((1, 1), dtype=np.bool_)


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(standstill=0.05))


def motion_and_recording(model: RobotModel, clip: float = np.inf) -> tuple[Motion, Recording]:
    angle = np.array([2.0, 3.1]) * TIME[:, None] + 0.4
    rate = np.array([2.0, 3.1])
    motion = Motion(TIME, np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle))
    rng = np.random.default_rng(2)
    torque = 20.0 * np.sin(angle * 1.7) + 0.2 * rng.standard_normal(angle.shape)
    return motion, Recording(
        time=TIME,
        position=motion.position + 1e-6 * rng.standard_normal(angle.shape),
        joint_names=model.joint_names,
        torque=np.clip(torque, -clip, clip),
    )


def test_a_clipped_torque_is_found_where_it_was_clipped(model: RobotModel) -> None:
    _, whole = motion_and_recording(model)
    _, clipped = motion_and_recording(model, clip=15.0)
    assert whole.torque is not None
    assert clipped.torque is not None
    true = np.abs(whole.torque) > 15.0
    found = flat_topped(clipped.torque, EVERYWHERE)
    assert not np.any(found & ~true)
    # Noise lets the torque out of the limit for a sample now and then; short runs are let pass.
    assert np.count_nonzero(found) > 0.9 * np.count_nonzero(true)
    assert not flat_topped(whole.torque, EVERYWHERE).any()


@given(
    resolution=st.sampled_from([1.0, 0.1, 0.01]),
    rate=st.floats(0.5, 20.0),
    phase=st.floats(0.0, 6.0),
)
def test_a_smooth_peak_read_with_a_coarse_resolution_is_not_clipped(
    resolution: float, rate: float, phase: float
) -> None:
    smooth = np.round(20.0 * np.sin(rate * TIME + phase) / resolution) * resolution
    assert not flat_topped(smooth[:, None], EVERYWHERE).any()


def test_a_channel_that_stays_the_same_at_rest_is_not_clipped() -> None:
    channel = np.concatenate([np.full(500, 12.0), 12.0 * np.cos(TIME[:2000] * 4.0)])[:, None]
    moving = np.arange(len(channel))[:, None] > 500
    assert not flat_topped(channel, moving).any()
    assert not flat_topped(np.full((100, 1), 3.0), EVERYWHERE).any()


def test_every_row_left_out_has_a_reason_and_counts_add_up(model: RobotModel) -> None:
    motion, recording = motion_and_recording(model, clip=15.0)
    mask = mask_rows(recording, model, motion, np.full(2, 40.0))
    reasons = np.any(list(mask.reasons.values()), axis=0)
    np.testing.assert_array_equal(mask.usable, ~reasons)
    lost = np.sum(list(mask.counts.values()), axis=0)
    np.testing.assert_array_equal(lost + mask.usable.sum(axis=0), len(TIME))
    for reason in (TORN, STANDSTILL, REVERSAL, SATURATED):
        assert np.all(mask.counts[reason] > 0)


@pytest.mark.parametrize("friction", [True, False])
def test_rows_beside_a_reversal_of_a_coupled_motor_are_left_out(friction: bool) -> None:
    turns = np.array([[1.0, 0.0], [-0.8, 1.0]])
    model = RobotModel.from_urdf(
        URDF,
        friction=FrictionLaw(standstill=0.05),
        coupling=Coupling(turns, friction=friction),
    )
    motion, recording = motion_and_recording(model)
    reversals = mask_rows(recording, model, motion, np.array([40.0, 20.0])).reasons[REVERSAL]
    motor = motion.velocity @ turns[1]
    assert model.friction.motors == ((1,) if friction else ())

    def beside(speed: Array, reach: float) -> NDArray[np.bool_]:
        at = TIME[:-1][speed[1:] * speed[:-1] < 0.0]
        assert len(at)
        return np.asarray(np.abs(TIME[:, None] - at).min(axis=1) <= reach)

    # As far as the slower of its joints is smoothed; the joints' own reversals as ever.
    for joint, reach in enumerate((1.0 / 40.0, 1.0 / 20.0)):
        own = beside(motion.velocity[:, joint], reach)
        expected = own | beside(motor, 1.0 / 20.0) if friction else own
        apart = np.flatnonzero(expected != reversals[:, joint])
        # But for the sample at the edge.
        assert len(apart) <= 2 * np.count_nonzero(np.diff(expected))
        assert np.count_nonzero(expected) > 10 * len(apart)
        assert (np.count_nonzero(expected & ~own) > 50) == friction


@pytest.mark.parametrize("delay", [-0.08, 0.0, 0.08])
def test_a_row_read_earlier_is_torn_where_it_is_read(model: RobotModel, delay: float) -> None:
    """Its motion comes from `delay` before; there has to be some, and not at an end."""
    _, recording = motion_and_recording(model)
    samples = prepare(recording, model, options=Preprocessing(torque_delay=delay))
    assert samples.mask is not None
    end = min(LONGEST_END, END_PERIODS / float(samples.position_bandwidth.min()))
    read = recording.time - delay
    inside = (read >= recording.time[0] + end) & (read <= recording.time[-1] - end)
    np.testing.assert_array_equal(samples.mask.reasons[TORN][:, 0], ~inside)
    assert not samples.usable[~inside].any()


def test_ends_of_a_low_passed_torque_are_torn_as_far_as_the_low_pass_reaches(
    model: RobotModel,
) -> None:
    _, recording = motion_and_recording(model)
    samples = prepare(recording, model, options=Preprocessing(torque_bandwidth=10.0))
    beside = recording.time < recording.time[0] + END_PERIODS / 10.0
    assert not samples.usable[beside].any()
    assert samples.usable[recording.time > recording.time[0] + LONGEST_END][:100].any()


def test_rows_beside_a_gap_and_short_stretches_are_torn(model: RobotModel) -> None:
    motion, recording = motion_and_recording(model)
    gap = np.zeros(len(TIME), dtype=np.bool_)
    gap[[2000, 2040]] = True
    torn = Recording(
        time=TIME, position=recording.position, joint_names=model.joint_names, gap_before=gap
    )
    rows = mask_rows(torn, model, motion, np.full(2, 40.0)).reasons[TORN][:, 0]
    assert rows[1950:2090].all()
    assert not rows[100:1940].any()
    assert not rows[2100:3900].any()


def test_the_limit_of_the_current_counts(model: RobotModel) -> None:
    motion, recording = motion_and_recording(model)
    driven = replace(recording, motor_current=recording.torque, torque=None)
    limit = np.array([18.0, 100.0])
    mask = mask_rows(driven, model, motion, np.full(2, 40.0), current_limit=limit)
    assert driven.motor_current is not None
    saturated = mask.reasons[SATURATED]
    np.testing.assert_array_equal(saturated[:, 0], np.abs(driven.motor_current[:, 0]) >= 17.91)
    assert not saturated[:, 1].any()
