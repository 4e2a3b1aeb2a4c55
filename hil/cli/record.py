"""`hil record`: record a motion of the controller's own program."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Final, Literal

import numpy as np
import typer
from rich.console import Console

from hil.archive.live import LiveView
from hil.archive.recorder import Recorded
from hil.base.arrays import Array
from hil.base.errors import ControllerError, HilError, InputError, OperatorStopError
from hil.base.one_screen import wrapped
from hil.base.progress import put, say
from hil.base.progress_lines import LINE_PERIOD, STATUS_LINE_PERIOD, progress_console
from hil.campaign import Progress, stop_on_interrupt
from hil.cell import AngleFrame, Cell
from hil.cell.schema import LINKS
from hil.cli.arguments import JsonOption, QuietOption, print_json
from hil.control.live_link import LiveLink
from hil.control.record import archive_path, moved_joints
from hil.control.record import record as record_motion
from hil.control.ur_recording import ConstantsFound, listening, record_arm
from identification.text import percentage

Kind = Annotated[Literal["excitation", "validation", "standstill"], typer.Option(metavar="USE")]


@dataclass(frozen=True)
class RecordRequest:
    """What is to be recorded of an arm; times in s."""

    output: Path
    kind: str
    duration: float | None
    wait: float | None


def record(
    cell: Path,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/record"),
    duration: Annotated[float | None, typer.Option(min=0.001)] = None,
    wait: Annotated[float | None, typer.Option(min=0.0)] = None,
    link: Annotated[str | None, typer.Option(metavar="rtde:HOST[:PORT]")] = None,
    kind: Kind = "excitation",
    live: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Record while the controller's own program moves the arm. This PC commands nothing.

    Each reply repeats the set-point that the controller sent, so the arm follows its own program
    and every cycle is archived. It is the safest first test with a robot. `hil identify` reads the
    archives like a campaign's: record fast motions over the whole range of every joint, some
    with --kind validation, and a few seconds at rest with --kind standstill.

    **Example:** `hil record cell.toml -o archives --duration 60`, then `hil identify archives/*`.

    Start it before the controller's program, so that the archive contains the start of the session.
    After the recording, replies continue until the arm has been at rest for a second, the drive is
    off or the session has ended. Ctrl-C ends the recording; a second one exits at once.

    Exit status: 0 complete; 4 the link or the controller failed, a packet was refused (see the line
    REFUSED), no controller came within --wait, or the session ended before --duration; 130 Ctrl-C
    ended the recording before --duration, or the wait for the controller.

    With a Universal Robots arm (transport rtde, or --link), this PC only listens: in any mode,
    while programs and other clients run. It takes no control of the arm and blocks no
    other client. Every output is archived; a missing frame leaves a gap in the time stamps.

    Options:
        cell: The cell file.
        output: The archive (*.mcap), or a folder for numbered archives.
        duration: Time to record, s. Default: until Ctrl-C.
        wait: Time to wait for the controller, s. Default: unlimited; with rtde one attempt.
        link: Listen to the Universal Robots arm at this address, in place of the cell's link.
        kind: excitation (fitted), validation (predicted) or standstill (noise).
        live: Stream to Foxglove at this address, such as 127.0.0.1:8765.
    """
    loaded = with_rtde(Cell.load(cell), link)
    how = RecordRequest(output, kind, duration, wait)
    if loaded.controller.transport == "rtde":
        if live is not None:
            problem = "is not served while an arm is only listened to"
            raise InputError(None, problem, field="--live", remedy="leave it out")
        record_listening(loaded, how, quiet=quiet, json=json)
    else:
        view = None if live is None else LiveView.parse(live)
        record_replying(loaded, how, view, quiet=quiet, json=json)


def record_replying(
    cell: Cell, how: RecordRequest, live: LiveView | None, *, quiet: bool, json: bool
) -> None:
    """Record the cycles of a controller that waits for replies; as `record`."""
    path = archive_path(how.output, how.kind)
    report = partial(say, err=True)
    with (
        stop_on_interrupt(twice=True) as stop,
        LiveLink.open(cell, live=live, report=report, stop=stop) as link,
    ):
        view = View(cell, quiet=quiet or json)
        link.connection.report = report
        view.say(f"waiting for the controller; recording to {path}. Ctrl-C to stop")
        if link.live is not None:
            view.say(link.live.notice)
        for note in link.notes():
            view.say(f"note: {note}")
        done = record_motion(
            link, cell, path,
            kind=how.kind, stop=stop, duration=how.duration, wait=how.wait, watch=view.show,
        )  # fmt: skip
    _finish(path, done, cell, how, by_operator=stop.requested, line=LINE, json=json)


def with_rtde(cell: Cell, link: str | None) -> Cell:
    """Return the cell with the link rtde:HOST[:PORT], if one is given.

    Raises:
        InputError: it is another kind of link, or none.
    """
    if link is None:
        return cell
    name, _, address = link.partition(":")
    fields = LINKS["rtde"].parse(address) if name == "rtde" else None
    if fields is None:
        remedy = "write rtde:HOST or rtde:HOST:PORT; the cell file describes other links"
        problem = f"{link!r} is not a link that can only be listened to"
        raise InputError(None, problem, field="--link", remedy=remedy)
    table = cell.file.controller
    cycle_ms = 2 if table is None or table.transport != "rtde" else table.cycle_ms
    return cell.with_link(transport="rtde", cycle_ms=cycle_ms, **fields)


