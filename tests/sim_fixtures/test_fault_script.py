"""One line of text, one fault."""

from __future__ import annotations

import re

import pytest

from drivers.transports.faults import Corrupt, Delay, Duplicate, Lose, Reorder
from sim_fixtures.faults import (
    GRAMMAR,
    ControllerFault,
    FaultScriptError,
    parse_fault,
    split_faults,
)

LINES = {
    "lose@1200": Lose(1200),
    "lose@1200x3:to_controller": Lose(1200, "to_controller", 3),
    "delay@1200:5ms": Delay(1200, seconds=0.005),
    "delay@1200:250us": Delay(1200, seconds=250e-6),
    "delay@0x4:1.5cycles:to_controller": Delay(0, cycles=1.5, direction="to_controller", count=4),
    "duplicate@1200": Duplicate(1200),
    "duplicate@1200x2:to_controller": Duplicate(1200, "to_controller", 2),
    "reorder@1200": Reorder(1200),
    "reorder@1200:to_controller": Reorder(1200, "to_controller"),
    "corrupt@1200:offset=8": Corrupt(1200, 8),
    "corrupt@1200:offset=8:mask=0x80:to_controller": Corrupt(1200, 8, 0x80, "to_controller"),
    "restart@5000:cold": ControllerFault("restart", 5000, word="cold"),
    "restart@5000": ControllerFault("restart", 5000, word="cold"),
    "restart@5000:warm": ControllerFault("restart", 5000, word="warm"),
    "drive-drop@7": ControllerFault("drive-drop", 7),
    "e-stop@7": ControllerFault("e-stop", 7),
    "axis-leaves@7:axis=3": ControllerFault("axis-leaves", 7, 3),
    "following-error@7:axis=2": ControllerFault("following-error", 7, 2, 500, "jam"),
    "following-error@7x20:axis=2:slip": ControllerFault("following-error", 7, 2, 20, "slip"),
    "saturate@7x30:axis=1": ControllerFault("saturate", 7, 1, 30),
    "push@7:axis=2": ControllerFault("push", 7, 2, 50),
    "push@7x30:axis=1": ControllerFault("push", 7, 1, 30),
    "pause@7x50:502": ControllerFault("pause", 7, count=50, word="502"),
    "pause@7:500": ControllerFault("pause", 7, count=50, word="500"),
}


@pytest.mark.parametrize(("line", "fault"), LINES.items())
def test_a_line_says_which_fault(line: str, fault: object) -> None:
    assert parse_fault(line) == fault


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("", "is not KIND@CYCLE"),
        ("lose", "is not KIND@CYCLE"),
        ("lose@-3", "is not KIND@CYCLE"),
        ("lose@1200x0", "not positive"),
        ("lose@1x1000000001", "count is more than 1000000000"),
        ("lose@1x100000000000000000000", "count is more than"),
        ("saturate@1x2000000000:axis=1", "count is more than"),
        ("e-stop@1000000001", "cycle is more than"),
        ("lose@" + "9" * 5000, "cycle is more than"),
        ("lose@1200:sideways", "no option 'sideways'"),
        ("loose@1200", "none of lose, delay"),
        ("delay@1200", "a time"),
        ("delay@1200:0ms", "neither seconds nor cycles"),
        ("corrupt@1200", "offset=NUMBER is missing"),
        ("corrupt@1200:offset=far", "not offset=NUMBER"),
        ("corrupt@1200:offset=1:mask=0", "mask 0"),
        ("axis-leaves@7", "axis=NUMBER is missing"),
        ("axis-leaves@7:axis=0", "count from 1"),
        ("e-stop@7x3", "takes no count"),
        ("restart@7:lukewarm", "no option"),
        ("pause@7:503", "no option"),
    ],
)
def test_a_line_that_is_none_says_why_and_lists_the_grammar(line: str, reason: str) -> None:
    with pytest.raises(FaultScriptError, match=re.escape(reason)) as caught:
        parse_fault(line)
    assert GRAMMAR in str(caught.value)
    assert caught.value.text == line


def test_every_example_of_the_grammar_is_a_fault() -> None:
    examples = re.findall(r"^([a-z-]+@\S+)", GRAMMAR, re.MULTILINE)
    assert len(examples) == 13
    for line in examples:
        parse_fault(line)


def test_faults_of_link_and_controller_are_told_apart() -> None:
    faults = [parse_fault(line) for line in ("lose@1", "e-stop@2", "reorder@3", "restart@4")]
    assert split_faults(faults) == ((faults[0], faults[2]), (faults[1], faults[3]))
