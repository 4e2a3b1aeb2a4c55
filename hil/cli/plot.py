"""`hil plot`: plot an archive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.archive.check import archive_files
from hil.base.files import make_folder
from hil.base.progress import say
from hil.base.terminal_text import printable
from hil.cli.arguments import JsonOption, print_json
from hil.plots import check_format, save
from hil.plots.archive_view import draw_archive, view_of


def plot(
    archive: Path,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    start: float | None = None,
    stop: float | None = None,
    joint: list[str] | None = None,
    json: JsonOption = False,
) -> None:
    """Plot an archive: position, velocity, current, torque, following error, events.

    Imported archives are plotted as far as they contain these. Long archives are reduced to minimum
    and maximum per interval, so that peaks remain; --start and --stop select a part. Time is
    counted from the first sample.

    **Example:** `hil plot runs/demo/archives/excitation_000_a1.mcap --joint 2 -o joint_2.svg`

    Options:
        archive: The archive (*.mcap), or a folder, whose first archive is plotted.
        output: The picture (*.png, *.svg, *.pdf). Default: the name of the archive with .png, in
            the working directory.
        start: Start of the plotted part, s.
        stop: End of the plotted part, s.
        joint: Plot this joint only, by name or number from 1 (repeatable).
    """
    archive, *others = archive_files([archive])
    target = output or Path(archive.with_suffix(".png").name)
    check_format(target)
    view = view_of(archive, start=start, stop=stop, joints=tuple(joint or ()))
    make_folder(target.parent)
    save(draw_archive(view), target)
    if json:
        peaks = {
            quantity.title: {
                name: None if trace.peak_share is None else round(trace.peak_share, 4)
                for name, trace in zip(view.joint_names, quantity.traces, strict=True)
            }
            for quantity in view.quantities
        }
        span = {"start": view.start, "stop": view.stop}
        print_json(
            {"archive": str(archive), "picture": str(target), **span, "peak_share_of_limit": peaks}
        )
        return
    if others:
        say(
            f"note: {archive} is the first of {len(others) + 1} archives; choose another to plot it"
        )
    for problem in (view.facts.damage, view.facts.lost):
        if problem:
            typer.echo(printable(f"note: {problem}"))
    shown = f"{view.start:.6g} s to {view.stop:.6g} s of {view.facts.duration:.6g} s"
    typer.echo(printable(f"{target}: {view.facts.title}, {shown}, {len(view.events)} events"))
