"""A simulated controller on a real link, with the buttons of its operator."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from types import FrameType

from drivers.errors import DriverError
from drivers.exchange.realtime import without_pauses
from drivers.transports.base import TransportError
from hil.base.errors import ControllerError, InputError
from hil.cell.field_error import FieldError
from hil.cell.schema import LINKS, ControllerTable
from sim_fixtures import ControllerSettings, Phase, SimulatedController, serve
from sim_fixtures.settings import PlantDiverged


def open_controller_link(
    addresses: Mapping[str, str | None], settings: ControllerSettings, n_axes: int
) -> serve.ControllerLink:
    """Open the controller's end at the one address, by option; --link has "NAME:ADDRESS".

    Raises:
        InputError: not one link, or an invalid one, that cannot be opened or cannot carry the
            session.
    """
    given = [(option, text) for option, text in addresses.items() if text is not None]
    if len(given) != 1:
        remedy = "give one of --udp, --can and --link"
        raise InputError(None, "one link is needed", remedy=remedy)
    option, text = given[0]
    name = option.removeprefix("--")
    address = text
    if option == "--link":
        name, _, address = text.partition(":")
    carrying = [link for link, each in LINKS.items() if each.controller]
    kind = LINKS.get(name)
    if kind is None or not kind.controller:
        remedy = f"write NAME:ADDRESS; names are {', '.join(carrying)}"
        raise InputError(None, f"{option} {text!r} names no transport", remedy=remedy)
    try:
        fields = kind.parse(address)
    except FieldError as error:
        problem = f"{option} {text!r}: {error.problem}"
        raise InputError(None, problem, remedy=error.remedy) from error
    if fields is None:
        noun, form = kind.form
        raise InputError(None, f"{option} {text!r} is not {noun}", remedy=f"write {form}")
    cycle_ms = round(1e3 * settings.period)
    table = ControllerTable.model_validate({"transport": name, "cycle_ms": cycle_ms, **fields})
    spec = kind.spec(table, n_axes)
    moved_by_pc = settings.corrected or not settings.own_motion
    mode = settings.open_mode if moved_by_pc else None
    try:
        end: serve.ControllerLink = import_module(kind.controller).open_controller_link(spec, mode)
    except TransportError as error:
        raise InputError(None, str(error)) from error
    return end


class Buttons:
    """Requests of the operator at the controller, by signals and a time limit."""

    def __init__(self, duration: float | None = None) -> None:
        self.interrupted = self._at_once = False
        self._until = None if duration is None else time.monotonic() + duration
        self._pressed: set[int] = set()

    def request(self) -> serve.Request:
        """Return whether to continue, to end (by a signal or the time limit), or to give up."""
        if self._at_once:
            return serve.Request.ABORT
        over = self._until is not None and time.monotonic() >= self._until
        return serve.Request.END if self.interrupted or over else serve.Request.CONTINUE

    def press(self, signum: int, frame: FrameType | None = None) -> None:
        """Handle a signal: SIGINT, SIGTERM end, the second immediately; SIGUSR1, 2 are buttons."""
        del frame
        if signum in (signal.SIGUSR1, signal.SIGUSR2):
            self._pressed.add(signum)
        else:
            self._at_once = self.interrupted
            self.interrupted = True

    def apply(self, controller: SimulatedController) -> None:
        """Apply pressed buttons to the controller: drive on, or the emergency stop."""
        if signal.SIGUSR1 in self._pressed:
            self._pressed.discard(signal.SIGUSR1)
            controller.drive_on()
        if signal.SIGUSR2 in self._pressed:
            self._pressed.discard(signal.SIGUSR2)
            controller.lose_drive("emergency stop")


@contextmanager
def buttons(duration: float | None) -> Iterator[Buttons]:
    """Install signal handlers that press buttons, see `Buttons.press`."""
    pressed = Buttons(duration)
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)
    previous = {number: signal.signal(number, pressed.press) for number in signals}
    try:
        yield pressed
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def realtime_process(priority: int | None) -> Iterator[None]:
    """Run without garbage collection, with exact timers and, if given, a real-time priority."""
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            problem = f"the system refuses a real-time priority of {priority} ({error.strerror})"
            remedy = "leave --priority out, or raise the limit (ulimit -r) or run as root"
            raise InputError(None, problem, remedy=remedy) from error
    without_pauses()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


@dataclass(frozen=True)
class Served:
    """Result of a session on a real link; controller and counts belong to the last start."""

    controller: SimulatedController
    summary: serve.ServeCounts
    intervals: int  #: times that all axes were open
    starts: int  #: number of starts
    foreign: int  #: datagrams of other hosts; 0 on other links


def serve_session(
    build: Callable[[], SimulatedController],
    link: serve.ControllerLink,
    pressed: Buttons,
    *,
    patience: float = serve.STOP_TIMEOUT,
    cycle_extension: float = 0.0,
    watch: Callable[[SimulatedController, serve.ServeCounts], None] = lambda *_: None,
) -> Served:
    """Serve until a session has ended; a start aborted by the PC is repeated after a second.

    Args:
        build: creates a controller that was just switched on.
        link: to the PC.
        pressed: buttons of the controller.
        patience: for the arm to come to rest at the end [s].
        cycle_extension: longest extension of a cycle to wait for its reply [s].
        watch: called every cycle.

    Raises:
        InputError: the link cannot carry the session.
        ControllerError: the state of the simulated arm is not finite.
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
            pressed.apply(controller)
            watch(controller, tally)

        try:
            summary = serve.serve(
                controller, link, request=pressed.request, watch=observe,
                patience=patience, cycle_extension=cycle_extension,
            )  # fmt: skip
        except DriverError as error:
            raise InputError(None, str(error)) from error
        except PlantDiverged as error:
            raise ControllerError(str(error)) from error
        begun = Phase.DRIVE_OFF in phases[1:]
        if begun or not summary.ended or pressed.request() is not serve.Request.CONTINUE:
            opened = phases[1:].count(Phase.OPEN)
            foreign = getattr(link, "foreign", 0)
            return Served(controller, summary, opened, starts, foreign)
        until = time.monotonic() + serve.KNOCK_INTERVAL
        while time.monotonic() < until and pressed.request() is serve.Request.CONTINUE:
            time.sleep(0.05)
