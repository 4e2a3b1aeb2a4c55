from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest

from drivers.state_diagram import common_inputs, edges, label, meanings, page
from drivers.states import TRANSITIONS, Input, State

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE, PICTURE, SCRIPT = (
    DOCS / name for name in ("state-machine.md", "state-machine.svg", "state_machine_svg.py")
)
SVG = "{http://www.w3.org/2000/svg}"


def test_the_page_in_the_documentation_is_the_one_made_from_the_table():
    assert PAGE.read_text() == page(), "write it anew: python -m drivers.state_diagram"


def test_running_the_module_prints_the_page():
    printed = subprocess.run(
        [sys.executable, "-m", "drivers.state_diagram"],
        check=True,
        capture_output=True,
        text=True,
        cwd=PAGE.parents[1],
    )
    assert printed.stdout == page()


@pytest.fixture(scope="module")
def drawing() -> ModuleType:
    """The script that draws the picture."""
    spec = importlib.util.spec_from_file_location("state_machine_svg", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_picture_in_the_documentation_is_the_one_drawn_from_the_table(drawing: ModuleType):
    assert PICTURE.read_text() == drawing.svg(), "draw it anew: python docs/state_machine_svg.py"


def read_back(text: str) -> dict[tuple[State, Input], State]:
    """The table, from nothing but the arrows of the picture."""
    inputs = {label(what): what for what in Input}
    states = {label(state): state for state in State}
    started = [state for state, row in TRANSITIONS.items() if Input.OFF in row]
    found: dict[tuple[State, Input], State] = {}
    for group in ElementTree.fromstring(text).iter(f"{SVG}g"):
        title, shown = group.findtext(f"{SVG}title"), group.findtext(f"{SVG}text")
        assert title is not None and shown is not None
        source, names, target = title.split(" | ")
        assert shown.removeprefix("↻ ") == names, "what is seen is what is meant"
        for before in started if source == "any" else [states[source]]:
            for name in names.split(", "):
                key = before, inputs[name]
                assert key not in found, f"two arrows leave {before.name} for {name}"
                found[key] = states[target]
    return found


def test_the_arrows_say_all_that_the_table_says_and_nothing_else(drawing: ModuleType):
    table = {
        (before, what): after for before, row in TRANSITIONS.items() for what, after in row.items()
    }
    assert read_back(drawing.svg()) == table


def test_a_changed_table_changes_the_picture(drawing: ModuleType):
    changed = {
        **TRANSITIONS,
        State.CLOSED: {**TRANSITIONS[State.CLOSED], Input.OFF: State.FAULTED},
    }
    assert Input.OFF in common_inputs(TRANSITIONS)
    assert Input.OFF not in common_inputs(changed)
    assert drawing.svg(changed) != drawing.svg()


def test_nothing_in_the_picture_lies_upon_a_box_or_outside(drawing: ModuleType):
    root = ElementTree.fromstring(drawing.svg())
    boxes = [_box(one) for one in root.iter(f"{SVG}rect") if "box" in one.get("class", "")]
    words = [_box(one) for group in root.iter(f"{SVG}g") for one in group.iter(f"{SVG}rect")]
    assert len(boxes) == len(TRANSITIONS)
    for k, (left, top, right, bottom) in enumerate([*boxes, *words]):
        assert left >= 0 and top >= 0 and right <= drawing.WIDTH and bottom <= drawing.HEIGHT
        for other in boxes[: k if k < len(boxes) else len(boxes)]:
            apart = right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
            assert apart


def _box(rect: ElementTree.Element) -> tuple[float, float, float, float]:
    x, y, wide, tall = (float(rect.get(key, "nan")) for key in ("x", "y", "width", "height"))
    return x, y, x + wide, y + tall


def test_the_diagram_has_few_enough_arrows_to_be_read():
    assert len(edges(TRANSITIONS)) <= 40


def test_every_input_has_a_meaning_and_every_state_is_drawn():
    assert set(meanings()) == set(Input)
    assert all(text.endswith(".") for text in meanings().values())
    drawn = PICTURE.read_text()
    assert all(f">{label(state)}</text>" in drawn for state in State)
