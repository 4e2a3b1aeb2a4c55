"""The live view, received by an independent WebSocket client (`tests/hil/live_viewer.py`)."""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import pytest

from drivers.events import GapSeen
from hil.archive.live import LiveView, LiveViewError, Serve

pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
pytest.importorskip("websockets", reason="websockets is not installed")

from hil.archive import live
from tests.hil.archive.live_archive import NAMES, PERIOD, drives, records, served
from tests.hil.live_viewer import SUBPROTOCOL, Viewer


def test_messages_are_the_measured_cycles_at_the_requested_rate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        live, "MAX_CLOCK_DRIFT", 3600.0
    )  # cycles are published more slowly than their period
    with served(rate=100.0) as publisher, Viewer(publisher.port) as viewer:
        viewer.subscribe("/joint_states")
        seen: list[tuple[int, Any]] = []
        first = 0
        while len(seen) < 20:  # messages before the subscription are not sent
            publisher.publish(records(first, 20), ())
            first += 20
            try:
                while True:
                    topic, log_time, message = viewer.message(timeout=0.05)
                    assert topic == "/joint_states"
                    seen.append((log_time, message))
            except TimeoutError:
                assert first < 2000, "no message arrived"
        for _, message in seen:
            assert list(message.name) == list(NAMES)
            cycle = round(message.position[0] * 1e3)
            assert cycle % 10 == 0
            np.testing.assert_allclose(message.position, [cycle * 1e-3, -cycle * 1e-3])
            # torque = current * torque constant * gear ratio, by hand
            np.testing.assert_allclose(message.effort, [2.0 * 0.5 * 100, 4.0 * 0.25 * -50])
            assert message.header.stamp.sec * 1000 + message.header.stamp.nanosec // 10**6 == cycle
        steps = np.diff([log_time for log_time, _ in seen])
        np.testing.assert_array_equal(steps, 10_000_000)
        assert abs(seen[-1][0] - time.time_ns()) < 5e9


def test_all_channels_and_events_are_sent() -> None:
    with served() as publisher, Viewer(publisher.port) as viewer:
        assert viewer.socket.subprotocol == SUBPROTOCOL
        assert viewer.info["capabilities"] == []  # clients cannot publish
        kinds = {topic: channel["schemaName"] for topic, channel in viewer.channels.items()}
        state = "sensor_msgs/msg/JointState"
        assert kinds == {
            "/hil/cycle": "hil_msgs/msg/Cycle2", "/hil/events": "rcl_interfaces/msg/Log",
            "/joint_states": state, "/joint_states_commanded": state,
        }  # fmt: skip
        viewer.subscribe("/hil/events")
        for _ in range(100):
            publisher.publish(records(0, 0), (GapSeen(3, 1000),))
            try:
                _, _, message = viewer.message(timeout=0.05)
            except TimeoutError:
                continue
            assert (message.name, message.level, message.stamp.sec) == ("GapSeen", 30, 1)
            assert message.msg == "packets missed before cycle 1000: 3"
            return
        pytest.fail("no event arrived")


@pytest.mark.safety
def test_a_viewer_that_reads_nothing_delays_nothing() -> None:
    """Its oldest messages are dropped; another client receives the newest."""
    with served(rate=1000.0) as publisher, Viewer(publisher.port) as dead:
        dead.subscribe("/hil/cycle", "/joint_states", "/joint_states_commanded")
        with Viewer(publisher.port) as viewer:
            viewer.subscribe("/joint_states")
            took = []
            first = 0
            until = time.monotonic() + 0.8
            while first <= 10 * live.MAX_CLIENT_MESSAGES or time.monotonic() < until:
                began = time.perf_counter()
                publisher.publish(records(first, 100), ())
                took.append(time.perf_counter() - began)
                first += 100
                time.sleep(0.01)
            assert np.median(took[len(took) // 2 :]) < 0.05
            assert sum(seconds > 0.05 for seconds in took) <= 5
            assert len(publisher._waiting) <= live.MAX_QUEUED_BATCHES
            _, _, newest = viewer.last_message(silence=2.0)
            assert round(newest.position[0] * 1e3) == first - 1


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("9000", "127.0.0.1", 9000),
        ("0.0.0.0:8765", "0.0.0.0", 8765),
        ("[::1]:8765", "::1", 8765),
        *((text, "", 0) for text in ("", "localhost", "a:99999", "::1", "ws://a:1")),
    ],
)
def test_an_address_is_host_and_port_or_a_port_on_this_computer(
    text: str, host: str, port: int
) -> None:
    assert LiveView().host == "127.0.0.1"
    if port:
        view = LiveView.parse(text)
        assert (view.host, view.port) == (host, port)
    else:
        with pytest.raises(LiveViewError, match=r"HOST:PORT; e\.g\. 127\.0\.0\.1:8765"):
            LiveView.parse(text)


def test_a_port_in_use_or_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def serve(port: int) -> None:
        live.LivePublisher(Serve(1, LiveView(port=port), NAMES, PERIOD, drives()))

    with served() as publisher, pytest.raises(LiveViewError, match="in use"):
        serve(publisher.port)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(LiveViewError, match=r"pip install .*\[live\]"):
        serve(0)
