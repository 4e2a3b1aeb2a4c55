"""When frames of a Universal Robots controller came, by the stamps of the kernel."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace

import pytest

from drivers.ur.description import UrDescription
from drivers.ur.rtde import FrameSplitter, FrameType, frame
from drivers.ur.transport import UrTransport
from tests.drivers.ur.ur_bench import UrBench

pytestmark = pytest.mark.safety


def connection() -> tuple[socket.socket, socket.socket]:
    """Both ends of a connection by TCP."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = socket.create_connection(server.getsockname())
        return ours, server.accept()[0]


DATA = frame(FrameType.DATA, bytes(range(100)))


@pytest.fixture
def link() -> Iterator[tuple[UrTransport, socket.socket]]:
    """The transport of this computer, and the controller's end."""
    ours, theirs = connection()
    primary, spare = connection()
    agreed = SimpleNamespace(splitter=FrameSplitter(), frames=())
    bench = UrBench()
    bench.run(1)
    description = bench.session.init
    assert isinstance(description, UrDescription)
    transport = UrTransport(ours, primary, agreed, description)  # type: ignore[arg-type]
    with closing(transport), theirs, spare:
        assert transport.receive(1.0) == description.encode()
        # Linux begins to note times of arrival some time after a first socket asked for them.
        until = transport.now + 10.0
        while transport.arrived is None and transport.now < until:
            theirs.sendall(DATA)
            assert transport.receive(1.0) == DATA
        yield transport, theirs


def test_a_frame_came_when_the_kernel_received_it(
    link: tuple[UrTransport, socket.socket],
) -> None:
    transport, theirs = link
    before = transport.now
    theirs.sendall(DATA)
    assert transport.wait(10.0)
    after = transport.now
    time.sleep(0.05)  # this process does not read it
    assert transport.receive(1.0) == DATA
    assert transport.arrived is not None
    assert before <= transport.arrived <= after


def test_of_frames_read_at_once_the_last_has_a_time(
    link: tuple[UrTransport, socket.socket],
) -> None:
    transport, theirs = link
    theirs.sendall(3 * DATA)
    assert transport.wait(10.0)
    times = []
    for _ in range(3):
        assert transport.receive(1.0) == DATA
        times.append(transport.arrived)
    assert times[:2] == [None, None]
    assert times[2] is not None


def test_what_the_controller_says_in_words_has_no_time(
    link: tuple[UrTransport, socket.socket],
) -> None:
    transport, theirs = link
    theirs.sendall(DATA)
    transport.receive(1.0)
    transport._note("a popup")
    assert transport.receive(1.0) is not None
    assert transport.arrived is None
