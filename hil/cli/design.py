"""`hil design`: search the motion that tells most about the parameters."""

from __future__ import annotations

import json as json_format
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.campaign.stop import stop_on_interrupt
from hil.cell import Cell
from hil.design import DesignSettings, Method, load_settings, preset
from hil.design.earlier import known_from
from hil.design.folder import DesignFolder, require_same
from hil.design.result import DesignResult
from hil.design.run import Designed, run_design
from hil.design.settings import preset_text
from hil.errors import InputError, OperatorStopError
from hil.plots import save
from hil.progress import Reporter
from hil.progress import reporter as make_reporter


def design(
    cell: Annotated[Path | None, typer.Argument(help="The cell file.", show_default=False)] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the result.")] = Path(
        "runs/design"
    ),
    method: Annotated[
        Method | None,
        typer.Option(
            help="What is searched. a: the paper's method A, sines of largest determinant. b: its "
            "method B, via points of best fitness by eq. 7. balanced: the same with terms of equal "
            "weight. front: both criteria at once, and the knee of their front (the default).",
            show_default=False,
        ),
    ] = None,
    settings: Annotated[
        Path | None,
        typer.Option(
            help="Settings of your own (TOML) instead of a method's; begin with --show-settings.",
            show_default=False,
        ),
    ] = None,
    show_settings: Annotated[
        Method | None,
        typer.Option(
            help="Print the settings of a method, explained, and do nothing else.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="One seed is one result; that of the settings if left out."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=256,
            help="Processes; as many as there are processors if left out. The result does not "
            "depend on it.",
        ),
    ] = None,
    kinematic: Annotated[
        bool,
        typer.Option(
            "--kinematic",
            help="Keep joint limits only, and do not return home: for comparison with the paper, "
            "not for a robot.",
        ),
    ] = False,
    earlier: Annotated[
        list[Path] | None,
        typer.Option(
            help="A campaign folder, or archives (repeat the option): the new motion adds to what "
            "they say, and concentrates on what they leave uncertain.",
            show_default=False,
        ),
    ] = None,
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            help="Earlier results to draw on the front, e.g. those of methods a and b.",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the search in OUTPUT that was stopped.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier design in OUTPUT.")
    ] = False,
    view: Annotated[
        bool, typer.Option("--view", help="Then show the motion in the browser, in 3D.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the last line.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the criteria as JSON.")] = False,
) -> None:
    """Search the motion that excites and decouples the parameters of CELL. Nothing moves.

    The motion keeps the joint limits at every instant, the motors' currents by the nominal model,
    and the clearance to floor, walls and the arm itself; it begins and ends in the cell's home.
    What comes of it is judged by two numbers: log det, which grows with the information on all
    parameters together, and the coupling index I_c, which is the smaller the less the estimates
    of different parameters get into each other's way.

    Leaves `excitation.toml` (motion, criteria, settings), `excitation.png` (what the robot is
    going to do), and a journal to resume from in OUTPUT. Ctrl-C ends the search with the best
    motion so far; a second one leaves at once. `hil demo --excitation OUTPUT` runs the motion.

    **Examples:**

    - `hil design cell.toml -o runs/mine`
    - `hil design --show-settings front > my.toml`, then `hil design cell.toml --settings my.toml`
    - `hil design cell.toml --method b --kinematic -o runs/b`: the paper's comparison
    - `hil design cell.toml --earlier runs/demo -o runs/second`: adds to what is known
    """
    if show_settings is not None:
        typer.echo(preset_text(show_settings), nl=False)
        return
    if cell is None:
        raise InputError(None, "for which cell?", remedy="name a cell file: hil design CELL")
    if method is not None and settings is not None:
        raise InputError(
            None,
            "names a method, and so do the settings",
            field="--method",
            remedy="give either --method or --settings",
        )
    if resume and force:
        raise InputError(None, "--resume and --force exclude each other", remedy="give one of them")
    if view:
        _require_view()
    reporter = make_reporter(quiet=quiet or json)
    loaded, folder = Cell.load(cell), DesignFolder(output)
    references = _references(compare or [])
    asked = _settings(folder, method, settings, seed, kinematic=kinematic, resume=resume)
    with stop_on_interrupt() as stop:
        known = known_from(earlier, loaded, reporter) if earlier else None
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
        )
        _say(reporter, done, loaded)
        _draw(folder, done, loaded, references)
    typer.echo(json_format.dumps(_summary(done, folder)) if json else _line(done, folder))
    if not done.design.complete:
        raise OperatorStopError(
            f"stopped before the end of the search; the best motion so far is in {folder.result}; "
            "go on with --resume"
        )
    if view:
        _show(done, loaded)


