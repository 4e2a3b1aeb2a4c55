"""Untrusted clients of the live view can read, and nothing else."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
pytest.importorskip("websockets", reason="websockets is not installed")

from hil.archive import live
from tests.hil.archive.live_archive import records, served
from tests.hil.live_viewer import Viewer

pytestmark = pytest.mark.safety

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


def test_invalid_frames_do_not_end_the_service(
    publisher: live.LivePublisher,
) -> None:
    address = ("127.0.0.1", publisher.port)
    with ExitStack() as left:
        for _ in range(100):
            left.enter_context(socket.create_connection(address, timeout=5.0))
        viewer = left.enter_context(Viewer(publisher.port))
        viewer.socket.socket.sendall(b"\x82\xff" + b"\xff" * 8)  # a length of exabytes
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
