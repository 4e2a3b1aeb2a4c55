"""Poses at rest, and motions that resemble them."""

from __future__ import annotations

import numpy as np

from identification.signals.poses import poses_without_motion

ROWS = 10  # of a pose, or of a sample that is held


def test_unrelated_rests_are_poses() -> None:
    poses = np.random.default_rng(1).uniform(-1.0, 1.0, (8, 3))
    assert poses_without_motion(np.repeat(poses, ROWS, axis=0)) == 8


def test_a_motion_whose_samples_are_held_is_none() -> None:
    """As of a topic at 10 Hz that is logged at 100 Hz."""
    time = np.arange(0.0, 20.0, 0.1)
    motion = np.column_stack([np.sin(1.3 * time), np.cos(0.7 * time)])
    assert poses_without_motion(np.repeat(motion, ROWS, axis=0)) is None


def test_a_motion_in_coarse_steps_is_none() -> None:
    step = 0.0015
    slow = np.rint(np.linspace(0.0, 1.0, 4000) / step) * step
    assert poses_without_motion(slow[:, None]) is None


def test_a_joint_that_stands_has_no_poses() -> None:
    assert poses_without_motion(np.zeros((100, 2))) is None
