"""Command line of the package.

Exit statuses are in `hil.base.exit_status`. With `--json` stdout is one JSON object, also on
failure; the error text is printed to stderr in any case.
"""

from __future__ import annotations

import gc
import json
import os
import re
import sys
from collections import UserDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperCommand, TyperGroup, TyperOption

from hil.base.errors import DISK_ERRNOS, HilError, InputError, OperatorStopError
from hil.base.exit_status import ExitStatus
from hil.base.interrupt import leave_if_interrupted
from hil.base.progress_lines import command_lines
from hil.base.terminal_text import printable
from hil.base.version import software
from hil.cli.suggestions import OTHER_COMMANDS, improve, with_present_names


def asks_for_json(arguments: Sequence[str]) -> bool:
    """Return whether `--json` is among the options, which end at `--`."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return "--json" in options


def exit_code_of(error: BaseException) -> int:
    """Return the exit status of an error."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in DISK_ERRNOS:
            return ExitStatus.FAILED
        cause = cause.__cause__
    if _comes_from_below(error):
        return ExitStatus.BAD_INPUT
    code = getattr(error, "exit_code", ExitStatus.FAILED)  # of HilError and of click
    return code if isinstance(code, int) else 1


def _comes_from_below(error: BaseException) -> bool:
    """Return whether the error is one of the packages below, without importing them."""
    below = {
        "identification.errors": "IdentificationError",
        "planner.errors": "PlannerError",
        "sim_fixtures.settings": "SimulationError",
    }
    return any(
        isinstance(error, getattr(sys.modules.get(module), name, ()))
        for module, name in below.items()
    )


def as_json(error: BaseException) -> dict[str, Any]:
    """Return the JSON form of an error, with the figures of the work done before it."""
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
def errors_as_json(requested: bool) -> Iterator[None]:
    """Print an exception of the block as JSON if `requested`; Ctrl-C is an `OperatorStopError`."""
    try:
        yield
    except typer.Exit:  # the command has printed its result
        raise
    except KeyboardInterrupt as interrupt:
        stopped = OperatorStopError("interrupted")
        _print(stopped, requested)
        raise stopped from interrupt
    except Exception as error:
        improve(error)
        if isinstance(error, typer.BadParameter):  # typer checks choices by pydantic
            error.message = error.message.removeprefix("Value error, ")
        _print(error, requested)
        raise


def _print(error: Exception, requested: bool) -> None:
    if requested:
        with suppress(OSError):  # the reader has closed the pipe; the exit status remains
            typer.echo(json.dumps(as_json(error)))


class LazyCommands(UserDict[str, Any]):
    """Commands by name, imported on first use: the function of that name or `app` of a module."""

    def __getitem__(self, name: str) -> Any:
        """Return the command, importing it on first use."""
        command = super().__getitem__(name)
        if command is None:
            # Modules leave nothing to collect: looking for it takes a tenth of their time now, and
            # would again during the command and at its end.
            gc.disable()
            try:
                command = self[name] = _command(name)
            finally:
                gc.freeze()
                gc.enable()
        return command

    def purpose(self, name: str) -> str:
        """Read the purpose of a command from its docstring, without importing it."""
        source = Path(__file__).with_name(f"{_module(name)}.py").read_text("utf-8")
        text = source.splitlines()[0].partition(": ")[2].removesuffix('"""')
        return text[0].upper() + text[1:]

    def by_purpose(self) -> dict[str, Any]:
        """Return commands that have only a purpose, for help and completion."""
        return {
            name: TyperCommand(name, help=self.purpose(name), rich_help_panel=panel)
            for panel, names in GROUPS.items()
            for name in names
        }


def _module(name: str) -> str:
    return "imports" if name == "import" else name.replace("-", "_")  # a Python keyword


def _command(name: str) -> Any:
    with leave_if_interrupted():
        module = import_module(f"{__name__}.{_module(name)}")
    alone = typer.Typer(callback=lambda: None, rich_markup_mode="markdown", add_completion=False)
    if hasattr(module, "app"):
        alone.add_typer(module.app, name=name)
    else:
        alone.command(name)(getattr(module, _module(name)))
    group = typer.main.get_command(alone)
    assert isinstance(group, TyperGroup)
    return presented(group.commands[name])


def presented(command: Any) -> Any:
    """Return the command with the help of its options from `Options:` in its docstring."""
    if isinstance(commands := getattr(command, "commands", {}), LazyCommands):
        commands = {}
    for subcommand in commands.values():
        presented(subcommand)
    text, _, options = (command.help or "").partition("\n\nOptions:\n")
    command.help = text
    entries = re.split(r"^    (?=\w)", options, flags=re.MULTILINE)[1:]
    explained = dict(entry.split(": ", 1) for entry in entries)
    for option in (*command.params, command.get_help_option(typer.Context(command))):
        if option.name in explained:
            option.help = " ".join(explained[option.name].split())
        if getattr(option, "is_flag", False):
            option.metavar = ""
            option.secondary_opts = option.secondary_opts if option.default else []
        elif isinstance(option, TyperOption):
            _shorten(option)
    return command


