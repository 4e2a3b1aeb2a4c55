"""What is told of a motion that was found beside its criteria."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import numpy as np
import pytest

from hil.cell import Cell
from hil.design import preset, problem_of
from hil.design.advice import margins, weakest
from hil.motion_checks import MotionChecks
from identification.excitation import CollisionChecker, Objective, check_motion, sampled
from planner import FourierSeries
from sim_fixtures.ns16 import CELL_PATH


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def swinging(cell: Cell, joints: list[int], frequency: float = 1.0) -> FourierSeries:
    """Small sines about home of some joints."""
    amplitude, frequencies = np.zeros((6, 1)), frequency * (1.0 + 0.3 * np.arange(6.0))[:, None]
    amplitude[joints] = 0.2
    return FourierSeries(cell.home, amplitude, frequencies, 12.0, 2.0)


def test_margins_name_the_motor_and_the_pair(cell):
    problem = problem_of(cell, preset("b"))
    motion = swinging(cell, [0, 1, 2])
    began = time.perf_counter()
    found = margins(cell, problem, motion)
    assert time.perf_counter() - began < 1.0
    currents, pair = found.split("; ")
    assert currents.startswith("current at most ") and "% of its limit (motor of joint_" in currents
    assert pair.startswith("nearest 0.") and "(link_" in pair

    # The checks agree: with a limit that little lower, or a margin that little wider, it is broken.
    share = float(currents.split()[3]) / 100.0
    checks = MotionChecks.of(cell)
    for factor, ok in ((share + 0.01, True), (share - 0.01, False)):
        limited = type(checks.currents)(
            **{**vars(checks.currents), "current_limit": factor * checks.currents.current_limit}
        )
        assert check_motion(motion, cell.joint_limits, currents=limited).ok is ok


def test_the_nearest_pair_is_no_contact_even_where_the_margin_is_narrow(cell):
    narrow = cell.with_values({"workspace.margin": 0.01})
    motion = swinging(cell, [0, 1, 2])
    wide, found = (
        margins(each, problem_of(each, preset("b")), motion).partition("nearest ")[2]
        for each in (cell, narrow)
    )
    assert wide == found
    distance, (first, second) = float(found.split()[0]), re.findall(r"\((\S+), (.+)\)", found)[0]
    near = CollisionChecker(
        cell.urdf, replace(cell.workspace, margin=distance + 0.006), limits=cell.joint_limits
    )
    contact = near.deepest_contact(sampled(motion).position)
    assert contact is not None and (contact.first, contact.second) == (first, second)


def test_margins_are_of_what_was_looked_at(cell):
    assert margins(cell, problem_of(cell, preset("b").kinematic()), swinging(cell, [0])) == ""


def test_what_a_motion_cannot_tell_apart_is_named(cell):
    still = weakest(Objective(cell.model), swinging(cell, [0, 1, 2, 3, 4]))
    assert {"I6zz", "f0_6", "f1_6"} & set(still)
    names = cell.model.parameter_names
    chosen = [names.index(name) for name in ("f0_1", "f1_1", "f0_2", "f1_2")]
    objective = Objective(cell.model, parameters=np.array(sorted(chosen)))
    found = weakest(objective, swinging(cell, [0, 1]))
    assert found and set(found) <= {"f0_1", "f1_1", "f0_2", "f1_2"}
    assert {name[-1] for name in found[:2]} in ({"1"}, {"2"})  # the two of one joint
