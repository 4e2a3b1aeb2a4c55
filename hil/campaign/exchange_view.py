"""What the supervising process knows of its exchange process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.events import (
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    PacketRejected,
    Refused,
)
from drivers.exchange.control import ControlBlock, Pulse
from drivers.exchange.event_log import (
    EventsLost,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    Leaving,
)
from drivers.exchange.process import ExchangeProcess
from drivers.states import State
from hil.terminal_text import plural

from .motion_link import Beginning, Connection

HUNG = 5.0
"""s without a sign of life after which an exchange process is ended: the controller, unanswered
for so long, has acted by its own watch."""


@dataclass(eq=False)
class ExchangeView:
    """Events taken in, and whether the process lives.

    Attributes:
        exchange: the process.
        explained: adds the cause to what the process says, where it is known here.
        connection: what is known of the controller.
        lost: the last loss of the link.
        ended: the end of the motion asked for last, if its event came.
        inits: init packets so far.
        refused: the refusal since a motion was asked for last.
        not_understood: of packets that came last and got no answer, how many and why.
        began: whether the motion asked for last has sent anything, or may have.
    """

    exchange: ExchangeProcess
    explained: Callable[[str], str] = str
    connection: Connection = field(default_factory=Connection)
    lost: LinkLost | None = None
    ended: MotionEnded | None = None
    inits: int = 0
    began: bool = False
    refused: Refused | None = None
    not_understood: str = ""
    _beginning: Beginning = field(default_factory=lambda: Beginning(time.monotonic()))
    _rejected: int = 0
    _said: str = ""
    _ended_for: str = ""
    _ended_before: int = 0
    _pulse: Pulse = field(init=False)

    def __post_init__(self) -> None:
        control = ControlBlock(self.exchange.control_fd)
        self._pulse = Pulse(lambda: control.exchange_heartbeat)

    def look(self) -> list[ExchangeEvent]:
        """Take in what the exchange says, and return it."""
        events = self.exchange.events()
        for event in events:
            self.connection.note(event)
            if isinstance(event, InitReceived):
                self.inits += 1
            elif isinstance(event, LinkLost):
                self.lost = event
            elif isinstance(event, MotionEnded):
                self.ended = event
            elif isinstance(event, Refused):
                self.refused = event
            elif isinstance(event, PacketRejected) and event.why:
                self._rejected += event.count
                packets = plural(self._rejected, "packet")
                self.not_understood = f"{packets} came and got no answer: {event.why}"
            elif isinstance(event, MotionStarted | EventsLost):
                self.began = True
            elif isinstance(event, ExchangeFailed):
                self._said = event.trace.strip().splitlines()[-1]
            elif isinstance(event, Leaving | ExchangeEnded) and not self._said:
                self._said = self.explained(event.reason)
        return events

    def forget_motion(self) -> None:
        """Another motion is about to be asked for."""
        self.look()
        self.ended, self.refused, self.began = None, None, False
        self._beginning = Beginning(time.monotonic())
        self._ended_before = self.status.ended_count

    def not_begun(self) -> str | None:
        """Why the motion asked for will not begin any more, in words; None while it may."""
        found = self._beginning.hopeless(self.state, time.monotonic())
        return None if self.began or self.motion_ended else found

    @property
    def motion_ended(self) -> bool:
        """Whether the motion asked for has ended; the event that says so may have been lost."""
        return self.ended is not None or self.status.ended_count != self._ended_before

    @property
    def status(self) -> ControlBlock:
        """The exchange's fields of the control block."""
        return self.exchange.status()

    @property
    def state(self) -> State:
        """Of the session."""
        return State(self.status.state)

    @property
    def trouble(self) -> str | None:
        """What a process that had to be ended was ended for."""
        return f"the exchange process {self._ended_for}" if self._ended_for else None

    def failure(self) -> str | None:
        """Why no answers come any more, in words; None as long as they do.

        A process that hangs is ended.
        """
        if self.exchange.alive and self._pulse.quiet() > HUNG:
            self.exchange.kill()
            self._ended_for = f"gave no sign of life for {HUNG:g} s and was ended"
        if self.exchange.alive:
            return None
        self.look()
        said = f" ({self._said})" if self._said else ""
        return f"the exchange process {self._ended_for or 'ended' + said}"
