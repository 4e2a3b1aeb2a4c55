"""What a `MotionLink` steers over: packets of one controller, and the archive of them.

`hil.control.virtual_link` has the port in virtual time, `hil.control.live_link` that in real
time. Only what differs between them is here; requests, time-outs and endings are the link's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.exchange.event_log import ExchangeEvent
from drivers.motion_source import MotionSource
from drivers.states import State
from hil.archive import ArchiveSpec
from hil.archive.live import LiveView
from hil.archive.recorder import Recorded
from hil.control.motion_watch import Stop


@dataclass(frozen=True)
class PortStatus:
    """State of the session; counts are since it was created, see `drivers.events.Counters`.

    Attributes:
        cycle: the controller's.
        replied, missed, late, not_accepted: packets that got a reply, never arrived, got it late or
            not at all, and whose reply was not accepted.
        late_packets: packets that came late themselves.
        foreign: packets from other addresses.
        ended_count: motions that have ended, also where the event of it was lost.
        motion_time, rate: elapsed time [s] of the last motion at its planned speed, and motion time
            per time; NaN if unknown.
    """

    state: State
    cycle: int
    replied: int
    missed: int
    late: int
    not_accepted: int
    foreign: int
    ended_count: int
    motion_time: float
    rate: float
    late_packets: int = 0

    @property
    def counts(self) -> tuple[int, int, int, int, int]:
        """Packets that got a reply, were missed, came late, got it late, and were not accepted."""
        return self.replied, self.missed, self.late_packets, self.late, self.not_accepted


class ControllerPort(Protocol):
    """Exchange with one controller, with at most one open archive.

    Attributes:
        is_virtual: whether time is simulated; then it passes in `exchange_until` only.
        only_simulated: whether only a simulated controller can be connected.
        live: where viewers connect, None if nowhere.
    """

    is_virtual: bool
    only_simulated: bool
    live: LiveView | None

    @property
    def now(self) -> float:
        """Time of the link, s."""

    def status(self) -> PortStatus:
        """Return the state of the session."""

    def failure(self) -> str | None:
        """Return why no packet gets a reply any more; None while they do."""

    def notes(self) -> tuple[str, ...]:
        """Return what the system refused, in sentences; nothing of it is essential."""

    def prepare(self, stop: Stop) -> None:
        """Wait for what an earlier failure left, or a stop; read records from now on.

        Raises:
            ControllerError: the archive process ended, or waits for its disk.
        """

    def poll(self) -> Sequence[ExchangeEvent]:
        """Receive events; in virtual time, also archive them and the records of before."""

    def new_records(self) -> NDArray[np.void]:
        """Return the cycle records since the last call, the newest last.

        While an archive is open in virtual time they may begin later.
        """

    def exchange_until(self, finished: Callable[[], bool], /) -> bool:
        """Exchange packets until `finished()`; return False if they ended before.

        It is called after every packet in virtual time, about every 20 ms in real time.
        """

    def due(self) -> bool:
        """Return whether a motion is to be looked after now; called once by each `finished`."""

    def submit(self, source: MotionSource, wanted: Callable[[], bool], /) -> None:
        """Request a motion; withdraw it where it is not `wanted()` when it could start.

        Raises:
            RequestError: it was not accepted, or withdrawn (WithdrawnError).
            DriverError: the exchange does not answer.
        """

    def supervision(self) -> AbstractContextManager[None]:
        """Stop the arm on its path if `poll` is not called for a second in this context."""

    def stop(self, reason: str) -> None:
        """Request a stop on the path and the end of open mode."""

    def override(self, fraction: float) -> None:
        """Change the speed of the present motion."""

    def hold(self) -> None:
        """Hold the present motion on its path until `resume`."""

    def resume(self) -> None:
        """Resume the motion that is held."""

    def open_archive(
        self, spec: ArchiveSpec, *, own_motion: bool
    ) -> AbstractContextManager[object]:
        """Open an archive, of one motion or of the controller's own; nothing moves before.

        Records of before belong to a recording of the controller's `own_motion` only.

        Raises:
            ArchiveWriteError: it cannot be created.
            ControllerError: it was not opened in time.
        """

    def archived(self) -> Recorded | None:
        """Return what the archive of a motion contains once it is complete; None before.

        Raises:
            ArchiveWriteError: it cannot be written. In virtual time any error of the writer.
        """

    def archive_failure(self) -> str | None:
        """Return why nothing is archived any more, other than the disk; None while archiving."""

    def close_archive(self, outcome: str, reason: str) -> Recorded:
        """Complete the open archive, and return what it contains.

        Raises:
            ArchiveWriteError: it cannot be written.
            ControllerError: it was not completed in time.
        """

    def close(self) -> None:
        """End the session; ControllerError if it did not end properly."""
