"""The controller's end of the CAN profile: what a gateway in the cabinet would do.

Start packets travel as many frames and take longer than a cycle on a real bus, so a gateway waits
for their answers; cyclic packets it leaves to the controller's clock.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import can

from drivers.transports.base import TransportError
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.ends import ControllerEnd
from drivers.transports.can.transport import CanSpec, Port, open_bus
from sim_fixtures.serve import ControllerLinkError

START_PATIENCE: Final = 0.25
"""s that the answer to a packet sent as segments is waited for."""


class CanControllerLink:
    """Carries the controller's packets over a bus; fulfils `sim_fixtures.serve.ControllerLink`.

    Args:
        bus: python-can's; closed with this.
        rates: profile and bit rates.
        start_patience: least time in s that `receive` waits after a packet sent as segments.
        clock: s, the arrival of frames that the bus does not stamp.

    Attributes:
        foreign: frames that are not of the profile, or of no use.
    """

    def __init__(
        self,
        bus: can.BusABC,
        rates: BusRates,
        *,
        start_patience: float = START_PATIENCE,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._end = ControllerEnd(rates)
        self._port = Port(bus, self._end, fd=rates.profile == "fd", clock=clock)
        self._start_patience = start_patience
        self._awaited = False

    def send(self, packet: bytes) -> None:
        """Send one packet of the controller.

        What the bus does not take is lost; an empty packet cannot be sent.

        Raises:
            CanError: an init packet of a session that the profile or the bus cannot carry.
            TransportClosed: closed, or the bus failed.
        """
        if not packet:
            return
        self._port.send(self._end.packet(packet))
        self._awaited = self._end.segmented

    def receive(self, timeout: float) -> bytes | None:
        """The PC's next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: closed, or the bus failed.
        """
        patience = max(timeout, self._start_patience) if self._awaited else timeout
        # Asked again after that, a lost answer is not waited for a second time.
        self._awaited = False
        return self._port.receive(patience)

    @property
    def discarded(self) -> Counter[str]:
        """Frames, sets and packets thrown away so far, by kind."""
        return self._port.discarded

    @property
    def foreign(self) -> int:
        """Frames that are none of the PC's."""
        return self._port.discarded["foreign"]

    def close(self) -> None:
        """Give the bus up. Closing twice changes nothing."""
        self._port.close()


def open_controller_link(
    spec: CanSpec, mode: int | None = None, *, start_patience: float = START_PATIENCE
) -> CanControllerLink:
    """Open the controller's end on a bus of python-can.

    Args:
        spec: of the bus.
        mode: open mode of the session; None where no axis is opened.
        start_patience: s that the answer to a start packet is waited for.

    Raises:
        ControllerLinkError: it cannot be opened, or cannot carry the session (`CanError` as cause).
    """
    rates = spec.rates
    try:
        spec.check(mode)
        bus = open_bus(spec.interface, spec.channel, rates, spec.options)
    except TransportError as error:
        raise ControllerLinkError(error.link, f"{error.reason}; {error.remedy}") from error
    return CanControllerLink(bus, rates, start_patience=start_patience)


__all__ = ["START_PATIENCE", "CanControllerLink", "CanSpec", "open_controller_link"]
