"""Whoever reaches the port of the live view: he may look, and that is all he may."""

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
    "a text of a gigabyte": b"\x81\xff" + struct.pack(">Q", 1 << 30) + b"1234",
    "an opcode that is none": b"\x8f\x80abcd",
    "a frame that is not masked": b"\x81\x02hi",
    "reserved bits": b"\xf1\x82abcdhi",
    "a control frame in parts": b"\x09\x80abcd",
    "text that is none": b"\x81\x82\0\0\0\0\xff\xfe",
}
WISHES = (
    {"op": "advertise", "channels": [{"id": 1, "topic": "/x", "encoding": "json"}]},
    {"op": "setParameters", "parameters": [{"name": "override", "value": 2.0}]},
    {"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1},
    {"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1e99}]},
)


@pytest.fixture
def publisher() -> Iterator[live.LivePublisher]:
    with served() as made:
        yield made


def shaken(port: int) -> socket.socket:
    """A connection past its handshake."""
    there = socket.create_connection(("127.0.0.1", port), timeout=5.0)
    key = base64.b64encode(os.urandom(16)).decode()
    there.sendall(
        "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOL}\r\n\r\n".encode()
    )
    assert there.recv(4096).startswith(b"HTTP/1.1 101")
    return there


def ended(there: socket.socket) -> bool:
    """Whether the other side ends a connection within seconds, whatever it says before."""
    try:
        while there.recv(4096):
            continue
    except ConnectionResetError:  # what was sent and never read is an end as well
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
    raise AssertionError("nothing comes any more")


def test_frames_that_are_none_end_their_own_connection(publisher: live.LivePublisher) -> None:
    with ExitStack() as left:
        for what, frame in FRAMES.items():
            there = left.enter_context(shaken(publisher.port))
            there.sendall(frame)
            assert ended(there), what
        still_served(publisher)


def test_nothing_can_be_sent_set_or_fetched(publisher: live.LivePublisher) -> None:
    with Viewer(publisher.port) as viewer:
        assert viewer.info["capabilities"] == []
        for wish in WISHES:
            viewer.socket.send(json.dumps(wish))
        refused = 0
        while refused < len(WISHES):
            said = viewer.socket.recv(timeout=5.0)
            refused += isinstance(said, str) and json.loads(said)["op"] == "status"
    still_served(publisher)


def test_many_that_say_nothing_keep_nobody_out(publisher: live.LivePublisher) -> None:
    with ExitStack() as left:
        for _ in range(100):
            address = ("127.0.0.1", publisher.port)
            left.enter_context(socket.create_connection(address, timeout=5.0))
        still_served(publisher)
