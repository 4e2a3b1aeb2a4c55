"""`hil move`: the arm goes a checked straight way to a posture."""

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

from hil.campaign import Campaign, MotionLink, stop_on_interrupt
from hil.campaign.motion_link import checks_in_force, narrower_limits
from hil.campaign.operator import MotionProgress, OperatorRequest
from hil.cell import AngleFrame, Cell
from hil.cell_link import cell_link
from hil.cli.arguments import AcceptInitOption, JsonOption
from hil.errors import ControllerFault, InputError, OperatorStopError, UnsafeError
from hil.files import make_folder
from hil.move import THERE, Way, axis_alone, posture, send, straight_way, turned
from hil.progress import Task, say
from hil.progress import reporter as make_reporter
from hil.recording import archive_path
from hil.terminal_text import printable


def move(
    where: Annotated[Path, typer.Argument(metavar="CELL|CAMPAIGN")] = Path("cell.toml"),
    to: Annotated[str | None, typer.Option(metavar="start|home|POSTURE")] = None,
    joint: str | None = None,
    by: float | None = None,
    speed: Annotated[float | None, typer.Option(min=0.1, max=100.0)] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y")] = False,
    accept_init: AcceptInitOption = False,
    only_axis: bool = False,
    json: JsonOption = False,
) -> None:
    """Move the arm on a straight way in joint space, slowly, and archive it.

    The way is planned from where the arm stands and checked against limits, motor currents, floor,
    walls and the arm itself; then it is shown, and sent once a person says yes. Without a terminal
    nothing that may be a real arm moves unless --yes is given. Ctrl-C brings the arm to rest on
    its way. With transport "simulated" the controller is simulated here, and the arm stands again
    at initial_deg the next time.

    **Example:** `hil move cell.toml --joint 1 --by 5 --speed 5`, then
    `hil move cell.toml --to start`.

    Exit status 0 when it arrived (or was there), 2 when what was typed cannot be used or the
    planner failed, 3 when the way is refused or nobody confirmed it,
    4 when the controller, the link or the guard ended it, 130 when it was stopped.

    Options:
        where: A cell file, or a campaign's folder.
        to: home_deg of the cell; the start of the campaign's excitation (of a cell alone: home); or
            angles in degrees in the frame of [limits], "0,-20,-90,0,60,0".
        joint: Instead of --to: one joint, by name or number from 1.
        by: How far it turns, degrees.
        speed: Percent of the joints' speeds; the cell's approach_speed if left out.
        output: The archive (*.mcap), or a folder to number it in; runs/move if left out, of a
            campaign its own archives.
        yes: Do not ask: the way is free, and somebody looks. What may be a real arm then goes no
            faster than the cell's approach_speed.
        only_axis: With --joint: the controller's program opens the axis of that joint only, and the
            others have to stay closed.
    """
    if (to is None) == (joint is None) or (joint is None) != (by is None):
        remedy = "give either --to, or --joint and --by"
        raise InputError(None, "where is the arm to go?", remedy=remedy)
    campaign = Campaign.open(where) if where.is_dir() else None
    cell = Cell.load(where) if campaign is None else campaign.cell
    axis = axis_alone(cell, joint) if only_axis else None
    wanted = None
    if to is not None:
        motion = None if campaign is None else campaign.plan.excitation.trajectory
        wanted = posture(cell, to, None if motion is None else motion.sample(np.array([0.0]))[0][0])
    with _reserved(campaign), cell_link(cell, accept_init=accept_init, only_axis=axis) as link:
        link.connection.say = partial(say, err=True)
        if yes and not link.only_simulated:
            most = 100.0 * cell.campaign.approach_speed
            if speed is not None and speed > most:
                raise UnsafeError(
                    f"--speed {speed:g} with --yes is faster than the cell's approach_speed "
                    f"({most:g} %), and nobody confirms the way; nothing was sent: leave out "
                    "--yes, or go slower."
                )
        with stop_on_interrupt() as stop:
            here = link.connect(stop)
        target = turned(cell, here, joint or "", by or 0.0) if wanted is None else wanted
        if np.max(np.abs(target - here)) <= THERE:
            link.close()
            _tell("the arm is there already; nothing was sent", {"outcome": "there"}, json=json)
            return
        way = straight_way(
            cell,
            here,
            target,
            speed=None if speed is None else speed / 100.0,
            checks=checks_in_force(cell, link.connection),
        )
        if not json:
            typer.echo(printable(_described(way, cell, link)))
        _confirm(cell, link, yes=yes, json=json)
        own = campaign.folder if campaign is not None and output is None else None
        if own is None:
            path = archive_path(output or Path("runs/move"), "move")
        else:
            make_folder(own.archives)
            path = own.archives / own.next_name("move", 0).filename
        bar, durable = make_reporter(quiet=json), cell.controller.transport != "simulated"
        with stop_on_interrupt() as stop, bar.task("moving (s)", way.duration) as task:
            ended = send(way, cell, link, path, stop=stop, watch=_Shown(task), durable=durable)
            stopped = stop.requested
        if own is not None:
            own.add(path.name, ended.outcome)
        figures: dict[str, object] = {
            "archive": str(path),
            "outcome": ended.outcome,
            "reason": ended.reason,
            "simulated": link.only_simulated,
            "duration": way.duration,
            "target_deg": AngleFrame.of(cell).shown(way.target).tolist(),
        }
        said = f"{ended.outcome}: {ended.reason or 'the arm is there'}; archived in {path}"
        if not json:
            typer.echo(printable(said))
        try:
            link.close()
        except ControllerFault as fault:
            raise fault.beside(figures) from None
        if json and ended.outcome == "completed":
            _tell(said, figures, json=json)
    if ended.outcome == "stopped" and stopped:
        how = f"the arm was stopped on its way; {path} is whole."
        raise OperatorStopError(how).beside(figures)
    if ended.outcome != "completed":
        why = f"the move ended {ended.outcome}: {ended.reason}; {path} is whole."
        raise ControllerFault(why).beside(figures)


