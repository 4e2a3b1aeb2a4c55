"""Faults of the simulated controller and its robot, and the text format of all faults.

Cycles are packets of the controller from 0, as in the simulated link; axes count from 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from drivers.transports import simulated as link
from sim_fixtures.arm import DisturbanceKind
from sim_fixtures.settings import SimulationError

GRAMMAR: Final = """\
KIND@CYCLE[xCOUNT][:OPTION]...   cycles count the controller's packets from 0; both up to 1e9

lose@1200x3                      packets to the PC are lost; :to_controller the PC's replies
delay@1200:5ms                   they arrive later, by ms, us, s or cycles (:1.5cycles)
duplicate@1200                   they arrive twice
reorder@1200                     the packet is overtaken by the next one
corrupt@1200:offset=8            the byte at that offset is changed; :mask=0x80 says which bits
    all five: to_pc (the default) or to_controller
restart@5000:cold                the controller restarts; :warm with the init packet at once
drive-drop@2000                  the drive is switched off
e-stop@2000                      the emergency stop is pressed
axis-leaves@2000:axis=3          one axis leaves open mode
following-error@2000x500:axis=2  the axis is stuck; :slip its encoder reads a wrong position
saturate@2000x500:axis=1         a load drives the current near its limit
push@2000x50:axis=1              a push on the axis that does not trip the drive
pause@2000x50:502                the controller pauses; :500 for the other kind"""


SLIP_FACTOR = 1.5  # encoder error as a multiple of the following-error threshold
LOAD_SHARE = 0.9  # load as a share of the largest motor torque
PUSH_SHARE = 0.15  # push as a share of the largest motor torque; it does not trip the drive


class FaultyProgram(Protocol):
    """Changes of a controller's program by faults."""

    def axis_leaves(self, axis: int) -> None:
        """Close one axis, from 0, while the others stay open."""

    def pause(self, mode: int, cycles: int) -> None:
        """Report a pause, mode 500 or 502, for some cycles."""


class FaultyController(Protocol):
    """A controller in which faults can be injected, with its arm."""

    @property
    def program(self) -> FaultyProgram:
        """Its program."""

    def restart(self, *, warm: bool) -> None:
        """Restart, warm or cold."""

    def lose_drive(self, reason: str) -> None:
        """Switch the drive off for a reason."""

    def disturb(self, kind: DisturbanceKind, axis: int, size: float, cycles: int) -> None:
        """Disturb one axis; see `SimulatedController.disturb`.

        Args:
            kind: of the disturbance.
            axis: from 1.
            size: as there.
            cycles: that it lasts.
        """


@dataclass(frozen=True)
class InjectedFault:
    """One fault of the controller or its robot; see `GRAMMAR` for the kinds.

    `cycle` is the first one, `axis` counts from 1, `count` is its duration in cycles,
    `word` the option of the kind, "" without one.
    """

    kind: str
    cycle: int
    axis: int = 1
    count: int = 1
    word: str = ""

    def apply_to(self, controller: FaultyController) -> None:
        """Apply the fault."""
        match self.kind:
            case "restart":
                controller.restart(warm=self.word == "warm")
            case "drive-drop":
                controller.lose_drive("the drive dropped out")
            case "e-stop":
                controller.lose_drive("emergency stop")
            case "axis-leaves":
                controller.program.axis_leaves(self.axis - 1)
            case "following-error":
                controller.disturb(
                    "slip" if self.word == "slip" else "jam", self.axis, SLIP_FACTOR, self.count
                )
            case "pause":
                controller.program.pause(int(self.word), self.count)
            case _:
                size = LOAD_SHARE if self.kind == "saturate" else PUSH_SHARE
                controller.disturb("load", self.axis, size, self.count)


Fault = link.Fault | InjectedFault


class _Kind(NamedTuple):
    """Kind of fault: default count (0: none), names of its options, the required one, a word."""

    times: int = 0
    options: tuple[str, ...] = ()
    needed: str = ""
    word: str = ""


