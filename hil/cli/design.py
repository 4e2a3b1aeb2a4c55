"""`hil design`: search for the excitation of a cell."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hil.base.errors import HilError, InputError, OperatorStopError
from hil.base.one_screen import brief
from hil.base.progress import Collecting, Reporter, say
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import printable, typed
from hil.campaign.campaign import campaign_of_design, require_replaceable
from hil.campaign.plan import quick_settings, validation_motions, within_ranges
from hil.campaign.trajectory_files import write_trajectories
from hil.cell import Cell
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, at_most_one, print_json
from hil.cli.weigh import centre_from
from hil.control.motion_checks import MotionChecks
from hil.control.motion_watch import stop_on_interrupt
from hil.design import METHODS, Method, load_settings, preset
from hil.design.design import Designed, DesignFolder, run_design
from hil.design.messages import criteria_text
from hil.design.settings import preset_text
from hil.plots import save
from hil.plots.design_picture import draw_design
from hil.precision.forecast import PrecisionDesign, payload_search, short_search
from hil.precision.given_recordings import given_of
from hil.precision.requirements import requirements_from
from hil.weighing.payload_campaign import assumed_payload, loaded_cell, payload_options
from identification.model.known_payload import Payload


def design_summary(done: Designed, folder: DesignFolder) -> dict[str, Any]:
    """Return the content of `--json`; None for values that are not finite."""
    excitation = done.result.excitation
    design = done.design
    figures = {k: v for k, v in asdict(excitation.criteria).items() if k != "n_samples"}
    return {
        "method": excitation.method,
        "seed": excitation.seed,
        "complete": design.complete,
        "exhausted": design.exhausted,
        "unchecked": list(done.result.settings.unchecked),
        **{k: v if v is not None and math.isfinite(v) else None for k, v in figures.items()},
        "duration": float(excitation.trajectory.duration),
        "precision": list(done.result.data.get("precision", ())),
        "tried": excitation.tried,
        "infeasible": dict(excitation.rejected),
        "front": len(design.front),
        "file": str(folder.result),
        "picture": str(folder.picture),
    }


def _draw(folder: DesignFolder, done: Designed, cell: Cell) -> None:
    """Draw the picture; a failure is only reported."""
    try:
        save(draw_design(done.design, cell, done.result.settings.unchecked), folder.picture)
    except InputError as error:
        say(f"warning: {error}; repeat with --resume to draw it", err=True)


def design(
    cell: Annotated[Path | None, typer.Argument()] = None,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/design"),
    method: Annotated[
        Method | None,
        typer.Option(
            help=f"Search method: {', '.join(METHODS)}. Default: gradient.", metavar="NAME"
        ),
    ] = None,
    settings: Path | None = None,
    show_settings: Annotated[Method | None, typer.Option(metavar="NAME")] = None,
    quick: bool = False,
    given: Annotated[list[Path] | None, typer.Option(metavar="ARCHIVE|FOLDER")] = None,
    precision: Annotated[list[str] | None, typer.Option(metavar="TEXT")] = None,
    purpose: Annotated[Literal["payload"] | None, typer.Option("--for", metavar="payload")] = None,
    payload_mass: Annotated[float, typer.Option(min=0.001, metavar="KG")] = 5.0,
    payload_centre: Annotated[str | None, typer.Option(metavar="X,Y,Z")] = None,
    repetitions: Annotated[int | None, typer.Option(min=1, max=1000)] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    workers: Annotated[int | None, typer.Option(min=1, max=256)] = None,
    limits_only: bool = False,
    resume: bool = False,
    force: bool = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Search for a motion that excites and decouples the parameters of CELL. Nothing moves.

    The motion satisfies the joint limits at every instant, the limits of motor current (and joint
    torque, if the cell states any) by the nominal model, and the clearance to floor, walls and the
    arm itself. It begins and ends at the home posture of the cell. Two criteria rate it: log det,
    the information on all parameters together (higher is better), and the coupling index I_c, the
    correlation between the estimates of different parameters (lower is better).

    Writes `excitation.toml` (motion, criteria, settings), `excitation.png` (a picture of the
    motion) and a journal for --resume to OUTPUT, and makes OUTPUT a campaign; the next step is `hil
    rehearse OUTPUT`, with --for payload `hil run OUTPUT --payload NAME`. For a cell without
    [controller], trajectory files are written instead: CSV, ROS 2 JointTrajectory and, for six
    axes, URScript with a player. Ctrl-C or SIGTERM ends the search after the current generation
    (seconds; minutes if the evaluation of a motion hangs) and saves the best motion so far; a
    second one exits at once. `hil demo --excitation OUTPUT` runs the motion.

    **Examples:**

    - `hil design cell.toml -o runs/mine`
    - `hil design --show-settings gradient > my.toml`, then `hil design cell.toml --settings
      my.toml`

    Options:
        cell: The cell file.
        output: Folder for the result.
        settings: TOML file with search settings, or an earlier excitation.toml, in place of
            --method. --show-settings prints a template.
        show_settings: Print the commented settings of a method and exit.
        quick: Run a short search: method b with the number of motions in `candidates` of
            [campaign].
        given: Archive or campaign folder of earlier recordings of this arm (repeatable): the motion
            adds what they lack; criteria are computed for all recordings together.
        precision: Required half-widths of 95 % intervals, such as "parameters 5 %, torque 2": the
            motion minimises the largest ratio of predicted to required interval.
        purpose: payload: a motion of at most ten seconds that weighs a payload (`hil payload`), for
            a known arm, preferably from --given.
        payload_mass: With --for payload: expected mass, with which the currents also stay within
            their limits. Default: 5 kg.
        payload_centre: Its expected centre of mass, m in the frame of the flange. Default:
            0,0,0.1.
        repetitions: Number of repetitions of the motion. Default: as in [campaign].
        seed: Seed of the search; the same seed gives the same result. Default: as in the settings.
        workers: Number of processes; the result does not depend on it. Default: one per processor.
        limits_only: Check joint limits only and do not return to the home posture; for comparison
            with the paper, not for a robot.
        resume: Continue an interrupted search in OUTPUT.
        force: Replace an earlier design in OUTPUT.
    """
    if show_settings is not None:
        typer.echo(preset_text(show_settings), nl=False)
        return
    if cell is None:
        raise InputError(None, "no cell file", remedy="give a cell file: hil design CELL")
    at_most_one(method=method, settings=settings, quick=quick)
    at_most_one(resume=resume, force=force)
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    loaded = Cell.load(cell).with_campaign(repetitions=repetitions)
    folder = DesignFolder(output)
    require_replaceable(output)
    there = folder.resumed_settings() if resume else None
    stated = bool(precision)
    if purpose is not None:
        precision = precision or ["mass of payload 1 %"]
        requested = there or (
            payload_search(loaded.joint_limits) if settings is None else load_settings(settings)
        )
    elif quick:
        requested = short_search() if precision else quick_settings(loaded)
    elif settings is not None:
        requested = load_settings(settings)
    else:
        searched = within_ranges(preset(method or "gradient"), loaded)
        requested = searched if method or there is None else there
    if given:
        requested = requested.replaced(objective={"given": [str(path.resolve()) for path in given]})
    if precision:
        requirements = [str(requirement) for requirement in requirements_from(precision)]
        requested = requested.replaced(objective={"precision": requirements})
    if seed is not None:
        requested = requested.replaced(seed=seed)
    if limits_only:
        requested = requested.kinematic()
    if payload_centre is not None and purpose is None:
        remedy = "add --for payload"
        raise InputError(None, "needs a payload", field="--payload-centre", remedy=remedy)

    recordings = [Path(name) for name in requested.objective.given]
    prior_knowledge = given_of(loaded, recordings) if recordings else None
    assumed = None
    if purpose is not None:
        assumed = assumed_payload(loaded, payload_mass, centre_from(payload_centre))
    promise = _promise(loaded, requested.objective.precision, recordings, reporter, assumed)
    planned = 1 if promise is None else 2 if purpose else loaded.campaign.repetitions
    if promise is not None and purpose is None and settings is None and there is None:
        usual_length = requested.constraints.max_duration
        requested = promise.lengthened(requested, planned)
        if (longest := requested.constraints.max_duration) > usual_length:
            reporter.say(
                f"repetitions of a motion of {usual_length:g} s would not meet the precision: one "
                f"of at most {longest:g} s is searched"
            )

    def finish(done: Designed) -> None:
        """Report and draw the result, while the folder is locked."""
        excitation = done.result.excitation
        unchecked = done.result.settings.unchecked
        broken = ", ".join(f"{kind} {count}" for kind, count in excitation.rejected.items())
        lines = [
            f"{excitation.tried} motions tried; broken constraints: {broken or 'none'}; "
            f"{len(done.design.front)} on the front"
        ]
        if unchecked:
            text = f"not checked: {', '.join(unchecked)}; {loaded.name} may refuse this motion"
            say(f"warning: {text}", err=True)  # also with --quiet
        lacking, files = _campaign(folder, loaded, done)
        if files:
            lines.append(f"trajectory files in {folder.root}: {', '.join(files)}")
        elif lacking is None:
            command = f"hil rehearse {typed(folder.root)}"
            if assumed is not None:
                weighing = f"--payload NAME {payload_options(assumed)} --rehearse"
                if stated:
                    weighing += " --until-precise"
                command = f"hil run {typed(folder.root)} {weighing}"
            lines.append(f"{folder.root} is now a campaign; next: {command}")
        else:
            lines.append(f"note: no campaign was created: {lacking}")
        summary = design_summary(done, folder) | {
            "campaign": str(folder.root) if lacking is None and not files else None,
            "no_campaign": lacking,
            "trajectories": [*files],
        }
        if json:
            print_json(summary)
        else:
            p = done.problem.objective.n_parameters
            figures = criteria_text(excitation.criteria.measures, p)
            duration = excitation.trajectory.duration
            found = [f"{figures}, {duration:.2f} s: {folder.result}"]
            if promise is not None:
                forecasts = promise.forecasts(excitation, planned)
                found += [each.message(planned, promise.scale) for each in forecasts]
            said = reporter.lines if isinstance(reporter, Collecting) else []
            shown = found if quiet else [*found, *said, *lines]
            for line in shown if verbose else brief(shown):
                typer.echo(printable(line))
        _draw(folder, done, loaded)

    with stop_on_interrupt() as stop:
        done = run_design(
            folder,
            loaded,
            requested,
            reporter,
            workers=workers or len(os.sched_getaffinity(0)),
            stop=lambda: stop.requested,
            given=prior_knowledge,
            precision=None if promise is None else promise.precision(planned),
            carrying=None if assumed is None else loaded_cell(loaded, "payload", assumed),
            promised=None
            if promise is None
            else lambda excitation: [
                forecast.to_dict() for forecast in promise.forecasts(excitation, planned)
            ],
            resume=resume,
            force=force,
            then=finish,
        )
    if not done.design.complete:
        raise OperatorStopError(
            f"stopped before the end of the search; the best motion so far is in {folder.result}; "
            "continue with --resume"
        )


def _promise(
    cell: Cell,
    requirements: Sequence[str],
    recordings: Sequence[Path],
    reporter: Reporter,
    payload: Payload | None,
) -> PrecisionDesign | None:
    """Return the requirements about a cell, None without any, and report the torque error."""
    if not requirements:
        return None
    motions = [motion.trajectory for motion in validation_motions(cell, MotionChecks.of(cell))]
    promise = PrecisionDesign.of(
        cell, requirements_from(requirements), motions, recordings, payload
    )
    reporter.say(f"torque error: {promise.source}")
    return promise


def _campaign(
    folder: DesignFolder, cell: Cell, done: Designed
) -> tuple[str | None, tuple[str, ...]]:
    """Create a campaign, or trajectory files; return why neither, and the files."""
    unchecked = done.result.settings.unchecked
    if not done.design.complete:
        return "the search was stopped", ()
    if unchecked:
        return f"{', '.join(unchecked)} were not checked", ()
    try:
        if cell.file.controller is None and cell.file.campaign is not None:
            return None, write_trajectories(folder.root, cell, done.result.excitation)
        campaign_of_design(folder.root, cell, done.result.excitation)
    except (HilError, OSError) as error:  # the design is valid without one
        return str(error), ()
    return None, ()
