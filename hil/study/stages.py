"""How long the stages of a study take, kept in its folder so that sessions add up."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Final

import psutil
from pydantic import Field

from hil.errors import OutputError
from hil.files import write_or_tell
from hil.reading import text_of
from hil.results.frozen import Frozen

TIMES: Final = "times.json"
_EVERY: Final = 10.0
"""s between two writings: what a kill may cost."""


Seconds = Annotated[float, Field(ge=0.0, le=1e9)]
"""What a clock may have counted: a finite time of at most some thirty years."""


class Times(Frozen):
    """s by stage, over all sessions."""

    wall: dict[str, Seconds] = Field(default_factory=dict)
    processor: dict[str, Seconds] = Field(default_factory=dict)
    """Of this process and its children."""
    whole: bool = True
    """False for a study that was begun before times were kept."""


class Stages:
    """Adds up what the stages take; a session that is killed has written so far."""

    def __init__(self, root: Path, *, begun: bool) -> None:
        """Go on from what is in the folder; `begun` says whether there was a study in it."""
        self._path = root / TIMES
        try:
            self._times = Times.model_validate_json(text_of(self._path))
        except (OSError, ValueError):
            self._times = Times(whole=not begun)

    @property
    def times(self) -> Times:
        """So far, of stages that have ended."""
        return self._times

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Whatever happens until this is left belongs to a stage.

        Raises:
            OutputError: its time cannot be written; an error of the stage itself goes first.
        """
        before, begin = self._times, (time.perf_counter(), _processor())
        over = threading.Event()

        def added() -> Times:
            taken = time.perf_counter() - begin[0], max(0.0, _processor() - begin[1])
            return before.model_copy(
                update={
                    "wall": _plus(before.wall, name, taken[0]),
                    "processor": _plus(before.processor, name, taken[1]),
                }
            )

        def keep() -> None:
            while not over.wait(_EVERY):
                with suppress(OutputError):  # the end of the stage tries again, and tells
                    self._write(added())

        thread = threading.Thread(target=keep, daemon=True)
        thread.start()

        def end() -> None:
            over.set()
            thread.join()
            self._times = added()
            self._write(self._times)

        try:
            yield
        except BaseException:
            with suppress(OutputError):
                end()
            raise
        end()

    def _write(self, times: Times) -> None:
        write_or_tell(self._path, times.model_dump_json(indent=1) + "\n")


def _plus(before: dict[str, float], name: str, seconds: float) -> dict[str, float]:
    return before | {name: round(before.get(name, 0.0) + seconds, 1)}


def _processor() -> float:
    """Seconds of processor of this process and of all its children, ended or not."""
    own = psutil.Process()
    total = 0.0
    for process in (own, *own.children(recursive=True)):
        try:
            times = process.cpu_times()
        except psutil.Error:  # it has just ended
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return total
