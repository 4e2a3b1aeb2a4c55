"""A largest torque per joint in the cell file refuses motions as the motor currents do."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from hil.campaign.intervals import hold
from hil.cell import Cell, CellError
from hil.design import preset, problem_of
from hil.design.advice import NoExcitationError
from hil.motion_checks import MotionChecks
from identification.model.motion import Motion
from sim_fixtures.ns16 import CELL_PATH

HELD = 2
"""The joint that bears most at home: the forearm stands out level."""


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def limited(cell: Cell, torque: list[float]) -> Cell:
    """The cell with these torque limits."""
    text = cell.text.replace("[limits]\n", f"[limits]\ntorque = {torque}\n", 1)
    return Cell.from_texts(text, cell.urdf, cell.path)


def held_torque(cell: Cell) -> float:
    """What the joint bears at home by the nominal model and its uncertainty, by pinocchio [N·m]."""
    model = pin.buildModelFromXML(cell.urdf)
    gravity = pin.computeGeneralizedGravity(model, model.createData(), cell.home)
    return (1.0 + cell.nominal.uncertainty) * abs(float(gravity[HELD]))


def test_a_cell_without_torque_limits_has_none(cell: Cell) -> None:
    assert cell.torque_limit is None
    assert MotionChecks.of(cell).currents.torque_limit is None


def test_torque_limits_are_those_of_the_file(cell: Cell) -> None:
    torque = [1000.0, 900.0, 800.0, 70.0, 60.0, 50.0]
    np.testing.assert_array_equal(limited(cell, torque).torque_limit, torque)


@pytest.mark.parametrize(
    ("torque", "words"),
    [
        ([100.0], ["limits.torque", "has 1 entries but the URDF has 6 joints", "or none"]),
        ([100.0] * 5 + [0.0], ["limits.torque", "N·m at the joint"]),
        ([100.0] * 5 + [float("nan")], ["limits.torque", "N·m at the joint"]),
    ],
)
def test_what_is_no_limit_is_refused(cell: Cell, torque: list[float], words: list[str]) -> None:
    with pytest.raises(CellError) as caught:
        limited(cell, torque)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(("share", "refused"), [(1.02, False), (0.98, True)])
def test_standing_at_home_is_refused_where_gravity_is_beyond_the_limit(
    cell: Cell, share: float, refused: bool
) -> None:
    torque = [1e4] * 6
    torque[HELD] = share * held_torque(cell)
    told = MotionChecks.of(limited(cell, torque)).refusal(hold(cell.home, 1.0))
    assert (told is not None) == refused
    if told is not None:
        assert told.startswith("torque of joint_3: ")
        assert f"N·m, at most {torque[HELD]:.4g} N·m is wanted" in told


def test_a_design_keeps_the_limit_too(cell: Cell) -> None:
    torque = [1e4] * 6
    torque[HELD] = 0.5 * held_torque(cell)
    with pytest.raises(NoExcitationError, match=r"torque of joint_3: .* N·m"):
        problem_of(limited(cell, torque), preset("b"))
    roomy = limited(cell, [1e4] * 6)
    currents = problem_of(roomy, preset("b")).constraints.currents
    assert currents is not None
    np.testing.assert_array_equal(currents.torque_limit, [1e4] * 6)


def test_a_known_payload_counts_in_what_gravity_demands(cell: Cell) -> None:
    payload = "[robot.payload]\nmass = 8.0\ncentre = [0.05, 0.0, 0.1]\n"
    laden = Cell.from_texts(f"{cell.text}\n{payload}", cell.urdf, cell.path)
    model = pin.buildModelFromXML(cell.urdf)
    body = pin.Inertia(8.0, np.array([0.05, 0.0, 0.1]), np.zeros((3, 3)))
    model.appendBodyToJoint(model.njoints - 1, body, pin.SE3.Identity())
    gravity = pin.computeGeneralizedGravity(model, model.createData(), cell.home)
    still = np.zeros((1, 6))
    standing = Motion(np.zeros(1), cell.home[np.newaxis], still, still)
    torque = MotionChecks.of(laden).currents.torque(standing)[0]
    # The NS 16's model has no offset: at standstill there is nothing but gravity.
    np.testing.assert_allclose(
        torque, (1.0 + cell.nominal.uncertainty) * gravity, rtol=1e-9, atol=1e-9
    )
    bare = MotionChecks.of(cell).currents.torque(standing)[0]
    assert abs(torque[HELD] - bare[HELD]) > 50.0
