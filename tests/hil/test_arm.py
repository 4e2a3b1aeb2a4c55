"""The arm as it is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from hil.arm import Arm

SHAPE = '<collision><geometry><box size="0.3 0.1 0.1"/></geometry></collision>'
URDF = (
    f'<robot name="r"><link name="base"/><link name="upper">{SHAPE}{SHAPE}</link>'
    '<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>'
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
)


@pytest.mark.parametrize(
    ("old", "new"),
    [("<collision>", '<collision><origin xyz="0 0 1e300"/>'), ("0.3 0.1", "0.3 1e308")],
)
def test_of_a_shape_beyond_every_robot_nothing_is_drawn(old: str, new: str) -> None:
    arm = Arm.from_urdf(URDF.replace(old, new, 1))
    assert len(Arm.from_urdf(URDF).solids) == 2
    assert len(arm.solids) == 1
    assert np.isfinite(arm.tips(np.zeros((1, 1)))).all()


def test_the_end_of_an_arm_whose_only_shape_is_a_point_is_that_point() -> None:
    arm = Arm.from_urdf(URDF.replace("0.3 0.1 0.1", "0 0 0"))
    assert arm.tip.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("size", ["0.3 0.1 0.1", "0.3 0.1 0", "0.3 0 0", "0 0 0", "1e6 1e-9 1"])
def test_a_body_has_a_surface_however_flat_it_is(size: str) -> None:
    arm = Arm.from_urdf(URDF.replace("0.3 0.1 0.1", size))
    assert [solid.faces.shape for solid in arm.solids] == [(12, 3)] * 2
