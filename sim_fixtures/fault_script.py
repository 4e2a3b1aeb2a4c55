"""One line of text for one fault, of the link or of the controller."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Final

from drivers.transports import faults as link
from sim_fixtures import controller_faults as controller
from sim_fixtures.errors import SimulationError

Fault = link.Fault | controller.ControllerFault

GRAMMAR: Final = """\
KIND@CYCLE[xCOUNT][:OPTION]...   cycles count the controller's packets from 0; both up to 1e9

lose@1200x3                      packets to the PC never arrive; :to_controller the PC's answers
delay@1200:5ms                   they arrive later, by ms, us, s or cycles (:1.5cycles)
duplicate@1200                   they arrive twice
reorder@1200                     the packet is overtaken by the next one
corrupt@1200:offset=8            the byte at that offset is changed; :mask=0x80 says which bits
    all five: to_pc (the default) or to_controller
restart@5000:cold                the controller starts anew; :warm with the init packet at once
drive-drop@2000                  the drive goes off by itself
e-stop@2000                      the emergency stop is pressed
axis-leaves@2000:axis=3          one axis leaves open mode
following-error@2000x500:axis=2  the axis is stuck; :slip its encoder is read wrongly
saturate@2000x500:axis=1         a load drives the current near its limit
push@2000x50:axis=1              somebody leans against the axis; nothing trips
pause@2000x50:502                the controller pauses; :500 for the other kind"""

_HEAD: Final = re.compile(r"(?P<kind>[a-z-]+)@(?P<cycle>\d+)(?:x(?P<count>\d+))?")
_TIME: Final = re.compile(r"(?P<value>\d+(?:\.\d+)?)(?P<unit>us|ms|s|cycles?)")
_SECONDS: Final = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


class FaultScriptError(SimulationError, ValueError):
    """A line that describes no fault.

    Attributes:
        text: the line.
        reason: what is wrong with it.
    """

    def __init__(self, text: str, reason: str) -> None:
        self.text = text
        self.reason = reason
        super().__init__(f"{text!r} is not a fault: {reason}. A fault is written\n\n{GRAMMAR}")


class _Line:
    """The parts of a line; every part has to be asked for."""

    def __init__(self, text: str) -> None:
        head, *options = text.strip().split(":")
        match = _HEAD.fullmatch(head)
        if match is None:
            raise FaultScriptError(text, f"{head!r} is not KIND@CYCLE or KIND@CYCLExCOUNT")
        self.text = text
        self.kind: str = match["kind"]
        self.cycle = self._cycles("cycle", match["cycle"])
        self._count = None if match["count"] is None else self._cycles("count", match["count"])
        self._options = options

    def error(self, reason: str) -> FaultScriptError:
        return FaultScriptError(self.text, reason)

    def _cycles(self, what: str, digits: str) -> int:
        # Compared by length first: Python refuses to read thousands of digits.
        if len(digits.lstrip("0")) > len(str(link.MOST_CYCLES)) or int(digits) > link.MOST_CYCLES:
            raise self.error(f"the {what} is more than {link.MOST_CYCLES}")
        return int(digits)

    def count(self, default: int = 1) -> int:
        count, self._count = self._count, None
        if count is not None and count < 1:
            raise self.error("the count is not positive")
        return default if count is None else count

    def word(self, *words: str) -> str:
        """The one of `words` that is an option; the first if none is."""
        for option in self._options:
            if option in words:
                self._options.remove(option)
                return option
        return words[0]

    def number(self, name: str, default: int | None = None) -> int:
        """The value of option NAME=..., decimal or with 0x."""
        for option in self._options:
            key, equals, value = option.partition("=")
            if key == name and equals:
                self._options.remove(option)
                try:
                    return int(value, 0)
                except ValueError:
                    raise self.error(f"{option!r} is not {name}=NUMBER") from None
        if default is None:
            raise self.error(f"{name}=NUMBER is missing")
        return default

    def axis(self) -> int:
        axis = self.number("axis")
        if axis < 1:
            raise self.error("axes count from 1")
        return axis

    def time(self) -> dict[str, float]:
        """The duration as keyword arguments of `Delay`."""
        for option in self._options:
            match = _TIME.fullmatch(option)
            if match is not None:
                self._options.remove(option)
                value = float(match["value"])
                if match["unit"].startswith("cycle"):
                    return {"cycles": value}
                return {"seconds": value * _SECONDS[match["unit"]]}
        raise self.error("a time such as 5ms or 2cycles is missing")

    def direction(self) -> link.Direction:
        return "to_controller" if self.word("to_pc", "to_controller") != "to_pc" else "to_pc"

    def require_empty(self) -> None:
        if self._count is not None:
            raise self.error(f"{self.kind} takes no count")
        if self._options:
            raise self.error(f"{self.kind} has no option {self._options[0]!r}")


def _corrupt(line: _Line) -> Fault:
    offset, mask = line.number("offset"), line.number("mask", 0xFF)
    return link.Corrupt(line.cycle, offset, mask, line.direction(), line.count())


def _following_error(line: _Line) -> Fault:
    slips = line.word("jam", "slip") == "slip"
    return controller.FollowingErrorFault(
        line.cycle, line.axis(), "slip" if slips else "jam", line.count(500)
    )


def _pause(line: _Line) -> Fault:
    by_pc = line.word("502", "500") == "500"
    return controller.Pause(line.cycle, line.count(50), 500 if by_pc else 502)


_KINDS: Final[dict[str, Callable[[_Line], Fault]]] = {
    "lose": lambda line: link.Lose(line.cycle, line.direction(), line.count()),
    "delay": lambda line: link.Delay(
        line.cycle, **line.time(), direction=line.direction(), count=line.count()
    ),
    "duplicate": lambda line: link.Duplicate(line.cycle, line.direction(), line.count()),
    "reorder": lambda line: link.Reorder(line.cycle, line.direction()),
    "corrupt": _corrupt,
    "restart": lambda line: controller.Restart(line.cycle, line.word("cold", "warm") == "warm"),
    "drive-drop": lambda line: controller.DriveDrop(line.cycle),
    "e-stop": lambda line: controller.EmergencyStop(line.cycle),
    "axis-leaves": lambda line: controller.AxisLeaves(line.cycle, line.axis()),
    "following-error": _following_error,
    "saturate": lambda line: controller.CurrentSaturation(line.cycle, line.axis(), line.count(500)),
    "push": lambda line: controller.Push(line.cycle, line.axis(), line.count(50)),
    "pause": _pause,
}


def parse_fault(text: str) -> Fault:
    """Return the fault that a line describes; see `GRAMMAR`.

    Raises:
        FaultScriptError: it describes none.
    """
    line = _Line(text)
    make = _KINDS.get(line.kind)
    if make is None:
        raise line.error(f"{line.kind!r} is none of {', '.join(_KINDS)}")
    try:
        fault = make(line)
    except FaultScriptError:
        raise
    except ValueError as error:
        raise line.error(str(error)) from error
    line.require_empty()
    return fault


def split_faults(
    faults: Iterable[Fault],
) -> tuple[tuple[link.Fault, ...], tuple[controller.ControllerFault, ...]]:
    """Return the faults of the link and those of the controller."""
    every = tuple(faults)
    of_link = tuple(fault for fault in every if isinstance(fault, link.Fault))
    of_controller = tuple(fault for fault in every if not isinstance(fault, link.Fault))
    return of_link, of_controller
