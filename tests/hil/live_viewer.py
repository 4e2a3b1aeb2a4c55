"""A client of the live view, independent of the library that serves it.

It follows the protocol (https://github.com/foxglove/ws-protocol, in its present
form `foxglove.sdk.v1`) with other libraries for WebSockets and messages.
"""

from __future__ import annotations

import json
import struct
from typing import Any

from mcap_ros2._dynamic import generate_dynamic  # type: ignore[import-untyped]
from websockets.sync import client

SUBPROTOCOL = "foxglove.sdk.v1"


class Viewer:
    """A connection that subscribes to channels and decodes their messages."""

    def __init__(self, port: int) -> None:
        self.socket = client.connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[SUBPROTOCOL],
            compression=None,
            close_timeout=0.5,  # s; a client that reads nothing does not read the reply either
        )
        self.info = self._text("serverInfo")
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < 4:
            for channel in self._text("advertise")["channels"]:
                self.channels[channel["topic"]] = channel

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def _text(self, op: str) -> dict[str, Any]:
        while True:
            message = self.socket.recv(timeout=5.0)
            if isinstance(message, str):
                content: dict[str, Any] = json.loads(message)
                if content["op"] == op:
                    return content

    def subscribe(self, *topics: str) -> None:
        """Subscribe; the identifier of a subscription is that of its channel."""
        wanted = [self.channels[topic]["id"] for topic in topics]
        subscriptions = [{"id": number, "channelId": number} for number in wanted]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def message(self, timeout: float = 5.0) -> tuple[str, int, Any]:
        """Return topic, log time and decoded content of the next message."""
        return self._decoded(self._data(timeout))

    def last_message(self, silence: float) -> tuple[str, int, Any]:
        """Return the last message before a silence of so many seconds."""
        last = self._data(5.0)
        while True:
            try:
                last = self._data(silence)
            except TimeoutError:
                return self._decoded(last)

    def _data(self, timeout: float) -> bytes:
        while True:
            data = self.socket.recv(timeout=timeout)
            if isinstance(data, bytes) and data[0] == 1:
                return data

    def _decoded(self, data: bytes) -> tuple[str, int, Any]:
        number, log_time = struct.unpack_from("<IQ", data, 1)
        topic = next(t for t, c in self.channels.items() if c["id"] == number)
        channel = self.channels[topic]
        decoders = generate_dynamic(channel["schemaName"], channel["schema"])
        return topic, log_time, decoders[channel["schemaName"]](data[13:])