def record_listening(cell: Cell, how: RecordRequest, *, quiet: bool, json: bool) -> None:
    """Record an arm that is only listened to; as `record`."""
    path = archive_path(how.output, how.kind)
    view = View(cell, quiet=quiet or json, replies=False)
    warn = partial(say, err=True)
    with (
        stop_on_interrupt() as stop,
        listening(cell, stop=stop, wait=how.wait, report=warn) as arm,
    ):
        view.say(f"listening to {cell.controller.host}; recording to {path}. Ctrl-C to stop")
        for note in arm.notes:
            view.say(f"note: {note}")
        done = record_arm(
            arm, cell, path,
            kind=how.kind, stop=stop, duration=how.duration, watch=view.show, report=warn,
        )  # fmt: skip
    found = ConstantsFound.of(path, cell)
    more = {"stated_constants": [float(k) if np.isfinite(k) else None for k in found.stated]}
    _finish(
        path, done, cell, how,
        by_operator=stop.requested, line=HEARD_LINE, json=json, more=more,
    )  # fmt: skip
    if not json and not quiet and found.are_doubtful:
        say(wrapped("\n".join(constants_lines(found))))


def constants_lines(found: ConstantsFound) -> Iterator[str]:
    """Yield what an arm states of its torque constants, and the next step."""
    if np.isfinite(found.stated).any():
        yield f"torque constants by the arm's own model: {_constants(found.stated)}"
    if found.differ:
        yield f"the cell has others: {_constants(found.in_cell)}; correct torque_constant"
    share = percentage(found.uncertainty)
    yield (
        f"next  the constants are uncertain by {share}: record the motion with a known load, then\n"
        "      hil torque-constants ARCHIVES --loaded LOADED --mass KG --centre X,Y,Z"
    )


def _constants(constants: Array) -> str:
    values = ", ".join(f"{k:.2f}" if np.isfinite(k) else "-" for k in constants)
    return f"{values} N·m/A, gears included"


def _finish(
    path: Path,
    done: Recorded,
    cell: Cell,
    how: RecordRequest,
    *,
    by_operator: bool,
    line: str,
    json: bool,
    more: Mapping[str, object] = MappingProxyType({}),
) -> None:
    """Print how a recording ended, or raise how it ended early."""
    early = _early_end(path, done, how.duration, by_operator=by_operator)
    moved = moved_joints(path, cell) if how.kind == "standstill" else ()
    figures = {**_figures(path, done, cell), **more, **({"moved_joints": moved} if moved else {})}
    if not json:
        say(wrapped(line.format_map(figures)))
    elif early is None:
        print_json(figures)
    if moved:
        say(
            f"warning: {', '.join(moved)} moved, so this is no standstill. Record again while the "
            "arm rests",
            err=True,
        )
    if early is not None:
        raise early.beside(figures)


def _early_end(
    path: Path, done: Recorded, duration: float | None, *, by_operator: bool
) -> HilError | None:
    """Return the error of a recording that ended early."""
    if done.outcome == "completed" and (duration is None or done.seconds >= duration):
        return None
    if done.outcome == "completed":
        reached = f"after {done.seconds:.1f} s of {duration:g} s"
        return ControllerError(f"{done.reason} {reached}; {path} is complete.")
    if done.outcome == "stopped" and by_operator:
        return OperatorStopError(f"the recording was ended early; {path} is complete.")
    return ControllerError(f"{done.reason}; {path} is complete up to there.")


def _figures(path: Path, done: Recorded, cell: Cell) -> dict[str, object]:
    return {
        "archive": str(path),
        "outcome": done.outcome,
        "reason": done.reason,
        "cycles": done.records,
        "duration": done.records * cell.period,
        "missed": done.missed,
        "late_packets": done.late_packets,
        "late": done.late,
        "not_accepted": done.not_accepted,
        "records_lost": done.records_lost,
        "events_lost": done.events_lost,
    }


LINE: Final = (
    "{archive}: {duration:.1f} s, cycles {cycles}, packets {missed} missed, {late_packets} late; "
    "replies {late} late, {not_accepted} not accepted; lost {records_lost} records, "
    "{events_lost} events; {outcome}: {reason}"
)
HEARD_LINE: Final = (
    "{archive}: {duration:.1f} s in {cycles} frames, {missed} missed; {outcome}: {reason}"
)


class View:
    """Progress of a recording: a line every 5 s, and one when it is over.

    Progress is shown on a terminal: standard output, else standard error. Without one it goes to
    standard error, less often. `replies` says whether there are any to be late, and a state of
    their session.
    """

    def __init__(self, cell: Cell, *, quiet: bool, replies: bool = True) -> None:
        self._cell = cell
        self._quiet = quiet
        self._replies = replies
        console = progress_console()
        self._progress = None if quiet else console or Console(stderr=True)
        self._period = STATUS_LINE_PERIOD if console is not None else LINE_PERIOD
        self._over = ""
        self._next = 0.0

    def say(self, text: str) -> None:
        """Print a line, unless quiet."""
        if not self._quiet:
            say(text)

    def show(self, progress: Progress) -> None:
        """Print what has changed."""
        if progress.over != self._over:
            self._over = progress.over
            # Also when quiet: the arm still moves, and needs replies.
            how = "replying until the arm is at rest (Ctrl-C to exit at once)"
            say(f"{progress.over}; {how}", err=self._quiet)
        if self._progress is not None and time.monotonic() >= self._next:
            self._next = time.monotonic() + self._period
            put(self._progress, self._line(progress))

    def _line(self, progress: Progress) -> str:
        if progress.waiting:
            return progress.waiting
        text = f"{progress.cycles * self._cell.period:.1f} s  {progress.missed} missed"
        if self._replies:
            text = f"{progress.state.name.lower().replace('_', ' ')}  {text}"
            text += (
                f", {progress.late_packets} late, replies {progress.late} late, "
                f"{progress.not_accepted} not accepted"
            )
        if progress.position is None or not np.isfinite(progress.position).all():
            return text
        return f"{text}  {AngleFrame.pendant(self._cell).text_of_angles(progress.position)}"
