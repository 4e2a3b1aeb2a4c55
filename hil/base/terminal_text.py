"""Text for a terminal, from untrusted names of files, joints, fields and events."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from os import PathLike
from typing import Final

_JOINT_NUMBER: Final = re.compile(r"\bjoint (\d{1,3})\b")


def typed(path: str | PathLike[str]) -> str:
    """Return a path as a word of a command line, quoted where a shell needs it."""
    return shlex.quote(str(path))


def with_joint_names(text: str, joint_names: Sequence[str]) -> str:
    """Return a text of the drivers, which number joints from 1, with the names of the joints."""

    def name(match: re.Match[str]) -> str:
        index = int(match[1]) - 1
        return joint_names[index] if 0 <= index < len(joint_names) else match[0]

    return _JOINT_NUMBER.sub(name, text)


def one_line(text: str) -> str:
    """Return a text as one printable line: names in archives may contain anything."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def plural(number: int, noun: str) -> str:
    """Return number and noun: 1 packet, 2 packets, 2 replies."""
    several = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else several}"


def printable(text: str, *, keep: str = "\n") -> str:
    """Return the text with nonprintable characters as Python escapes, except the ones in `keep`."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else escape(c) for c in text)


def escape(character: str) -> str:
    """Return a character as a Python escape."""
    return character.encode("unicode_escape").decode("ascii")
