from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from drivers.state_diagram import common_inputs, edges, label, meanings, mermaid, page
from drivers.states import TRANSITIONS, Input, State

PAGE = Path(__file__).resolve().parents[2] / "docs" / "state-machine.md"


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


def read_back(text: str) -> dict[tuple[State, Input], State]:
    """The table, from nothing but the arrows of the diagram."""
    inputs = {label(what): what for what in Input}
    started = [state for state, row in TRANSITIONS.items() if Input.OFF in row]
    arrows = re.findall(r"^ +(\w+) --> (\w+) : (.+)$", text, re.MULTILINE)
    found: dict[tuple[State, Input], State] = {}
    for source, target, names in arrows:
        for before in started if source == "any" else [State[source.upper()]]:
            for name in names.split(", "):
                key = before, inputs[name]
                assert key not in found, f"two arrows leave {before.name} for {name}"
                found[key] = State[target.upper()]
    return found


def test_the_arrows_say_all_that_the_table_says_and_nothing_else():
    table = {
        (before, what): after for before, row in TRANSITIONS.items() for what, after in row.items()
    }
    assert read_back(mermaid()) == table


def test_a_changed_table_changes_the_diagram():
    changed = {
        **TRANSITIONS,
        State.CLOSED: {**TRANSITIONS[State.CLOSED], Input.OFF: State.FAULTED},
    }
    assert Input.OFF in common_inputs(TRANSITIONS)
    assert Input.OFF not in common_inputs(changed)
    assert mermaid(changed) != mermaid()


def test_the_diagram_has_few_enough_arrows_to_be_read():
    assert len(edges(TRANSITIONS)) <= 40


def test_every_input_has_a_meaning_and_every_state_is_drawn():
    assert set(meanings()) == set(Input)
    assert all(text.endswith(".") for text in meanings().values())
    assert all(f'"{label(state)}" as' in mermaid() for state in State)
