"""`hil move`: move the arm along a checked straight path in joint space."""

from __future__ import annotations

import json as json_format
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hil.base.errors import (
    ControllerError,
    ExecutionError,
    InputError,
    OperatorStopError,
    UnsafeError,
)
from hil.base.files import make_folder
from hil.base.one_screen import wrapped
from hil.base.progress import Task, say
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import printable
from hil.campaign import Campaign, MotionLink, stop_on_interrupt
from hil.cell import AngleFrame, Cell
from hil.cli.arguments import JsonOption
from hil.control.cell_link import cell_link
from hil.control.connection import active_checks, lower_limits
from hil.control.errors import SlippedError
from hil.control.messages import lower_limit_words
from hil.control.motion_watch import MotionProgress, OperatorRequest
from hil.control.move import (
    POSTURE_TOLERANCE,
    CheckedMove,
    axis_alone,
    joint_index,
    plan_move,
    posture,
    send,
    turned,
)
from hil.control.record import archive_path
from identification.excitation.collision_messages import unchecked_text


def move(
    where: Annotated[Path, typer.Argument(metavar="CELL|CAMPAIGN")] = Path("cell.toml"),
    to: Annotated[str | None, typer.Option(metavar="POSTURE")] = None,
    joint: str | None = None,
    by: float | None = None,
    speed: Annotated[float | None, typer.Option(min=0.1, max=100.0)] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y")] = False,
    only_axis: bool = False,
    json: JsonOption = False,
) -> None:
    """Move the arm slowly along a straight path in joint space, and archive the motion.

    The path starts at the present posture and is checked against limits, motor currents, floor,
    walls and self-collision. It is shown and sent after confirmation. Without a terminal, a
    controller that may be real receives nothing unless --yes is given. Ctrl-C stops the arm on its
    path. With transport "simulated" the controller runs in this process, and each call starts at
    initial_deg.

    **Example:** `hil move cell.toml --joint 1 --by 5 --speed 5`, then `hil move cell.toml --to
    start`.

    Exit status: 0 the arm arrived (or was there), 2 bad input or planning failed, 3 the path was
    refused or not confirmed, 4 controller, link or guard ended the motion, 130 stopped.

    Options:
        where: A cell file or a campaign folder.
        to: home; start (of the excitation of the campaign); or angles in degrees in the frame of
            [limits], such as "0,-20,-90,0,60,0".
        joint: Move one joint only, by name or number from 1; with --by, in place of --to.
        by: Displacement of that joint, degrees.
        speed: Percent of the joint speed limits. Default: approach_speed of the cell.
        output: The archive (*.mcap), or a folder for numbered archives. Default: runs/move, or the
            archives of the campaign.
        yes: Do not ask for confirmation: the path is clear and an operator watches. At most at
            approach_speed of the cell, unless simulated.
        only_axis: With --joint: the controller's program opens the axis of that joint only; the
            others must remain closed.
    """
    if (to is None) == (joint is None) or (joint is None) != (by is None):
        remedy = "give either --to, or --joint and --by"
        raise InputError(None, "one target is needed", remedy=remedy)
    campaign = Campaign.open(where) if where.is_dir() else None
    cell = Cell.load(where) if campaign is None else campaign.cell
    if joint is not None:
        joint_index(cell, joint, "--joint")  # refused before anything is connected
    axis = axis_alone(cell, joint) if only_axis else None
    wanted = None
    if to is not None:
        motion = None if campaign is None else campaign.plan.excitation.trajectory
        wanted = posture(cell, to, None if motion is None else motion.sample(np.array([0.0]))[0][0])
    report = partial(say, err=json)
    with _reserved(campaign), cell_link(cell, only_axis=axis, report=report) as link:
        link.connection.report = report
        if yes and not link.only_simulated:
            most = 100.0 * cell.campaign.approach_speed
            if speed is not None and speed > most:
                raise UnsafeError(
                    f"--speed {speed:g} with --yes is faster than the cell's approach_speed "
                    f"({most:g} %), without confirmation; nothing was sent: leave out --yes or "
                    "reduce --speed."
                )
        with stop_on_interrupt() as stop:
            here = link.connect(stop)
        target = turned(cell, here, joint or "", by or 0.0) if wanted is None else wanted
        if np.max(np.abs(target - here)) <= POSTURE_TOLERANCE:
            link.close()
            _print(
                "the arm is at the target; nothing was sent",
                {"outcome": "there"},
                json=json,
            )
            return
        move = plan_move(
            cell,
            here,
            target,
            speed=None if speed is None else speed / 100.0,
            checks=active_checks(cell, link.connection),
        )
        if not json:
            typer.echo(printable(_described(move, cell, link)))
        _confirm(cell, link, yes=yes, json=json)
        folder = campaign.folder if campaign is not None and output is None else None
        if folder is None:
            path = archive_path(output or Path("runs/move"), "move")
        else:
            make_folder(folder.archives)
            path = folder.archives / folder.next_name("move", 0)
        bar = make_reporter(quiet=json)
        durable = cell.controller.transport != "simulated"
        with (
            stop_on_interrupt() as stop,
            bar.task("moving (s)", move.duration) as task,
        ):
            try:
                ended = send(move, cell, link, path, stop=stop, watch=_Shown(task), durable=durable)
            except SlippedError as slip:
                if folder is not None:
                    folder.add(path.name, slip.outcome, slip.reason)
                raise slip.beside({"archive": str(path), "outcome": slip.outcome}) from None
            stopped = stop.requested
        if folder is not None:
            folder.add(path.name, ended.outcome)
        figures: dict[str, object] = {
            "archive": str(path),
            "outcome": ended.outcome,
            "reason": ended.reason,
            "simulated": link.only_simulated,
            "duration": move.duration,
            "target_deg": AngleFrame.of(cell).shown(move.target).tolist(),
        }
        completed = ended.outcome == "completed"
        message = f"archived in {path}"
        if completed:
            message = f"completed: {ended.reason or 'the arm has arrived'}; {message}"
        if not json:
            typer.echo(printable(message))
        try:
            link.close()
        except ControllerError as fault:
            raise fault.beside(figures) from None
        if json and completed:
            _print(message, figures, json=json)
    if ended.outcome == "stopped" and stopped:
        raise OperatorStopError("the arm was stopped on its path.").beside(figures)
    if not completed:
        # On a terminal a refusal was reported with its reason and remedy when it happened.
        why = "" if ended.outcome == "refused" and not json else f": {ended.reason}"
        raise ExecutionError(f"the motion ended {ended.outcome}{why}.").beside(figures)


