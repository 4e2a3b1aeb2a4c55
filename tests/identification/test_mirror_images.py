"""Arms that are mirror images of themselves: what their torque cannot say of signs."""

from __future__ import annotations

import numpy as np
import pytest

from identification.hypotheses.joint_changes import Axes, Change
from identification.hypotheses.mirror_images import Signs, mirror_images
from identification.model.kinematics import chain_from_urdf
from tests.jointed_arms import jointed_arm

DOWN = np.array([0.0, 0.0, -9.81])


@pytest.mark.parametrize(
    ("axes", "gravity", "expected"),
    [
        ("zyyy", DOWN, {(0,), (0, 1, 2, 3), (1, 2, 3)}),
        ("yyy", DOWN, {(0, 1, 2)}),
        ("zyyxyx", DOWN, {(0, 3, 5), (0, 1, 2, 4), (1, 2, 3, 4, 5)}),
        # without gravity a plane of joints has an image upside down, that moves the same joints
        ("yyy", np.zeros(3), {(0, 1, 2)}),
    ],
)
def test_joints_that_an_image_negates(
    axes: str, gravity: np.ndarray, expected: set[tuple[int, ...]]
) -> None:
    chain = chain_from_urdf(jointed_arm(axes))
    assert {*mirror_images(chain, gravity)} == expected


def test_a_skew_axis_has_no_image() -> None:
    chain = chain_from_urdf(
        jointed_arm("zyyx").replace('axis xyz="1 0 0"', 'axis xyz="0.6 0.6 0.5"')
    )
    assert mirror_images(chain, DOWN) == ()


def test_signs_one_after_the_other_are_one_change_for_each_joint() -> None:
    """All torques and one of them again cancel."""
    steps = (Change("torque sign", (0, 1, 2)), Change("torque sign", (0,)), Change("zero", (1,)))
    signs = Signs.of(Axes.of(steps, 3))
    assert signs.changes == (Change("torque sign", (1,)), Change("torque sign", (2,)))


def test_all_joints_alike_are_one_change() -> None:
    signs = Signs(np.ones(5), -np.ones(5))
    assert signs.changes == (Change("torque sign", (0, 1, 2, 3, 4)),)
    assert signs.is_probable
    assert not signs.flipped((0, 1)).is_probable
