"""Frames of RTDE, the real-time data exchange of Universal Robots (TCP port 30004).

A frame is a big-endian ``uint16`` with its length (header included), a ``uint8`` with its type, and
a payload. TCP splits and joins frames as it likes. Values of a data frame are packed without
padding, in the order of a recipe that the client requests and the controller confirms.

Pure functions of bytes; nothing here opens a socket.

Source: RTDE guide of the maker; universal-robots.com, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, PacketError

PORT: Final = 30004
VERSION: Final = 2
"""Of the protocol, that has a frequency and numbered recipes."""
MAX_NAME_BYTES: Final = 2048
"""Bytes of the list of names in a request."""
MAX_TEXT_BYTES: Final = 255
"""Bytes of a line of text from the controller."""
_HEADER: Final = struct.Struct(">HB")
MAX_FRAME_BYTES: Final = 0xFFFF
"""Bytes of the longest frame, header included."""


class FrameType(IntEnum):
    """Type of a frame, an ASCII letter."""

    VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT = ord("M")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


_NUMPY_TYPES: Final[dict[str, Any]] = {
    "BOOL": np.dtype("?"),
    "UINT8": np.dtype("u1"),
    "UINT32": np.dtype(">u4"),
    "INT32": np.dtype(">i4"),
    "UINT64": np.dtype(">u8"),
    "DOUBLE": np.dtype(">f8"),
    "VECTOR3D": np.dtype((">f8", (3,))),
    "VECTOR6D": np.dtype((">f8", (6,))),
    "VECTOR6INT32": np.dtype((">i4", (6,))),
    "VECTOR6UINT32": np.dtype((">u4", (6,))),
}
"""Types of values by their names in the protocol."""
NOT_FOUND: Final = "NOT_FOUND"
"""Type of an output or input that this controller does not have."""
IN_USE: Final = "IN_USE"
"""Type of an input that another client of the controller writes."""


class RtdeError(DriverError):
    """Bytes that are not RTDE, or a request that the controller refused."""


class OutputsMissingError(RtdeError):
    """Outputs that this controller does not have; `names` are theirs."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__(f"the controller does not send {', '.join(names)}")
        self.names = tuple(names)


class InputsInUseError(RtdeError):
    """Inputs that another client of the controller writes; `names` are theirs."""

    def __init__(self, names: Sequence[str]) -> None:
        further = f" and {len(names) - 1} more of the registers" if len(names) > 1 else ""
        super().__init__(f"another program writes {names[0]}{further}")
        self.names = tuple(names)


class RtdeFrame(NamedTuple):
    """One frame: its type, which may be unknown, and its payload."""

    kind: int
    payload: bytes


def frame(kind: FrameType, payload: bytes = b"") -> bytes:
    """Return the bytes of a frame.

    Raises:
        ValueError: the payload is longer than a frame can be.
    """
    length = _HEADER.size + len(payload)
    if length > MAX_FRAME_BYTES:
        raise ValueError(f"a frame of {length} bytes; at most {MAX_FRAME_BYTES} are possible")
    return _HEADER.pack(length, kind) + payload


class FrameSplitter:
    """Frames of a stream that arrives in pieces of any size."""

    def __init__(self) -> None:
        self._rest = b""

    @property
    def unfinished(self) -> int:
        """Bytes of a frame that has not arrived completely."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[RtdeFrame]:
        """Return the frames that these bytes complete.

        Raises:
            RtdeError: a length shorter than a header: the stream is not RTDE.
        """
        data = self._rest + data
        frames = []
        start = 0
        while start + _HEADER.size <= len(data):
            length, kind = _HEADER.unpack_from(data, start)
            if length < _HEADER.size:
                raise RtdeError(f"a frame of {length} bytes: this is not the RTDE port")
            if start + length > len(data):
                break
            frames.append(RtdeFrame(kind, data[start + _HEADER.size : start + length]))
            start += length
        self._rest = data[start:]
        return frames


def version_request(version: int = VERSION) -> bytes:
    """Return the request for a version of the protocol."""
    return frame(FrameType.VERSION, struct.pack(">H", version))


def accepted(payload: bytes) -> bool:
    """Return whether the controller accepts a version, a start or a pause.

    Raises:
        PacketError: the reply has another length.
    """
    _require_length("reply", payload, 1)
    return payload != b"\0"


class ControllerVersion(NamedTuple):
    """Version of the controller's software: 3 is CB3, 5 e-Series, 10 PolyScope X."""

    major: int
    minor: int
    bugfix: int
    build: int

    def __str__(self) -> str:
        return ".".join(map(str, self))


def controller_version(payload: bytes) -> ControllerVersion:
    """Return the version in a reply (PacketError: another length)."""
    _require_length("controller version", payload, 16)
    return ControllerVersion(*struct.unpack(">4I", payload))


