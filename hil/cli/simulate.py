"""`hil simulate`: simulate the controller on a real link to test a PC program."""

from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from hil.base.errors import InputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import wrapped
from hil.base.progress import say_at_once
from hil.base.terminal_text import plural, printable
from hil.cell import Cell
from hil.cli.arguments import JsonOption, print_json
from hil.cli.record import with_rtde
from hil.control.move import joint_index
from hil.control.simulated_cell import (
    OWN_SPEED_SHARE,
    controller_settings,
    own_postures,
    simulated_controller,
    with_simulation,
)
from hil.control.simulator_on_link import (
    Served,
    buttons,
    open_controller_link,
    realtime_process,
    serve_session,
)
from hil.control.ur_simulation import served_arm
from sim_fixtures import ControllerSettings, Phase, SimulatedController
from sim_fixtures.faults import parse_fault, split_faults
from sim_fixtures.serve import STOP_TIMEOUT, Latencies, Request, ServeCounts

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


class PhasePrinter:
    """Prints a line for each change of a session's phase; nothing if `quiet`."""

    def __init__(self, settings: ControllerSettings, *, quiet: bool) -> None:
        self._settings = settings
        self._quiet = quiet
        self._began = time.monotonic()
        self._phase: Phase | None = None
        self._cycles = -1
        self._printed: Counter[str] = Counter()
        self._hidden = 0

    def say(self, text: str) -> None:
        """Print a line, unless the terminal blocks."""
        if not self._quiet:
            say_at_once(text)

    def watch(self, controller: SimulatedController, counts: ServeCounts) -> None:
        """Print the phase if it has changed since the last cycle."""
        phase = controller.phase
        if phase is not self._phase or counts.cycles < self._cycles:
            self._phase = phase
            text = WORDS[phase]
            if phase is Phase.OPENING:
                text += f" in mode {self._settings.open_mode}"
            text += f": {controller.reason}" if controller.reason else ""
            self._report(text)
        self._cycles = counts.cycles

    def _report(self, text: str) -> None:
        """Print a line, or count it if the same one was printed `MAX_SAME_LINES` times already."""
        self._printed[text] += 1
        if self._printed[text] > MAX_SAME_LINES:
            if self._hidden == 0:
                self.say(f"{self._elapsed()}  ... and so on; repeated lines are not printed")
            self._hidden += 1
            return
        if self._hidden:
            self.say(f"{self._elapsed()}  (lines not printed: {self._hidden})")
            self._hidden = 0
        self.say(f"{self._elapsed()}  {text}")

    def next_session(self) -> None:
        """Begin a session: its lines are counted from zero."""
        self._printed.clear()
        self._hidden = 0
        self._phase = None

    def _elapsed(self) -> str:
        return f"{time.monotonic() - self._began:8.3f} s"


MAX_SAME_LINES: Final = 3
"""Times that a line of a session is printed: openings may repeat every second."""
OWN_MOTION_TIMEOUT: Final = 30.0
"""Longest time for a motion of the controller's own program to end, s."""
LOST_OPENINGS: Final = 20
"""Consecutive losses of open mode by missing replies after which the session ends."""
REOPENING_SECONDS: Final = 1.0
"""Shortest time before the axes open again after such a loss, s."""


