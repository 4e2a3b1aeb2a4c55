"""`hil simulate`: the controller's end of a real link, for somebody else's PC program."""

from __future__ import annotations

import os
import time
from dataclasses import fields, replace
from pathlib import Path
from select import select
from typing import Annotated, Any, Final, Literal

import typer

from drivers.transports.faults import FaultyLink
from hil.cell import Cell
from hil.cli.arguments import JsonOption, print_json
from hil.errors import InputError
from hil.move import joint_index
from hil.serving import Served, buttons, open_far_end, serve_session, undisturbed
from hil.simulation import controller_settings, own_postures, simulated_controller
from hil.terminal_text import printable
from sim_fixtures import ControllerSettings, SimulatedController
from sim_fixtures.errors import SettingError
from sim_fixtures.faults import Fault, FaultScriptError, parse_fault, split_faults
from sim_fixtures.program import Phase
from sim_fixtures.serve import PATIENCE, Histogram, Tally

REFRESH: Final = 0.25
WIDTH: Final = 110

WORDS: Final = {
    Phase.START: "starting: sync and init packets",
    Phase.DRIVE_OFF: "drive off",
    Phase.DRIVING_ON: "driving on (501)",
    Phase.CLOSED: "drive on, axes closed (mode 0)",
    Phase.MOVING: "the controller's own program moves the arm (mode 0)",
    Phase.PAUSED: "pause",
    Phase.OPENING: "axes opening",
    Phase.OPEN: "all axes open: the PC moves the arm",
    Phase.CLOSING: "the PC asked for the end of open mode",
    Phase.TRIPPED: "drive lost",
    Phase.SHUTDOWN: "switching off",
    Phase.ENDING: "end of session (504)",
    Phase.ENDED: "ended",
}


_REPEATED: Final = frozenset({Phase.CLOSED, Phase.OPENING, Phase.OPEN})
"""Phases that an opening lost again and again goes through."""


class Status:
    """One line for each change of phase and, on a terminal, one that is written over.

    Where open mode is lost again and again, one line for the 2nd, 4th, 8th ... time.

    A line is written only if the terminal or pipe can take it at once; a reader that has stopped
    reading loses lines, the PC program loses nothing.

    Args:
        place: where the PC program is expected.
        settings: of the controller.
        quiet: say nothing.
        stretch: s by which a cycle may be made longer to wait for its answer.
        descriptor: file descriptor to write to.
    """

    def __init__(
        self,
        place: str,
        settings: ControllerSettings,
        *,
        quiet: bool,
        stretch: float = 0.0,
        descriptor: int = 1,
    ) -> None:
        self._stretch = stretch
        self._place = place
        self._settings = settings
        self._quiet = quiet
        self._out = descriptor
        self._terminal = not quiet and os.isatty(descriptor)
        self._began = time.monotonic()
        self._refresh_at = 0.0
        self._phase: Phase | None = None
        self._reason = ""
        self._cycles = -1

    def introduce(self, name: str) -> None:
        """Say what this is, and what it is not."""
        settings = self._settings
        self.say(
            f"{name}: a SIMULATED controller for {self._place}; nothing moves.\n"
            f"cycle {1e3 * settings.period:g} ms, mode {settings.open_mode}, "
            f"{'cold' if settings.cold_start else 'warm'} start, open mode ends after "
            f"{settings.missed_replies} missing "
            f"{'reply' if settings.missed_replies == 1 else 'replies'}, process {os.getpid()}"
            + (
                f"\ncycles are made longer by up to {self._stretch:g} s to wait for an answer; "
                "no real controller does that"
                if self._stretch
                else ""
            )
        )

    def watch(self, controller: SimulatedController, tally: Tally) -> None:
        """Show what has changed since the last cycle."""
        if self._quiet:
            return
        phase = controller.phase
        if phase is not self._phase or tally.cycles < self._cycles:
            self._phase = phase
            self._say_change(controller)
        self._cycles = tally.cycles
        if self._terminal and (now := time.monotonic()) >= self._refresh_at:
            self._refresh_at = now + REFRESH
            self._write("\r\x1b[K" + self._line(tally)[:WIDTH])

    def say(self, text: str) -> None:
        """Write a line that stays."""
        if not self._quiet:
            self._write(("\r\x1b[K" if self._terminal else "") + text + "\n")

    def clear(self) -> None:
        """Take the line that is written over away."""
        if self._terminal:
            self._write("\r\x1b[K")

    def _say_change(self, controller: SimulatedController) -> None:
        lost = controller.openings_lost
        if lost <= 1 or controller.gave_up or controller.phase not in _REPEATED:
            self.say(self._change(controller))
        elif controller.phase is Phase.CLOSED and lost.bit_count() == 1:
            self.say(
                f"{self._seconds()}  open mode was lost again, {lost} times in a row by now: "
                f"{controller.reason}"
            )

    def _seconds(self) -> str:
        return f"{time.monotonic() - self._began:8.3f} s"

    def _change(self, controller: SimulatedController) -> str:
        text = f"{self._seconds()}  {WORDS[controller.phase]}"
        if controller.phase is Phase.OPENING:
            text += f" in mode {self._settings.open_mode}"
        if controller.reason and controller.reason != self._reason:
            text += f": {controller.reason}"
        self._reason = controller.reason
        return text

    def _line(self, tally: Tally) -> str:
        if not tally.cycles:
            return f"waiting for a PC program at {self._place} (asked {tally.knocks} times)"
        return (
            f"{tally.cycles} cycles, {tally.replies} replies, {tally.missed} missed, "
            f"{tally.late} late, {tally.rejected} rejected, {tally.own_late} begun late by us"
            + (f", {tally.stretched} stretched" if self._stretch else "")
        )

    def _write(self, text: str) -> None:
        if not select([], [self._out], [], 0.0)[1]:
            return
        try:
            os.write(self._out, text.encode())
        except OSError:
            self._quiet = True  # nobody reads any more


