"""The page and the picture of the state table, as `docs/state_machine.py` makes them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from xml.etree import ElementTree

from drivers.states import TRANSITIONS, Input, State

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "state_machine.py"
SVG = "{http://www.w3.org/2000/svg}"
_spec = importlib.util.spec_from_file_location("state_machine", SCRIPT)
drawing = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(drawing)


def test_page_and_picture_are_those_made_from_the_table():
    assert drawing.PAGE.read_text() == drawing.page(), "run: python docs/state_machine.py"
    assert drawing.TARGET.read_text() == drawing.svg(), "run: python docs/state_machine.py"


def read_back(text: str) -> dict[tuple[State, Input], State]:
    """The table, from nothing but the arrows of the picture."""
    inputs = {drawing.label(what): what for what in Input}
    states = {drawing.label(state): state for state in State}
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


def test_the_arrows_say_all_that_the_table_says_and_nothing_else():
    table = {
        (before, what): after for before, row in TRANSITIONS.items() for what, after in row.items()
    }
    assert read_back(drawing.svg()) == table


def test_a_changed_table_changes_the_picture():
    changed = {
        **TRANSITIONS,
        State.CLOSED: {**TRANSITIONS[State.CLOSED], Input.OFF: State.FAULTED},
    }
    assert Input.OFF in drawing.common_inputs(TRANSITIONS)
    assert Input.OFF not in drawing.common_inputs(changed)
    assert drawing.svg(changed) != drawing.svg()


def test_nothing_in_the_picture_lies_upon_a_box_or_outside():
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
    assert len(drawing.edges(TRANSITIONS)) <= 40


def test_every_input_has_a_meaning_and_every_state_is_drawn():
    assert set(drawing.meanings()) == set(Input)
    assert all(text.endswith(".") for text in drawing.meanings().values())
    drawn = drawing.TARGET.read_text()
    assert all(f">{drawing.label(state)}</text>" in drawn for state in State)
