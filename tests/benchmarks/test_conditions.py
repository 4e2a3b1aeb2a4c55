"""Conditions of real logs: what each changes, and how a log that is refused is shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import plain_fit
from benchmarks.board import Parts
from benchmarks.conditions import CONDITIONS, errors_of, summary
from benchmarks.joint_log import JointLog
from hil.importers.imported_robot import Robot

URDF = Path(__file__).resolve().parents[2] / "examples" / "two_joints" / "robot.urdf"


@pytest.fixture
def log() -> JointLog:
    """Ten seconds at 100 Hz whose torque has nothing to do with the motion."""
    random = np.random.default_rng(0)
    time = np.arange(1000) / 100.0
    angle = np.array([1.0, 1.7]) * time[:, None]
    return JointLog(
        robot=Robot.from_urdf(URDF),
        time=time,
        position=np.sin(angle),
        velocity=np.array([1.0, 1.7]) * np.cos(angle),
        torque=random.standard_normal((1000, 2)),
        rated_payload=1.0,
    )


def test_a_log_as_recorded_is_unchanged(log: JointLog) -> None:
    assert CONDITIONS["as recorded"](log) is log


def test_without_velocity_positions_and_torques_stay(log: JointLog) -> None:
    changed = CONDITIONS["without velocity"](log)
    assert changed.velocity is None
    assert changed.position is log.position and changed.torque is log.torque


def test_without_masses_the_description_has_none(log: JointLog) -> None:
    assert plain_fit.has_masses(log.pinocchio_model())
    changed = CONDITIONS["without masses"](log)
    assert not plain_fit.has_masses(changed.pinocchio_model())
    assert changed.robot.joint_names == log.robot.joint_names


def test_a_slower_logger_leaves_out_rows(log: JointLog) -> None:
    changed = CONDITIONS["50 Hz"](log)
    assert changed.n_rows == 500 and changed.time[1] == pytest.approx(0.02)
    assert CONDITIONS["100 Hz"](log).n_rows == 1000


def test_torques_have_as_many_steps_as_bits(log: JointLog) -> None:
    torque = CONDITIONS["16 bits of torque"](log).torque
    step = np.ptp(log.torque, axis=0) / 2**16
    np.testing.assert_allclose(torque / step, np.rint(torque / step), atol=1e-6)
    assert 0.0 < np.abs(torque - log.torque).max() <= 0.51 * step.max()


def test_a_text_has_few_decimals(log: JointLog) -> None:
    changed = CONDITIONS["four decimals"](log)
    for before, after in ((log.position, changed.position), (log.torque, changed.torque)):
        np.testing.assert_array_equal(after, np.round(before, 4))
    assert changed.velocity is not None and np.all(changed.velocity == np.round(log.velocity, 4))


def test_currents_differ_by_a_factor_of_each_joint(log: JointLog) -> None:
    ratio = CONDITIONS["currents"](log).torque / log.torque
    np.testing.assert_allclose(ratio, ratio[:1].repeat(len(ratio), axis=0))
    assert ratio[0, 0] != pytest.approx(ratio[0, 1]) and np.all(ratio > 0.0)


def test_negated_torques_change_their_sign(log: JointLog) -> None:
    np.testing.assert_array_equal(CONDITIONS["negated torque"](log).torque, -log.torque)


def test_a_filtered_torque_lags_and_has_no_fast_part(log: JointLog) -> None:
    """By the group delay of two poles at 5 Hz, sqrt(2) / (2 pi 5 Hz); four octaves above, 1/256."""
    time = np.arange(0.0, 10.0, 1e-3)
    wave = np.column_stack([np.sin(2.0 * np.pi * 0.1 * time), np.sin(2.0 * np.pi * 80.0 * time)])
    fast = replace(log, time=time, position=wave, velocity=None, torque=wave)
    changed = CONDITIONS["filtered torque"](fast)
    assert np.median(np.diff(changed.time)) == pytest.approx(1.0 / 125.0)
    later = changed.time > 1.0
    lag = np.sqrt(2.0) / (2.0 * np.pi * 5.0)
    slow = np.sin(2.0 * np.pi * 0.1 * (changed.time - lag))
    np.testing.assert_allclose(changed.torque[later, 0], slow[later], atol=2e-3)
    assert np.abs(changed.torque[later, 1]).max() < 1.0 / 200.0


def test_a_short_log_is_the_first_ten_seconds(log: JointLog) -> None:
    twice = replace(log, time=2.0 * log.time)
    changed = CONDITIONS["10 s"](twice)
    assert changed.n_rows == 500
    np.testing.assert_array_equal(changed.position, log.position[:500])


def test_a_refusal_is_a_row(log: JointLog, tmp_path: Path) -> None:
    """Of a joint whose torque was not measured, next to a row whose torque was."""
    constant = log.torque.copy()
    constant[:, 0] = 1.0
    unmeasured = replace(log, torque=constant)
    refused = errors_of(Parts(unmeasured, unmeasured), tmp_path)
    assert "torque" in refused["refused"]
    named = {"data": "arm", "split": "a to b", "condition": "noise"}
    figures = summary([{**named, **refused}, {**named, "ratio": 1.04}])
    assert figures["refused"] == figures["above_plain"] == ["arm, a to b, noise"]
    assert figures["worst_ratio"] == 1.04
