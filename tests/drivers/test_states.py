"""The state table: complete, and safe by construction."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path
from xml.etree import ElementTree

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


def test_every_running_state_knows_what_follows_every_packet_and_every_fault():
    for state, what in itertools.product(RUNNING, [*FROM_PACKETS, Input.INIT, Input.SILENCE]):
        assert what in TRANSITIONS[state], f"{state.name} does not know {what.name}"
    for state in RUNNING:
        assert TRANSITIONS[state][Input.REFUSAL] is State.FAULTED


def test_every_state_can_be_reached():
    reached = {State.SYNC}
    while True:
        more = {after for state in reached for after in TRANSITIONS[state].values()} - reached
        if not more:
            break
        reached |= more
    assert reached == set(State)


def test_nothing_leads_out_of_the_end():
    assert not TRANSITIONS[State.ENDED]


def test_an_init_packet_always_starts_over():
    for state in [State.SYNC, *RUNNING]:
        assert TRANSITIONS[state][Input.INIT] is State.INIT


def test_drive_off_always_leads_out_of_open_mode():
    for state in RUNNING:
        assert TRANSITIONS[state][Input.OFF] is State.DRIVE_OFF


def test_open_mode_is_entered_only_from_where_axes_were_closed_with_the_drive_on():
    entered_from = {
        state for state, row in TRANSITIONS.items() for after in row.values() if after is State.OPEN
    }
    allowed = {State.DRIVING_ON, State.CLOSED, State.OPENING, State.OPEN}
    assert entered_from == allowed


@pytest.mark.parametrize("state", [State.INIT, State.DRIVE_OFF, State.FREEZING, State.FAULTED])
@pytest.mark.parametrize("what", [Input.OPEN, Input.PARTLY_OPEN])
def test_open_axes_are_not_believed_before_closed_ones(state, what):
    assert TRANSITIONS[state][what] is State.FAULTED


def test_a_fault_is_left_only_by_what_cannot_move():
    moving = {after for after in TRANSITIONS[State.FAULTED].values() if after in HAS_SET_POINTS}
    assert not moving


def test_only_open_axes_can_be_left_on_request():
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
    def test_without_the_drive_modes_do_not_matter(self, modes):
        assert self.read(modes, drive_on=False) is Input.OFF

    def test_axes_that_are_not_wanted_do_not_matter(self):
        assert self.read([4, 4, 0], wanted=slice(0, 2)) is Input.OPEN
        assert self.read([0, 0, 4], wanted=slice(0, 2)) is Input.CLOSED


class TestWaitingRequests:
    @pytest.mark.parametrize(
        "before", [State.DRIVE_OFF, State.DRIVING_ON, State.CLOSED, State.FREEZING]
    )
    def test_wait_for_open_mode(self, before):
        for after in (State.CLOSED, State.OPENING, State.OPEN):
            assert keeps_request(before, after)

    @pytest.mark.parametrize("before", [State.INIT, State.DRIVE_OFF])
    def test_wait_for_the_drive(self, before):
        assert keeps_request(before, State.DRIVE_OFF)
        assert keeps_request(before, State.DRIVING_ON)

    @pytest.mark.parametrize(
        "before", [s for s in RUNNING if s not in (State.INIT, State.DRIVE_OFF)]
    )
    def test_never_survive_the_drive_going_off(self, before):
        assert not keeps_request(before, State.DRIVE_OFF)

    @pytest.mark.parametrize("before", RUNNING)
    def test_never_survive_a_fault_or_the_end(self, before):
        assert not keeps_request(before, State.FAULTED)
        assert not keeps_request(before, State.ENDED)

    def test_do_not_survive_an_opening_that_is_given_up(self):
        assert not keeps_request(State.OPENING, State.CLOSED)

    @pytest.mark.parametrize("before", [s for s in RUNNING if s is not State.FREEZING])
    def test_do_not_survive_a_pause_that_begins(self, before):
        assert not keeps_request(before, State.FREEZING)

    def test_made_in_a_pause_wait_for_its_end(self):
        assert keeps_request(State.FREEZING, State.FREEZING)

    def test_survive_the_first_init_but_no_later_one(self):
        assert keeps_request(State.SYNC, State.INIT)
        assert not keeps_request(State.CLOSED, State.INIT)


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


def test_every_input_has_a_meaning_and_every_state_is_drawn():
    assert set(drawing.meanings()) == set(Input)
    assert all(text.endswith(".") for text in drawing.meanings().values())
    drawn = drawing.TARGET.read_text()
    assert all(f">{drawing.label(state)}</text>" in drawn for state in State)
