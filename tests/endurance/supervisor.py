"""The supervisor of a long run: campaigns one after another on one link.

`python -m tests.endurance.supervisor FOLDER PORT CONTROLLER` opens one `LiveLink` to a simulated
controller on this computer (process CONTROLLER) and runs campaigns of the plan in FOLDER on it,
each in a folder of its own, until its standard input is closed or SIGTERM comes: then the arm is
brought to rest on its path and everything ends. Exchange and archive process live as long as it
does. It tells what it knows in lines of JSON: the link's processes, the exchange's counters every
`TELL_EVERY` s, each campaign that is over, and the error that ended it, if one did.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from drivers.transports.udp import UdpSpec
from hil.campaign import Campaign, CampaignPlan, Stop, stop_on_interrupt
from hil.campaign.live_link import LiveLink
from hil.cell import Cell
from hil.demo_link import LOOPBACK
from hil.errors import HilError
from hil.progress import Silent
from tests.endurance.stalls import so_far

TELL_EVERY: Final = 5.0
"""s between two looks at the exchange's counters."""
TRIES: Final = 5
"""Resumptions of one campaign until it is given up and the next begins: where the machine pauses
again and again, repetitions differ and are rejected."""
COUNTERS: Final = (
    "answered", "missed", "late", "answered_late", "unanswered", "refused", "duplicates", "stale",
    "malformed", "foreign", "overflow", "ended_count", "worst_turnaround_us",
)  # fmt: skip


@dataclass(eq=False)
class Lasting:
    """A link that campaigns use one after another: none of them ends it."""

    link: LiveLink

    def __getattr__(self, name: str) -> Any:
        return getattr(self.link, name)

    def close(self) -> None:
        """Stay open for the next campaign."""


@dataclass(eq=False)
class Supervisor:
    """Runs campaigns on one link until it is told to stop."""

    folder: Path
    link: LiveLink
    controller: int
    stop: Stop
    number: int = 0
    _over: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Campaign after campaign."""
        cell = Cell.load(self.folder / "cell.toml")
        plan = CampaignPlan.load(self.folder / "plan.json")
        while not self.stop.requested:
            before = self.link.exchange.status().ended_count
            campaign = Campaign.create(self.folder / f"campaign_{self.number:05d}", cell, plan)
            errors: list[str] = []
            complete = self._complete(campaign, errors)
            say(
                "campaign",
                number=self.number,
                folder=str(campaign.folder.root),
                complete=complete,
                stopped=not complete and self.stop.requested,
                restarts=errors,
                motions=self.link.exchange.status().ended_count - before,
                descriptors=self._descriptors(),
                held=held(),
            )
            self.number += 1

    def _complete(self, campaign: Campaign, errors: list[str]) -> bool:
        """Run and resume it until it is complete; False if it was stopped or given up."""
        link: Any = Lasting(self.link)
        while not self.stop.requested and len(errors) < TRIES:
            try:
                campaign.run(
                    link, self.stop, Silent(), provenance={"simulated": "yes"}, unrehearsed=True
                )
                return True
            except HilError as error:
                if self.stop.requested:
                    break
                errors.append(f"{type(error).__name__}: {error}")
                if not self.link.exchange.alive or not self.link.archive.alive:
                    raise
                os.kill(self.controller, signal.SIGUSR1)  # somebody presses drive-on
                campaign = Campaign.open(campaign.folder.root)
        return False

    def _descriptors(self) -> dict[str, int]:
        """Open ones of each process, now that no archive is open."""
        folders = {name: Path(f"/proc/{pid}/fd") for name, pid in self.pids.items()}
        return {name: sum(1 for _ in folder.iterdir()) for name, folder in folders.items()}

    @property
    def pids(self) -> Mapping[str, int]:
        """Of every process that has a part in it."""
        return {
            "supervisor": os.getpid(),
            "exchange": self.link.exchange.pid,
            "archive": self.link.archive.process.pid,
            "controller": self.controller,
        }

    @contextmanager
    def telling(self) -> Iterator[None]:
        """Tell the exchange's counters meanwhile, from a thread of its own."""
        teller = threading.Thread(target=self._tell, daemon=True)
        teller.start()
        try:
            yield
        finally:
            self._over.set()
            teller.join()

    def _tell(self) -> None:
        while True:
            status = self.link.exchange.status()
            stalls, stood = so_far(self.folder)  # at the same time: what one explains of the other
            say(
                "status",
                counters={name: getattr(status, name) for name in COUNTERS},
                latencies=list(status.latencies),
                stalls=stalls,
                stood=stood,
            )
            if self._over.wait(TELL_EVERY):
                return


_LIBC: Final = ctypes.CDLL(None)
_INTERNED: Final = 2**17
"""More strings than the table takes before it is rebuilt; it has 32 000 that stay."""


class _MallInfo(ctypes.Structure):
    """`struct mallinfo2` of glibc 2.33."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd",
            "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    )  # fmt: skip


def held() -> dict[str, int]:
    """What this process holds of its memory: bytes of malloc, blocks of Python's own allocator.

    What it once held and gave back stays its own until it is used again: only this tells a leak
    from a campaign that needed more for a moment than any before. Python's free lists and its cache
    of attributes (4096 names at most) do not count: they fill for hours. Nor does what is used up
    of its table of interned strings, as by names of files: that is rebuilt, to the size that those
    in it need. Only blocks without glibc.
    """
    gc.collect()
    sys._clear_type_cache()
    for number in range(_INTERNED):
        sys.intern(f"number {number}")
    blocks = {"blocks": sys.getallocatedblocks()}
    if (mallinfo := getattr(_LIBC, "mallinfo2", None)) is None:
        return blocks
    mallinfo.restype = _MallInfo
    found = mallinfo()
    return {"bytes": found.uordblks + found.hblkhd, **blocks}


def say(kind: str, **facts: object) -> None:
    """One line of JSON, in one piece; for nobody, if nobody listens any more."""
    line = json.dumps({"kind": kind, **facts}) + "\n"
    with suppress(OSError):
        os.write(1, line.encode())


def main() -> int:
    """Run until told to end."""
    folder, port, controller = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])

    def finish() -> None:
        with suppress(ProcessLookupError):
            os.kill(controller, signal.SIGTERM)

    cell = Cell.load(folder / "cell.toml")
    spec = UdpSpec(LOOPBACK, port, LOOPBACK)
    with stop_on_interrupt() as stop:
        threading.Thread(target=_until_alone, args=(stop,), daemon=True).start()
        try:
            with LiveLink.open(cell, transport=spec, finish=finish) as link:
                runner = Supervisor(folder, link, controller, stop)
                realtime = link.exchange.realtime
                say("link", pids=runner.pids, scheduling=realtime.scheduling, notes=link.notes())
                with runner.telling():
                    runner.run()
        except HilError as error:
            say("error", text=f"{type(error).__name__}: {error}")
            return error.exit_code
    return 0


def _until_alone(stop: Stop) -> None:
    """Whoever started this holds the other end of its standard input."""
    while os.read(0, 1024):
        pass
    stop.requested = True


if __name__ == "__main__":
    sys.exit(main())
