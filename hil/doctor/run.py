"""Everything looked at and measured, in order."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hil.progress import Reporter

from . import machine, permissions, port
from .canbus import can_check
from .check import Check, Status
from .fitness import ENOUGH_SECONDS, Fitness, in_words, judge
from .latency import Latency
from .link import CanLink, Link, UdpLink
from .measure import TURNAROUND_PERIOD, disk_trial, measure, obtained
from .network import network_checks
from .route import address_of
from .storage import disk_checks
from .system import System

CYCLES_MS = (1, 2)


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        checks: in the order of a reader's interest.
        latencies: measured; an empty tuple if no probe ran.
        one: verdict on 1 ms.
        two: verdict on 2 ms.
        cycle_ms: the cycle that has to be fit.
        seconds: length of each measurement.
    """

    checks: tuple[Check, ...]
    latencies: tuple[Latency, ...]
    one: Fitness
    two: Fitness
    cycle_ms: int
    seconds: float

    @property
    def wanted(self) -> Fitness:
        """The verdict on the cycle that has to be fit."""
        return self.one if self.cycle_ms == CYCLES_MS[0] else self.two

    @property
    def fit(self) -> bool:
        """Whether the cell's link can be run from this PC: cycle fit, and no check bad."""
        return self.wanted.fit and not any(check.status is Status.BAD for check in self.checks)

    @property
    def provisional(self) -> bool:
        """Whether too little was measured for the verdict to be relied upon."""
        return self.seconds < ENOUGH_SECONDS

    @property
    def line(self) -> str:
        """The verdict in one or two plain sentences."""
        words = in_words(self.one, self.two)
        bad = [check.name for check in self.checks if check.status is Status.BAD]
        if self.fit:
            words += f" This PC can answer a controller at {self.cycle_ms} ms."
        elif self.wanted.fit:
            words += f" But the link will not work as it is: {', '.join(bad)}."
        else:
            words += f" Do not connect an arm at {self.cycle_ms} ms."
        if self.provisional:
            words += f" Provisional: measured for {self.seconds:g} s only, 60 s are the least."
        return words


def examine(
    link: Link | None,
    cycle_ms: int,
    seconds: float,
    place: Path,
    reporter: Reporter,
    system: System | None = None,
) -> Diagnosis:
    """Look at this PC and measure it for twice `seconds`.

    Args:
        link: the cell's link, None for a simulated controller.
        cycle_ms: the cycle that has to be fit; the wake-up timer runs at it.
        seconds: length of each measurement.
        place: where archives will be written.
        reporter: shows progress.
        system: the machine, this one if left out.
    """
    system = system or System()
    reporter.say("looking at this PC; no packet is sent to the controller")
    given = obtained()
    checks = [*permission_checks(given, system), *machine_checks(given, system)]
    checks += link_checks(link, system)
    checks += disk_checks(place, disk_trial(place))
    checks.append(machine.load(system))
    period, before = cycle_ms / 1000, system.text("/proc/stat") or ""
    wake_up = measure("wake-up", "wake-ups", period, seconds, reporter)
    turnaround = measure("turnaround", "turnaround", TURNAROUND_PERIOD, seconds, reporter)
    checks.append(machine.stolen(before, system.text("/proc/stat") or ""))
    for name, latency in (("wake-up", wake_up), ("turnaround", turnaround)):
        if latency is None:
            checks.append(failed(name))
    latencies = tuple(latency for latency in (wake_up, turnaround) if latency is not None)
    one, two = (judge(latencies, cycle) for cycle in CYCLES_MS)
    return Diagnosis(tuple(checks), latencies, one, two, cycle_ms, seconds)


def failed(name: str) -> Check:
    """A measurement that could not be made."""
    found = "the probe gave no figures"
    remedy = "python -m hil.doctor.probe permissions   # says why"
    return Check(f"{name} latency", Status.BAD, found, "without it nothing is known", (remedy,))


def permission_checks(given: permissions.Obtained | None, system: System) -> list[Check]:
    """What the operating system allows."""
    return [
        permissions.user(),
        permissions.scheduling(given),
        permissions.memory_lock(given),
        permissions.processor_awake(given, system),
    ]


def machine_checks(given: permissions.Obtained | None, system: System) -> list[Check]:
    """The computer itself."""
    return [
        machine.timer_resolution(),
        machine.clock_source(system),
        machine.governor(system),
        machine.idle_states(system, kept_awake=given is not None and given.cpu_awake),
        machine.isolation(system),
        machine.preemption(system),
        machine.virtualisation(system),
        machine.python(),
    ]


def link_checks(link: Link | None, system: System) -> list[Check]:
    """What lies between this PC and the controller."""
    if isinstance(link, CanLink):
        return [can_check(link, system)]
    if isinstance(link, UdpLink):
        trial = port.try_port(link.bind, link.port)
        return [
            *network_checks(link.host, link.port, address_of(link.host, system), system),
            port.port_check(link.bind, link.port, trial, system),
            port.options_check(trial),
        ]
    why = "routes, ports and buses are looked at when a cell with a real link is given"
    return [Check("controller link", Status.OK, "none: no cell, or a simulated one", why)]
