"""Scripts of faults: one line says what happens, and when.

Faults of link, controller and arm have the format of `sim_fixtures.faults`. The other lines are
faults of the PC and its disk, and acts of the operator: `parse_script` for campaigns in virtual
time, `parse_strikes` for real processes, `parse_disk_fault` for the files of any process.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, cast, get_args

from drivers.states import State
from sim_fixtures.faults import GRAMMAR as FAULTS
from sim_fixtures.faults import Fault, FaultScriptError, parse_fault

GRAMMAR: Final = """\
KIND@AT[xCOUNT][:OPTION]         AT counts the controller's cycles from 0, through all runs of the
                                 campaign, or operations of the disk

stall@1200:12ms                  the PC stalls; :answering when an answer is ready
clock@1200:+2s                   its clock jumps, also backwards
kill@1200                        its process is killed
interrupt@1200                   Ctrl-C twice: the run is aborted during a motion
power-cut@1200:keep=0.3          a share of the present archive remains; x2 also of the previous one
kill-at-write@7:keep=0.3         killed in the 7th write to archives, of which a share is written
kill-at-save@2:left              killed in the 2nd save of the manifest; or :before, :after
disk-full@7x2:keep=0.3           the 7th and 8th write to archives fail after a share (ENOSPC)
disk-error@7                     the 7th write fails (EIO)
short-write@7:keep=0.3           the 7th write writes a share only
save-full@2                      the 2nd save of the manifest fails
create-full@3                    the 3rd archive cannot be created
lurch@1200x3:0.01                a simulated defect: 3 set-points are off by 0.01 rad; or :nan
stop@1200                        Ctrl-C once: stop on the path
override@1200:60                 the operator sets the speed to 60 %
hold@1200x3                      the operator holds the arm until asked 3 times
with-dry-run@0                   the campaign is rehearsed and does its dry run
declines@0x1                     the operator does not accept the first dry run
hurry@0                          runs are repeated at once, without a restart of the controller"""

_KINDS_BY_UNIT: Final = {
    "cycle": "stall clock kill interrupt power-cut lurch stop override hold",
    "write": "kill-at-write disk-full disk-error short-write",
    "save": "kill-at-save save-full",
    "create": "create-full",
    "always": "with-dry-run declines hurry",
}
KINDS: Final = {kind: what for what, kinds in _KINDS_BY_UNIT.items() for kind in kinds.split()}
"""Quantity counted by `AT` of each kind."""
_LINE: Final = re.compile(
    r"(?P<kind>[a-z-]+)@(?P<at>\d{1,9})(?:x(?P<count>\d{1,6}))?(?P<options>(?::[^:\s]+)*)"
)
_NUMBER: Final = re.compile(r"(?:keep=)?(?P<value>[+-]?\d+(?:\.\d+)?)(?P<unit>ms|s)?")
_WORDS: Final = frozenset({"answering", "left", "before", "after", "nan"})


@dataclass(frozen=True)
class ScriptedEvent:
    """A fault of the PC or its disk, or an act of the operator."""

    line: str  # its text
    kind: str  # one of `KINDS`
    at: int  # in the unit of `KINDS`
    count: int = 1
    value: float = 0.0  # number among the options: seconds, a share, percent; 0 for none
    word: str = ""  # word among the options; "" for none


@dataclass(frozen=True)
class Script:
    lines: tuple[str, ...]
    faults: tuple[tuple[str, Fault], ...]  # of link, controller and arm, each with its line
    events: tuple[ScriptedEvent, ...]  # of PC, disk and operator

    def of(self, counts: str) -> tuple[ScriptedEvent, ...]:
        """Return the events whose `AT` counts this quantity, in order."""
        return tuple(event for event in self.events if KINDS[event.kind] == counts)

    def has(self, kind: str) -> bool:
        return any(event.kind == kind for event in self.events)


DISTURBS_THE_ARM: Final = frozenset({"push", "saturate", "following-error"})
"""Kinds of faults that move the arm away from its set-points."""


def kind_of(line: str) -> str:
    """Return the kind of a line."""
    return line.partition("@")[0]


def parse_script(lines: Iterable[str]) -> Script:
    """Parse a script, without empty lines and comments (#); ValueError for an invalid line."""
    used = _used(lines)
    faults = tuple((line, _fault(line)) for line in used if kind_of(line) not in KINDS)
    events = tuple(_event(line) for line in used if kind_of(line) in KINDS)
    return Script(tuple(used), faults, events)


def _used(lines: Iterable[str]) -> list[str]:
    stripped = [line.strip() for line in lines]
    return [line for line in stripped if line and not line.startswith("#")]


def _fault(line: str) -> Fault:
    try:
        return parse_fault(line)
    except FaultScriptError as error:
        raise ValueError(
            f"{line!r} cannot be read ({error.reason}); lines are\n{GRAMMAR}\n{FAULTS}"
        ) from error


def _event(line: str) -> ScriptedEvent:
    match = _LINE.fullmatch(line)
    if match is None:
        raise ValueError(f"{line!r} cannot be read; lines are\n{GRAMMAR}\n{FAULTS}")
    value = 0.0
    word = ""
    for option in filter(None, match["options"].split(":")):
        number = _NUMBER.fullmatch(option)
        if number is not None:
            value = float(number["value"]) * (1e-3 if number["unit"] == "ms" else 1.0)
        elif option in _WORDS:
            word = option
        else:
            raise ValueError(f"{line!r} has no option {option!r}; lines are\n{GRAMMAR}")
    count = int(match["count"]) if match["count"] else 1
    return ScriptedEvent(line, match["kind"], int(match["at"]), count, value, word)


STRIKES: Final = """\
KIND@MOMENT[COUNT][:OPTION]:PROCESS

KIND     kill (SIGKILL), freeze (SIGSTOP), interrupt (Ctrl-C), hangup (its terminal is closed),
         disk-full (its newest archive cannot grow)
MOMENT   start of the supervisor; the COUNTth cycle of the controller, motion, archive that is
         created, archive that is entered in the manifest, or state of the session that is entered;
         then: so long after the line before
OPTION   way=0.34s: so far has the motion come in its own time; state=opening: which state;
         after=0.02s: so long after the moment
PROCESS  exchange, archive, supervisor or controller"""

Victim = Literal["exchange", "archive", "supervisor", "controller"]
Moment = Literal["start", "cycle", "motion", "archive", "entered", "state"]
StrikeKind = Literal["kill", "freeze", "interrupt", "hangup", "disk-full"]

_STRIKE: Final = re.compile(
    rf"(?P<kind>{'|'.join(get_args(StrikeKind))})@"
    rf"(?P<moment>then|{'|'.join(get_args(Moment))})(?P<count>\d*)"
    r"(:way=(?P<way>[\d.e-]+)s)?(:state=(?P<state>[a-z_]+))?(:after=(?P<after>[\d.e-]+)s)?"
    rf":(?P<victim>{'|'.join(get_args(Victim))})"
)


@dataclass(frozen=True)
class Trigger:
    """When the first process is struck: `delay` s after its moment.

    `moment` is the `start` of the supervisor, a `cycle` of the controller, a time of a `motion`, an
    `archive` that is created or `entered` in the manifest, or a `state` of the exchange.
    """

    moment: Moment
    count: int  # which cycle, or which motion, archive, entry or time that the state was entered
    delay: float  # s from then to the kill
    way: float = 0.0  # s of its own time that a motion has come, where one is waited for
    state: State = State.CLOSED  # of the session, where one is waited for

    def __str__(self) -> str:
        way = f":way={self.way!r}s" if self.moment == "motion" else ""
        state = f":state={self.state.name.lower()}" if self.moment == "state" else ""
        return f"{self.moment}{self.count}{way}{state}:after={self.delay!r}s"


@dataclass(frozen=True)
class Strikes:
    """What happens to real processes: to one, and to others after it."""

    kind: StrikeKind
    trigger: Trigger  # when the first is struck
    victims: tuple[Victim, ...]  # in this order
    apart: float = 0.0  # s between two

    @property
    def lines(self) -> tuple[str, ...]:
        """Its script."""
        first, *others = self.victims
        then = (f"{self.kind}@then:after={self.apart!r}s:{victim}" for victim in others)
        return (f"{self.kind}@{self.trigger}:{first}", *then)


def parse_strikes(lines: Iterable[str]) -> Strikes:
    """Parse a script for real processes; ValueError for an invalid one."""
    used = _used(lines)
    matches = [_STRIKE.fullmatch(line) for line in used]
    if not used or None in matches:
        wrong = next((line for line, match in zip(used, matches, strict=True) if not match), "")
        raise ValueError(f"{wrong!r} cannot be read; lines are\n{STRIKES}")
    first, *others = (match for match in matches if match is not None)
    apart = {float(match["after"] or 0.0) for match in others}
    alike = all(match["moment"] == "then" for match in others) and len(apart) <= 1
    if first["moment"] == "then" or not alike or {m["kind"] for m in others} - {first["kind"]}:
        raise ValueError(
            f"{used!r}: the lines after the first are of its kind, `then`, and equally far apart"
        )
    state = (first["state"] or "closed").upper()
    if state not in State.__members__:
        raise ValueError(f"{used[0]!r} has no state of a session")
    trigger = Trigger(
        cast(Moment, first["moment"]),
        int(first["count"] or 0),
        float(first["after"] or 0.0),
        float(first["way"] or 0.0),
        State[state],
    )
    victims = tuple(cast(Victim, match["victim"]) for match in (first, *others))
    return Strikes(cast(StrikeKind, first["kind"]), trigger, victims, *apart)


DISK_FAULTS: Final = """\
KIND@OPERATION[,OPERATION][+AFTER][xTIMES]:NAMES

KIND       EIO, EDQUOT, ENOSPC or EROFS: the operation fails so; hang=7s: it takes so long, and what
           follows waits
OPERATION  create, write, fsync, rename; all for each of them
AFTER      so many pass before; TIMES: on how many it acts, without it on all from there on
NAMES      pattern of the names of files"""

CREATE = "create"
WRITE = "write"
SYNC = "fsync"
RENAME = "rename"
CHANGES: Final = (CREATE, WRITE, SYNC, RENAME)  # operations on which a disk may fail or hang
REFUSALS: Final = {name: getattr(errno, name) for name in ("EIO", "EDQUOT", "ENOSPC", "EROFS")}
_DISK_FAULT: Final = re.compile(
    rf"((?P<error>{'|'.join(REFUSALS)})|hang=(?P<hang>[\d.]+)s)@"
    rf"(?P<operations>all|({'|'.join(CHANGES)})(,({'|'.join(CHANGES)}))*)"
    r"(\+(?P<after>\d+))?(x(?P<times>\d+))?:(?P<names>\S+)"
)


@dataclass(frozen=True)
class DiskFault:
    """A disk that fails or hangs."""

    operations: Sequence[str] = CHANGES  # on which of `CHANGES`
    names: str = "*"  # pattern of the names of files it is about
    after: int = 0  # how many matching operations pass before it begins
    times: int = 0  # on how many it then acts; 0: on all
    error: str = ""  # name of the error, "" for none
    hang: float = 0.0  # s, counted from the first of them, until which none of them ends

    def __str__(self) -> str:
        what = self.error or f"hang={self.hang:g}s"
        on = "all" if tuple(self.operations) == CHANGES else ",".join(self.operations)
        after = f"+{self.after}" if self.after else ""
        times = f"x{self.times}" if self.times else ""
        return f"{what}@{on}{after}{times}:{self.names}"


def parse_disk_fault(line: str) -> DiskFault:
    """Parse a line; ValueError for an invalid one."""
    match = _DISK_FAULT.fullmatch(line)
    if match is None:
        raise ValueError(f"{line!r} cannot be read; lines are\n{DISK_FAULTS}")
    operations = CHANGES if match["operations"] == "all" else match["operations"].split(",")
    return DiskFault(
        tuple(operations),
        match["names"],
        int(match["after"] or 0),
        int(match["times"] or 0),
        match["error"] or "",
        float(match["hang"] or 0.0),
    )
