"""The screen of a run: what it shows at any size, and what keys of a real terminal do."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from drivers.states import State
from hil.base.progress import Bar, LineReporter, Silent, reporter
from hil.base.progress_lines import ProgressLines
from hil.campaign import screen as layout
from hil.campaign.operator import RunStatus
from hil.campaign.operator_keys import Keyboard, after, single_keys, typed
from hil.campaign.screen import Screen, ScreenError
from hil.cell import Cell
from hil.cell.schema import CanTable
from hil.control.motion_watch import MotionProgress, OperatorRequest, Stop
from sim_fixtures.ns16 import CELL_PATH
from tests.hil import screen_rig
from tests.hil.screen_rig import Terminal, on_terminal

pytestmark = pytest.mark.long

NAMES = tuple(f"joint_{number}" for number in range(1, 7))


def status(**changes: Any) -> RunStatus:
    """A repetition in the middle, with something of everything."""
    motion = {
        "motion_time": 6.2, "duration": 18.6, "cycles": 123456, "missed": 2, "late": 1,
        "late_packets": 3,
        "not_accepted": 0, "state": State.OPEN,
        "following_error": np.radians([0.0, 0.15, -0.2, 0.01, -0.02, 1.01]),
        "following_share": np.array([0.0, 0.31, 0.85, 0.02, 0.04, 1.3]),
        "current": np.array([2.3, -7.1, 5.0, 0.2, -0.3, 1.1]),
        "current_share": np.array([0.11, 0.72, 0.88, 0.02, 0.05, 0.3]),
        "override": 0.8, "rate": 0.75,
    }  # fmt: skip
    return RunStatus("repetition", 7, 30, 1145.0, MotionProgress(**(motion | changes)))


def screen_of(at: RunStatus | None, title: str = "x") -> Screen:
    screen = Screen(NAMES, Stop(), title=title, controller="10.2.12.150", quiet=True)
    if at is not None:
        screen.show(at)
    return screen


def screen_lines(width: int, height: int, screen: Screen) -> list[str]:
    console = Console(width=width, height=height, file=StringIO(), color_system=None)
    rendered = console.render_lines(screen.picture(), console.options, pad=False)
    return ["".join(segment.text for segment in line) for line in rendered]


class TestPicture:
    def test_80_by_24_show_everything(self) -> None:
        screen = screen_of(status())
        screen._messages.append("repetition 5 rejected: its current differs")
        screen._keyboard = Keyboard(str)
        screen._keyboard.attached = True
        rows = screen_lines(80, 24, screen)
        text = "\n".join(rows)
        for phrase in (
            "10.2.12.150", "repetition 7 of 30", "19:05 left", "6.2 of 18.6 s",
            "override 80 %", "now 75 %",
            "cycles 123456, packets 2 missed, 3 late; replies 1 late, 0 not accepted",
            "repetition 5 rejected: its current differs", layout.HELP,
        ):  # fmt: skip
            assert phrase in text
        (second,) = [line for line in rows if line.startswith("joint_2")]
        assert second.split() == ["joint_2", "0.150°", "31", "%", "-7.10", "A", "72", "%"]
        line = layout.status_line(status())
        for phrase in (
            "repetition 7 of 30", "6.2 of 18.6 s", "override 80 %", "2 missed", "1 late",
            "following error 130 % of its limit", "current 88 % of its limit", ", 19:05 left",
        ):  # fmt: skip
            assert phrase in line

    @pytest.mark.parametrize(("width", "height"), [(20, 3), (80, 24), (300, 60)])
    def test_fits_the_terminal(self, width: int, height: int) -> None:
        names = ("following_error", "following_share", "current", "current_share")
        nothing = status(**dict.fromkeys(names))
        for at in (status(), nothing, RunStatus("move", 1, 3, 1.0), None):
            rows = screen_lines(width, height, screen_of(at, "a title that is long " * 4))
            assert len(rows) == height
            assert max(map(len, rows)) <= width
            assert rows[-1].startswith("Ctrl-C")

    def test_a_refusal_stands_out_of_the_messages(self) -> None:
        screen = screen_of(status())
        screen._messages += ["REFUSED: velocity of joint_1", "another line"]
        console = Console(width=80, height=24, file=StringIO())
        rows = console.render_lines(screen.picture(), console.options)
        styles = {part.text.strip(): str(part.style) for row in rows for part in row}
        assert styles["REFUSED: velocity of joint_1"] == "bold red"
        assert styles["another line"] == "dim"

    def test_shows_stop_hold_and_silence(self) -> None:
        held, stopping, silent = (screen_of(status()) for _ in range(3))
        held.press("h")
        stopping.press("s")
        silent._came -= 30.0
        for screen, state_text in (
            (held, "HELD"),
            (stopping, "STOPPING"),
            (silent, "no news for 3"),
        ):
            assert state_text in screen_lines(80, 24, screen)[1]

    def test_a_drive_that_is_off_has_no_following_error(self) -> None:
        names = ("following_error", "following_share", "current", "current_share")
        off = status(position=np.zeros(6), **dict.fromkeys(names))
        lines = screen_lines(80, 24, screen_of(off))
        joints = [line.split() for line in lines if line.startswith("joint_")]
        assert joints == [[name, "-", "-", "-", "-"] for name in NAMES]

    def test_after_a_silence_it_shows_why_the_run_waits(self) -> None:
        screen = screen_of(status())
        assert any("open" in line for line in screen_lines(80, 24, screen))
        screen.say("waiting for the controller")
        screen._came -= 30.0
        lines = screen_lines(80, 24, screen)
        assert "no news for 30 s: waiting for the controller" in lines[1]
        assert not any("open" in line or line.startswith("joint_") for line in lines[:-1])

    def test_between_two_motions_an_older_message_is_no_reason(self) -> None:
        screen = screen_of(status())
        screen.say("not checked for collisions: link_1 and link_2")
        screen.show(RunStatus("repetition", 7, 30, 1145.0))
        screen._came -= 30.0
        line = screen_lines(80, 24, screen)[1]
        assert "no motion for 30 s" in line
        assert "collisions" not in line

    def test_between_two_motions_it_shows_the_next_override(self) -> None:
        screen = screen_of(RunStatus("dry run", 1, 2, 60.0, most=0.2))
        assert "override 20 %" in screen_lines(80, 24, screen)[1]
        screen.press("-")
        assert screen.request().override == pytest.approx(0.1)
        assert "override 10 %" in screen_lines(80, 24, screen)[1]

    def test_names_the_controller(self) -> None:
        cell = Cell.load(CELL_PATH)
        can = CanTable(interface="socketcan", channel="can0")
        for changed, name in (
            (cell, "SIMULATED"),
            (cell.with_link(transport="udp", host="127.0.0.1"), "SIMULATED"),
            (cell.with_link(transport="udp"), "10.2.12.150"),
            (cell.with_link(transport="can", can=can), "socketcan:can0"),
        ):
            screen = Screen.of(changed, Stop(), quiet=True)
            assert name in screen_lines(120, 24, screen)[0]


# --- keys ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "override", "held"),
    [
        ("h", 1.0, True), ("hr", 1.0, False), ("h ", 1.0, False), ("-", 0.9, False),
        ("---", 0.7, False), ("-+", 1.0, False), ("+", 1.0, False), ("3", 0.3, False),
        ("1-", 0.1, False), ("10", 1.0, False), ("5h", 0.5, True), ("x", 1.0, False),
        ("\x1b", 1.0, True),
    ],
)  # fmt: skip
def test_keys_change_the_request(keys: str, override: float, held: bool) -> None:
    request = OperatorRequest()
    for key in keys:
        request = after(request, key, request.override)
    assert request.override == pytest.approx(override)
    assert request.held is held


@pytest.mark.parametrize(
    ("sent", "keys"),
    [
        # arrows, function keys and pasted text
        ("\x1b[A\x1b[1;5C\x1bOP\x1b[1;", ""), ("\x1b[15~-", "-"), ("0000000", ""),
        ("ssh host 1", "sshhs"),
        # Esc is a key, also before another
        ("\x1b", "\x1b"), ("\x1bs", "\x1bs"), ("\x1b\x1b[A", "\x1b"), ("\x1b[A\x1bs", "\x1bs"),
        # where no other key moves the arm on
        ("\x1b ", "\x1b"), ("\x1br", "\x1b"), ("\x1b3", "\x1b"), ("\x1bh", "\x1bh"),
    ],
)  # fmt: skip
def test_sequences_and_pasted_text_are_no_keys(sent: str, keys: str) -> None:
    assert typed(sent) == keys


def test_the_override_of_a_dry_run_ends_with_it() -> None:
    """One that is set in the move after it stays: the operator lowers the speed of what follows."""
    screen = Screen(NAMES, Stop(), quiet=True)
    screen.show(RunStatus("dry run", 1, 1, 1.0))
    screen.press("1")
    screen.press("h")
    screen.show(RunStatus("move", 1, 1, 1.0))
    screen.press("h")
    assert screen.request() == OperatorRequest(0.1, held=True)
    screen.show(RunStatus("warm-up", 1, 1, 1.0))
    assert screen.request() == OperatorRequest(1.0, held=True)
    screen.press("5")
    screen.show(RunStatus("repetition", 1, 4, 1.0))
    assert screen.request().override == 0.5
    for phase in ("dry run", "move", "repetition"):
        screen.show(RunStatus(phase, 1, 4, 1.0))
        if phase == "move":
            screen.press("2")
    assert screen.request().override == 0.2
    # Resumed at 20 % by the run, one key lowers it to 10 %, not to 90 %.
    screen = Screen(NAMES, Stop(), quiet=True)
    screen.show(status(override=0.2))
    screen.press("-")
    assert screen.request().override == pytest.approx(0.1)


# --- a real terminal -------------------------------------------------------------------------


class Rig:
    """`screen_rig.py` on a terminal."""

    def __init__(self, end: Terminal, file: Path) -> None:
        self._end = end
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._end, name)

    def await_reported(
        self, ready: Callable[[list[dict[str, object]]], bool], typing: str = ""
    ) -> None:
        """Wait until what the program received is as wanted; type again what it discarded."""
        again = time.monotonic() + 0.1
        until = time.monotonic() + 30.0
        while not ready(self.reported()):
            assert time.monotonic() < until, self.reported()
            if typing and time.monotonic() >= again:
                again += 3.0
                self.press(typing)
            self.look()

    def await_request(self, **expected: object) -> None:
        self.await_reported(lambda lines: bool(lines) and lines[-1] == expected)

    def reported(self) -> list[dict[str, object]]:
        text = self._file.read_text() if self._file.exists() else ""
        return [json.loads(line) for line in text.splitlines()]


@contextlib.contextmanager
def terminal(folder: Path, ending: str = "return") -> Iterator[Rig]:
    with on_terminal(screen_rig.__file__, folder / "reported", ending) as end:
        yield Rig(end, folder / "reported")


ENTER = b"\x1b[?1049h"
LEAVE = b"\x1b[?1049l"


def test_keys_arrive_and_the_screen_survives_a_resize(tmp_path: Path) -> None:
    with terminal(tmp_path) as end:
        end.await_request(override=1.0, held=False)
        end.await_seen(b"repetition 3 of 30")
        assert ENTER in end.seen
        end.press("h")
        end.await_request(override=1.0, held=True)
        end.await_seen(b"HELD")
        end.press(" ")
        end.await_request(override=1.0, held=False)
        end.press("-")
        end.await_request(override=0.9, held=False)
        end.press("3")
        end.await_request(override=0.3, held=False)
        end.press("\x1b[A")  # an arrow
        end.press("\x1a")  # Ctrl-Z would take the program's signs of life away
        end.resize(40, 10)
        end.press("+")
        end.await_request(override=0.4, held=False)
        end.clear()
        end.await_seen(b"h hold")
        end.press("s")
        assert end.end() == 0
        assert end.reported()[-1] == {"stop": True}
        assert LEAVE in end.seen
        assert end.seen.rindex(b"the last line") > end.seen.rindex(LEAVE)
        assert termios.tcgetattr(end.far) == end.before


@pytest.mark.parametrize(
    ("ending", "signum", "code"),
    [
        ("error", None, 1),
        ("return", signal.SIGTERM, 0),
        pytest.param("exit", None, 7, marks=pytest.mark.slow),
        pytest.param("return", signal.SIGINT, 0, marks=pytest.mark.slow),
        pytest.param("return", signal.SIGHUP, 0, marks=pytest.mark.slow),
    ],
)
def test_the_terminal_is_restored_at_every_end(
    tmp_path: Path, ending: str, signum: signal.Signals | None, code: int
) -> None:
    with terminal(tmp_path, ending) as end:
        end.await_seen(b"repetition 3 of 30")
        assert termios.tcgetattr(end.far) != end.before
        if signum is None:
            end.press("s")
        else:
            end.process.send_signal(signum)
        assert end.end() == code
        assert termios.tcgetattr(end.far) == end.before
        assert end.seen.count(ENTER) == end.seen.count(LEAVE) == 1


@pytest.mark.parametrize(
    ("ending", "asked", "replies"),
    [
        ("question", b"Type yes to accept", ("y\n", "\n", "yes\n")),
        ("contradiction", b"type joint_2 to accept", ("yes\n", "joint_1\n", "joint_2\n")),
    ],
)
def test_a_dry_run_is_accepted_by_one_word_only(
    tmp_path: Path, ending: str, asked: bytes, replies: tuple[str, ...]
) -> None:
    """By yes, or by the names of the joints whose torque contradicts their weight."""
    with terminal(tmp_path, ending) as end:
        for number, answer in enumerate(replies, start=1):
            end.await_seen(asked)
            assert (b"joint_2: measured torque runs against" in end.seen) is (ending != "question")
            end.clear()
            end.await_reported(lambda lines, number=number: len(lines) >= number, answer)
        end.await_seen(b"repetition 3 of 30")  # the screen is back
        end.press("s")
        assert end.end() == 0
        assert [line["accepted"] for line in end.reported()[:3]] == [False, False, True]


def test_a_blocked_terminal_delays_no_stop(tmp_path: Path) -> None:
    with terminal(tmp_path) as end:
        end.await_seen(b"repetition 3 of 30")
        end.reads = False
        time.sleep(1.5)  # some hundred kB of pictures later it blocks
        end.process.send_signal(signal.SIGTERM)
        until = time.monotonic() + 3.0
        while {"stop": True} not in end.reported():
            assert time.monotonic() < until, "the stop was not seen"
            time.sleep(0.02)


def test_split_key_sequences_are_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a slow line the parts of an arrow come one by one; none of them is a key."""
    monkeypatch.setattr(
        "hil.campaign.operator_keys._ESCAPE_TIMEOUT", 5.0
    )  # this machine may be slow, too
    near, far = pty.openpty()
    pressed: list[str] = []
    keyboard = Keyboard(pressed.append)
    reader = threading.Thread(target=keyboard.read, args=(far,))
    before = termios.tcgetattr(far)
    with single_keys(far):
        reader.start()
        for part in ("\x1b", "[1;", "5C", "s"):
            os.write(near, part.encode())
            time.sleep(0.005)
        until = time.monotonic() + 5.0
        while "s" not in pressed and time.monotonic() < until:
            time.sleep(0.01)
        keyboard.over.set()
        reader.join()
    assert pressed == ["s"]
    assert termios.tcgetattr(far) == before
    os.close(near)
    os.close(far)


