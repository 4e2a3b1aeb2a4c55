"""What is being recorded, for a viewer to look at meanwhile: the Foxglove WebSocket protocol.

The same messages as in an archive, a part of them. Nothing that is looked at can hold recording up:
rows are left in a queue that drops the oldest, a thread of its own encodes them, and the server
(the official SDK, in threads of its own) drops the oldest messages of a client that is too slow.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.exchange.event_log import ExchangeEvent
from hil.archive.events import ArchivedEvent
from hil.archive.recorder import describe, level_of
from hil.archive.schema import (
    COMMANDED,
    CYCLE,
    EVENT_CHANNEL,
    MEASURED,
    Channel,
    cycle_messages,
    profile,
)
from hil.version import install_command

if TYPE_CHECKING:
    import foxglove
    from foxglove.websocket import WebSocketServer


import re
from typing import Self

from hil.errors import InputError
from hil.reading import LARGEST_PORT

LOOPBACK: Final = "127.0.0.1"
PORT: Final = 8765
"""That of the Foxglove WebSocket protocol."""
RATE: Final = 50.0
"""Messages of a channel per second: more than a screen shows."""
_ADDRESS: Final = re.compile(r"((?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]+):)?(?P<port>\d{1,5})")


class LiveViewError(InputError):
    """The live view cannot be served as asked for."""


@dataclass(frozen=True)
class LiveView:
    """A live view that was asked for; pickles.

    Attributes:
        host: address it is bound to; anybody who reaches that address may look.
        port: TCP.
        rate: cycles published per second, at most.
    """

    host: str = LOOPBACK
    port: int = PORT
    rate: float = RATE

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read HOST:PORT, or PORT alone for this computer only.

        Raises:
            LiveViewError: it is neither.
        """
        match = _ADDRESS.fullmatch(text.strip())
        if match is None or int(match["port"]) > LARGEST_PORT:
            remedy = f"e.g. {LOOPBACK}:{PORT}"
            raise LiveViewError(None, f"--live {text} is no HOST:PORT", remedy=remedy)
        return cls((match["host"] or LOOPBACK).strip("[]"), int(match["port"]))

    @property
    def invitation(self) -> str:
        """One line that says where to look."""
        return f"live view: open ws://{self} in Foxglove"

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


Records = NDArray[np.void]

QUEUE: Final = 50
"""Portions (of some 20 ms) that may wait for the thread; the oldest are dropped."""
BACKLOG: Final = 512
"""Messages that may wait for one client; the oldest are dropped."""
SLEEP: Final = 0.2
"""s between two looks whether to end."""
ASTRAY: Final = 1.0
"""s by which the controller's time may leave this computer's before they are put together anew."""


@dataclass(frozen=True, eq=False)
class Serve:
    """Let viewers look from now on, whether or not an archive is open.

    Attributes:
        job: for the answer, `Serving` or `Failed`.
        view: where.
        joint_names: of the link's joints.
        period: of the controller, s.
        drive_train: in force until an archive says otherwise.
    """

    job: int
    view: LiveView
    joint_names: tuple[str, ...]
    period: float
    drive_train: DriveTrain


@dataclass(frozen=True, eq=False)
class _Portion:
    records: Records
    events: tuple[ExchangeEvent, ...]
    drive_train: DriveTrain


class LivePublisher:
    """Serves viewers until `close`.

    Args:
        asked: where, how often, and of which link.

    Attributes:
        port: served.
        drive_train: in force; makes joint torques of target currents.

    Raises:
        LiveViewError: the address cannot be bound, or the library is not installed.
    """

    def __init__(self, asked: Serve) -> None:
        self._server, self._context = _serve(asked.view)
        self.port = int(self._server.port)
        self.drive_train = asked.drive_train
        self._names = asked.joint_names
        known = profile(len(asked.joint_names))
        cycles = (known[topic] for topic in (CYCLE, MEASURED, COMMANDED))
        self._period = asked.period
        self._step = max(1, round(1.0 / (asked.view.rate * asked.period)))
        self._channels = [_channel(channel, self._context) for channel in cycles]
        self._events = _channel(EVENT_CHANNEL, self._context)
        self._clock = ViewerClock()
        self._waiting: deque[_Portion] = deque(maxlen=QUEUE)
        self._more, self._over = threading.Event(), False
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._thread.start()

    def publish(self, records: Records, events: Sequence[ExchangeEvent]) -> None:
        """Leave what has come for the thread: some of the records, all events; returns at once."""
        if len(records):
            records = records[records["cycle"] % self._step == 0]
        if len(records) or events:
            self._waiting.append(_Portion(records, tuple(events), self.drive_train))
            self._more.set()

    def close(self) -> None:
        """End the server; viewers see it go."""
        self._over = True
        self._more.set()
        self._thread.join(2.0 * SLEEP)
        self._server.stop()

    def _work(self) -> None:
        while not self._over:
            self._more.wait(SLEEP)
            self._more.clear()
            while self._waiting:
                self._send(self._waiting.popleft())

    def _send(self, portion: _Portion) -> None:
        records = portion.records
        if len(records):
            torque = portion.drive_train.joint_torque(records["target_current"])
            batch = cycle_messages(self._names, self._period, records, torque)
            times = [self._clock.at(int(stamp)) for stamp in batch.stamp]
            for channel, rows in zip(self._channels, batch.messages.values(), strict=True):
                size = rows.dtype.itemsize
                data = rows.tobytes()
                for index, log_time in enumerate(times):
                    message = data[index * size : (index + 1) * size]
                    channel.log(message, log_time=log_time)
        for event in portion.events:
            seconds = self._period * (getattr(event, "cycle", None) or 0)
            said = ArchivedEvent(seconds, type(event).__name__, describe(event), level_of(event))
            self._events.log(said.encode(), log_time=time.time_ns())


class ViewerClock:
    """Times of messages on this computer's clock, evenly spaced like the controller's cycles.

    The stamps in the messages are the controller's own, as in an archive; they begin anew with
    each session, which a viewer's time line would not bear.
    """

    def __init__(self) -> None:
        self._offset: int | None = None

    def at(self, stamp: int) -> int:
        """Time of a message, ns since 1970, by its stamp, ns since the session began."""
        now = time.time_ns()
        offset = self._offset
        if offset is None or abs(stamp + offset - now) > 1e9 * ASTRAY:
            self._offset = offset = now - stamp
        return stamp + offset


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
            message_backlog_size=BACKLOG,
        )
    except Exception as error:  # the library names no narrower one
        remedy = "name an address of this computer and a free port"
        raise LiveViewError(None, f"--live {view}: {error}", remedy=remedy) from error
    return server, context


def _channel(channel: Channel, context: foxglove.Context) -> foxglove.Channel:
    import foxglove

    schema = foxglove.Schema(
        name=channel.schema, encoding="ros2msg", data=channel.definition.encode()
    )
    return foxglove.Channel(channel.topic, schema=schema, message_encoding="cdr", context=context)
