"""Who an arm is: what its primary interface and its dashboard server state, without moving it.

Both are optional: PolyScope X has no dashboard, and either may be disabled under Security.

Layouts of the primary interface: Universal Robots, "Remote Control Via TCP/IP", client interfaces.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.arrays import Array
from drivers.ur.messages import MAX_PACKAGE_BYTES, PACKAGE

PRIMARY_PORT: Final = 30001
DASHBOARD_PORT: Final = 29999
IDENTITY_TIMEOUT: Final = 2.0
"""Longest wait for either of them, s."""
MODELS: Final[Mapping[int, str]] = {
    1: "UR5", 2: "UR10", 3: "UR3", 4: "UR16", 7: "UR20", 8: "UR30"
}  # fmt: skip
"""Names of arms by their type; names of the e-Series end in e, except UR20 and UR30."""
_WITHOUT_E: Final = (7, 8)
_ROBOT_STATE_PACKAGE: Final = 16
_KINEMATICS_PART: Final = 5
_CONFIGURATION_PART: Final = 6
_KINEMATICS_SIZE: Final = 6 * 4 + 4 * 6 * 8
_CONFIGURATION_SIZE: Final = 4 * 6 * 8 + 5 * 8 + 4 * 6 * 8 + 4 * 4


@dataclass(frozen=True, eq=False)
class DhParameters:
    """Denavit-Hartenberg parameters (standard convention) of six joints, m and rad, (6,) each."""

    theta: Array
    a: Array
    d: Array
    alpha: Array


@dataclass(frozen=True, eq=False)
class ArmIdentity:
    """What an arm states of itself; None where it does not.

    Attributes:
        kind: number of its type (`MODELS`).
        lower, upper: limits of position (6,) [rad].
        velocity, acceleration: largest ones of its joints (6,) [rad/s, rad/s²].
        nominal: DH parameters of its type.
        calibrated: DH parameters of this arm.
        calibration: checksum of the calibration, hexadecimal.
        serial_number, model, polyscope: as its dashboard states them.
        remote_control: whether it accepts programs of other computers.
        unreachable: what could not be asked, and why.
    """

    kind: int | None = None
    lower: Array | None = None
    upper: Array | None = None
    velocity: Array | None = None
    acceleration: Array | None = None
    nominal: DhParameters | None = None
    calibrated: DhParameters | None = None
    calibration: str | None = None
    serial_number: str | None = None
    model: str | None = None
    polyscope: str | None = None
    remote_control: bool | None = None
    unreachable: tuple[str, ...] = ()

    def named(self, major: int) -> str | None:
        """Return the name of the type for a major version of the software, such as "UR5e"."""
        kinds = {name: kind for kind, name in MODELS.items()}
        kind = kinds.get(self.model or "") if self.kind is None else self.kind
        if kind is None or kind not in MODELS:
            return self.model
        suffix = "" if kind in _WITHOUT_E or major <= 3 else "e"
        return MODELS[kind] + suffix


def ask_identity(
    host: str, *, primary: int = PRIMARY_PORT, dashboard: int = DASHBOARD_PORT
) -> ArmIdentity:
    """Ask an arm who it is; what cannot be reached is in `unreachable`."""
    identity = ArmIdentity()
    unreachable = []
    try:
        identity = with_state(identity, _read_state(host, primary))
    except (OSError, ValueError) as error:
        unreachable.append(f"primary interface ({host}:{primary}): {_reason(error)}")
    try:
        identity = with_replies(identity, _ask_dashboard(host, dashboard))
    except (OSError, ValueError) as error:
        unreachable.append(f"dashboard server ({host}:{dashboard}): {_reason(error)}")
    return replace(identity, unreachable=tuple(unreachable))


def with_state(identity: ArmIdentity, state: bytes) -> ArmIdentity:
    """Return the identity with configuration and calibration of a state package.

    `state` is the payload of the package: parts, each with its length and type.

    Raises:
        ValueError: the parts do not belong to this interface.
    """
    parts = dict(_parts(state))
    if (data := parts.get(_CONFIGURATION_PART)) is not None:
        if len(data) < _CONFIGURATION_SIZE:
            raise ValueError(f"a configuration of {len(data)} bytes")
        numbers = _doubles(data, 53)
        limits = numbers[:12].reshape(6, 2).T
        rates = numbers[12:24].reshape(6, 2).T
        a, d, alpha, theta = numbers[29:53].reshape(4, 6)
        _, _, kind, _ = struct.unpack_from(">4i", data, 53 * 8)
        identity = replace(
            identity, kind=kind, lower=limits[0], upper=limits[1],
            velocity=rates[0], acceleration=rates[1], nominal=DhParameters(theta, a, d, alpha),
        )  # fmt: skip
    if (data := parts.get(_KINEMATICS_PART)) is not None:
        if len(data) < _KINEMATICS_SIZE:
            raise ValueError(f"kinematics of {len(data)} bytes")
        theta, a, d, alpha = _doubles(data[24:], 24).reshape(4, 6)
        identity = replace(
            identity,
            calibration=data[:24].hex(),
            calibrated=DhParameters(theta, a, d, alpha),
        )
    return identity


def with_replies(identity: ArmIdentity, replies: Mapping[str, str]) -> ArmIdentity:
    """Return the identity with the replies of a dashboard by request; unknown ones are left out."""
    known = {
        request: reply
        for request, reply in replies.items()
        if reply and not reply.lower().startswith(("could not understand", "error"))
    }
    remote = known.get("is in remote control")
    return replace(
        identity,
        serial_number=known.get("get serial number"),
        model=known.get("get robot model"),
        polyscope=known.get("PolyscopeVersion"),
        remote_control=None if remote is None else remote.lower() == "true",
    )


REQUESTS: Final = (
    "PolyscopeVersion",
    "get serial number",
    "get robot model",
    "is in remote control",
)
"""Questions to a dashboard; none changes anything."""


def _parts(state: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of each part of a state."""
    start = 0
    while start + PACKAGE.size <= len(state):
        length, kind = PACKAGE.unpack_from(state, start)
        if length < PACKAGE.size or start + length > len(state):
            raise ValueError(f"a part of {length} bytes in a state of {len(state)}")
        yield kind, state[start + PACKAGE.size : start + length]
        start += length


