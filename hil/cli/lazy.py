"""Commands that are imported when they are typed: none pays for the libraries of another."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperGroup

from hil.importing import leave_if_interrupted


class LazyCommands(UserDict[str, Any]):
    """Commands by name, each from the module of this package that has its name or the one given.

    A module has either a function of the command's name, or an `app` of several commands.

    Args:
        names: of the commands, in the order of the help.
        modules: of those whose module is called otherwise.
    """

    def __init__(self, names: Sequence[str], **modules: str) -> None:
        super().__init__({name: modules.get(name, name) for name in names})

    def __getitem__(self, name: str) -> Any:
        """The command, imported if it was not yet."""
        known = super().__getitem__(name)
        if isinstance(known, str):
            known = self[name] = _command(name, known)
        return known


def _command(name: str, module: str) -> Any:
    with leave_if_interrupted():
        found = import_module(f"{__package__}.{module}")
    alone = typer.Typer(callback=lambda: None, rich_markup_mode="markdown", add_completion=False)
    if hasattr(found, "app"):
        alone.add_typer(found.app, name=name)
    else:
        alone.command(name)(getattr(found, name))
    group = typer.main.get_command(alone)
    assert isinstance(group, TyperGroup)
    return without_flag_types(group.commands[name])


def without_flag_types(command: Any) -> Any:
    """The command, in whose help nothing stands behind a flag: nothing is typed there."""
    help_option = command.get_help_option(typer.Context(command))
    for option in (*command.params, help_option):
        if getattr(option, "is_flag", False):
            option.metavar = ""
    if not isinstance(commands := getattr(command, "commands", {}), LazyCommands):
        for one in commands.values():
            without_flag_types(one)
    return command
