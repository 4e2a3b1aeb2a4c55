"""Long work says how far it is: bars on a terminal, lines elsewhere, nothing when quiet."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from hil.progress import Bar, LineReporter, Silent, reporter


def test_lines_come_every_tenth_of_the_way(capsys: pytest.CaptureFixture[str]) -> None:
    plain = LineReporter()
    with plain.task("smoothing", 40) as task:
        for k in range(40):
            task.advance(1, f"file {k}")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "smoothing"
    assert len(lines) == 11
    assert lines[1] == "smoothing: 10 %  file 3"
    assert lines[-1] == "smoothing: 100 %  file 39"


def test_a_bar_shows_the_note_and_the_time_left() -> None:
    screen = io.StringIO()
    bar = Bar(Console(file=screen, force_terminal=True, width=140))
    with bar.task("running", 10) as task:
        task.advance(4, "excitation 3")
        bar.say("a line [above] the bar")
    shown = screen.getvalue()
    assert "a line [above] the bar" in shown
    assert "running" in shown
    assert "left" in shown


@pytest.mark.parametrize("title", ["designing (motions)", "running the campaign (s of motion)"])
def test_eighty_columns_hold_count_times_and_note(title: str) -> None:
    screen = io.StringIO()
    bar = Bar(Console(file=screen, force_terminal=True, width=80, color_system=None))
    note = "generation 112 of 120, log det 104.1, I_c 80.1"
    with bar.task(title, 23000) as task:
        task.advance(11500, note)
    lines = [line.rstrip() for line in screen.getvalue().splitlines()]
    (shown,) = [line for line in lines if "11500/23000" in line]
    assert title in shown and "0:00:0" in shown and " left " in shown and "━" in shown
    assert note in lines


def test_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    quiet = reporter(quiet=True)
    assert isinstance(quiet, Silent)
    quiet.say("nothing")
    with quiet.task("nothing", 1) as task:
        task.advance(1)
    assert capsys.readouterr().out == ""


def test_what_is_no_terminal_gets_lines() -> None:
    assert isinstance(reporter(), LineReporter)
