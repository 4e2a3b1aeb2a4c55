"""Untrusted texts, for a terminal: names of files, joints, fields, events."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """Return number and noun: 1 packet, 2 packets, 2 replies."""
    several = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else several}"


def printable(text: str, *, keep: str = "\n") -> str:
    """The text with whatever is not printed written out, as Python writes it in a string.

    A terminal obeys control characters and turns lines round for others; what is no character at
    all (bytes of a file name that are no UTF-8) cannot even be written.

    Args:
        text: anything.
        keep: characters that stay nevertheless.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else written_out(c) for c in text)


def written_out(character: str) -> str:
    """A character as Python writes it in a string."""
    return character.encode("unicode_escape").decode("ascii")