@pytest.mark.parametrize("what", ["a key that fails", "the terminal is gone"])
def test_keys_that_are_not_read_any_more_are_reported(what: str) -> None:
    near, far = os.pipe()
    screen = Screen(NAMES, Stop(), quiet=True)
    screen._keyboard = keyboard = Keyboard(broken)
    keyboard.attached = True
    if what == "a key that fails":
        os.write(far, b"h")
    os.close(far)
    keyboard.read(near)
    os.close(near)
    assert not keyboard.attached
    with pytest.raises(ScreenError, match=r"no key|terminal is gone"):
        screen.request()


def broken(_: str) -> None:
    raise KeyError("no key")


def test_a_failing_picture_ends_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(layout, "status_line", lambda *_: 1 / 0)
    with Screen(NAMES, Stop(), console=Console(file=StringIO())) as screen:
        until = time.monotonic() + 5.0
        with pytest.raises(ScreenError, match="ZeroDivisionError"):
            while time.monotonic() < until:
                screen.show(status())
                time.sleep(0.01)
        assert screen.request() == OperatorRequest()


# --- no terminal -----------------------------------------------------------------------------


def test_without_a_terminal_there_are_lines_or_none() -> None:
    out = StringIO()
    with Screen(NAMES, Stop(), console=Console(file=out, width=200)) as screen:
        assert not screen.can_answer
        screen.say("first [things] first")
        screen.show(status())
        await_text(out, "repetition 7 of 30")
        assert screen.request() == OperatorRequest()
    assert out.getvalue().splitlines()[0] == "first [things] first"
    assert "\x1b" not in out.getvalue()
    assert out.getvalue().count("repetition 7 of 30") == 1  # not ten a second
    out = StringIO()
    with Screen(NAMES, Stop(), quiet=True, console=Console(file=out)) as screen:
        screen.say("nothing")
        screen.show(status())
        time.sleep(0.3)
    assert out.getvalue() == ""


