"""How a command that fails says so where a script reads it: one JSON object on stdout.

The sentence for a person goes to stderr all the same, and the exit status is the same.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import typer

from hil.errors import DISK_REFUSES, HilError, InputError, OperatorStopError
from identification import IdentificationError
from planner import PlannerError

INTERNAL = 1
"""Exit status of an internal error, and where a disk is full or refuses to be written."""
USAGE = 2
"""Exit status where something that was typed or given cannot be used."""


def asks_for_json(arguments: Sequence[str]) -> bool:
    """Whether a command was typed with `--json`; what follows `--` is no option."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return "--json" in options


def exit_code_of(error: BaseException) -> int:
    """The exit status that an error ends the command line with."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in DISK_REFUSES:
            return INTERNAL
        cause = cause.__cause__
    if isinstance(error, PlannerError | IdentificationError):
        return USAGE
    code = getattr(error, "exit_code", 1)  # HilError, and what typer says of a wrong command line
    return code if isinstance(code, int) else 1


def as_json(error: BaseException) -> dict[str, Any]:
    """What a script receives of an error.

    Returns:
        `error`: the sentence; `kind`: name of its class; `exit_code`; of an `InputError` also
        `path`, `field`, `problem` and `remedy`, null or "" where there is none; and the figures of
        what was done before.
    """
    sentence = error.format_message() if hasattr(error, "format_message") else str(error)
    figures = error.figures if isinstance(error, HilError) else {}
    document: dict[str, Any] = {
        **figures,
        "error": sentence or type(error).__name__,
        "kind": type(error).__name__,
        "exit_code": exit_code_of(error),
    }
    if isinstance(error, InputError):
        document |= {
            "path": None if error.path is None else str(error.path),
            "field": error.field,
            "problem": error.problem,
            "remedy": error.remedy,
        }
    return document


@contextmanager
def errors_as_json(asked: bool) -> Iterator[None]:
    """Print what ends the block as JSON, if that was asked for; it goes on as it is.

    Ctrl-C becomes an `OperatorStopError`.
    """
    try:
        yield
    except typer.Exit:  # a command that has said what there is to say
        raise
    except KeyboardInterrupt as interrupt:
        stopped = OperatorStopError("interrupted")
        _print(stopped, asked)
        raise stopped from interrupt
    except Exception as error:
        _print(error, asked)
        raise


def _print(error: Exception, asked: bool) -> None:
    if asked:
        with suppress(OSError):  # nobody reads any more; the status still counts
            typer.echo(json.dumps(as_json(error)))
