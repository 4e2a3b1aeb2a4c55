"""The processes of one run while it goes on: who has begun, who has ended, and who gets killed."""

from __future__ import annotations

import os
import select
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from drivers.states import State
from tests.process_death import product
from tests.process_death.controller import Page
from tests.process_death.rounds import Victim

PATIENCE: Final = 90.0
"""s for anything that has to happen, on a machine that does other things as well."""
LOOK: Final = 0.001
"""s between two looks."""
NOTICED: Final = 100
"""Cycles within which an exchange has noticed the death of its supervisor."""
MAY_MOVE: Final = (State.OPENING, State.OPEN, State.EXITING)


class NeverHappenedError(AssertionError):
    """Something that has to happen did not."""


@dataclass(eq=False)
class Death:
    """One kill.

    Attributes:
        victim: who died.
        pid: its process.
        written: records that the exchange had written just before.
    """

    victim: Victim
    pid: int
    written: int


class Watched:
    """The processes of one run while it goes on."""

    def __init__(self, page: Page, supervisor: int, controller: int, *, loops: bool) -> None:
        self.pids: dict[Victim, int] = {"supervisor": supervisor, "controller": controller}
        self.status: dict[int, int] = {}
        self.memory: product.Memory | None = None
        self._page, self._loops = page, loops
        self._ends: dict[int, int] = {}
        self._leaving: int | None = None
        self._watch(supervisor)
        self._watch(controller)

    def _watch(self, pid: int) -> None:
        with suppress(ProcessLookupError):
            self._ends[pid] = os.pidfd_open(pid)

    def over(self, victim: Victim) -> bool:
        """Whether a process has ended; one that never began counts as ended."""
        pid = self.pids.get(victim, 0)
        if pid not in self._ends:
            return True
        if not select.select([self._ends[pid]], [], [], 0.0)[0]:
            return False
        if victim in ("supervisor", "controller") and pid not in self.status:
            self.status[pid] = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        return True

    def look(self) -> None:
        """Find what the supervisor has started meanwhile."""
        modules: tuple[tuple[Victim, str], ...] = (
            ("exchange", product.EXCHANGE),
            ("archive", product.ARCHIVE),
        )
        for victim, module in modules:
            if victim not in self.pids and (
                pid := product.started_by(self.pids["supervisor"], module)
            ):
                self._watch(pid)
                self.pids[victim] = pid
                self._page.tell(self.pids.get("exchange", 0), self.pids.get("archive", 0))
        if self.memory is None and "exchange" in self.pids:
            with suppress(OSError):
                self.memory = product.Memory(self.pids["exchange"])
        if not self._loops and self._left_alone():
            self._page.finish()  # as whoever stands at the cabinet would

    def _left_alone(self) -> bool:
        """Whether nobody wants anything to move any more, and nothing does.

        An exchange may take some cycles to notice that its supervisor is dead, and begin a motion
        meanwhile. A controller that is told to end closes its axes as soon as their targets stand,
        which they also do at the begin of a motion.
        """
        control = None if self.memory is None else self.memory.control
        if not (self.over("supervisor") or (control is not None and control.finish)):
            return False
        if self._leaving is None:
            self._leaving = self._page.count
        moves = control is not None and control.state in MAY_MOVE and not self.over("exchange")
        return not moves and self._page.count - self._leaving > NOTICED

    def wait(self, *victims: Victim) -> None:
        """Until they have ended.

        Raises:
            NeverHappenedError: one did not.
        """
        deadline = time.monotonic() + PATIENCE
        for victim in victims:
            while not self.over(victim):
                self.look()
                if time.monotonic() > deadline:
                    raise NeverHappenedError(f"the {victim} never ended")
                time.sleep(5 * LOOK)

    def kill(self, victim: Victim) -> Death:
        """SIGKILL."""
        written = 0 if self.memory is None else self.memory.written
        with suppress(ProcessLookupError):
            os.kill(self.pids[victim], signal.SIGKILL)
        return Death(victim, self.pids[victim], written)

    def close(self) -> None:
        """End whatever is left, and let go."""
        for victim, pid in self.pids.items():
            if not self.over(victim):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        for victim in ("supervisor", "controller"):
            pid = self.pids[victim]
            if pid not in self.status:
                self.status[pid] = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        for end in self._ends.values():
            os.close(end)
        if self.memory is not None:
            self.memory.close()
