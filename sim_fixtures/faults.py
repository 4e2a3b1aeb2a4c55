"""Faults of the simulated controller and its robot, and the text format of all faults.

Cycles are packets of the controller from 0, as in `drivers.transports.faults`; axes count from 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.transports import faults as link
from sim_fixtures.errors import SimulationError

if TYPE_CHECKING:
    from sim_fixtures.controller import SimulatedController

GRAMMAR: Final = """\
KIND@CYCLE[xCOUNT][:OPTION]...   cycles count the controller's packets from 0; both up to 1e9

lose@1200x3                      packets to the PC are lost; :to_controller the PC's answers
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


SLIP = 1.5  # encoder error as a multiple of the following-error threshold
LOAD = 0.9  # load as a share of the largest motor torque
PUSH = 0.15  # push as a share of the largest motor torque; it does not trip the drive


@dataclass(frozen=True)
class _Kind:
    """Options of a kind of fault: an axis, a default count (0: none), words (default first)."""

    axis: bool = False
    count: int = 0
    words: tuple[str, ...] = ("",)


_OF_CONTROLLER: Final[Mapping[str, _Kind]] = {
    "restart": _Kind(words=("cold", "warm")),
    "drive-drop": _Kind(),
    "e-stop": _Kind(),
    "axis-leaves": _Kind(axis=True),
    "following-error": _Kind(axis=True, count=500, words=("jam", "slip")),
    "saturate": _Kind(axis=True, count=500),
    "push": _Kind(axis=True, count=50),
    "pause": _Kind(count=50, words=("502", "500")),
}
_OF_LINK: Final = ("lose", "delay", "duplicate", "reorder", "corrupt")


@dataclass(frozen=True)
class ControllerFault:
    """One fault of the controller or its robot; see `GRAMMAR` for the kinds.

    `cycle` is that of its beginning, `axis` counts from 1, `count` is its duration in cycles,
    `word` the option of the kind, "" without one.
    """

    kind: str
    cycle: int
    axis: int = 1
    count: int = 1
    word: str = ""

    def apply_to(self, controller: SimulatedController) -> None:
        """Apply the fault."""
        match self.kind:
            case "restart":
                controller.restart(warm=self.word == "warm")
            case "drive-drop":
                controller.lose_drive("the drive dropped out")
            case "e-stop":
                controller.lose_drive("emergency stop")
            case "axis-leaves":
                controller.axis_leaves(self.axis)
            case "following-error":
                controller.disturb(
                    "slip" if self.word == "slip" else "jam", self.axis, SLIP, self.count
                )
            case "pause":
                controller.pause(int(self.word), self.count)
            case _:
                size = LOAD if self.kind == "saturate" else PUSH
                controller.disturb("load", self.axis, size, self.count)


Fault = link.Fault | ControllerFault

_HEAD: Final = re.compile(r"(?P<kind>[a-z-]+)@(?P<cycle>\d+)(?:x(?P<count>\d+))?")
_TIME: Final = re.compile(r"(?P<value>\d+(?:\.\d+)?)(?P<unit>us|ms|s|cycles?)")
_SECONDS: Final = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


class FaultScriptError(SimulationError, ValueError):
    """A text that is not a fault, with the reason."""

    def __init__(self, text: str, reason: str) -> None:
        self.text = text
        self.reason = reason
        super().__init__(f"{text!r} is not a fault: {reason}. A fault is written\n\n{GRAMMAR}")