def _settings(
    folder: DesignFolder,
    method: Method | None,
    file: Path | None,
    seed: int | None,
    *,
    kinematic: bool,
    resume: bool,
) -> DesignSettings:
    """Return what is asked for; of a search to be resumed, what it began with."""
    there = folder.interrupted() if resume else None
    if file is not None:
        asked = load_settings(file)
    elif method is not None or there is None:
        asked = preset(method or "front")
    else:
        asked = there
    if seed is not None:
        asked = asked.replaced(seed=seed)
    if kinematic:
        asked = asked.kinematic()
    if there is not None:
        require_same(asked, there, folder.settings)
    return asked


def _require_view() -> None:
    """Refuse before the search what could not be shown after it."""
    from hil.view import require_viewer  # what it needs may not be installed

    require_viewer()


def _show(done: Designed, cell: Cell) -> None:
    from hil.view import show  # what it needs may not be installed

    with show(done.result.excitation, cell) as opened:
        typer.echo(f"3D view: {opened.address} (Ctrl-C ends it)", err=True)
        opened.run()


def _references(paths: list[Path]) -> dict[str, tuple[float, float]]:
    """Return log det and coupling index of earlier results, by method."""
    found: dict[str, tuple[float, float]] = {}
    for path in paths:
        excitation = DesignResult.load(path).excitation
        name = f"method {excitation.method.upper()}" if len(excitation.method) == 1 else ""
        name = name or excitation.method
        if name in found:
            name = f"{name} ({path})"
        found[name] = excitation.criteria.log10_det, excitation.criteria.coupling_index
    return found


def _draw(
    folder: DesignFolder, done: Designed, cell: Cell, references: dict[str, tuple[float, float]]
) -> None:
    from hil.plots.design_picture import draw_design  # loads the arm's shapes

    figure = draw_design(
        done.result.excitation,
        cell,
        front=done.design.front,
        chosen=done.design.chosen,
        references=references,
        title=cell.name,
    )
    save(figure, folder.picture)


def _say(reporter: Reporter, done: Designed, cell: Cell) -> None:
    """Say what the criteria are and what stood in the way."""
    excitation = done.result.excitation
    criteria = excitation.criteria
    broken = ", ".join(f"{kind} {count}" for kind, count in excitation.rejected.items())
    reporter.say(
        f"{excitation.tried} motions tried; broken constraints: {broken or 'none'}; "
        f"{len(done.design.front.log10_det)} on the front"
    )
    if criteria.condition is not None and criteria.scaled_condition is not None:
        reporter.say(
            f"condition number of the regressor {criteria.condition:.0f}, "
            f"{criteria.scaled_condition:.1f} with columns of unit length"
        )
    kept = done.result.settings.constraints
    unlooked = [
        name
        for name, looked in (
            ("floor, walls and the arm itself", kept.collision),
            ("currents", kept.current),
        )
        if not looked
    ]
    if unlooked:
        reporter.say(f"not looked at: {', '.join(unlooked)}; {cell.name} may refuse this motion")
    sines = done.result.settings.sines
    if sines is not None and sines.ramp == 0.0:
        reporter.say(
            "this motion begins and ends at full speed: no controller can run it; give it a ramp"
        )


def _line(done: Designed, folder: DesignFolder) -> str:
    excitation, n = done.result.excitation, done.result.n_parameters
    criteria = excitation.criteria
    return (
        f"log det {criteria.log10_det:.2f}, I_c {criteria.coupling_index:.2f} of "
        f"{n * (n - 1) // 2}, {excitation.trajectory.duration:.2f} s: {folder.result}"
    )


def _summary(done: Designed, folder: DesignFolder) -> dict[str, Any]:
    excitation = done.result.excitation
    criteria = excitation.criteria
    return {
        "method": excitation.method,
        "seed": excitation.seed,
        "complete": done.design.complete,
        "log10_det": criteria.log10_det,
        "coupling_index": criteria.coupling_index,
        "fitness": criteria.fitness,
        "condition": criteria.condition,
        "scaled_condition": criteria.scaled_condition,
        "duration": float(excitation.trajectory.duration),
        "tried": excitation.tried,
        "infeasible": dict(excitation.rejected),
        "front": len(done.design.front.log10_det),
        "file": str(folder.result),
        "picture": str(folder.picture),
    }
