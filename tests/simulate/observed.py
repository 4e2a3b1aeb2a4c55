"""What is seen of one simulated campaign from outside: all that a law may judge by."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers import Counters
from drivers.events import Event
from hil.campaign.plan import CampaignPlan
from hil.campaign.run import RunResult
from hil.cell import Cell
from identification import RobotModel, Samples
from identification.estimators.least_squares import RepeatedEstimate
from sim_fixtures import ControllerSettings

Array = NDArray[np.float64]
Digests = Mapping[str, str]
"""File name (in the archives folder; or "manifest.json") to SHA-256 of its bytes."""


class Exchanged(NamedTuple):
    """A packet that the PC's end of the link received, and what it sent before the next one."""

    now: float  # time on the PC's own clock as the session sees it [s]; clock faults are in it
    cycle: int  # the controller's cycle in which it was received, counted over all lives
    packet: bytes  # as it arrived
    replies: tuple[bytes, ...]  # in order; () for none, as for packets left out of a pile
    record: int  # row in `Life.records` that it made; -1 for none
    given: bool  # whether it was handed to the session, whatever came of it


class Act(NamedTuple):
    """A call of the session from the PC's own side that was not refused."""

    before: int  # index of the exchanged packet before which it came
    name: str  # "request", "stop", "override", "hold", "resume", "discarded" or "tick"
    detail: tuple[Any, ...]  # its arguments


@dataclass(frozen=True, eq=False)
class Life:
    """One process life of the PC: one `Campaign.open(...).run(...)` over a link of its own.

    A life in which nothing was missing any more never connects: then all is empty.

    Attributes:
        records: (m,) of `drivers.cycle_dtype`, all that the session committed, in order.
        events: each with the index of the exchanged packet that it came with or after.
        error: what it raised, whatever it is; a `Killed` or `KeyboardInterrupt` among them.
        died: the process was killed in mid-cycle: the last packet may be unanswered, and what was
            in memory is lost.
        before, after: digests of the files in the folder when the life began and when it had ended
            (and been torn).
    """

    exchanged: tuple[Exchanged, ...]  # in the order of their arrival
    records: NDArray[np.void]
    acts: tuple[Act, ...]  # calls of the session
    events: tuple[tuple[int, Event], ...]
    counters: Counters  # of the session when the life ended
    settings: Mapping[str, Any]  # keyword arguments of the session
    first_cycle: int  # the controller's cycle in which this life began (counted over all lives)
    last_cycle: int  # that in which it ended
    result: RunResult | None  # what the run returned; None if it raised or died
    error: BaseException | None
    died: bool
    archives: tuple[str, ...]  # names of the archives that this life began, in order
    torn: Mapping[str, int]  # archive name to bytes that its death took from the end of the file
    refused: frozenset[str]  # archives that the disk took no more of before that
    disk: tuple[str, ...]  # names of the disk's failures that struck in this life
    before: Digests
    after: Digests


@dataclass(frozen=True, eq=False)
class ArmHistory:
    """The controller's side, one row for each of its cycles, over all lives and between them.

    The last second and more of it is after the last life has ended.
    """

    sent: tuple[bytes, ...]  # (k,) packets as the controller sent them, b"" for none
    position: Array  # (k, n) joint angles [rad] at the beginning of the cycle
    velocity: Array  # (k, n) [rad/s]
    phase: tuple[str, ...]  # (k,) names of `sim_fixtures.Phase`
    open_axes: NDArray[np.bool_]  # (k,) whether any axis was in open mode


class Estimated(NamedTuple):
    """What was identified, by weighted least squares as a campaign does it."""

    result: RepeatedEstimate  # pooled and per repetition
    pooled: tuple[str, ...]  # names of the archives that were fitted, predicted or rested at
    model: RobotModel  # of the arm
    fitted: tuple[Samples, ...]  # what was fitted, one a repetition


@dataclass(frozen=True, eq=False)
class Observed:
    """One simulated campaign with its faults.

    Attributes:
        found: the estimate from `folder` by the product's own way; None where the campaign was not
            completed, or where `unidentified` says why.
        twin_found: that of the same plan on the same cell without any fault; None of that itself.
    """

    seed: int  # that all was drawn from
    cell: Cell  # with its limits, drive train and truth
    plan: CampaignPlan  # what was to be run
    controller: ControllerSettings  # how the controller behaves
    schedule: tuple[str, ...]  # the faults and acts, one line each, as `--script` takes them
    struck: tuple[str, ...]  # lines of these that came to pass
    runs: tuple[Life, ...]  # the process lives, in order
    arm: ArmHistory  # the controller's side
    folder: Path  # the campaign's, after the last life
    found: Estimated | None
    twin_found: Estimated | None
    unidentified: str  # why there is none although the campaign was completed; "" otherwise

    @property
    def pooled(self) -> tuple[str, ...]:
        """Names of the archives that the estimate is made of."""
        return () if self.found is None else self.found.pooled

    @property
    def complete(self) -> bool:
        """Whether the last life said that nothing is missing any more."""
        last = self.runs[-1].result
        return last is not None and last.complete

    @property
    def ended(self) -> str:
        last = self.runs[-1]
        if last.error is not None:
            return f"{type(last.error).__name__}: {last.error}"
        return "complete" if self.complete else "incomplete"


class Broken(NamedTuple):
    """A law that does not hold."""

    law: str  # its name; what shrinking keeps
    text: str  # what is wrong, with the figures


Law = Callable[[Observed], Iterable[Broken]]
