"""Each copy of a log has the one fault that it is named after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import degradations
from benchmarks.degradations import DEGRADATIONS, EXPECTED, FITTED_ONLY
from benchmarks.joint_log import JointLog
from tests.benchmarks.two_joint_log import two_joint_log


@pytest.fixture(scope="module")
def log() -> JointLog:
    return two_joint_log(1)


@pytest.fixture(scope="module")
def clean() -> JointLog:
    return two_joint_log(1, noise=0.0)


class TestTable:
    def test_every_fault_has_an_expected_cause(self) -> None:
        assert DEGRADATIONS.keys() == EXPECTED.keys() >= FITTED_ONLY


class TestLogger:
    def test_stamps_jitter_in_order(self, log: JointLog) -> None:
        late = degradations.jittered_stamps(log).time - log.time
        assert late.std() == pytest.approx(0.15 * 0.01, rel=0.1)
        assert np.diff(log.time + late).min() > 0.0

    def test_two_percent_of_the_rows_are_lost(self, log: JointLog) -> None:
        fewer = degradations.lost_rows(log)
        assert fewer.n_rows / log.n_rows == pytest.approx(0.98, abs=0.01)
        assert np.isin(fewer.time, log.time).all()

    def test_a_slower_log_has_the_values_of_its_time(self, clean: JointLog) -> None:
        slow = degradations.resampled(clean)
        assert np.diff(slow.time) == pytest.approx(1.0 / 94.0)
        expected = np.interp(slow.time, clean.time, clean.position[:, 0])
        assert slow.position[:, 0] == pytest.approx(expected)

    def test_positions_have_twelve_bits(self, log: JointLog) -> None:
        coarse = degradations.quantised_positions(log)
        step = np.ptp(log.position, axis=0) / 4096
        assert np.abs(coarse.position - log.position).max(axis=0) == pytest.approx(
            step / 2, rel=0.1
        )
        assert all(len(np.unique(column)) <= 4098 for column in coarse.position.T)

    def test_the_torque_comes_ten_milliseconds_late(self, log: JointLog) -> None:
        late = degradations.delayed_torque(log)
        assert late.torque[1:] == pytest.approx(log.torque[:-1])

    def test_filters_leave_what_is_slow(self, clean: JointLog) -> None:
        quick = np.sin(2.0 * np.pi * 30.0 * clean.time)[:, None]
        noisy = replace(clean, torque=clean.torque + quick, position=clean.position + quick)
        inner = slice(100, -100)
        torque = degradations.filtered_torque(noisy).torque - clean.torque
        position = degradations.filtered_positions(noisy).position - clean.position
        assert np.abs(position[inner]).max() < 0.05
        assert np.abs(torque[inner]).mean() < 0.5  # Coulomb friction is not slow


class TestArm:
    def test_two_neighbouring_torques_are_exchanged(self) -> None:
        log = two_joint_log(1)
        three = replace(log, torque=np.column_stack([log.torque, log.torque[:, 0]]))
        mixed = degradations.exchanged_joints(three).torque
        assert np.array_equal(mixed, three.torque[:, [0, 2, 1]])

    def test_one_torque_is_turned(self) -> None:
        log = two_joint_log(1)
        three = replace(log, torque=np.column_stack([log.torque, log.torque[:, 0]]))
        assert np.array_equal(degradations.turned_sign(three).torque, three.torque * [1, 1, -1])

    def test_the_payload_is_there_in_the_second_half_only(self, clean: JointLog) -> None:
        """Its weight, at rest and with the arm stretched out level, on the elbow."""
        still = replace(
            clean, position=np.zeros_like(clean.position), velocity=np.zeros_like(clean.position)
        )
        added = degradations.payload_in_second_half(still).torque - still.torque
        assert not added[:500].any()
        # 0.5 kg straight above the elbow, which is 0.45 m of level way from the shoulder.
        assert added[500:, 1] == pytest.approx(0.0, abs=1e-9)
        assert np.abs(added[500:, 0]) == pytest.approx(0.5 * 9.81 * 0.45)