def simulate(
    cell: Path,
    udp: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None,
    can: Annotated[str | None, typer.Option(metavar="NAME:CHANNEL")] = None,
    link: Annotated[str | None, typer.Option(metavar="NAME:ADDRESS")] = None,
    cycle: Annotated[int | None, typer.Option(min=1, max=4)] = None,
    mode: int | None = None,
    stagger: Annotated[int, typer.Option(min=0)] = 3,
    only_axis: Annotated[int | None, typer.Option(min=1)] = None,
    missed: Annotated[int, typer.Option(min=1)] = 1,
    patience: Annotated[float, typer.Option(min=0.0, max=10.0)] = 0.0,
    while_silent: Annotated[
        Literal["hold", "continue", "drive-off"], typer.Option(metavar="MOTION")
    ] = "hold",
    warm_start: bool = False,
    intervals: Annotated[int | None, typer.Option(min=1)] = None,
    own_motion: bool = False,
    own_speed: Annotated[float, typer.Option(min=0.01, max=1.0)] = OWN_SPEED_SHARE,
    effects: bool = False,
    fault: Annotated[list[str] | None, typer.Option(metavar="SPEC")] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    duration: Annotated[float | None, typer.Option(min=0.0)] = None,
    repeat: bool = False,
    priority: Annotated[int | None, typer.Option(min=1, max=99)] = None,
    json: JsonOption = False,
) -> None:
    """Simulate a C4G controller with its arm for a PC program on a real network or bus.

    No hardware is involved and nothing moves. The PC program under test runs elsewhere, listens,
    and must behave as with the real controller:

    - reply to every packet within its cycle, with the received number plus one (after 32767: 1);
    - echo the start: nine sync packets, the init packet (number 10, 1200 bytes), two more syncs;
    - reply to modes 501 (driving on) and 0 (closed) with the received mode and no demand;
    - when every axis reports the open mode and the status byte is 5 (drive on): start from the
      received target and reply with the next one;
    - request the end of open mode with status byte 1, then stay synchronous until 504.

    Mode 505 in a reply requests drive off, 508 reports a following error; targets in such a packet
    are ignored. After a fault the drive stays off until its button is pressed.

    **Example**, two terminals: `hil simulate cell.toml --udp 127.0.0.1:2001 --intervals 1` and
    `your_program --listen 2001`.

    The order does not matter: the first packet is repeated every second until the reply. Ctrl-C
    ends the session properly (a second one immediately); `kill -USR1` presses drive-on,
    `kill -USR2` the emergency stop. See `docs/simulate.md`, also for the faults.

    With --link rtde:HOST[:PORT] it is a Universal Robots controller that listens at that address
    (RTDE, primary interface and dashboard) until Ctrl-C, and runs the program of `hil move`.

    Options:
        cell: Cell file; without a [simulation] table the arm has the values of [nominal].
        udp: Address of the PC program.
        can: CAN bus in place of UDP, in python-can names, such as socketcan:can0.
        link: UDP or CAN address in one option, such as udp:127.0.0.1:2001; or rtde:HOST[:PORT].
        cycle: Cycle, ms. Default: as in the cell.
        mode: Open mode: 1, 2, 4, 5, 7, 8 or 9. Default: as in the cell.
        stagger: Cycles between two axes entering open mode.
        only_axis: Open this axis only.
        missed: Consecutive missing replies that end open mode (unknown for a real controller).
        patience: Largest extension of a cycle to wait for its reply, s. A real controller does not
            wait.
        while_silent: Motion of the arm in a cycle of open mode without a reply: hold, continue or
            drive-off.
        warm_start: Start with the init packet, as after 506.
        intervals: Number of intervals of open mode before the session ends. Default: unlimited.
        own_motion: In mode 0 the controller's own program moves the arm, within the limits of
            the cell.
        own_speed: Speed of that motion, as a fraction of the velocity limits.
        effects: Simulate effects that the identified model does not contain.
        fault: Fault of the controller to inject (repeatable).
        seed: Seed of noise and model errors.
        duration: Time after which the session is ended, s.
        repeat: Serve one session after the other, each with a controller just switched on, until
            Ctrl-C or --duration; --json prints one line for each.
        priority: Real-time priority (SCHED_FIFO) to request.
    """
    read = Cell.load(cell)
    if link is not None and link.startswith("rtde:"):
        others = {
            "--udp": udp, "--can": can, "--cycle": cycle, "--mode": mode, "--only-axis": only_axis,
            "--warm-start": warm_start, "--intervals": intervals, "--effects": effects,
            "--repeat": repeat,
        }  # fmt: skip
        serve_rtde(
            with_rtde(read, link),
            ArmOnRtde(
                own_speed if own_motion else None, fault or [], seed, duration, priority, patience
            ),
            [option for option, value in others.items() if value],
            json=json,
        )
        return
    loaded = with_simulation(read)
    if only_axis is not None:
        joint_index(loaded, str(only_axis), "--only-axis")
    settings = replace(
        controller_settings(loaded, effects=effects),
        period=loaded.period if cycle is None else cycle / 1000.0,
        open_mode=loaded.controller.mode if mode is None else mode,
        opening_stagger=stagger,
        only_axis=only_axis,
        missed_replies=missed,
        lost_openings=LOST_OPENINGS,
        reopening_time=REOPENING_SECONDS,
        while_silent="drive_off" if while_silent == "drive-off" else while_silent,
        cold_start=not warm_start,
        open_intervals=intervals,
        own_motion=_postures(loaded) if own_motion else (),
        own_motion_repeats=True,
    )
    on_link, in_controller = split_faults(map(parse_fault, fault or ()))
    if on_link:
        remedy = "disturb the network instead, with `tc qdisc add ... netem`"
        raise InputError(None, "faults of the link", field="--fault", remedy=remedy)

    def build() -> SimulatedController:
        return simulated_controller(
            loaded,
            effects=effects,
            settings=settings,
            seed=seed,
            faults=in_controller,
            own_speed=own_speed,
        )

    addresses = {"--udp": udp, "--can": can, "--link": link}
    end = open_controller_link(addresses, settings, len(loaded.joint_names))
    status = PhasePrinter(settings, quiet=json)
    status.say(
        f"{loaded.name}: a SIMULATED controller for {udp or can or link}; nothing moves.\n"
        f"cycle {1e3 * settings.period:g} ms, mode {settings.open_mode}, process {os.getpid()}"
    )
    if loaded is not read:
        status.say("[simulation] is missing: the nominal arm is simulated, from its home posture")
    if patience:
        status.say(f"cycles are extended by up to {patience:g} s to wait for a reply")
    sessions = 0
    try:
        with buttons(duration) as pressed, realtime_process(priority):
            while True:
                served = serve_session(
                    build,
                    end,
                    pressed,
                    # The controller's own program stops at the next posture only.
                    patience=OWN_MOTION_TIMEOUT if own_motion else STOP_TIMEOUT,
                    cycle_extension=patience,
                    watch=status.watch,
                )
                over = pressed.request() is not Request.CONTINUE
                if sessions and over and not served.summary.cycles:
                    return  # the end was requested while the next program was waited for
                _print_closing(served, as_json=json)
                sessions += 1
                if over or not repeat:
                    break
                status.next_session()
                status.say("waiting for the next PC program; Ctrl-C ends")
    finally:
        end.close()
    if not served.summary.ended and pressed.interrupted:
        raise typer.Exit(ExitStatus.STOPPED)
    if served.controller.program.gave_up or not served.summary.ended:
        raise typer.Exit(ExitStatus.CONTROLLER_FAULT)


