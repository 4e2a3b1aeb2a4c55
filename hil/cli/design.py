"""`hil design`: search the motion that tells most about the parameters."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hil.campaign.campaign import campaign_of_design, require_replaceable
from hil.campaign.operator import Stop, stop_on_interrupt
from hil.campaign.plan import quick_settings
from hil.campaign.trajectory_files import write_trajectories
from hil.cell import Cell
from hil.cli.arguments import JsonOption, QuietOption, at_most_one, print_json
from hil.design import Method, load_settings, preset
from hil.design.advice import WEAK, NoExcitationError, criteria_text, margins, weakest
from hil.design.earlier import known_from
from hil.design.result import references
from hil.design.run import Designed, DesignFolder, require_same, run_design
from hil.design.settings import preset_text
from hil.errors import HilError, InputError, OperatorStopError
from hil.plots import save
from hil.progress import reporter as make_reporter
from hil.progress import say
from hil.terminal_text import printable
from identification.excitation import coupling_index_max


def design_summary(done: Designed, folder: DesignFolder) -> dict[str, Any]:
    """What was found, for a script; what is no finite number is None."""
    excitation, design = done.result.excitation, done.design
    figures = {k: v for k, v in asdict(excitation.criteria).items() if k != "n_samples"}
    return {
        "method": excitation.method,
        "seed": excitation.seed,
        "complete": design.complete,
        "exhausted": design.exhausted,
        "unchecked": list(done.result.settings.unchecked),
        **{k: v if v is not None and math.isfinite(v) else None for k, v in figures.items()},
        "duration": float(excitation.trajectory.duration),
        "tried": excitation.tried,
        "infeasible": dict(excitation.rejected),
        "front": len(design.front),
        "file": str(folder.result),
        "picture": str(folder.picture),
    }


def _lines(done: Designed) -> Iterator[str]:
    """What the criteria are and what limited them."""
    excitation, design = done.result.excitation, done.design
    sines, criteria = done.result.settings.sines, excitation.criteria
    broken = ", ".join(f"{kind} {count}" for kind, count in excitation.rejected.items())
    yield (
        f"{excitation.tried} motions tried; broken constraints: {broken or 'none'}; "
        f"{len(design.front)} on the front"
    )
    raw, scaled = criteria.condition, criteria.scaled_condition
    if raw is not None and scaled is not None:
        yield (
            f"condition number of the regressor {raw:.0f}, {scaled:.1f} with columns of unit length"
        )
        if scaled > WEAK:
            names = ", ".join(weakest(done.problem.objective, excitation.trajectory))
            yield (
                f"this motion hardly separates {names}: take more "
                f"{'via points' if sines is None else 'harmonics'}, allow a longer motion, search "
                "longer, or judge by other parameters ([objective] parameters)"
            )
    if design.chosen is None:
        yield f"polished from {criteria_text(design.origin_criteria.measures)}"
    if sines is not None and sines.ramp == 0.0:
        yield "this motion begins and ends at full speed: no controller can run it; give it a ramp"


def _draw(
    folder: DesignFolder,
    done: Designed,
    cell: Cell,
    beside: dict[str, tuple[float, ...]],
    *,
    together: bool,
) -> None:
    """Draw the picture; without it the design is as good."""
    from hil.plots.design_picture import draw_design  # loads the arm's shapes

    design, excitation = done.design, done.result.excitation
    grown = tuple(design.front.measures[design.origin].tolist())
    figure = draw_design(
        excitation,
        cell,
        front=design.front,
        chosen=design.chosen,
        knee=None if design.chosen is not None else grown,
        references=beside,
        unchecked=done.result.settings.unchecked,
        complete=design.complete,
        together=together,
        margins=margins(cell, done.problem, excitation.trajectory),
        title=cell.name,
    )
    try:
        save(figure, folder.picture)
    except InputError as error:
        say(f"warning: {error}; repeat with --resume to draw it again", err=True)


def _folder(given: str) -> Path:
    """The folder named; a name that is empty would be the working directory."""
    if not given:
        raise InputError(None, "is empty", field="--output", remedy="name a folder")
    return Path(given)


def design(
    cell: Annotated[Path | None, typer.Argument()] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", parser=_folder, metavar="<path>")
    ] = Path("runs/design"),
    method: Method | None = None,
    settings: Path | None = None,
    show_settings: Method | None = None,
    quick: bool = False,
    repetitions: Annotated[int | None, typer.Option(min=1, max=1000)] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    workers: Annotated[int | None, typer.Option(min=1, max=256)] = None,
    kinematic: bool = False,
    purpose: Annotated[Literal["arm", "payload"], typer.Option("--for")] = "arm",
    earlier: list[Path] | None = None,
    compare: list[Path] | None = None,
    resume: bool = False,
    force: bool = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Search the motion that excites and decouples the parameters of CELL. Nothing moves.

    The motion keeps the joint limits at every instant, the motors' currents (and joint torques,
    where the cell limits them) by the nominal model, and the clearance to floor, walls and the arm
    itself; it begins and ends in the cell's home. What comes of it is judged by two numbers: log
    det, which grows with the information on all parameters together, and the coupling index I_c,
    which is the smaller the less the estimates of different parameters get into each other's way.

    Leaves `excitation.toml` (motion, criteria, settings), `excitation.png` (what the robot is
    going to do), and a journal to resume from in OUTPUT, and makes OUTPUT a campaign: `hil rehearse
    OUTPUT` comes next. For a cell without [controller] it leaves trajectory files instead: CSV, ROS
    2 JointTrajectory, and for six axes URScript and a player. Ctrl-C (or SIGTERM) ends the search
    with the best motion so far once the generation under way is scored: seconds, a few minutes if a
    motion hangs. A second one leaves at once. `hil demo --excitation OUTPUT` runs the motion.

    **Examples:**

    - `hil design cell.toml -o runs/mine`
    - `hil design --show-settings front > my.toml`, then `hil design cell.toml --settings my.toml`
    - `hil design cell.toml --earlier runs/demo -o runs/second`: adds to what is known
    - `hil design cell.toml --for payload -o runs/load`: a short motion for `hil payload`

    Options:
        cell: The cell file.
        output: Folder for the result.
        method: What is searched. a: the paper's method A, sines of largest determinant. b: its
            method B, via points of best fitness by eq. 7. balanced: the same with terms of equal
            weight. front: both criteria at once, and the knee of their front (the default).
        settings: Settings of your own (TOML) instead of a method's, or those of an earlier
            excitation.toml; begin with --show-settings.
        show_settings: Print the settings of a method, explained, and do nothing else.
        quick: A short search, for a first look: method b, as many motions as `candidates` of
            [campaign] says.
        repetitions: How often the motion is run; that of [campaign] if left out.
        seed: One seed is one result; that of the settings if left out.
        workers: Processes; as many as there are processors if left out. The result does not depend
            on it.
        kinematic: Keep joint limits only, and do not return home: for comparison with the paper,
            not for a robot.
        purpose: arm: all parameters of the arm. payload: only the payload, the arm known, by a
            motion of at most ten seconds (`hil payload`).
        earlier: A campaign folder, or archives (repeat the option): the new motion adds to what
            they say, and concentrates on what they leave uncertain.
        compare: Earlier results to draw on the front, e.g. those of methods a and b; of the same
            robot, judged by the same parameters, without --earlier.
        resume: Go on with the search in OUTPUT that was stopped.
        force: Replace an earlier design in OUTPUT.
    """
    if show_settings is not None:
        typer.echo(preset_text(show_settings), nl=False)
        return
    if cell is None:
        raise InputError(None, "for which cell?", remedy="name a cell file: hil design CELL")
    at_most_one(method=method, settings=settings, quick=quick)
    at_most_one(resume=resume, force=force)
    reporter = make_reporter(quiet=quiet or json)
    loaded, folder = Cell.load(cell).with_campaign(repetitions=repetitions), DesignFolder(output)
    require_replaceable(output)
    there = folder.interrupted() if resume else None
    if quick:
        asked = quick_settings(loaded)
    elif settings is not None:
        asked = load_settings(settings)
    else:
        asked = preset(method or "front") if method or there is None else there
    if seed is not None:
        asked = asked.replaced(seed=seed)
    if kinematic:
        asked = asked.kinematic()
    if purpose == "payload":
        asked = asked.for_payload()
    if there is not None:
        require_same(asked, there, folder.settings)
    beside = references(compare or [], loaded, asked, together=bool(earlier))
    known = known_from(earlier, loaded, reporter) if earlier else None

    def finish(done: Designed) -> None:
        """Say what was found, then draw it, while no other search may enter the folder."""
        for line in _lines(done):
            reporter.say(line)
        if unchecked := ", ".join(done.result.settings.unchecked):
            words = f"not looked at: {unchecked}; {loaded.name} may refuse this motion"
            say(f"warning: {words}", err=True)  # however quiet it is to be
        lacking, files = _campaign(folder, loaded, done)
        if files:
            reporter.say(f"trajectory files in {folder.root}: {', '.join(files)}")
        elif lacking is None:
            root = shlex.quote(str(folder.root))
            reporter.say(f"{folder.root} is a campaign now; next: hil rehearse {root}")
        else:
            reporter.say(f"note: no campaign was made of it: {lacking}")
        found = design_summary(done, folder) | {
            "campaign": str(folder.root) if lacking is None and not files else None,
            "no_campaign": lacking,
            "trajectories": [*files],
        }
        if json:
            print_json(found)
        else:
            excitation, p = done.result.excitation, done.problem.objective.n_parameters
            typer.echo(
                printable(
                    f"{criteria_text(excitation.criteria.measures)} of {coupling_index_max(p):.0f},"
                    f" {excitation.trajectory.duration:.2f} s: {folder.result}"
                )
            )
        _draw(folder, done, loaded, beside, together=known is not None)

    with _stoppable(folder) as stop:
        try:
            done = run_design(
                folder,
                loaded,
                asked,
                reporter,
                workers=workers or len(os.sched_getaffinity(0)),
                known=known,
                stop=lambda: stop.requested,
                resume=resume,
                force=force,
                then=finish,
            )
        except NoExcitationError as error:
            if not folder.settings.exists():  # nothing was begun
                raise
            raise NoExcitationError(
                f"{error}; then repeat the command with --force, or with --resume where cell and "
                "settings stay as they are"
            ) from error
    if not done.design.complete:
        raise OperatorStopError(
            f"stopped before the end of the search; the best motion so far is in {folder.result}; "
            "go on with --resume"
        )


def _campaign(
    folder: DesignFolder, cell: Cell, done: Designed
) -> tuple[str | None, tuple[str, ...]]:
    """Make the design a campaign, or trajectory files where the cell names no controller.

    Returns:
        in words why there is neither, None if there is; and the trajectory files.
    """
    unchecked = done.result.settings.unchecked
    if not done.design.complete:
        return "the search was stopped", ()
    if unchecked:
        return f"{', '.join(unchecked)} were not looked at", ()
    try:
        if cell.file.controller is None and cell.file.campaign is not None:
            return None, write_trajectories(folder.root, cell, done.result.excitation)
        campaign_of_design(folder.root, cell, done.result.excitation)
    except (HilError, OSError) as error:  # the design is as good without one
        return str(error), ()
    return None, ()


@contextmanager
def _stoppable(folder: DesignFolder) -> Iterator[Stop]:
    """Turn Ctrl-C and SIGTERM into a request to stop; a second one leaves with a sentence."""
    try:
        with stop_on_interrupt() as stop:
            yield stop
    except KeyboardInterrupt:
        raise OperatorStopError(
            f"left at once; what was scored is in {folder.journal}; go on with --resume"
        ) from None