def outputs_request(frequency: float, names: Sequence[str]) -> bytes:
    """Return the request for outputs, in this order, `frequency` times a second.

    Raises:
        ValueError: the names are too long together.
    """
    joined = ",".join(names).encode("ascii")
    if len(joined) > MAX_NAME_BYTES:
        raise ValueError(f"{len(joined)} bytes of names; at most {MAX_NAME_BYTES} are possible")
    return frame(FrameType.OUTPUTS, struct.pack(">d", frequency) + joined)


def inputs_request(names: Sequence[str]) -> bytes:
    """Return the request to write inputs, in this order."""
    return frame(FrameType.INPUTS, ",".join(names).encode("ascii"))


def confirmed_inputs(names: Sequence[str], payload: bytes) -> int:
    """Return the number of the recipe in a reply to `inputs_request` with these names.

    Raises:
        InputsInUseError: another client writes some of them.
        RtdeError: the controller lacks some of them, or replies something else.
    """
    number, types = payload[0] if payload else 0, payload[1:].decode("latin-1").split(",")
    if len(types) != len(names):
        raise RtdeError(f"{len(names)} inputs were requested, {len(types)} confirmed")
    pairs = [*zip(names, types, strict=True)]
    if used := [name for name, kind in pairs if kind == IN_USE]:
        raise InputsInUseError(used)
    if missing := [name for name, kind in pairs if kind == NOT_FOUND]:
        raise RtdeError(f"the controller does not have {', '.join(missing)}")
    if number == 0:
        raise RtdeError("the controller refuses to have its inputs written")
    return number


@dataclass(frozen=True)
class OutputRecipe:
    """Outputs that the controller confirmed, in the order of their values.

    Attributes:
        number: of the recipe, the first byte of its data frames.
        names, types: of the outputs.
    """

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @classmethod
    def confirmed(cls, names: Sequence[str], payload: bytes) -> OutputRecipe:
        """Return the recipe of a reply to `outputs_request` with these names.

        Raises:
            OutputsMissingError: the controller lacks some of them.
            RtdeError: the reply has another number of types, or an unknown one.
        """
        number, types = payload[0] if payload else 0, payload[1:].decode("latin-1").split(",")
        if len(types) != len(names):
            raise RtdeError(f"{len(names)} outputs were requested, {len(types)} confirmed")
        if missing := [name for name, kind in zip(names, types, strict=True) if kind == NOT_FOUND]:
            raise OutputsMissingError(missing)
        if unknown := sorted(set(types) - _NUMPY_TYPES.keys()):
            raise RtdeError(f"outputs of an unknown type: {unknown[0]!r}")
        return cls(number, tuple(names), tuple(types))

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Layout of the values of one data frame."""
        fields = zip(self.names, map(_NUMPY_TYPES.__getitem__, self.types), strict=True)
        return np.dtype([*fields])

    def values(self, payloads: Sequence[bytes]) -> NDArray[np.void]:
        """Return the values of k data frames (k,), in native byte order.

        Raises:
            PacketError: a frame is of another recipe, or has another length.
        """
        size = 1 + self.dtype.itemsize
        for payload in payloads:
            _require_length("data frame", payload, size)
            if payload[0] != self.number:
                raise PacketError("recipe", payload[0], f"{self.number}, the one requested")
        packed = b"".join(payload[1:] for payload in payloads)
        return np.frombuffer(packed, self.dtype).astype(self.dtype.newbyteorder("="))


@dataclass(frozen=True)
class ControllerText:
    """A line of text from the controller; `level` is 0 exception, 1 error, 2 warning, 3 info."""

    message: str
    source: str
    level: int


_INFO: Final = 3  # level of a text


def text_frame(message: str) -> bytes:
    """Return a frame with a line of text, cut to the length that a frame can have."""
    words = (message.encode()[:MAX_TEXT_BYTES], b"controller")
    packed = b"".join(bytes([len(word)]) + word for word in words)
    return frame(FrameType.TEXT, packed + bytes([_INFO]))


def controller_text(payload: bytes) -> ControllerText:
    """Return the text of a frame of protocol version 2.

    Raises:
        PacketError: the frame ends within a text.
    """
    message, end = _string(payload, 0)
    source, end = _string(payload, end)
    if end >= len(payload):
        raise PacketError("length of the text", len(payload), f"{end + 1} bytes")
    return ControllerText(message, source, payload[end])


def _string(payload: bytes, start: int) -> tuple[str, int]:
    """Return a text that its length precedes, and where it ends."""
    end = start + 1 + (payload[start] if start < len(payload) else 0)
    if end > len(payload):
        raise PacketError("length of the text", len(payload), f"{end} bytes or more")
    return payload[start + 1 : end].decode("utf-8", "replace"), end


def _require_length(name: str, payload: bytes, length: int) -> None:
    if len(payload) != length:
        raise PacketError(f"length of the {name}", len(payload), f"{length} bytes")
