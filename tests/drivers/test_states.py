"""The state table: complete, and safe by construction."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path

import pytest

from drivers import Mode
from drivers.states import (
    STATES_WITH_SET_POINTS,
    TRANSITIONS,
    Input,
    State,
    keeps_request,
    read_input,
)

FROM_PACKETS = [
    Input.OFF,
    Input.DRIVING_ON,
    Input.CLOSED,
    Input.PARTLY_OPEN,
    Input.OPEN,
    Input.PAUSE,
    Input.UNAVAILABLE,
    Input.END,
]
RUNNING = [state for state in State if state not in (State.SYNC, State.ENDED)]


def test_table_of_running_states_is_complete():
    for state, what in itertools.product(RUNNING, [*FROM_PACKETS, Input.INIT, Input.SILENCE]):
        assert what in TRANSITIONS[state], f"no entry of {state.name} for {what.name}"
    for state in RUNNING:
        assert TRANSITIONS[state][Input.REFUSAL] is State.FAULTED


def test_each_state_can_be_reached():
    reached = {State.SYNC}
    while True:
        more = {after for state in reached for after in TRANSITIONS[state].values()} - reached
        if not more:
            break
        reached |= more
    assert reached == set(State)


def test_laws_of_the_table():
    assert not TRANSITIONS[State.ENDED], "it is final"
    for state in [State.SYNC, *RUNNING]:
        assert TRANSITIONS[state][Input.INIT] is State.INIT
    for state in RUNNING:
        assert TRANSITIONS[state][Input.OFF] is State.DRIVE_OFF
    # Axes have to be closed before they are open.
    entered_from = {state for state, row in TRANSITIONS.items() if State.OPEN in row.values()}
    assert entered_from == {State.DRIVING_ON, State.CLOSED, State.OPENING, State.OPEN}
    for state in (State.INIT, State.DRIVE_OFF, State.FREEZING, State.FAULTED):
        for what in (Input.OPEN, Input.PARTLY_OPEN):
            assert TRANSITIONS[state][what] is State.FAULTED
    assert not STATES_WITH_SET_POINTS & set(TRANSITIONS[State.FAULTED].values())
    asking = [state for state, row in TRANSITIONS.items() if Input.EXIT in row]
    assert asking == [State.OPENING, State.OPEN, State.EXITING]


MEANINGS = {
    Input.CLOSED: ([0, 0, 0], [0, 10, 0]),
    Input.DRIVING_ON: ([501, 501, 501], [0, 501, 0]),
    Input.OPEN: ([4, 4, 4],),
    Input.PARTLY_OPEN: ([4, 0, 4], [4, 5, 4], [5, 5, 5], [4, 501, 4]),
    Input.PAUSE: ([502, 502, 502], [4, 500, 4]),
    Input.END: ([504, 504, 504],),
    Input.UNAVAILABLE: (
        *([4, 504, 4], [4, 999, 4], [4, 4, 3], [502, 3, 4], [504, 0, 504]),
        *([508, 0, 0], [3, 3, 3], [-1, -1, -1]),
    ),
}


@pytest.mark.parametrize(
    ("modes", "meaning"), [(modes, meaning) for meaning, each in MEANINGS.items() for modes in each]
)
def test_modes(modes, meaning):
    assert read_input(True, modes, modes, Mode.POSITION) is meaning
    if meaning is not Input.END:
        assert read_input(False, modes, modes, Mode.POSITION) is Input.OFF


@pytest.mark.parametrize(("modes", "meaning"), [([4, 4, 0], Input.OPEN), ([0, 0, 4], Input.CLOSED)])
def test_unwanted_axes(modes, meaning):
    assert read_input(True, modes, modes[:2], Mode.POSITION) is meaning


WAITS = {
    State.SYNC: {State.SYNC, State.INIT},
    State.INIT: {State.SYNC, State.INIT},
    State.DRIVE_OFF: {State.INIT, State.DRIVE_OFF},
    State.DRIVING_ON: {State.INIT, State.DRIVE_OFF, State.DRIVING_ON},
    State.CLOSED: set(State) - STATES_WITH_SET_POINTS,
    State.OPENING: set(State),
    State.OPEN: set(State),
    State.FREEZING: {State.FREEZING},
}
"""States before a transition, by the state after it, in which a request that waits is retained."""


@pytest.mark.parametrize("before", State)
def test_requests_that_wait_are_retained(before):
    for after in State:
        assert keeps_request(before, after) == (before in WAITS.get(after, ())), after


SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "state_machine.py"
_spec = importlib.util.spec_from_file_location("state_machine", SCRIPT)
drawing = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(drawing)


def test_page_and_picture_are_generated_from_the_table():
    assert drawing.PAGE.read_text() == drawing.page(), "run: python docs/state_machine.py"
    assert drawing.TARGET.read_text() == drawing.svg(), "run: python docs/state_machine.py"