@dataclass(frozen=True)
class ArmOnRtde:
    """How an arm is simulated: speed of its program, faults, seed, s, priority and patience, s."""

    own_speed: float | None
    faults: list[str]
    seed: int | None
    duration: float | None
    priority: int | None
    patience: float


def serve_rtde(cell: Cell, arm: ArmOnRtde, others: list[str], *, json: bool) -> None:
    """Serve the Universal Robots arm of a cell until Ctrl-C or the end of the duration."""
    if others:
        problem = "does not apply to a Universal Robots controller"
        raise InputError(None, problem, field=others[0], remedy="leave it out")
    loaded = with_simulation(cell)
    server = served_arm(
        loaded,
        own_speed=arm.own_speed,
        faults=arm.faults,
        seed=arm.seed,
        cycle_extension=arm.patience,
    )
    if not json:
        ports = ", ".join(f"{name} {port}" for name, port in server.ports.items())
        say_at_once(
            f"{cell.name}: a SIMULATED Universal Robots controller at {cell.controller.host}; "
            f"no real arm moves.\nports: {ports}; process {os.getpid()}"
        )
    try:
        with buttons(arm.duration) as pressed, realtime_process(arm.priority):
            server.run(lambda: pressed.request() is not Request.CONTINUE)
    finally:
        server.close()
    figures = {
        "cycles": server.controller.cycle + 1,
        "late": server.late,
        "skipped": server.skipped,
        "clients": server.most_clients,
    }
    if json:
        print_json(figures)
    else:
        text = (
            "{cycles} cycles, {late} of them late by a cycle; at most {clients} clients at a time, "
            "to which {skipped} frames were not sent because they did not read"
        )
        typer.echo(wrapped(text.format_map(figures)))