class _Shown:
    """Progress bar of a motion, as its operator; only Ctrl-C stops the motion."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._done = 0.0

    def show(self, progress: MotionProgress) -> None:
        """Update the bar."""
        done = max(self._done, progress.motion_time or 0.0)
        self._task.advance(done - self._done)
        self._done = done

    def request(self) -> OperatorRequest:
        """Request no change."""
        return OperatorRequest()


@contextmanager
def _reserved(campaign: Campaign | None) -> Iterator[None]:
    """Lock the folder of a campaign before connecting, or raise CampaignFolderError."""
    with nullcontext() if campaign is None else campaign.folder.locked():
        if campaign is not None:
            campaign.folder.require_unchanged()
        yield


def _confirm(cell: Cell, link: MotionLink, *, yes: bool, json: bool) -> None:
    """Ask for confirmation, or raise UnsafeError (no terminal), OperatorStopError (declined)."""
    if yes:
        return
    if json or not sys.stdin.isatty():
        if link.only_simulated:
            return
        raise UnsafeError(
            "the path needs confirmation, as the controller may be real; nothing was sent: run it "
            "in a terminal, or add --yes if an operator watches the arm."
        )
    who = "the simulated arm" if link.only_simulated else f"the arm of {cell.name}"
    try:
        agreed = typer.confirm(f"Is the path clear, and may {who} move?")
    except typer.Abort:
        agreed = False
    if not agreed:
        raise OperatorStopError("not confirmed; nothing was sent.")


def _described(move: CheckedMove, cell: Cell, link: MotionLink) -> str:
    """Format the path, one line per joint."""
    frame = AngleFrame.of(cell)
    start = frame.shown(move.start)
    end = frame.shown(move.target)
    peaks = np.degrees(move.motion.trajectory.extrema().velocity)
    width = max(len(name) for name in (*cell.joint_names, "joint"))
    lines = [f"{'joint':{width}}  {'from':>9}  {'to':>9}  {'by':>9}   peak speed"]
    lines += [
        f"{name:{width}}  {a:z8.2f}°  {b:z8.2f}°  {b - a:+z8.2f}°  {peak:7.2f} °/s"
        for name, a, b, peak in zip(cell.joint_names, start, end, peaks, strict=True)
    ]
    who = "a SIMULATED controller" if link.only_simulated else f"the controller of {cell.name}"
    lines.append(
        f"{move.duration:.2f} s at {100.0 * move.speed:.3g} % of the joints' speeds, {frame.whose};"
        f" checked against limits, motor currents, floor, walls and self-collision; to {who}"
    )
    below = lower_limits(cell, link.connection, "following_error")
    lines += [
        f"the smaller following-error threshold applies, {lower_limit_words(each)}"
        for each in below
    ]
    unchecked = unchecked_text(move.checks.checker.exceptions)
    return wrapped("\n".join(filter(None, [*lines, unchecked])))


def _print(text: str, figures: dict[str, object], *, json: bool) -> None:
    typer.echo(json_format.dumps(figures) if json else printable(text))
