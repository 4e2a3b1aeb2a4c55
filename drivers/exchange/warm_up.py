"""Cycles of a second session, which bring the code of a cycle into the caches."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Final

import numpy as np

from drivers.arrays import Array
from drivers.c4g_wire import C4gProtocol
from drivers.cycle_records import CycleRing
from drivers.drive_train import DriveTrain
from drivers.guard import Guard, GuardLimits
from drivers.motion_source import BoundsName
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import PollingTransport, Transport
from drivers.wire import ControllerProtocol

_WARM_UP_CYCLES: Final = 200
"""Cycles before the first packet."""
LEAD_SECONDS: Final = 3e-4
"""Time before the next packet at which such a cycle begins, s: it takes some 0.15 ms, and the
packet may come some 0.05 ms early."""
_MAX_SLOW_CYCLES: Final = 3
"""Cycles in a row that took longer than `LEAD_SECONDS`: a processor on which they would delay
replies."""


def may_poll(scheduling: str, processors: set[int]) -> bool:
    """Whether this process may poll: it has priority, and other processes another processor.

    Without priority it would lose its turn by that.

    Args:
        scheduling: as in `RealTimeReport`.
        processors: on which the process that started this one, and with it the others, may run.
    """
    return scheduling.startswith("SCHED_FIFO") and len(processors | os.sched_getaffinity(0)) > 1


class _Rest:
    """A motion source at rest."""

    finished = False
    bounds: BoundsName = "plan"

    def __init__(self, position: Array) -> None:
        self.start = position
        self._velocity = np.zeros_like(position)

    def begin(self, position: Array) -> None:
        self.start = position

    def advance(self) -> tuple[Array, Array]:
        return self.start, self._velocity

    def stop(self) -> None:
        self.finished = True


class WarmUp:
    """A motion at rest in a session of its own, with packets of its own over a link of its own.

    The first cycles of a process are slow, and so is each cycle for which the code has to come from
    memory again, because others used the processor's caches: twice as slow at the median.

    Args:
        drives: of the arm.
        limits: of the guard.
        period: the controller's cycle, s.
        link: one that receives what it sends, by the code of the real one; None without.
        protocol: of the controller.

    Attributes:
        session: open unless something is wrong.
        reply: the last one.
        polls: from this cycle to `LEAD_SECONDS` after the packet is due the link is polled. False
        at first.
    """

    def __init__(
        self,
        drives: DriveTrain,
        limits: GuardLimits,
        period: float,
        link: Transport | None = None,
        protocol: ControllerProtocol | None = None,
    ) -> None:
        self.polls = False
        self._link = link
        self._slow = 0
        n = drives.n_joints
        position = 0.5 * (limits.lower + limits.upper)
        self.reply: bytes | None = None
        self._period = period
        own: ControllerProtocol = C4gProtocol() if protocol is None else protocol
        self._packets = own.own_packets(
            drives, position, period, (limits.following_error, limits.current)
        )
        ring = CycleRing(n, 16, state=own.state)
        self.session = Session(drives, Guard(limits, period), ring, protocol=own)
        self.session.reply(self._packets.first(), 0.0)
        self.session.request(_Rest(position))
        self.cycle(opened=False)
        for _ in range(_WARM_UP_CYCLES):
            self.cycle()
        self.session.events()

    def cycle(self, *, opened: bool = True) -> None:
        """Have the session reply to one more packet."""
        packet = self._packets.next(opened=opened)
        if self._link is not None:
            self._link.send(packet)
            self._link.receive(0.0)  # whatever comes
        # Last: it has more code than a link, and what ran last is nearest.
        self.reply = self.session.reply(packet, 0.0)

    def before_packet(self, transport: Transport, session: Session, arrived: float) -> None:
        """Run one cycle shortly before the packet that follows one which arrived at this time.

        Only in open mode, and where the link can wait for a packet without reading it: one that
        comes early is delayed by no more than this cycle. None is run any more once
        `_MAX_SLOW_CYCLES` in a row were not at their end when the packet was due.
        """
        if self._slow == _MAX_SLOW_CYCLES or session.state is not State.OPEN:
            return
        if not isinstance(transport, PollingTransport):
            return
        due = arrived + self._period
        remaining = due - LEAD_SECONDS - transport.now
        if remaining <= 0.0 or transport.wait(remaining):
            return
        begun = transport.now
        with suppress(Exception):  # whatever it may be, the real session goes on
            self.cycle()
        self._slow = self._slow + 1 if transport.now - begun > LEAD_SECONDS else 0
        if self.polls:
            transport.polls_until = due + LEAD_SECONDS
