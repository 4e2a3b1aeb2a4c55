"""Arguments shared by several commands, and their checks."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Sequence
from copy import copy
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from hil.base.errors import InputError

ARM = "Arm"
CHANNELS = "Channels of logs and bags"
ESTIMATION = "Estimation"
PAYLOAD = "Payload"
PURPOSE = "Purpose"
"""Panels of options in help texts."""

CampaignArgument = Annotated[Path, typer.Argument(help="Campaign folder (`hil design -o`).")]
ArchivesArgument = Annotated[
    list[Path],
    typer.Argument(
        help="Archives (*.mcap), or one campaign folder.",
        metavar="ARCHIVE",
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print only the result.")]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Print everything, not just one screen.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
DhOption = Annotated[
    Path | None,
    typer.Option(
        metavar="TABLE",
        help="DH table (CSV) in place of --urdf, with --convention.",
        rich_help_panel=ARM,
    ),
]
ConventionOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Convention of --dh: standard or modified (Craig).",
        rich_help_panel=ARM,
    ),
]


Command = Callable[..., None]


def with_options(
    group: Callable[..., Any], to: str, *, but: Sequence[str] = (), rare: Sequence[str] = ()
) -> Callable[[Command], Command]:
    """Add the fields of a dataclass as options; they are passed as `to`.

    Args:
        group: the dataclass.
        to: parameter of the command that gets it.
        but: fields that are no options.
        rare: options that work and are not in the help, as the column map has entries for them.
    """
    options = {**inspect.signature(group, eval_str=True).parameters}
    for name in but:
        del options[name]
    for name in rare:
        options[name] = _hidden(options[name])

    def decorate(command: Command) -> Command:
        parameters: dict[str, inspect.Parameter] = {}
        for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
            parameters |= options if name == to else {name: parameter}

        @wraps(command)
        def run(*positional: Any, **given: Any) -> None:
            typed = {name: given.pop(name) for name in [*given] if name in options}
            command(*positional, **given, **{to: group(**typed)})

        keyword = [
            parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in parameters.values()
        ]
        run.__signature__ = inspect.Signature(keyword)  # type: ignore[attr-defined]
        run.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
        return run

    return decorate


def _hidden(option: inspect.Parameter) -> inspect.Parameter:
    kind, described = get_args(option.annotation)
    described = copy(described)
    described.hidden = True
    return option.replace(annotation=Annotated[kind, described])


def at_most_one(**given: object) -> None:
    """Raise InputError if options that exclude each other were given; by their Python names."""
    typed = [_option(name) for name, value in given.items() if value not in (None, False, [])]
    if len(typed) > 1:
        problem = "exclude each other"
        raise InputError(None, problem, field=" and ".join(typed), remedy="give one of them")


def exactly_one(missing: str, remedy: str, /, **given: object) -> None:
    """Raise InputError unless one of several options was given; by their Python names.

    `missing` says what is not known without them, `remedy` gives each with a value.
    """
    at_most_one(**given)
    if all(value in (None, False, []) for value in given.values()):
        raise InputError(None, missing, remedy=remedy)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def numbers(text: str, count: int, option: str) -> list[float]:
    """Parse numbers separated by commas (InputError if they are not so many, or not finite)."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        problem = f"{text!r} is not {count} numbers"
        raise InputError(None, problem, field=option, remedy="separate them by commas")
    return values


def print_json(document: object) -> None:
    """Print one JSON object."""
    typer.echo(json.dumps(document))


def figures(
    texts: Sequence[str], option: str, example: str, *, bare: bool = True
) -> dict[str, float]:
    """Parse NAME=NUMBER values of an option (else InputError); with `bare`, NAME alone is 0."""
    numbers = {}
    for text in texts:
        name, equals, number = text.partition("=")
        try:
            numbers[name] = float(number) if equals or not bare else 0.0
        except ValueError as error:
            raise InputError(
                None, f"{text!r} is not NAME=NUMBER", field=option, remedy=f"write {example}"
            ) from error
    return numbers
