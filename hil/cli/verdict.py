"""How a command that identifies ends: one line, and an exit status a script can use."""

from __future__ import annotations

import typer

from hil.results import Results

NOT_GOOD = 5


def finish(results: Results, *, json: bool) -> None:
    """Print the verdict last, doubts to stderr before it; exit 5 if the model is not good."""
    if json:
        typer.echo(results.verdict.model_dump_json())
    else:
        for doubt in results.verdict.doubts:
            typer.echo(f"note: {doubt}", err=True)
        typer.echo(results.verdict.line)
    if not results.verdict.good:
        raise typer.Exit(NOT_GOOD)