def _doubles(data: bytes, count: int) -> Array:
    return np.frombuffer(data, ">f8", count).astype(np.float64)


def _read_state(host: str, port: int) -> bytes:
    """Return the first state with a configuration; it comes within a tenth of a second."""
    deadline = time.monotonic() + IDENTITY_TIMEOUT
    with socket.create_connection((host, port), IDENTITY_TIMEOUT) as connection:
        connection.settimeout(IDENTITY_TIMEOUT)
        while time.monotonic() < deadline:
            length, kind = PACKAGE.unpack(_exactly(connection, PACKAGE.size))
            if not PACKAGE.size <= length <= MAX_PACKAGE_BYTES:
                raise ValueError(f"a package of {length} bytes")
            payload = _exactly(connection, length - PACKAGE.size)
            if kind == _ROBOT_STATE_PACKAGE and _CONFIGURATION_PART in dict(_parts(payload)):
                return payload
    raise TimeoutError(f"no configuration within {IDENTITY_TIMEOUT:g} s")


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = connection.recv(size - len(data))
        if not piece:
            raise ConnectionError("the controller closed the connection")
        data += piece
    return data


def _ask_dashboard(host: str, port: int) -> dict[str, str]:
    """Return the reply to each request."""
    with socket.create_connection((host, port), IDENTITY_TIMEOUT) as connection:
        connection.settimeout(IDENTITY_TIMEOUT)
        with connection.makefile("rwb") as stream:
            stream.readline(MAX_PACKAGE_BYTES)  # the greeting
            replies = {}
            for request in REQUESTS:
                stream.write(f"{request}\n".encode())
                stream.flush()
                replies[request] = (
                    stream.readline(MAX_PACKAGE_BYTES).decode("utf-8", "replace").strip()
                )
            with suppress(OSError):
                stream.write(b"quit\n")
                stream.flush()
            return replies


def _reason(error: BaseException) -> str:
    return str(getattr(error, "strerror", None) or error) or type(error).__name__