class _Line:
    """The parts of a text; each option is removed when it is read."""

    def __init__(self, text: str) -> None:
        head, *self.options = text.strip().split(":")
        match = _HEAD.fullmatch(head)
        if match is None:
            raise ValueError(f"{head!r} is not KIND@CYCLE or KIND@CYCLExCOUNT")
        self.kind: str = match["kind"]
        self.cycle = self._cycles("cycle", match["cycle"])
        self.count = None if match["count"] is None else self._cycles("count", match["count"])

    @staticmethod
    def _cycles(what: str, digits: str) -> int:
        # By length first: int() rejects thousands of digits.
        if len(digits.lstrip("0")) > len(str(link.MOST_CYCLES)) or int(digits) > link.MOST_CYCLES:
            raise ValueError(f"the {what} is more than {link.MOST_CYCLES}")
        return int(digits)

    def word(self, *words: str) -> str:
        """Return the one of `words` that is an option; the first if none is."""
        found = next((option for option in self.options if option in words), None)
        if found is None:
            return words[0]
        self.options.remove(found)
        return found

    def number(self, name: str, default: int | None = None) -> int:
        """Return the value of option NAME=..., decimal or hexadecimal with 0x."""
        found = next((option for option in self.options if option.startswith(f"{name}=")), None)
        if found is None:
            if default is None:
                raise ValueError(f"{name}=NUMBER is missing")
            return default
        self.options.remove(found)
        try:
            return int(found.partition("=")[2], 0)
        except ValueError:
            raise ValueError(f"{found!r} is not {name}=NUMBER") from None

    def time(self) -> dict[str, float]:
        """Return the duration as keyword arguments of `Delay`."""
        for option in self.options:
            match = _TIME.fullmatch(option)
            if match is not None:
                self.options.remove(option)
                value = float(match["value"])
                if match["unit"].startswith("cycle"):
                    return {"cycles": value}
                return {"seconds": value * _SECONDS[match["unit"]]}
        raise ValueError("a time such as 5ms or 2cycles is missing")


def parse_fault(text: str) -> Fault:
    """Return the fault of a text; see `GRAMMAR`.

    Raises:
        FaultScriptError: the text is not a fault.
    """
    try:
        line = _Line(text)
        kind = _OF_CONTROLLER.get(line.kind)
        takes_count = line.kind != "reorder" if kind is None else kind.count > 0
        if line.kind not in _OF_LINK and kind is None:
            kinds = ", ".join((*_OF_LINK, *_OF_CONTROLLER))
            raise ValueError(f"{line.kind!r} is none of {kinds}")
        if line.count is not None and not takes_count:
            raise ValueError(f"{line.kind} takes no count")
        if line.count == 0:
            raise ValueError("the count is not positive")
        fault = _of_link(line) if kind is None else _of_controller(line, kind)
        if line.options:
            raise ValueError(f"{line.kind} has no option {line.options[0]!r}")
    except ValueError as error:
        raise FaultScriptError(text, str(error)) from error
    return fault


def _of_controller(line: _Line, kind: _Kind) -> ControllerFault:
    axis = line.number("axis") if kind.axis else 1
    if axis < 1:
        raise ValueError("axes count from 1")
    count = max(1, kind.count) if line.count is None else line.count
    return ControllerFault(line.kind, line.cycle, axis, count, line.word(*kind.words))


def _of_link(line: _Line) -> link.Fault:
    to: link.Direction = (
        "to_pc" if line.word("to_pc", "to_controller") == "to_pc" else "to_controller"
    )
    at, count = line.cycle, 1 if line.count is None else line.count
    match line.kind:
        case "lose":
            return link.Lose(at, to, count)
        case "delay":
            return link.Delay(at, **line.time(), direction=to, count=count)
        case "duplicate":
            return link.Duplicate(at, to, count)
        case "reorder":
            return link.Reorder(at, to)
    offset, mask = line.number("offset"), line.number("mask", 0xFF)
    return link.Corrupt(at, to, count, offset=offset, mask=mask)


def split_faults(
    faults: Iterable[Fault],
) -> tuple[tuple[link.Fault, ...], tuple[ControllerFault, ...]]:
    """Return the faults of the link and those of the controller."""
    every = tuple(faults)
    of_link = tuple(fault for fault in every if not isinstance(fault, ControllerFault))
    return of_link, tuple(fault for fault in every if isinstance(fault, ControllerFault))
