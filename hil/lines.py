"""Lines for a person: a terminal breaks them between words, a file or a pipe gets them whole."""

from __future__ import annotations

from rich.console import Console

from hil.terminal_text import printable


def put(console: Console, text: str) -> None:
    """Print one line as it is, without markup; broken between words where a person reads it.

    What steers a terminal is written out.
    """
    whole = not console.is_terminal
    console.print(printable(text), markup=False, emoji=False, highlight=False, soft_wrap=whole)


def say(text: str, *, err: bool = False) -> None:
    """Print one line to standard output, or to standard error."""
    put(Console(stderr=err), text)
