"""Live view of a recording: the Foxglove WebSocket protocol.

It cannot delay the recording: a queue drops the oldest rows, a thread encodes them, and the server
(the official SDK, in its own threads) drops the oldest messages of slow clients.
"""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.exchange.event_log import ExchangeEvent
from hil.archive.recorder import describe, level_of
from hil.archive.schema import (
    COMMANDED,
    CYCLE,
    EVENT_CHANNEL,
    MEASURED,
    ArchiveChannel,
    ArchivedEvent,
    cycle_messages,
    profile,
)
from hil.base.errors import InputError
from hil.base.safe_input import MAX_PORT
from hil.base.version import install_command

if TYPE_CHECKING:
    import foxglove
    from foxglove.websocket import WebSocketServer

LOOPBACK: Final = "127.0.0.1"
PORT: Final = 8765  # Of the Foxglove WebSocket protocol
MESSAGE_RATE: Final = 50.0  # Messages per second and channel
MAX_QUEUED_BATCHES: Final = 50  # Batches (of some 20 ms) queued for the thread
MAX_CLIENT_MESSAGES: Final = 512  # Messages queued for one client
END_POLL_PERIOD: Final = 0.2  # Time between two checks of the end condition, s
MAX_CLOCK_DRIFT: Final = 1.0
"""Difference of the controller's and this computer's time at which they are aligned again, s."""
_ADDRESS: Final = re.compile(r"((?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]+):)?(?P<port>\d{1,5})")


class LiveViewError(InputError):
    """The live view cannot be served."""


@dataclass(frozen=True)
class LiveView:
    """Address and rate of a live view; pickles. All who can reach `host` can connect."""

    host: str = LOOPBACK
    port: int = PORT
    rate: float = MESSAGE_RATE

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse HOST:PORT, or PORT for connections from this computer only; else LiveViewError."""
        match = _ADDRESS.fullmatch(text.strip())
        if match is None or int(match["port"]) > MAX_PORT:
            remedy = f"e.g. {LOOPBACK}:{PORT}"
            raise LiveViewError(None, f"--live {text} is not HOST:PORT", remedy=remedy)
        return cls((match["host"] or LOOPBACK).strip("[]"), int(match["port"]))

    @property
    def notice(self) -> str:
        """One line with the address to open."""
        return f"live view: open ws://{self} in Foxglove"

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


Records = NDArray[np.void]


@dataclass(frozen=True, eq=False)
class Serve:
    """Command to serve a live view, with and without an open archive; see `Serving`, `Failed`.

    `drive_train` is used until an archive is opened with its own.
    """

    job: int
    view: LiveView
    joint_names: tuple[str, ...]
    period: float
    drive_train: DriveTrain


class LivePublisher:
    """Serves viewers until `close`; `drive_train` converts target currents to joint torques.

    Raises:
        LiveViewError: the address cannot be bound, or foxglove-sdk is not installed.
    """

    def __init__(self, command: Serve) -> None:
        self._server, self._context = _serve(command.view)
        self.port = int(self._server.port)
        self.drive_train = command.drive_train
        self._names = command.joint_names
        channels = profile(len(command.joint_names))
        cycles = (channels[topic] for topic in (CYCLE, MEASURED, COMMANDED))
        self._period = command.period
        self._step = max(1, round(1.0 / (command.view.rate * command.period)))
        self._channels = [_channel(channel, self._context) for channel in cycles]
        self._events = _channel(EVENT_CHANNEL, self._context)
        self._offset: int | None = None
        self._waiting = deque[tuple[Records, tuple[ExchangeEvent, ...], DriveTrain]](
            maxlen=MAX_QUEUED_BATCHES
        )
        self._more = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._thread.start()

    def publish(self, records: Records, events: Sequence[ExchangeEvent]) -> None:
        """Queue a part of the records and all events; returns at once."""
        if len(records):
            records = records[records["cycle"] % self._step == 0]
        if len(records) or events:
            self._waiting.append((records, tuple(events), self.drive_train))
            self._more.set()

    def close(self) -> None:
        """End the server and its connections."""
        self._closed = True
        self._more.set()
        self._thread.join(2.0 * END_POLL_PERIOD)
        self._server.stop()

    def _work(self) -> None:
        while not self._closed:
            self._more.wait(END_POLL_PERIOD)
            self._more.clear()
            while self._waiting:
                self._send(*self._waiting.popleft())

    def _send(
        self, records: Records, events: Sequence[ExchangeEvent], drive_train: DriveTrain
    ) -> None:
        if len(records):
            torque = drive_train.joint_torque(records["target_current"])
            encoded = cycle_messages(self._names, self._period, records, torque)
            times = [self._time_of(int(stamp)) for stamp in encoded.stamp]
            for channel, rows in zip(self._channels, encoded.messages.values(), strict=True):
                for row, log_time in zip(rows, times, strict=True):
                    channel.log(row.tobytes(), log_time=log_time)
        for event in events:
            seconds = self._period * (getattr(event, "cycle", None) or 0)
            message = ArchivedEvent(seconds, type(event).__name__, describe(event), level_of(event))
            self._events.log(message.encode(), log_time=time.time_ns())

    def _time_of(self, stamp: int) -> int:
        """Return the time of a message, ns since 1970, by its stamp, ns since the session began.

        The times are evenly spaced, as the stamps, until the two clocks differ by
        `MAX_CLOCK_DRIFT`.
        """
        now = time.time_ns()
        if self._offset is None or abs(stamp + self._offset - now) > 1e9 * MAX_CLOCK_DRIFT:
            self._offset = now - stamp
        return stamp + self._offset


def _serve(view: LiveView) -> tuple[WebSocketServer, foxglove.Context]:
    try:
        import foxglove
    except ImportError as error:
        remedy = f"install it: {install_command('live')}"
        raise LiveViewError(None, "--live needs the library foxglove-sdk", remedy=remedy) from error
    context = foxglove.Context()
    try:
        server = foxglove.start_server(
            name="hil",
            host=view.host,
            port=view.port,
            context=context,
            message_backlog_size=MAX_CLIENT_MESSAGES,
        )
    except Exception as error:  # the library documents no narrower one
        remedy = "give an address of this computer and a free port"
        raise LiveViewError(None, f"--live {view}: {error}", remedy=remedy) from error
    return server, context


def _channel(channel: ArchiveChannel, context: foxglove.Context) -> foxglove.Channel:
    import foxglove

    schema = foxglove.Schema(
        name=channel.schema, encoding="ros2msg", data=channel.definition.encode()
    )
    return foxglove.Channel(channel.topic, schema=schema, message_encoding="cdr", context=context)
