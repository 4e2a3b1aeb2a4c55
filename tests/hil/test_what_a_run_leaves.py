"""What the process that supervised a run still holds afterwards: it may supervise for days.

Objects in a reference cycle wait for the cycle collector, which comes late in a process with many
objects: minutes in which each further run adds its share, and the heap is left with holes.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.campaign import Campaign, MotionFailedError, Stop
from hil.campaign.operator import RunStatus, Unattended
from hil.cell import Cell
from hil.version import software
from tests.hil.fast_cell import fast_campaign, fast_cell


class Impatient(Unattended):
    """Stops the arm in the first repetition."""

    def __init__(self, stop: Stop) -> None:
        self._stop = stop

    def show(self, status: RunStatus) -> None:
        self._stop.requested = status.phase == "repetition" and status.motion is not None


def left_in_cycles(work: Callable[[], object]) -> Counter[str]:
    """What `work` leaves to the cycle collector, by type."""
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        work()
        gc.collect()
        return Counter(type(one).__qualname__ for one in gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


def test_a_campaign_leaves_nothing_to_the_cycle_collector(tmp_path: Path) -> None:
    """Made of a cell file, run, stopped on the way, opened and run again."""
    plan = fast_campaign(tmp_path / "first", fast_cell(tmp_path, repetitions=1)).plan
    folder = tmp_path / "second"
    software()  # what is installed is read once in a process

    def work() -> None:
        stop = Stop()
        campaign = Campaign.create(folder, Cell.load(tmp_path / "cell.toml"), plan)
        with pytest.raises(MotionFailedError):
            campaign.run(stop=stop, operator=Impatient(stop), unrehearsed=True)
        assert Campaign.open(folder).run(unrehearsed=True).complete

    assert not left_in_cycles(work)
