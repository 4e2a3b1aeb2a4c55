"""The controller's end of the CAN profile, as a gateway at the controller.

The init packet takes longer than a cycle on a real bus, so replies to start packets are waited for;
cyclic packets are timed by the controller.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import can

from drivers.transports.can.frames import UP, BusRates, CanEndpoint
from drivers.transports.can.transport import CanLink, CanSpec, open_bus

START_PATIENCE: Final = 0.25
"""Least timeout for the reply to a start packet [s]."""


class CanControllerLink(CanLink):
    """`sim_fixtures.serve.ControllerLink` on a CAN bus, which `close` closes.

    After a start packet the timeout of `receive` is at least `start_patience` [s];
    `clock` [s] times frames without time stamp.
    """

    def __init__(
        self,
        bus: can.BusABC,
        rates: BusRates,
        *,
        start_patience: float = START_PATIENCE,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._end = CanEndpoint(rates, UP)
        super().__init__(bus, self._end, clock=clock)
        self._start_patience = start_patience
        self._awaited = False

    def send(self, packet: bytes) -> None:
        """Send one packet of the controller unless it is empty; what the bus refuses is lost.

        Raises:
            CanError: an init packet of a session that the bus cannot carry.
            TransportClosed: closed, or the bus failed.
        """
        if not packet:
            return
        super().send(packet)
        self._awaited = len(packet) != self._end.cyclic_length

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet of the PC, or None after `timeout` s.

        Raises:
            TransportClosed: closed, or the bus failed.
        """
        patience = max(timeout, self._start_patience) if self._awaited else timeout
        self._awaited = False  # a lost reply is waited for once
        return super().receive(patience)

    @property
    def foreign(self) -> int:
        """Number of frames that are not the PC's."""
        return self.discarded["foreign"]


def open_controller_link(spec: CanSpec, mode: int | None = None) -> CanControllerLink:
    """Open the controller's end on a bus of python-can, which carries any `mode`.

    Raises:
        TransportError: it cannot be opened, or (`CanError`) cannot carry the session.
    """
    spec.check(mode)
    bus = open_bus(spec.interface, spec.channel, spec.rates, spec.options)
    return CanControllerLink(bus, spec.rates)
