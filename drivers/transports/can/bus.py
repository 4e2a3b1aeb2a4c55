"""python-can's buses: opened by name, and their errors in our words."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator, Mapping
from typing import Any

import can

from drivers.errors import TransportClosed
from drivers.transports.base import TransportError
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.layout import Frame

_REMEDIES = {
    "socketcan": "bring it up: modprobe can_raw && ip link set {channel} up type can {rates}",
    "slcan": "see that the adapter is there and that you may open its port (group dialout)",
    "udp_multicast": "it needs msgpack and a route for multicast: ip route add 239.0.0.0/8 dev lo",
}


def open_bus(
    interface: str, channel: str, rates: BusRates, options: Mapping[str, Any]
) -> can.BusABC:
    """Open a bus of python-can.

    Args:
        interface: python-can's name: socketcan, slcan, pcan, virtual, udp_multicast, ...
        channel: can0, /dev/ttyACM0, ...; a multicast group may have its port behind a slash.
        rates: profile and bit rates; on SocketCAN they are set by `ip link`, not here.
        options: further arguments of that bus.

    Raises:
        TransportError: it cannot be opened.
    """
    link = f"CAN bus {interface}:{channel}"
    try:
        bus = can.Bus(**_arguments(interface, channel, rates), **options)
        if interface == "slcan":
            fast = rates.data_bitrate if rates.profile == "fd" else None
            bus.set_bitrate(rates.bitrate, fast)  # type: ignore[attr-defined]
    except (can.CanError, OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
        _dispose_of_half_made(error)
        remedy = _REMEDIES.get(interface, "see python-can's documentation of this interface")
        wanted = f"bitrate {rates.bitrate}"
        if rates.profile == "fd":
            wanted += f" dbitrate {rates.data_bitrate} fd on"
        remedy = remedy.format(channel=channel, rates=wanted)
        raise TransportError(link, str(error) or type(error).__name__, remedy) from error
    return bus


def _dispose_of_half_made(error: BaseException) -> None:
    """Shut down what python-can had begun to open; left to the collector it complains on stderr."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        for value in list(frame.f_locals.values()):
            if isinstance(value, can.BusABC):
                # It may lack any of its parts: all that counts is that it was tried.
                with contextlib.suppress(Exception):
                    value.shutdown()


def _arguments(interface: str, channel: str, rates: BusRates) -> dict[str, Any]:
    arguments: dict[str, Any] = {"interface": interface, "channel": channel}
    fd = rates.profile == "fd"
    if interface == "virtual":
        arguments["protocol"] = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
    elif interface == "udp_multicast":
        group, _, port = channel.partition("/")
        # Frames stay on this machine: nothing out there is to take them for a robot's.
        arguments.update(channel=group, hop_limit=0, fd=True)
        if port:
            arguments["port"] = int(port)
    elif interface == "socketcan":
        arguments["fd"] = fd
    elif interface != "slcan":
        arguments.update(bitrate=rates.bitrate, fd=fd)
        if fd:
            arguments["data_bitrate"] = rates.data_bitrate
    return arguments


@contextlib.contextmanager
def failing_as_closed(what: str) -> Iterator[None]:
    """Turn what a bus raises into TransportClosed, with its cause."""
    try:
        yield
    except (can.CanError, OSError, ValueError, TypeError) as error:
        raise TransportClosed(f"{what} failed: {error}") from error


def to_message(frame: Frame, *, fd: bool) -> can.Message:
    """The frame as python-can sends it."""
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=False,
        is_fd=fd,
        bitrate_switch=fd,
        check=False,
    )


def to_frame(message: can.Message, *, fd: bool) -> Frame | None:
    """The data frame of the right kind in a message, None if it is something else."""
    if message.is_extended_id or message.is_remote_frame or bool(message.is_fd) != fd:
        return None
    return Frame(message.arbitration_id, bytes(message.data))
