"""The controller's loop program: phases and what moves it on."""

from __future__ import annotations

from typing import Any

import pytest

from sim_fixtures import ControllerSettings, Phase, SettingError
from sim_fixtures.program import MISSING, Answer, LoopProgram, StartStep

FINE = Answer(valid=True)
QUICK: dict[str, Any] = {
    "drive_off_cycles": 2,
    "driving_on_cycles": 3,
    "closed_cycles": 2,
    "closing_cycles": 2,
    "opening_stagger": 2,
}


def program(**changes: Any) -> LoopProgram:
    return LoopProgram(3, ControllerSettings(**(QUICK | changes)))


def advance(loop: LoopProgram, cycles: int = 1, answer: Answer = FINE) -> None:
    for _ in range(cycles):
        loop.advance(answer, at_rest=True)


def advance_to(loop: LoopProgram, phase: Phase) -> None:
    for _ in range(100):
        if loop.phase is phase:
            return
        advance(loop)
    raise AssertionError(f"{phase!r} never came; stuck in {loop.phase!r}")


def test_a_warm_start_begins_with_init() -> None:
    loop = program(cold_start=False)
    assert loop.start_step is StartStep.INIT
    advance(loop)
    assert loop.phase is Phase.DRIVE_OFF


def test_an_init_packet_that_nobody_answers_ends_the_session() -> None:
    loop = program(cold_start=False)
    advance(loop, answer=MISSING)
    assert loop.phase is Phase.ENDED
    assert "init" in loop.reason


def test_phases_last_as_long_as_set() -> None:
    loop = program()
    advance_to(loop, Phase.DRIVE_OFF)
    phases = []
    while loop.phase is not Phase.OPENING:
        phases.append(loop.phase)
        advance(loop)
    assert phases == [Phase.DRIVE_OFF] * 2 + [Phase.DRIVING_ON] * 3 + [Phase.CLOSED] * 2


def test_one_axis_opens_alone() -> None:
    """The others stay closed, and the PC has the arm as soon as that axis is open."""
    loop = program(only_axis=2)
    advance_to(loop, Phase.OPEN)
    assert loop.open_axes == [False, True, False]
    assert loop.intervals == 1
    with pytest.raises(SettingError, match="only_axis"):
        program(only_axis=4)


def test_axes_open_one_after_the_other() -> None:
    loop = program()
    advance_to(loop, Phase.OPENING)
    seen = []
    while loop.phase is Phase.OPENING:
        seen.append(loop.open_axes)
        advance(loop)
    assert seen == [
        [True, False, False],
        [True, False, False],
        [True, True, False],
        [True, True, False],
        [True, True, True],
    ]
    assert loop.phase is Phase.OPEN
    assert loop.intervals == 1


def lose_opening(loop: LoopProgram) -> None:
    advance_to(loop, Phase.OPENING)
    while loop.phase is Phase.OPENING:
        advance(loop, answer=MISSING)


def test_after_a_lost_opening_the_axes_stay_closed_for_a_while() -> None:
    loop = program(reopening_time=0.05)
    advance_to(loop, Phase.OPENING)
    assert loop.openings_lost == 0
    lose_opening(loop)
    phases = []
    while loop.phase is not Phase.OPENING:
        phases.append(loop.phase)
        advance(loop)
    assert phases == [Phase.CLOSED] * 50
    advance_to(loop, Phase.OPEN)
    advance(loop, answer=Answer(valid=True, exit=True))
    phases = []
    while loop.phase is not Phase.OPENING:
        phases.append(loop.phase)
        advance(loop)
    assert phases == [Phase.CLOSING] * 2 + [Phase.CLOSED] * 2


def test_after_so_many_lost_openings_in_a_row_the_session_ends_with_a_reason() -> None:
    loop = program(lost_openings=3)
    for lost in (1, 2, 3):
        assert not loop.gave_up
        lose_opening(loop)
        assert loop.openings_lost == lost
    assert loop.gave_up
    advance_to(loop, Phase.ENDED)
    assert loop.reason == (
        "open mode was lost 3 times in a row: no valid reply in 1 cycle of open mode"
    )


