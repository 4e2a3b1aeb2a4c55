"""Text for a terminal, from untrusted names of files, joints, fields and events."""

from __future__ import annotations

import shlex
from os import PathLike


def typed(path: str | PathLike[str]) -> str:
    """Return a path as a word of a command line, quoted where a shell needs it."""
    return shlex.quote(str(path))


def plural(number: int, noun: str) -> str:
    """Return number and noun: 1 packet, 2 packets, 2 replies."""
    several = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else several}"


def printable(text: str, *, keep: str = "\n") -> str:
    """Return the text with nonprintable characters, except those in `keep`, as Python escapes."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else escape(c) for c in text)


def escape(character: str) -> str:
    """Return a character as a Python escape."""
    return character.encode("unicode_escape").decode("ascii")