class _Shown:
    """Moves the bar on with the arm; only Ctrl-C stops the motion."""

    def __init__(self, task: Task) -> None:
        self._task, self._done = task, 0.0

    def show(self, progress: MotionProgress) -> None:
        """Look at the motion."""
        done = max(self._done, progress.motion_time or 0.0)
        self._task.advance(done - self._done)
        self._done = done

    def request(self) -> OperatorRequest:
        """The motion as it was planned."""
        return OperatorRequest()


@contextmanager
def _reserved(campaign: Campaign | None) -> Iterator[None]:
    """Keep runs out of a campaign's folder from before the controller is connected.

    Raises:
        CampaignFolderError: one is at work on it, or the folder was changed.
    """
    with nullcontext() if campaign is None else campaign.folder.locked():
        if campaign is not None:
            campaign.folder.require_unchanged()
        yield


def _confirm(cell: Cell, link: MotionLink, *, yes: bool, json: bool) -> None:
    """Ask the person; what may be a real arm does not move without an answer.

    Raises:
        UnsafeError: nobody is here to answer.
        OperatorStopError: the answer was no.
    """
    if yes:
        return
    if json or not sys.stdin.isatty():
        if link.only_simulated:
            return
        raise UnsafeError(
            "nobody is here to confirm the way, and the controller may be a real one; nothing was "
            "sent: run it in a terminal, or add --yes where somebody looks at the arm."
        )
    who = "the simulated arm" if link.only_simulated else f"the arm of {cell.name}"
    try:
        agreed = typer.confirm(f"The way is free, and {who} may move?")
    except typer.Abort:
        agreed = False
    if not agreed:
        raise OperatorStopError("not confirmed; nothing was sent.")


def _described(way: Way, cell: Cell, link: MotionLink) -> str:
    """The way, joint by joint."""
    frame = AngleFrame.of(cell)
    start, end = frame.shown(way.start), frame.shown(way.target)
    peaks = np.degrees(way.trajectory.extrema().velocity)
    width = max(len(name) for name in (*cell.joint_names, "joint"))
    lines = [f"{'joint':{width}}  {'from':>9}  {'to':>9}  {'by':>9}   peak speed"]
    lines += [
        f"{name:{width}}  {a:8.2f}°  {b:8.2f}°  {b - a:+8.2f}°  {peak:7.2f} °/s"
        for name, a, b, peak in zip(cell.joint_names, start, end, peaks, strict=True)
    ]
    who = "a SIMULATED controller" if link.only_simulated else f"the controller of {cell.name}"
    lines.append(
        f"{way.duration:.2f} s at {100.0 * way.speed:.3g} % of the joints' speeds, {frame.whose}; "
        f"limits, motor currents, floor, walls and the arm itself are respected; to {who}"
    )
    below = narrower_limits(cell, link.connection, "following_error")
    lines += [f"the smaller following-error threshold counts, {note}" for note in below]
    return "\n".join([*lines, way.not_checked] if way.not_checked else lines)


def _tell(text: str, figures: dict[str, object], *, json: bool) -> None:
    typer.echo(json_format.dumps(figures) if json else printable(text))
