"""What is said where a search finds no motion, and of a motion beside its criteria."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import numpy as np
import pytest

from hil.cell import AngleFrame, Cell
from hil.design import DesignSettings, preset, problem_of
from hil.design.advice import NoExcitationError, margins, no_excitation, weakest
from hil.motion_checks import MotionChecks
from identification.excitation import (
    CollisionChecker,
    NoFeasibleMotionError,
    Objective,
    Violation,
    check_motion,
    sampled,
)
from planner import FourierSeries
from sim_fixtures.ns16 import CELL_PATH

VIA, SINES = preset("b"), preset("a")
CONTACT = Violation("collision", "link_2 and link_4", 0.01, 0.05, 1.0, (0.0,) * 6)
DEEPER = Violation("collision", "link_1 and link_6", -0.1, 0.05, 2.0, (0.0,) * 6)
CURRENT = Violation("current", "motor of joint_2", 12.0, 10.0, 1.0, (0.0,) * 6)


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def duration(value: float, bound: float) -> Violation:
    return Violation("duration", "the motion", value, bound, None)


def said(cell: Cell, settings: DesignSettings, rejected: dict, nearest: list, **more) -> str:
    found = {violation.kind: violation for violation in nearest}
    error = NoFeasibleMotionError(rejected, found, **({"tried": 1000} | more))
    return str(no_excitation(error, AngleFrame.of(cell), None, settings))


def advised(*arguments, **more) -> str:
    return said(*arguments, **more).partition("What can be changed: ")[2]


def test_sines_get_advice_about_sines(cell):
    for violation, words in ((CONTACT, "[sines] offset"), (CURRENT, "[sines] slowest, fastest")):
        advice = advised(cell, SINES, {violation.kind: 1000}, [violation])
        assert words in advice and "via" not in advice
        assert "[via_points]" in advised(cell, VIA, {violation.kind: 1000}, [violation])


def test_every_kind_that_forbids_more_than_half_gets_advice(cell):
    both = advised(cell, VIA, {"collision": 900, "current": 501}, [CONTACT, CURRENT])
    assert "range_share" in both and "current limits" in both
    one = advised(cell, VIA, {"collision": 900, "current": 500}, [CONTACT, CURRENT])
    assert "range_share" in one and "current limits" not in one
    split = advised(cell, VIA, {"collision": 400, "current": 450}, [CONTACT, CURRENT])
    assert "range_share" not in split and "current limits" in split


@pytest.mark.parametrize(
    ("value", "asked", "words", "longer"),
    [
        (18.5, (0.0, 0.5), "the shortest motion tried lasts 18.5 s, where 0 to 0.5 s", False),
        (22.0, (0.0, 20.0), "allow more time", True),
        (12.0, (60.0, 100.0), "the longest motion tried lasts 12 s, where 60 to 100 s", False),
        (20.3, (19.9, 20.0), "where 19.9 to 20 s are asked for: allow more time", True),
    ],
)
def test_a_duration_is_reported_with_what_is_asked_for(cell, value, asked, words, longer):
    settings = VIA.replaced(constraints={"min_duration": asked[0], "max_duration": asked[1]})
    bound = asked[value > asked[1]]
    advice = advised(cell, settings, {"duration": 100}, [duration(value, bound)], tried=100)
    assert words in advice and ("search longer" in advice) is longer


def test_after_a_tiny_search_a_longer_one_is_advised(cell):
    assert "search longer, 24 motions are few" in advised(
        cell, VIA, {"collision": 24}, [CONTACT], tried=24
    )
    assert "search longer" not in advised(cell, VIA, {"collision": 1000}, [CONTACT])


def test_motions_that_excite_too_little_are_advised_about(cell):
    advice = advised(cell, VIA, {"collision": 100}, [CONTACT], unexciting=900)
    assert advice == "take more via points or judge by fewer parameters ([objective] parameters)"


def test_the_closest_motion_has_one_violation_of_each_kind(cell):
    sentence = said(
        cell,
        VIA,
        {"collision": 1000, "current": 1000},
        [CONTACT, CURRENT],
        closest=(CONTACT, DEEPER, CURRENT),
    )
    closest = sentence.partition("comes closest breaks ")[2]
    assert closest.count("collision of") == 1 and "link_1 and link_6" in closest
    assert closest.count("current of") == 1


def test_currents_that_home_needs_are_refused_at_once(cell):
    limits = cell.drive_train.current_limit.tolist()
    limits[1] = 0.1
    weak = cell.with_values({"drive_train.current_limit": limits})
    words = r"begin at home: at rest there, current of motor of joint_2: [\d.]+ A, at most 0\.08 A"
    with pytest.raises(NoExcitationError, match=words) as caught:
        problem_of(weak, VIA)
    assert re.search(r"correct \[drive_train\].*home_deg in \[campaign\]", str(caught.value))
    with pytest.raises(NoExcitationError, match=r"where the sines swing about.*\[sines\] offset"):
        problem_of(weak, SINES.replaced(sines={"offset": "home"}))
    problem_of(weak, VIA.kinematic())


def test_sines_about_a_contact_are_refused_at_once(cell):
    folded = SINES.replaced(sines={"offset": [0.0, 90.0, -165.0, 0.0, 90.0, 0.0]})
    with pytest.raises(NoExcitationError, match=r"where the sines swing about: collision of"):
        problem_of(cell, folded)


# A motion that was found


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
