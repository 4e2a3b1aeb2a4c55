"""A simulated controller on a real link, from the first packet to the operator's last button."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Final, Literal

from drivers.errors import DriverError
from drivers.transports.faults import FaultyLink
from hil.errors import ControllerFault, InputError
from hil.reading import parse_port
from sim_fixtures import ControllerSettings, SimulatedController, serve
from sim_fixtures.errors import PlantDiverged
from sim_fixtures.program import Phase

_PR_SET_TIMERSLACK: Final = 29


def open_controller_link(
    udp: str | None, can: str | None, settings: ControllerSettings, n_axes: int
) -> serve.ControllerLink:
    """The controller's end of the link a person names.

    `udp` is "HOST:PORT" of the PC program, `can` "INTERFACE:CHANNEL", ":fd" or ":classic" behind
    it; a bus is asked whether it can carry the controller's cycle and mode.

    Raises:
        InputError: neither or both, or not of that form.
        ControllerLinkError: impossible to open, or unfit for the session.
    """
    if (udp is None) == (can is None):
        remedy = "give --udp or --can, not both"
        raise InputError(None, "a link has to be named, one of them", remedy=remedy)
    if can is not None:
        return _bus(can, settings, n_axes)
    host, _, port_text = (udp or "").rpartition(":")
    port = parse_port(port_text)
    if not host or port is None:
        remedy = "write HOST:PORT, for instance 127.0.0.1:2001"
        raise InputError(None, f"--udp {udp!r} is not an address", remedy=remedy)
    return serve.UdpControllerLink(host, port)


def _bus(text: str, settings: ControllerSettings, n_axes: int) -> serve.ControllerLink:
    interface, _, rest = text.partition(":")
    channel, _, profile = rest.rpartition(":") if ":" in rest else (rest, "", "fd")
    if profile not in ("fd", "classic"):
        problem = (
            f"--can {text!r} ends in {profile!r}, which is neither of the profiles fd and classic"
        )
        remedy = "end it with :fd or :classic (a channel with a colon in it needs one of them)"
        raise InputError(None, problem, remedy=remedy)
    if not (interface and channel):
        remedy = "write INTERFACE:CHANNEL, for instance socketcan:can0 or socketcan:can0:classic"
        raise InputError(None, f"--can {text!r} is not a bus", remedy=remedy)
    from sim_fixtures import can_link  # python-can is slow to load

    moved_by_pc = settings.corrected or not settings.own_motion
    kind: Literal["fd", "classic"] = "classic" if profile == "classic" else "fd"
    spec = can_link.CanSpec(interface, channel, kind, period=settings.period, n_axes=n_axes)
    return can_link.open_controller_link(spec, settings.open_mode if moved_by_pc else None)


class Buttons:
    """What the person in front of the cabinet wants, set by signals and by a time limit.

    Attributes:
        interrupted: whether a signal asked for the end.
    """

    def __init__(self, duration: float | None = None) -> None:
        self.interrupted = self._at_once = False
        self._until = None if duration is None else time.monotonic() + duration
        self._pressed: set[int] = set()

    def request(self) -> serve.Request:
        """Go on; or end, by a signal or because the time is over; or give up."""
        if self._at_once:
            return serve.Request.ABORT
        over = self._until is not None and time.monotonic() >= self._until
        return serve.Request.END if self.interrupted or over else serve.Request.CONTINUE

    def press(self, signum: int, frame: FrameType | None = None) -> None:
        """Take a signal: SIGINT or SIGTERM end, the second one at once; SIGUSR1, 2 are buttons."""
        del frame
        if signum in (signal.SIGUSR1, signal.SIGUSR2):
            self._pressed.add(signum)
        else:
            self._at_once, self.interrupted = self.interrupted, True

    def pass_on(self, controller: SimulatedController) -> None:
        """Press on the controller what was pressed here: drive on, or the emergency stop."""
        if signal.SIGUSR1 in self._pressed:
            self._pressed.discard(signal.SIGUSR1)
            controller.drive_on()
        if signal.SIGUSR2 in self._pressed:
            self._pressed.discard(signal.SIGUSR2)
            controller.emergency_stop()


@contextmanager
def buttons(duration: float | None) -> Iterator[Buttons]:
    """Signals as buttons, for as long as this lasts; see `Buttons.press`."""
    pressed = Buttons(duration)
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)
    previous = {number: signal.signal(number, pressed.press) for number in signals}
    try:
        yield pressed
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def undisturbed(priority: int | None) -> Iterator[None]:
    """No garbage collection, exact timers, and a real-time priority if one is given.

    Raises:
        InputError: the system refuses the priority.
    """
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            problem = f"the system refuses a real-time priority of {priority} ({error.strerror})"
            remedy = "leave --priority out, or raise the limit (ulimit -r) or run as root"
            raise InputError(None, problem, remedy=remedy) from error
    with suppress(OSError, AttributeError):  # else timers are batched with others, 50 µs
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


@dataclass(frozen=True)
class Served:
    """How a session on a real link came out: controller and counts are of the last start."""

    controller: SimulatedController
    summary: serve.ServeCounts
    intervals: int  #: how often all axes have been open
    starts: int  #: how often the start was begun
    foreign: int  #: datagrams from elsewhere; 0 where the link cannot tell


def serve_session(
    build: Callable[[], SimulatedController],
    far_end: serve.ControllerLink,
    pressed: Buttons,
    *,
    faults: FaultyLink | None = None,
    patience: float = serve.PATIENCE,
    stretch: float = 0.0,
    watch: Callable[[SimulatedController, serve.ServeCounts], None] = lambda *_: None,
) -> Served:
    """Serve until a session has ended; a start that the PC breaks off begins anew after a second.

    `build` makes a controller that has just been switched on. Faults are counted from each start.
    The arm has `patience` to come to rest at the end, and a cycle may be made longer by `stretch`
    to wait for its answer [s]. `watch` is called every cycle with the counts so far.

    Raises:
        InputError: the link cannot carry the session.
        ControllerFault: the simulated arm left the finite numbers.
    """
    starts = 0
    while True:
        starts += 1
        controller = build()
        phases = [controller.phase]

        def observe(
            tally: serve.ServeCounts,
            controller: SimulatedController = controller,
            phases: list[Phase] = phases,
        ) -> None:
            if controller.phase is not phases[-1]:
                phases.append(controller.phase)
            pressed.pass_on(controller)
            watch(controller, tally)

        try:
            summary = serve.serve(
                controller, far_end, faults=faults, request=pressed.request, watch=observe,
                patience=patience, stretch=stretch,
            )  # fmt: skip
        except DriverError as error:
            raise InputError(None, str(error)) from error
        except PlantDiverged as error:
            raise ControllerFault(str(error)) from error
        begun = Phase.DRIVE_OFF in phases[1:]
        if begun or not summary.ended or pressed.request() is not serve.Request.CONTINUE:
            opened, foreign = phases[1:].count(Phase.OPEN), getattr(far_end, "foreign", 0)
            return Served(controller, summary, opened, starts, foreign)
        until = time.monotonic() + serve.KNOCK_INTERVAL
        while time.monotonic() < until and pressed.request() is serve.Request.CONTINUE:
            time.sleep(0.05)
