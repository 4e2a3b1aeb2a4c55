"""The state table: complete, and safe by construction."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path

import pytest

from drivers import Mode
from drivers.states import (
    HAS_SET_POINTS,
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


def test_ended_is_final():
    assert not TRANSITIONS[State.ENDED]


def test_init_packet_leads_to_init():
    for state in [State.SYNC, *RUNNING]:
        assert TRANSITIONS[state][Input.INIT] is State.INIT


def test_drive_off_leads_out_of_open_mode():
    for state in RUNNING:
        assert TRANSITIONS[state][Input.OFF] is State.DRIVE_OFF


def test_open_mode_is_entered_after_closed_axes():
    entered_from = {
        state for state, row in TRANSITIONS.items() for after in row.values() if after is State.OPEN
    }
    allowed = {State.DRIVING_ON, State.CLOSED, State.OPENING, State.OPEN}
    assert entered_from == allowed


@pytest.mark.parametrize("state", [State.INIT, State.DRIVE_OFF, State.FREEZING, State.FAULTED])
@pytest.mark.parametrize("what", [Input.OPEN, Input.PARTLY_OPEN])
def test_open_axes_before_closed_ones_are_a_fault(state, what):
    assert TRANSITIONS[state][what] is State.FAULTED


def test_no_set_points_after_a_fault():
    moving = {after for after in TRANSITIONS[State.FAULTED].values() if after in HAS_SET_POINTS}
    assert not moving


def test_exit_is_an_input_of_open_axes():
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


class TestReading:
    def read(self, modes, *, drive_on=True, wanted=slice(None)):
        return read_input(drive_on, modes, modes[wanted], Mode.POSITION)

    @pytest.mark.parametrize(
        ("modes", "meaning"),
        [(modes, meaning) for meaning, each in MEANINGS.items() for modes in each],
    )
    def test_modes(self, modes, meaning):
        assert self.read(modes) is meaning

    @pytest.mark.parametrize("modes", [[0, 0, 0], [4, 4, 4], [501, 501, 501], [502] * 3])
    def test_modes_with_the_drive_off(self, modes):
        assert self.read(modes, drive_on=False) is Input.OFF

    def test_unwanted_axes(self):
        assert self.read([4, 4, 0], wanted=slice(0, 2)) is Input.OPEN
        assert self.read([0, 0, 4], wanted=slice(0, 2)) is Input.CLOSED


WAITS = {
    State.SYNC: {State.SYNC, State.INIT},
    State.INIT: {State.SYNC, State.INIT},
    State.DRIVE_OFF: {State.INIT, State.DRIVE_OFF},
    State.DRIVING_ON: {State.INIT, State.DRIVE_OFF, State.DRIVING_ON},
    State.CLOSED: set(State) - HAS_SET_POINTS,
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
