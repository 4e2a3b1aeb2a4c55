"""Untrusted clients of the live view can read, and nothing else."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
pytest.importorskip("websockets", reason="websockets is not installed")

from hil.archive import live
from tests.hil.live_viewer import SUBPROTOCOL, Viewer
from tests.hil.test_live_view import records, served

FRAMES = {
    "a length of exabytes": b"\x82\xff" + struct.pack(">Q", 1 << 62) + b"1234",
    "an opcode that is none": b"\x8f\x80abcd",
    "a frame that is not masked": b"\x81\x02hi",
    "text that is none": b"\x81\x82\0\0\0\0\xff\xfe",
}
REQUESTS = (
    {"op": "advertise", "channels": [{"id": 1, "topic": "/x", "encoding": "json"}]},
    {"op": "setParameters", "parameters": [{"name": "override", "value": 2.0}]},
    {"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1},
    {"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1e99}]},
)


@pytest.fixture
def publisher() -> Iterator[live.LivePublisher]:
    with served() as made:
        yield made


def connect(port: int) -> socket.socket:
    """Connect, with handshake."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=5.0)
    key = base64.b64encode(os.urandom(16)).decode()
    connection.sendall(
        "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOL}\r\n\r\n".encode()
    )
    assert connection.recv(4096).startswith(b"HTTP/1.1 101")
    return connection


def is_closed(connection: socket.socket) -> bool:
    """Return whether the server closes the connection within seconds."""
    try:
        while connection.recv(4096):
            continue
    except ConnectionResetError:  # unread data were left
        return True
    except TimeoutError:
        return False
    return True


def still_served(publisher: live.LivePublisher) -> None:
    with Viewer(publisher.port) as viewer:
        viewer.subscribe("/hil/cycle")
        for first in range(0, 20_000, 20):
            publisher.publish(records(first, 20), ())
            try:
                assert viewer.message(timeout=0.02)[0] == "/hil/cycle"
            except TimeoutError:
                continue
            return
    raise AssertionError("no message arrives")


def test_invalid_frame_ends_its_own_connection(publisher: live.LivePublisher) -> None:
    with ExitStack() as left:
        for what, frame in FRAMES.items():
            connection = left.enter_context(connect(publisher.port))
            connection.sendall(frame)
            assert is_closed(connection), what
        still_served(publisher)


def test_requests_are_refused(publisher: live.LivePublisher) -> None:
    with Viewer(publisher.port) as viewer:
        assert viewer.info["capabilities"] == []
        for request in REQUESTS:
            viewer.socket.send(json.dumps(request))
        refused = 0
        while refused < len(REQUESTS):
            reply = viewer.socket.recv(timeout=5.0)
            refused += isinstance(reply, str) and json.loads(reply)["op"] == "status"
    still_served(publisher)


def test_idle_connections_do_not_block_others(publisher: live.LivePublisher) -> None:
    with ExitStack() as left:
        for _ in range(100):
            address = ("127.0.0.1", publisher.port)
            left.enter_context(socket.create_connection(address, timeout=5.0))
        still_served(publisher)
