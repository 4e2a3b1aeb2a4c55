"""Text for one screen: at most 24 lines of 100 columns."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

SCREEN_LINES: Final = 24
SCREEN_COLUMNS: Final = 100
MAX_JOINT_ROWS: Final = 8
"""Rows of a table of joints, next to what else is on the screen."""
TAIL_LINES: Final = 3
"""Lines at the end of a long list: files, what was skipped, counts."""
_ELLIPSIS: Final = " ..."
_CONTINUED: Final = " \\"
_SENTENCE_END: Final = re.compile(r"(?<=[\w)%]\.) (?=[A-Z])")
_CLAUSE_END: Final = re.compile(r"[;,](?= )")
_LEAST_SHOWN: Final = (
    0.6  # of the text that fits, where it is cut at the end of a sentence or clause
)
_COMMAND: Final = re.compile(r"(?:^|[:>,] |then )(hil [a-z][^;()`]*)$")
_COMMAND_LINES: Final = 12  # at most, of a command to copy


@dataclass(frozen=True)
class Paragraph:
    """Text that takes at least one line, and more where there is room."""

    text: str
    label: str = ""  #: before the first line; the others are indented by as much
    most: int = 4  #: lines
    complete: bool = False  #: whether it is never cut, such as a command to copy

    def lines(self, count: int) -> list[str]:
        """Return the text on at most `count` lines, cut after a sentence, a clause or a word."""
        text = " ".join(self.text.split())
        whole = _broken(text, self.label, most=len(text) + 1)
        return whole if len(whole) <= count else _cut_to(text, self.label, count)

    @property
    def whole(self) -> int:
        """Number of lines of the whole text, at most `most`."""
        return min(self.most, len(self.lines(len(self.text) + 1)))

    @property
    def least(self) -> int:
        """Number of lines that it gets in any case."""
        return self.whole if self.complete else 1


Part = str | Paragraph
"""A line as it is, such as the row of a table; or text that may be cut."""


def one_screen(parts: Sequence[Part], lines: int = SCREEN_LINES) -> list[str]:
    """Return parts on at most `lines` lines: one each, and the first parts get the remaining ones.

    Text that is never cut gets all its lines before them.

    Empty lines are dropped, the last one first, if text needs the space.
    """
    chosen = list(parts)
    wanted = len(chosen) + sum(part.whole - 1 for part in chosen if isinstance(part, Paragraph))
    while wanted > lines and "" in chosen:
        del chosen[len(chosen) - 1 - chosen[::-1].index("")]
        wanted = wanted - 1
    spare = lines - sum(1 if isinstance(part, str) else part.least for part in chosen)
    shown: list[str] = []
    for part in chosen:
        if isinstance(part, str):
            shown.append(
                part[:SCREEN_COLUMNS].rstrip() if len(part) <= SCREEN_COLUMNS else _cut(part)
            )
            continue
        more = min(part.whole - part.least, max(spare, 0))
        spare -= more
        shown += part.lines(part.least + more)
    return shown[:lines]


def brief(lines: Sequence[str], last: int = 1) -> list[str]:
    """Return lines on one screen: of too many the first ones, their number, and the last ones."""
    shown: list[str] = list(lines)
    if (more := len(shown) - SCREEN_LINES) > 0:
        head = shown[: SCREEN_LINES - last - 1]
        shown = [*head, f"{more + 1} more lines: -v", *shown[len(shown) - last :]]
    return one_screen([line if len(line) <= SCREEN_COLUMNS else _paragraph(line) for line in shown])


def _paragraph(line: str) -> Paragraph:
    if _COMMAND.search(line) is None:
        return Paragraph(line, _indent(line))
    return Paragraph(line, _indent(line), _COMMAND_LINES, complete=True)


def _indent(line: str) -> str:
    return " " * (len(line) - len(line.lstrip()))


def _cut(line: str) -> str:
    return line[: SCREEN_COLUMNS - len(_ELLIPSIS)].rstrip() + _ELLIPSIS


def wrapped(text: str) -> str:
    """Return text whose long lines are broken between words, at `SCREEN_COLUMNS`."""
    broken = ([line] if len(line) <= SCREEN_COLUMNS else _broken(line) for line in text.split("\n"))
    return "\n".join(part for parts in broken for part in parts)


def _broken(text: str, label: str = "", *, most: int | None = None) -> list[str]:
    """Return text on lines of `SCREEN_COLUMNS`, a command at its end as a shell continues it.

    At most `most` lines, the last one cut at the end of a word.
    """
    command = _COMMAND.search(text)
    lines = textwrap.wrap(
        text,
        SCREEN_COLUMNS - (len(_CONTINUED) if command else 0),
        initial_indent=label,
        subsequent_indent=" " * len(label),
        max_lines=most,
        placeholder=_ELLIPSIS,
        break_on_hyphens=False,
        break_long_words=most is not None,
    )
    if command is None:
        return lines
    shown = 0
    for k, line in enumerate(lines[:-1]):
        shown += len(line) - len(label) + 1
        if shown > command.start(1):
            lines[k] += _CONTINUED
    return lines


def _cut_to(text: str, label: str, count: int) -> list[str]:
    """Return the beginning of a text on `count` lines; half a sentence says little."""
    cut = _broken(text, label, most=count)
    least = _LEAST_SHOWN * sum(map(len, cut))
    for end, mark in ((_SENTENCE_END, ""), (_CLAUSE_END, _ELLIPSIS)):
        starts = (text[: each.start()] + mark for each in end.finditer(text))
        parts = (_broken(start, label, most=len(text)) for start in starts)
        fitting = [lines for lines in parts if len(lines) <= count]
        if fitting and sum(map(len, fitting[-1])) >= least:
            return fitting[-1]
    return cut


def columns(rows: Sequence[Sequence[str]], *, left: int = 1) -> list[str]:
    """Return rows as lines with aligned columns, the first ones flush left, the others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if k < left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