OWN_MOVE: Final = 30.0
"""Seconds that the longest move of the controller's own may take to end."""
LOST_OPENINGS: Final = 20
"""Openings in a row that may be lost to missing replies; then the session ends."""
REOPENING: Final = 1.0
"""Seconds at least until the axes open again after such a loss."""

CellArgument = Annotated[
    Path, typer.Argument(help="Cell file with a [simulation] table.", show_default=False)
]
Udp = Annotated[
    str | None,
    typer.Option(metavar="HOST:PORT", help="Where the PC program listens.", show_default=False),
]
Can = Annotated[
    str | None,
    typer.Option(
        metavar="INTERFACE:CHANNEL[:fd|classic]",
        help="A CAN bus instead, by its python-can names, e.g. socketcan:can0.",
        show_default=False,
    ),
]
Cycle = Annotated[
    int | None, typer.Option(min=1, max=2, help="Cycle in ms; the cell's if left out.")
]
Mode = Annotated[
    int | None,
    typer.Option(help="Open mode: 1, 2, 4, 5, 7, 8 or 9; the cell's if left out."),
]
Stagger = Annotated[
    int, typer.Option(min=0, help="Cycles between one axis entering open mode and the next.")
]
OnlyAxis = Annotated[
    int | None,
    typer.Option("--only-axis", min=1, help="Open this axis only; the others stay closed."),
]
Missed = Annotated[
    int, typer.Option(min=1, help="Missing replies in a row that end open mode (real: unknown).")
]
WhileSilent = Annotated[
    Literal["hold", "continue", "drive-off"],
    typer.Option(help="What the arm does in a cycle of open mode that no reply came in."),
]
Intervals = Annotated[
    int | None,
    typer.Option(min=1, help="Intervals of open mode until the session ends; endless if left out."),
]
FaultOption = Annotated[
    list[str] | None,
    typer.Option("--fault", metavar="SPEC", help="Something that goes wrong; may be repeated."),
]
Patience = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=10.0,
        help="Make a cycle longer by up to so many seconds until its answer comes. No real "
        "controller does: for PCs that are held up now and then.",
    ),
]
Duration = Annotated[
    float | None, typer.Option(min=0.0, help="Seconds after which the session is ended.")
]
Priority = Annotated[
    int | None,
    typer.Option(min=1, max=99, help="Real-time priority (SCHED_FIFO) to ask the system for."),
]