def _print_closing(served: Served, *, as_json: bool) -> None:
    if as_json:
        print_json(_figures(served))
    else:
        typer.echo(wrapped(printable("\n".join(_sentences(served)))))


def _postures(cell: Cell) -> tuple[tuple[float, ...], ...]:
    postures = own_postures(cell)
    if not postures:
        problem = "no posture nearby can be reached without collision"
        remedy = "omit --own-motion, or enlarge the workspace"
        raise InputError(cell.path, problem, field="campaign.home_deg", remedy=remedy)
    return postures


ENDINGS: Final = {
    "none": "without 504",
    "unanswered": "504, without a reply to it",
    "replied": "504",
}
"""Ends of a session by what became of the packet with 504."""
_KEYS: Final = {"first_packets": "knocks", "extended": "stretched"}
"""Keys of `--json` by the counts that have another name."""


def _figures(served: Served) -> dict[str, object]:
    """Return the content of `--json`; times in µs."""
    summary = served.summary
    times = {"stretch_max_us": summary.longest_extension}
    for name, each in (("answer", summary.reply), ("cost", summary.cost)):
        parts = (f"{name}_{part}_us" for part in ("p50", "p99", "max"))
        times |= zip(parts, _parts(each), strict=True)
    return {
        **{
            _KEYS.get(name, name): count
            for name, count in vars(summary).items()
            if isinstance(count, int)
        },
        "foreign": served.foreign,
        "intervals": served.intervals,
        "starts": served.starts,
        "phase": served.controller.phase.name.lower(),
        "reason": served.controller.reason,
        **{name: round(1e6 * seconds, 1) for name, seconds in times.items()},
    }


def _sentences(served: Served) -> list[str]:
    """Format the summary."""
    summary = served.summary
    reason = served.controller.reason
    if not summary.cycles:
        sent = plural(summary.first_packets, "time")
        return [f"no reply of a PC program; the first packet was sent {sent}"]
    end = "the session was aborted"
    if summary.ended:
        end = f"the session has ended ({ENDINGS[served.controller.program.end_packet]})"
    because = f": {reason}" if reason else ""
    late = f"; {plural(summary.own_late, 'cycle')} started late by the simulation"
    if summary.own_late:
        late += f", {summary.slips} of them by a full cycle"
    again = f" after {plural(served.starts, 'start')}" if served.starts > 1 else ""
    extended = (
        f"; {plural(summary.extended, 'cycle')} extended by up to "
        f"{1e3 * summary.longest_extension:.1f} ms to wait for a reply"
        if summary.extended
        else ""
    )
    return [
        f"{end}{because}; open mode was reached {plural(served.intervals, 'time')}{again}",
        f"{plural(summary.cycles, 'cycle')}, {_replies(served)}{extended}",
        f"time to reply: {_times(summary.reply)}",
        f"time to simulate a cycle: {_times(summary.cost)}{late}",
    ]


def _replies(served: Served) -> str:
    """Return how many cycles had a valid reply, and which packets were of no use."""
    summary = served.summary
    if summary.missed:
        text = f"{summary.missed} without a valid reply in time"
    elif summary.extended or summary.read_late:
        text = "each with a valid reply"
    else:
        text = "each with a valid reply in time"
    if summary.read_late:
        text += (
            f"; {plural(summary.read_late, 'reply')} arrived in time but were read late: this "
            "computer was busy"
        )
    unused = {
        "too late": summary.late,
        "a second reply in one cycle": summary.surplus,
        "with a wrong number, length or content": summary.rejected,
    }
    replies = [f"{count} {reason}" for reason, count in unused.items() if count]
    if replies:
        text += f"; replies not used: {', '.join(replies)}"
    if served.foreign:
        text += f"; {plural(served.foreign, 'packet')} from other addresses not read"
    return text


def _times(times: Latencies) -> str:
    """Format median, 99 % quantile and maximum."""
    median, most, largest = (round(1e6 * seconds) for seconds in _parts(times))
    return f"{median} µs median, {most} µs 99 %, {largest} µs maximum"


def _parts(times: Latencies) -> tuple[float, float, float]:
    """Return median, 99 % quantile and maximum, s."""
    return times.quantile(0.5), times.quantile(0.99), times.largest
