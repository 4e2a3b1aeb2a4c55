"""Steps of the measured position that no arm makes are found; motion is none."""

from __future__ import annotations

import numpy as np
import pytest

from identification import Recording
from identification.validation.position_jumps import position_jumps
from tests.identification.test_verdict import finding_of


def recording(rate: float, *, jitter: float = 0.0, seed: int = 0) -> Recording:
    rng = np.random.default_rng(seed)
    time = np.cumsum((1.0 + jitter * rng.uniform(-1.0, 1.0, int(12 * rate))) / rate)
    q = np.column_stack([0.8 * np.sin(w * time + w) + 0.3 * np.sin(3.1 * w * time) for w in (2, 3)])
    q += 2e-5 * rng.standard_normal(q.shape)
    return Recording(time, q, ("hip", "knee"), torque=np.zeros_like(q))


def with_jump(one: Recording, size: float, rows: slice) -> Recording:
    position = one.position.copy()
    position[rows, 1] += size
    return Recording(one.time, position, one.joint_names, torque=one.torque)


@pytest.mark.parametrize("rate", [100.0, 125.0, 500.0, 1000.0])
@pytest.mark.parametrize("size", [0.2, 0.02, -0.02])
def test_a_lasting_jump_is_named_with_its_joint_time_and_size(rate: float, size: float) -> None:
    one, at = recording(rate), int(5 * rate)
    (jump,) = position_jumps(with_jump(one, size, slice(at, None)), "log.mcap")
    assert (jump.recording, jump.joint) == ("log.mcap", "knee")
    assert jump.time == pytest.approx(one.time[at] - one.time[0])
    assert jump.size == pytest.approx(size, abs=2e-3)
    finding = finding_of("position jumps", ("hip", "knee"), jumps=(jump,))
    assert finding.level == "wrong" and "knee" in finding.words and "knee" in finding.next_step


@pytest.mark.parametrize("rate", [100.0, 500.0, 5000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_motion_with_an_uneven_clock_has_none(rate: float, jitter: float) -> None:
    assert position_jumps(recording(rate, jitter=jitter, seed=3)) == []


def test_a_sudden_stop_is_none() -> None:
    """From 1 rad/s to rest within one sample; the position goes on where it was."""
    time = np.arange(0.0, 8.0, 0.002)
    q = np.column_stack([np.minimum(time, 4.0), np.sin(time)])
    q += 1e-5 * np.random.default_rng(1).standard_normal(q.shape)
    assert position_jumps(Recording(time, q, ("a", "b"), torque=np.zeros_like(q))) == []


def test_a_glitch_that_is_taken_back_is_no_slip() -> None:
    one = recording(500.0)
    assert position_jumps(with_jump(one, 0.2, slice(2500, 2501))) == []


def test_a_gap_is_no_jump() -> None:
    one = recording(500.0)
    gap = np.zeros(len(one.time), dtype=np.bool_)
    gap[2500] = True
    moved = one.position.copy()
    moved[2500:] += 0.3
    torn = Recording(one.time, moved, one.joint_names, torque=np.zeros_like(moved), gap_before=gap)
    assert position_jumps(torn) == []
