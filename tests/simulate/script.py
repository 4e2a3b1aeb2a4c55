"""One line of text for one thing that happens in a simulated campaign.

Faults of link, controller and arm are written as everywhere (`sim_fixtures.faults`); the
lines here are those of the PC, its disk and the person before it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from sim_fixtures.faults import GRAMMAR as FAULTS
from sim_fixtures.faults import Fault, FaultScriptError, parse_fault

GRAMMAR: Final = """\
KIND@AT[xCOUNT][:OPTION]         AT counts the controller's cycles from 0, through all runs of the
                                 campaign; or, where said, what is done with the disk

stall@1200:12ms                  the PC answers nothing for so long; :answering with an answer ready
clock@1200:+2s                   its clock jumps by so much, also backwards
kill@1200                        its process is killed
interrupt@1200                   Ctrl-C twice: the run unwinds in mid-motion
power-cut@1200:keep=0.3          the archive being written keeps that share; x2 the one before too
kill-at-write@7:keep=0.3         killed in the 7th write to archives, of which that share is there
kill-at-save@2:left              killed in the 2nd save of the manifest; or :before, :after
disk-full@7x2:keep=0.3           the 7th and 8th write to archives fail, with a share written
disk-error@7                     likewise, as a broken disk does
short-write@7:keep=0.3           the 7th write takes only a share of what it is given
save-full@2                      the 2nd save of the manifest fails
create-full@3                    the 3rd archive cannot be made
lurch@1200x3:0.01                a defect of ours: 3 set-points are off by 0.01 rad; or :nan
stop@1200                        Ctrl-C once: the arm is to stop on its path
override@1200:60                 the person asks for 60 % of the speed
hold@1200x3                      the person holds the arm, and releases it when asked 3 times
with-dry-run@0                   the campaign is rehearsed and does its dry run
declines@0x1                     the person does not accept the dry run the first time
hurry@0                          runs are begun again at once, the controller left as it is"""

KINDS: Final[dict[str, str]] = {
    "stall": "cycle",
    "clock": "cycle",
    "kill": "cycle",
    "interrupt": "cycle",
    "power-cut": "cycle",
    "lurch": "cycle",
    "stop": "cycle",
    "override": "cycle",
    "hold": "cycle",
    "kill-at-write": "write",
    "disk-full": "write",
    "disk-error": "write",
    "short-write": "write",
    "kill-at-save": "save",
    "save-full": "save",
    "create-full": "create",
    "with-dry-run": "always",
    "declines": "always",
    "hurry": "always",
}  # What `AT` of each kind counts
_LINE: Final = re.compile(
    r"(?P<kind>[a-z-]+)@(?P<at>\d{1,9})(?:x(?P<count>\d{1,6}))?(?P<options>(?::[^:\s]+)*)"
)
_NUMBER: Final = re.compile(r"(?:keep=)?(?P<value>[+-]?\d+(?:\.\d+)?)(?P<unit>ms|s)?")
_WORDS: Final = frozenset({"answering", "left", "before", "after", "nan"})


@dataclass(frozen=True)
class Mishap:
    """What happens to the PC, its disk, or by the person before it."""

    line: str  # as it was written
    kind: str  # one of `KINDS`
    at: int  # when; what it counts is in `KINDS`
    count: int = 1  # how often, or how many
    value: float = 0.0  # the number among the options: seconds, a share, percent; 0 for none
    word: str = ""  # the word among the options, "" for none


@dataclass(frozen=True)
class Script:
    """All that happens."""

    lines: tuple[str, ...]  # as written, in order
    faults: tuple[tuple[str, Fault], ...]  # of link, controller and arm, each with its line
    mishaps: tuple[Mishap, ...]  # of the PC, its disk and the person

    def of(self, counts: str) -> tuple[Mishap, ...]:
        """The mishaps whose `AT` counts that, in order."""
        return tuple(one for one in self.mishaps if KINDS[one.kind] == counts)

    def has(self, kind: str) -> bool:
        """Whether there is a mishap of this kind."""
        return any(one.kind == kind for one in self.mishaps)


DISTURBS_THE_ARM: Final = frozenset({"push", "saturate", "following-error"})
"""Kinds of lines after which it may be elsewhere than where it was sent."""


def kind_of(line: str) -> str:
    """The kind of a line, for tallies."""
    return line.partition("@")[0]


def parse_script(lines: Iterable[str]) -> Script:
    """Read a script; empty lines and those that begin with # say nothing.

    Raises:
        ValueError: a line is none of the grammar's.
    """
    kept = [line.strip() for line in lines]
    kept = [line for line in kept if line and not line.startswith("#")]
    faults: list[tuple[str, Fault]] = []
    mishaps: list[Mishap] = []
    for line in kept:
        if kind_of(line) in KINDS:
            mishaps.append(_mishap(line))
        else:
            faults.append((line, _fault(line)))
    return Script(tuple(kept), tuple(faults), tuple(mishaps))


def _fault(line: str) -> Fault:
    try:
        return parse_fault(line)
    except FaultScriptError as error:
        raise ValueError(
            f"{line!r} cannot be read ({error.reason}); lines are\n{GRAMMAR}\n{FAULTS}"
        ) from error


def _mishap(line: str) -> Mishap:
    match = _LINE.fullmatch(line)
    if match is None:
        raise ValueError(f"{line!r} cannot be read; lines are\n{GRAMMAR}\n{FAULTS}")
    value, word = 0.0, ""
    for option in filter(None, match["options"].split(":")):
        number = _NUMBER.fullmatch(option)
        if number is not None:
            value = float(number["value"]) * (1e-3 if number["unit"] == "ms" else 1.0)
        elif option in _WORDS:
            word = option
        else:
            raise ValueError(f"{line!r} has no option {option!r}; lines are\n{GRAMMAR}")
    count = int(match["count"]) if match["count"] else 1
    return Mishap(line, match["kind"], int(match["at"]), count, value, word)


def simpler(line: str) -> Sequence[str]:
    """The same line with smaller counts and plainer numbers, the boldest first."""
    found: list[str] = []
    for pattern, lead, trail in ((r"x(\d+)", "x", ""), (r":(\d+)ms", ":", "ms")):
        match = re.search(pattern, line)
        if match is not None and (number := int(match[1])) > 1:
            head, tail = line[: match.start()] + lead, trail + line[match.end() :]
            found += [f"{head}{less}{tail}" for less in (1, number // 2, number - 1)]
    match = re.search(r"@(\d+)", line)
    if match is not None:
        rounder = (round(int(match[1]), -2), round(int(match[1]), -1))
        head, tail = line[: match.start()], line[match.end() :]
        found += [f"{head}@{at}{tail}" for at in rounder]
    return [one for one in dict.fromkeys(found) if one != line]