def _shorten(option: TyperOption) -> None:
    """Put the default of an option into its text, and N in place of "<int range>"."""
    if option.metavar is None and (option.min is not None or option.max is not None):
        option.metavar = "N"
    default = option.default
    if isinstance(default, str | int | float | Path) and "Default:" not in (option.help or ""):
        option.help = f"{option.help} Default: {default}."
    option.show_default = False


GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "Start": ("demo", "new", "look"),
    "Identify": (
        "identify", "payload", "torque-constants", "batch", "compare", "trend", "export", "rollout",
        "report",
    ),
    "On the controller": (
        "doctor", "rehearse", "run", "status", "move", "record", "simulate",
    ),
    "Archives": ("import", "archive", "plot"),
    "Method": ("design", "plan", "study"),
}  # fmt: skip
"""Commands in the order of the help, by its panels."""

COMMANDS = LazyCommands(dict.fromkeys(name for names in GROUPS.values() for name in names))
"""All commands by name."""

_JSON = "hil.cli.json"
_LINES = "hil.cli.lines"
OWN_LINES: Final = frozenset(("simulate", "run", "record", "move"))
"""Commands that print lines of their own."""


class CommandGroup(TyperGroup):
    """The commands of `COMMANDS`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{**settings, "commands": COMMANDS})

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Show the commands by their purposes, without importing them."""
        presented(self)
        self.commands = COMMANDS.by_purpose()
        super().format_help(ctx, formatter)
        self.commands = COMMANDS

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete the name of a command, without importing one."""
        self.commands = COMMANDS.by_purpose()
        return super().shell_complete(ctx, incomplete)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the first argument names, or suggest one."""
        if args[0] in OTHER_COMMANDS and args[0] not in COMMANDS:
            ctx.fail(f"No such command {args[0]!r}. Did you mean 'hil {OTHER_COMMANDS[args[0]]}'?")
        return super().resolve_command(ctx, args)

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **extra: Any) -> Any:
        """Return the context of one call; it records whether JSON is requested."""
        requested = asks_for_json(args)
        args, notes = with_present_names(args)
        for note in notes:
            typer.echo(f"note: {note}", err=True)
        with errors_as_json(requested):
            context = super().make_context(info_name, args, *more, **extra)
        context.meta[_JSON] = requested
        quiet = (
            requested or bool({"-q", "--quiet"} & {*args}) or args[:1] == [] or args[0] in OWN_LINES
        )
        context.meta[_LINES] = "" if quiet else args[0]
        return context

    def invoke(self, ctx: Any) -> Any:
        """Run the command; print a failure as JSON if requested."""
        command = ctx.meta.get(_LINES, "")
        with (
            errors_as_json(ctx.meta.get(_JSON, False)),
            command_lines(command, quiet=not command),
        ):
            return super().invoke(ctx)


def _print_versions(requested: bool) -> None:
    if requested:
        hil, *others = (f"{name} {number}" for name, number in software().items())
        typer.echo(f"{hil} ({', '.join(others)})")
        raise typer.Exit


_VERSION = typer.Option(
    "--version",
    callback=_print_versions,
    is_eager=True,
    help="Show the versions of hil and its numerical libraries.",
)


def _global_options(version: Annotated[bool, _VERSION] = False) -> None:
    """Declare the global option; its callback does the work."""


app = typer.Typer(
    name="hil",
    cls=CommandGroup,
    callback=_global_options,
    help=(
        "Identify the dynamics of an industrial robot with its own controller in the loop.\n\n"
        "Start with `hil demo`: a complete campaign on a simulated COMAU NS 16, with a report."
    ),
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line; known errors become one line on stderr and an exit status."""
    try:
        app(standalone_mode=True)
    except OSError as error:
        if error.errno not in DISK_ERRNOS:
            raise
        file = f"{error.filename}: " if error.filename else ""
        _fail(f"{file}cannot be written ({error.strerror}); make room", ExitStatus.FAILED)
    except KeyboardInterrupt:
        _fail("interrupted", ExitStatus.STOPPED, stopped=True)
    except Exception as error:
        if not isinstance(error, HilError) and not _comes_from_below(error):
            raise
        text = "; ".join([str(error), *getattr(error, "__notes__", ())])
        _fail(text, exit_code_of(error), stopped=isinstance(error, OperatorStopError))


def _fail(text: str, status: int, *, stopped: bool = False) -> None:
    """Print one line and exit; a stop by the operator is not labelled an error."""
    word = ("stopped:", "bold yellow") if stopped else ("error:", "bold red")
    console = Console(stderr=True)
    try:
        line = Text.assemble(word, " ", printable(text))
        console.print(line, highlight=False, soft_wrap=not console.is_terminal)
    except OSError:  # the terminal is closed; the exit status remains
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
    sys.exit(status)
