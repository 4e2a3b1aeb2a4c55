"""What a person is told who gets no motion, before a search and after it."""

from __future__ import annotations

import re

import pytest

from hil.cell import AngleFrame, Cell
from hil.design import DesignSettings, preset, problem_of
from hil.design.advice import NoExcitationError, no_excitation
from identification.excitation import NoFeasibleMotionError, Violation
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


def test_what_cannot_be_bridged_is_told_with_its_ratio(cell):
    advice = advised(cell, VIA, {"duration": 100}, [duration(18.5, 0.5)], tried=100)
    assert advice.startswith("the shortest motion tried is 37 times too long: allow more time")
    assert "search longer" not in advice
    close = advised(cell, VIA, {"duration": 100}, [duration(22.0, 20.0)], tried=100)
    assert "times" not in close and close.startswith("allow more time")


def test_too_short_and_a_narrow_window_are_told_from_too_long(cell):
    asks = VIA.replaced(constraints={"min_duration": 60.0, "max_duration": 100.0})
    short = advised(cell, asks, {"duration": 1000}, [duration(12.0, 60.0)])
    assert short.startswith("the longest motion tried is 5.0 times too short: ask for less time")
    window = VIA.replaced(constraints={"min_duration": 19.9, "max_duration": 20.0})
    narrow = advised(cell, window, {"duration": 1000}, [duration(20.3, 20.0)])
    assert narrow.startswith("leave more room between 19.9 and 20 s")
    far = advised(cell, window, {"duration": 1000}, [duration(60.0, 20.0)])
    assert "3.0 times too long" in far


def test_a_tiny_search_is_told_to_go_on(cell):
    assert "search longer, 24 motions are few" in advised(
        cell, VIA, {"collision": 24}, [CONTACT], tried=24
    )
    assert "search longer" not in advised(cell, VIA, {"collision": 1000}, [CONTACT])


def test_motions_that_excite_too_little_are_advised_about(cell):
    advice = advised(cell, VIA, {"collision": 100}, [CONTACT], unexciting=900)
    assert advice == "take more via points or judge by fewer parameters ([objective] parameters)"


def test_the_closest_motion_is_told_with_one_violation_of_each_kind(cell):
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


def test_currents_that_home_itself_needs_are_told_before_any_motion_is_tried(cell):
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


def test_sines_that_swing_about_a_contact_are_refused_before_any_is_tried(cell):
    folded = SINES.replaced(sines={"offset": [0.0, 90.0, -165.0, 0.0, 90.0, 0.0]})
    with pytest.raises(NoExcitationError, match=r"where the sines swing about: collision of"):
        problem_of(cell, folded)