def test_openings_that_end_by_508_are_lost_like_any_other() -> None:
    """With a pause before the next, and an end of the session after so many."""
    loop = program(lost_openings=3, reopening_time=0.05)
    for lost in (1, 2, 3):
        advance_to(loop, Phase.OPEN)
        advance(loop, answer=Answer(valid=True, following_error=True))
        assert loop.openings_lost == lost
        if lost < 3:
            closed = 0
            while loop.phase is not Phase.OPENING:
                closed += 1
                advance(loop)
            assert closed == 50
    assert loop.gave_up
    assert loop.reason == (
        "open mode was lost 3 times in a row: the PC reported a following error (508)"
    )


def test_an_opening_that_the_pc_ends_makes_the_lost_ones_forgotten() -> None:
    loop = program(lost_openings=2)
    for _ in range(5):
        lose_opening(loop)
        advance_to(loop, Phase.OPEN)
        advance(loop, answer=Answer(valid=True, exit=True))
        assert loop.openings_lost == 0
    assert not loop.gave_up


def test_finish_does_not_wait_for_the_next_opening() -> None:
    loop = program(reopening_time=1.0)
    lose_opening(loop)
    loop.finish()
    advance(loop, 3)
    assert loop.phase is Phase.SHUTDOWN


def test_an_emergency_stop_while_giving_up_still_ends_the_session() -> None:
    loop = program(lost_openings=1)
    lose_opening(loop)
    loop.trip("emergency stop")
    advance_to(loop, Phase.ENDED)
    assert loop.gave_up


def test_replies_missed_before_open_mode_are_told_from_those_in_it() -> None:
    loop = program(missed_replies=5)
    advance_to(loop, Phase.CLOSED)
    while loop.phase is not Phase.OPENING:
        advance(loop, answer=MISSING)
    while loop.phase is Phase.OPENING:
        advance(loop, answer=MISSING)
    assert loop.reason == "no valid reply in 5 cycles in a row, the last 3 of them in open mode"


def test_long_silence_ends_the_session() -> None:
    loop = program(silence_limit=20)
    advance_to(loop, Phase.CLOSED)
    for _ in range(30):
        advance(loop, answer=MISSING)
    assert loop.phase is Phase.ENDED


def test_a_trip_in_open_mode_drops_the_drive_before_the_modes() -> None:
    loop = program()
    advance_to(loop, Phase.OPEN)
    loop.trip("test")
    assert not loop.powered
    assert loop.braked
    assert all(loop.open_axes)
    advance(loop, 2)
    assert loop.phase is Phase.DRIVE_OFF
    assert not any(loop.open_axes)


def test_leaving_while_axes_are_opening_opens_no_further_axis() -> None:
    for leave in ("trip", "exit"):
        loop = program()
        advance_to(loop, Phase.OPENING)
        if leave == "trip":
            loop.trip("test")
        else:
            advance(loop, answer=Answer(valid=True, exit=True))
        assert loop.open_axes == [True, False, False]
        advance(loop, 2)
        assert not any(loop.open_axes)


def test_finish_waits_until_the_arm_stands() -> None:
    loop = program()
    advance_to(loop, Phase.OPEN)
    loop.finish()
    loop.advance(FINE, at_rest=False)
    assert loop.phase is Phase.OPEN
    loop.advance(FINE, at_rest=True)
    assert loop.phase is Phase.CLOSING
    phases = []
    while loop.phase is not Phase.ENDED:
        phases.append(loop.phase)
        advance(loop)
    assert phases[-3:] == [Phase.SHUTDOWN, Phase.SHUTDOWN, Phase.ENDING]


def test_the_program_ends_by_itself_after_its_intervals() -> None:
    loop = program(open_intervals=1)
    advance_to(loop, Phase.OPEN)
    advance(loop, answer=Answer(valid=True, exit=True))
    advance_to(loop, Phase.ENDED)
    assert loop.intervals == 1


def test_finish_in_drive_off_ends_without_driving_on() -> None:
    loop = program()
    advance_to(loop, Phase.DRIVE_OFF)
    loop.finish()
    advance(loop, 3)
    assert loop.phase is Phase.ENDED


@pytest.mark.parametrize(
    "change",
    [
        {"lost_openings": 0},
        {"reopening_time": -1.0},
        {"period": 0.0005},
        {"substeps": 0},
        {"missed_replies": 0},
        {"open_mode": 3},
    ],
)
def test_impossible_settings_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(SettingError):
        ControllerSettings(**change)