def test_piped_output_has_messages_apart_from_progress(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Screen(NAMES, Stop()) as screen:
        screen.say("the cell is open")
        screen.show(status())
        time.sleep(0.3)
    printed = capsys.readouterr()
    assert printed.out == "the cell is open\n"
    (line,) = printed.err.splitlines()
    assert line.startswith("repetition 7 of 30, ")


def test_progress_is_shown_on_a_terminal_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`hil ... > file` at a terminal: messages in the file, progress on the terminal."""
    piped = reporter()
    with piped.task("fitting", 10) as task:
        task.advance(10)
        piped.step("rehearsing")
        piped.say("written to runs")
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("written to runs\n", "")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    shown = reporter()
    with shown.task("fitting", 10) as task:
        task.advance(10)
        shown.step("rehearsing")
        shown.say("written to runs")
    with Screen(NAMES, Stop()) as screen:
        screen.say("the cell is open")
        screen.show(status())
        time.sleep(0.3)
    printed = capsys.readouterr()
    assert printed.out == "written to runs\nthe cell is open\n"
    assert "fitting" in printed.err and "rehearsing" in printed.err
    assert "repetition 7 of 30" in printed.err.replace("\n", " ")


def test_a_full_pipe_blocks_nothing() -> None:
    reads, writes = os.pipe()
    fcntl.fcntl(writes, fcntl.F_SETPIPE_SZ, 4096)
    with os.fdopen(writes, "w", buffering=1) as file:
        began = time.monotonic()
        with Screen(NAMES, Stop(), console=Console(file=file, width=200)) as screen:
            for number in range(100):
                screen.say(f"{number} " + "x" * 180)
                screen.show(status())
        assert time.monotonic() - began < 3.0
        with os.fdopen(reads, "rb") as pipe:
            threading.Thread(target=pipe.read, daemon=True).start()
            file.close()


def await_text(out: StringIO, phrase: str) -> None:
    until = time.monotonic() + 5.0
    while phrase not in out.getvalue():
        assert time.monotonic() < until
        time.sleep(0.02)


# Progress of long work: bars on a terminal, lines elsewhere, nothing when quiet.


def test_lines_come_every_tenth_of_the_way(capsys: pytest.CaptureFixture[str]) -> None:
    lines_only = LineReporter()
    with lines_only.task("smoothing", 40) as task:
        for k in range(40):
            task.advance(1, f"file {k}")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "smoothing"
    assert len(lines) == 11
    assert lines[1] == "smoothing: 10 %  file 3"
    assert lines[-1] == "smoothing: 100 %  file 39"


def test_eighty_columns_hold_count_times_and_note() -> None:
    screen = StringIO()
    title = "running the campaign (s of motion)"
    bar = Bar(Console(file=screen, force_terminal=True, width=80, color_system=None))
    note = "generation 112 of 120, log det 104.1, I_c 80.1"
    with bar.task(title, 23000) as task:
        task.advance(11500, note)
        bar.say("a line [above] the bar")
    assert "a line [above] the bar" in screen.getvalue()
    lines = [line.rstrip() for line in screen.getvalue().splitlines()]
    (shown,) = [line for line in lines if "11500/23000" in line]
    assert title in shown and "0:00:0" in shown and " left " in shown and "━" in shown
    assert note in lines


class TestProgressLines:
    """Progress without a terminal."""

    def lines(self, capsys: pytest.CaptureFixture[str], *moments: float) -> list[str]:
        """Lines of a command that designs; no thread looks, but the test."""
        plain = ProgressLines()
        plain._looking = True
        with plain.stage("hil design", is_command=True), plain.stage("designing", 100.0) as stage:
            for done, moment in enumerate(moments, 1):
                stage.done = done
                stage.note = f"motion {done}"
                plain.look(stage.began + moment)
        captured = capsys.readouterr()
        assert captured.out == "", "results alone"
        return captured.err.splitlines()

    def test_a_stage_is_named_unless_it_is_over_at_once(self, capsys) -> None:
        assert self.lines(capsys, 0.1, 0.9) == []
        assert self.lines(capsys, 0.1, 1.1) == ["designing: 2 %, motion 2"]

    def test_silence_lasts_at_most_thirty_seconds(self, capsys) -> None:
        lines = self.lines(capsys, *range(1, 100))
        assert len(lines) == 4
        assert lines[1] == "designing: 31 %, about 1:09 min left, motion 31"

    def test_a_command_without_stages_is_named_after_thirty_seconds(self, capsys) -> None:
        plain = ProgressLines()
        plain._looking = True
        with plain.stage("hil look", is_command=True) as stage:
            for moment in (2.0, 29.0, 31.0, 40.0, 65.0):
                plain.look(stage.began + moment)
        said = ["hil look, 31 s so far", "hil look, 1:05 min so far"]
        assert capsys.readouterr().err.splitlines() == said

    def test_a_thread_looks_while_there_are_stages(self, capsys) -> None:
        plain = ProgressLines()
        plain.step("rehearsing")
        with plain.stage("reading", 1.0):
            time.sleep(1.7)
        assert capsys.readouterr().err.splitlines() == ["rehearsing; reading"]
        until = time.monotonic() + 5.0
        while plain._looking:
            assert time.monotonic() < until
            time.sleep(0.05)


def test_quiet_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    quiet = reporter(quiet=True)
    assert isinstance(quiet, Silent)
    quiet.say("nothing")
    with quiet.task("nothing", 1) as task:
        task.advance(1)
    assert capsys.readouterr().out == ""
    assert isinstance(reporter(), LineReporter)