_KINDS: Final[Mapping[str, _Kind]] = {
    "lose": _Kind(1, ("to",)),
    "delay": _Kind(1, ("time", "to"), "time"),
    "duplicate": _Kind(1, ("to",)),
    "reorder": _Kind(0, ("to",)),
    "corrupt": _Kind(1, ("offset", "mask", "to"), "offset"),
    "restart": _Kind(0, ("start",), word="cold"),
    "drive-drop": _Kind(),
    "e-stop": _Kind(),
    "axis-leaves": _Kind(0, ("axis",), "axis"),
    "following-error": _Kind(500, ("axis", "how"), "axis", "jam"),
    "saturate": _Kind(500, ("axis",), "axis"),
    "push": _Kind(50, ("axis",), "axis"),
    "pause": _Kind(50, ("mode",), word="502"),
}
_HEAD: Final = re.compile(r"([a-z-]+)@(\d{1,10})(?:x(\d{1,10}))?")
_OPTIONS: Final = {
    "to": re.compile(r"to_pc|to_controller"),
    "time": re.compile(r"(\d+(?:\.\d+)?)(us|ms|s|cycles?)"),
    "offset": re.compile(r"offset=(0x[\da-fA-F]+|\d+)"),
    "mask": re.compile(r"mask=(0x[\da-fA-F]+|\d+)"),
    "axis": re.compile(r"axis=([1-9]\d*)"),
    "start": re.compile(r"cold|warm"),
    "how": re.compile(r"jam|slip"),
    "mode": re.compile(r"500|502"),
}
_SECONDS: Final = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


class FaultScriptError(SimulationError, ValueError):
    """A text that is not a fault, with the reason."""

    def __init__(self, text: str, reason: str) -> None:
        self.text = text
        self.reason = reason
        super().__init__(f"{text!r} is not a fault: {reason}. A fault is written\n\n{GRAMMAR}")


def parse_fault(text: str) -> Fault:
    """Return the fault of a text; see `GRAMMAR`.

    Raises:
        FaultScriptError: the text is not a fault.
    """
    try:
        return _parsed(text)
    except ValueError as error:
        raise FaultScriptError(text, str(error)) from error


def _parsed(text: str) -> Fault:
    head, *options = text.strip().split(":")
    match = _HEAD.fullmatch(head)
    if match is None:
        raise ValueError(f"{head!r:.80} is not KIND@CYCLE or KIND@CYCLExCOUNT")
    name = match[1]
    cycle = int(match[2])
    times = match[3]
    kind = _KINDS.get(name)
    if kind is None:
        raise ValueError(f"{name!r} is none of {', '.join(_KINDS)}")
    if times is not None and not kind.times:
        raise ValueError(f"{name} takes no count")
    count = max(1, kind.times) if times is None else int(times)
    if not 1 <= count <= link.MAX_CYCLES or cycle > link.MAX_CYCLES:
        raise ValueError(f"the cycle is at most {link.MAX_CYCLES}, the count 1 to as many")
    matches = _matched(name, kind, options)
    to: link.Direction = "to_controller" if "to_controller" in options else "to_pc"
    match name:
        case "lose":
            return link.Lose(cycle, to, count)
        case "delay":
            value = float(matches["time"][1])
            unit = matches["time"][2]
            if unit.startswith("cycle"):
                return link.Delay(cycle, cycles=value, direction=to, count=count)
            return link.Delay(cycle, seconds=value * _SECONDS[unit], direction=to, count=count)
        case "duplicate":
            return link.Duplicate(cycle, to, count)
        case "reorder":
            return link.Reorder(cycle, to)
        case "corrupt":
            mask = int(matches["mask"][1], 0) if "mask" in matches else 0xFF
            offset = int(matches["offset"][1], 0)
            return link.Corrupt(cycle, to, count, offset=offset, mask=mask)
    axis = int(matches["axis"][1]) if "axis" in matches else 1
    qualifiers = (matches[option][0] for option in ("start", "how", "mode") if option in matches)
    return InjectedFault(name, cycle, axis, count, next(qualifiers, kind.word))


def _matched(name: str, kind: _Kind, options: Iterable[str]) -> dict[str, re.Match[str]]:
    """Return the options of a fault by their names."""
    matches: dict[str, re.Match[str]] = {}
    for text in options:
        for option in kind.options:
            match = _OPTIONS[option].fullmatch(text)
            if match is not None and option not in matches:
                matches[option] = match
                break
        else:
            raise ValueError(f"{name} has no option {text!r}")
    if kind.needed and kind.needed not in matches:
        raise ValueError(f"{name} needs the option {kind.needed}")
    return matches


def split_faults(
    faults: Iterable[Fault],
) -> tuple[tuple[link.Fault, ...], tuple[InjectedFault, ...]]:
    """Return the faults of the link and the faults of the controller."""
    every = tuple(faults)
    of_link = tuple(fault for fault in every if not isinstance(fault, InjectedFault))
    return of_link, tuple(fault for fault in every if isinstance(fault, InjectedFault))
