"""`hil plot`: what is in an archive, drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.arguments import JsonOption, print_json
from hil.errors import InputError
from hil.files import make_folder, write_atomically
from hil.plots import save
from hil.plots.archive_panels import BINS as PAGE_BINS
from hil.plots.archive_panels import archive_page
from hil.plots.archive_picture import draw_archive
from hil.plots.archive_view import BINS, view_of
from hil.plots.plan_picture import FORMATS
from hil.terminal_text import printable

PAGE = ".html"


def plot(
    archive: Annotated[Path, typer.Argument(help="The archive (*.mcap).", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="The picture (*.png, *.svg, *.pdf) or page (*.html); ARCHIVE's name with .png in "
            "this folder if left out.",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        float | None,
        typer.Option(help="From this second of the recording on.", show_default=False),
    ] = None,
    stop: Annotated[
        float | None, typer.Option(help="Up to this second of it.", show_default=False)
    ] = None,
    joint: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this joint, by name or number from 1; may be repeated.", show_default=False
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Draw what is in an archive: position, speed, current, torque, following error, events.

    Works on archives of hil and on imported ones, as far as they have these. Of a long archive the
    lowest and highest sample of each short stretch are drawn, so that no peak is lost; --start and
    --stop show a part of it as closely as you like, and a page (*.html) is zoomed into with the
    mouse, two fingers or the keys + - 0. Seconds count from the first sample.

    **Example:** `hil plot runs/demo/archives/excitation_000_a1.mcap --joint 2 -o joint_2.html`
    """
    if archive.is_dir():
        raise InputError(
            archive, "is a folder", remedy=f"name an archive, such as one of {archive}/archives"
        )
    target = output or Path(archive.with_suffix(".png").name)
    if target.suffix.lower() not in (PAGE, *FORMATS):
        known = ", ".join((*FORMATS, PAGE))
        raise InputError(
            target, f"{target.suffix!r} is no format for pictures", remedy=f"use {known}"
        )
    bins = PAGE_BINS if target.suffix.lower() == PAGE else BINS
    view = view_of(archive, start=start, stop=stop, joints=tuple(joint or ()), bins=bins)
    make_folder(target.parent)
    if target.suffix.lower() == PAGE:
        try:
            write_atomically(target, archive_page(view))
        except OSError as error:
            raise InputError(target, f"cannot be written ({error.strerror})") from error
    else:
        save(draw_archive(view), target)
    peaks = {
        quantity.title: {
            name: None if trace.peak_share is None else round(trace.peak_share, 4)
            for name, trace in zip(view.joint_names, quantity.traces, strict=True)
        }
        for quantity in view.quantities
    }
    if json:
        summary = {
            "picture": str(target),
            "start": view.start,
            "stop": view.stop,
            "peak_share_of_limit": peaks,
        }
        print_json(summary)
        return
    for problem in (view.facts.damage, view.facts.lost):
        if problem:
            typer.echo(printable(f"note: {problem}"))
    shown = f"{view.start:.6g} s to {view.stop:.6g} s of {view.facts.duration:.6g} s"
    line_text = f"{target}: {view.facts.title}, {shown}, {len(view.events)} events"
    typer.echo(printable(line_text))