WarmStart = Annotated[
    bool, typer.Option("--warm-start", help="Begin with the init packet, as after 506.")
]
OwnMotion = Annotated[
    bool,
    typer.Option(
        "--own-motion",
        help="In mode 0 the controller's own program moves the arm about, until it is stopped.",
    ),
]
OwnSpeed = Annotated[
    float, typer.Option(min=0.01, max=1.0, help="Of that motion: fraction of full speed.")
]
Effects = Annotated[
    bool, typer.Option("--effects", help="Switch on what the identified model leaves out.")
]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of noise and model errors.")]

HELP: Final = """\
Be the controller: a simulated C4G with its arm, for a PC program on a real network or bus.

Nothing here is hardware and nothing moves. The PC program under test runs elsewhere, listens,
and must do what the real controller asks of it:

- answer every packet within its cycle, with the number received plus one (32767 is followed
  by 1);

- echo the start: nine sync packets, the init packet (number 10, 1200 bytes), two more syncs;

- answer modes 501 (driving on) and 0 (closed) with the mode received and no demand;

- once every axis reports the open mode and the status byte is 5 (drive on): start from the
  target received and answer with the next one;

- ask for the end of open mode with status byte 1, then stay in step until 504.

Mode 505 in an answer asks for drive off, 508 reports a following error; targets in such a
packet are ignored. A drive that was lost stays off until somebody presses the button.

**Example**, two terminals on one machine:

    hil simulate cell.toml --udp 127.0.0.1:2001 --cycle 2 --intervals 1

    your_program --listen 2001

The order does not matter: the first packet is repeated every second until it is answered.
Ctrl-C ends the session properly (a second one at once); `kill -USR1` presses drive-on,
`kill -USR2` the emergency stop. `docs/simulate.md` has more, faults included.
"""


def simulate(
    cell: CellArgument,
    udp: Udp = None,
    can: Can = None,
    cycle: Cycle = None,
    mode: Mode = None,
    stagger: Stagger = 3,
    only_axis: OnlyAxis = None,
    missed: Missed = 1,
    patience: Patience = 0.0,
    while_silent: WhileSilent = "hold",
    warm_start: WarmStart = False,
    intervals: Intervals = None,
    own_motion: OwnMotion = False,
    own_speed: OwnSpeed = 0.3,
    effects: Effects = False,
    fault: FaultOption = None,
    seed: Seed = None,
    duration: Duration = None,
    priority: Priority = None,
    json: JsonOption = False,
) -> None:
    """Serve one session; `HELP` is what a person reads."""
    loaded = Cell.load(cell)
    if only_axis is not None:
        joint_index(loaded, str(only_axis), "--only-axis")
    settings = _settings(
        controller_settings(loaded, effects=effects),
        period=loaded.period if cycle is None else cycle / 1000.0,
        open_mode=loaded.controller.mode if mode is None else mode,
        opening_stagger=stagger,
        only_axis=only_axis,
        missed_replies=missed,
        lost_openings=LOST_OPENINGS,
        reopening_time=REOPENING,
        while_silent=while_silent.replace("-", "_"),
        cold_start=not warm_start,
        open_intervals=intervals,
        own_motion=_postures(loaded) if own_motion else (),
        own_motion_repeats=True,
        own_speed=own_speed,
    )
    on_link, in_controller = split_faults([_fault(text) for text in fault or ()])

    def build() -> SimulatedController:
        return simulated_controller(
            loaded, effects=effects, settings=settings, seed=seed, faults=in_controller
        )

    far_end = open_far_end(udp, can, settings, len(loaded.joint_names))
    status = Status(udp or can or "", settings, quiet=json, stretch=patience)
    try:
        with buttons(duration) as pressed, undisturbed(priority):
            status.introduce(loaded.name)
            served = serve_session(
                build,
                far_end,
                pressed,
                faults=FaultyLink(on_link, settings.period) if on_link else None,
                # Its own program stops at the next posture only.
                patience=OWN_MOVE if own_motion else PATIENCE,
                stretch=patience,
                watch=status.watch,
            )
    finally:
        far_end.close()
    _report(served, status, json=json, interrupted=pressed.interrupted)


simulate.__doc__ = HELP


def _report(served: Served, status: Status, *, json: bool, interrupted: bool) -> None:
    """Print the summary; leave with the exit status that the session has earned."""
    if json:
        print_json(_figures(served))
    else:
        status.clear()
        typer.echo(printable("\n".join(_sentences(served))))
    if not served.summary.ended and interrupted:
        raise typer.Exit(130)
    if served.gave_up or not served.summary.ended:
        raise typer.Exit(4)


def _postures(cell: Cell) -> tuple[tuple[float, ...], ...]:
    postures = own_postures(cell)
    if not postures:
        raise InputError(
            cell.path,
            "no posture about its home can be reached clear of floor, walls and the arm itself",
            field="campaign.home_deg",
            remedy="leave --own-motion out, or give the arm more room",
        )
    return postures


def _settings(settings: ControllerSettings, **changes: Any) -> ControllerSettings:
    try:
        return replace(settings, **changes)
    except SettingError as error:
        raise InputError(None, str(error)) from error


def _fault(text: str) -> Fault:
    try:
        return parse_fault(text)
    except FaultScriptError as error:
        raise InputError(None, str(error), field="--fault") from error


def _figures(served: Served) -> dict[str, object]:
    """The summary for a script; times in µs."""
    summary = served.summary
    counts = {
        field.name: getattr(summary, field.name)
        for field in fields(summary)
        if isinstance(getattr(summary, field.name), int)
    }
    times = {"stretch_max_us": round(1e6 * summary.stretch_max, 1)}
    for name, each in (("answer", summary.answer), ("cost", summary.cost)):
        for part, seconds in zip(("p50", "p99", "max"), _parts(each), strict=True):
            times[f"{name}_{part}_us"] = round(1e6 * seconds, 1)
    return {
        **counts,
        "foreign": served.foreign,
        "intervals": served.intervals,
        "starts": served.starts,
        "phase": served.phase.name.lower(),
        "reason": served.reason,
        **times,
    }


def _sentences(served: Served) -> list[str]:
    """The summary for a person."""
    summary = served.summary
    if not summary.cycles:
        return [f"no PC program answered; the first packet was sent {_times(summary.knocks)}"]
    end = "the session has ended (504)" if summary.ended else "the session was given up"
    return [
        f"{end}{': ' if served.reason else ''}{served.reason}; "
        f"open mode was reached {_times(served.intervals)}",
        f"{summary.cycles} cycles, {summary.replies} replies, {summary.missed} missed, "
        f"{summary.late} late, {summary.surplus} surplus, {summary.rejected} rejected, "
        f"{served.foreign} from elsewhere" + _stretched(summary),
        f"answers came after {_spread(summary.answer)}",
        f"controller and arm took {_spread(summary.cost)} to compute a cycle; "
        f"{summary.own_late} cycles began late by our own fault, {summary.slips} of them by a "
        "whole cycle",
    ]


def _parts(times: Histogram) -> tuple[float, float, float]:
    """Median, 99 % and longest [s]."""
    return times.quantile(0.5), times.quantile(0.99), times.largest


def _spread(times: Histogram) -> str:
    median, most, longest = map(_us, _parts(times))
    return f"{median} (median), {most} (99 %), {longest} (longest)"


def _stretched(summary: Tally) -> str:
    if not summary.stretched:
        return ""
    cycles = "1 cycle was" if summary.stretched == 1 else f"{summary.stretched} cycles were"
    return (
        f"; {cycles} stretched to wait for an answer, by up to {1e3 * summary.stretch_max:.1f} ms, "
        "as no real controller does"
    )


def _us(seconds: float) -> str:
    return f"{1e6 * seconds:.0f} µs"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
