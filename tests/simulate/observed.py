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
    """A packet that the PC's end of the link received, and what it sent before the next one.

    Attributes:
        now: time on the PC's own clock as the session sees it [s]; clock faults are in it.
        cycle: the controller's cycle in which it was received, counted over all lives.
        packet: as it arrived.
        replies: in order; () for none, as for packets left out of a pile.
        record: row in `Life.records` that it made; -1 for none.
        given: whether it was handed to the session, whatever came of it.
    """

    now: float
    cycle: int
    packet: bytes
    replies: tuple[bytes, ...]
    record: int
    given: bool


class Act(NamedTuple):
    """A call of the session from the PC's own side that was not refused.

    Attributes:
        before: index of the exchanged packet before which it came.
        name: "request", "stop", "override", "hold", "resume", "discarded" or "tick".
        detail: its arguments.
    """

    before: int
    name: str
    detail: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Life:
    """One process life of the PC: one `Campaign.open(...).run(...)` over a link of its own.

    A life in which nothing was missing any more never connects: then all is empty.

    Attributes:
        exchanged: in the order of their arrival.
        records: (m,) of `drivers.cycle_dtype`, all that the session committed, in order.
        acts: calls of the session.
        events: each with the index of the exchanged packet that it came with or after.
        counters: of the session when the life ended.
        settings: keyword arguments of the session.
        first_cycle: the controller's cycle in which this life began (counted over all lives).
        last_cycle: that in which it ended.
        result: what the run returned; None if it raised or died.
        error: what it raised, whatever it is; a `Killed` or `KeyboardInterrupt` among them.
        died: the process was killed in mid-cycle: the last packet may be unanswered, and what was
            in memory is lost.
        archives: names of the archives that this life began, in order.
        torn: archive name to bytes that its death took from the end of the file.
        refused: archives that the disk took no more of before that.
        disk: names of the disk's failures that struck in this life.
        before, after: digests of the files in the folder when the life began and when it had
            ended (and been torn).
    """

    exchanged: tuple[Exchanged, ...]
    records: NDArray[np.void]
    acts: tuple[Act, ...]
    events: tuple[tuple[int, Event], ...]
    counters: Counters
    settings: Mapping[str, Any]
    first_cycle: int
    last_cycle: int
    result: RunResult | None
    error: BaseException | None
    died: bool
    archives: tuple[str, ...]
    torn: Mapping[str, int]
    refused: frozenset[str]
    disk: tuple[str, ...]
    before: Digests
    after: Digests


@dataclass(frozen=True, eq=False)
class ArmHistory:
    """The controller's side, one row for each of its cycles, over all lives and between them.

    The last second and more of it is after the last life has ended.

    Attributes:
        sent: (k,) packets as the controller sent them, b"" for none.
        position: (k, n) joint angles [rad] at the beginning of the cycle.
        velocity: (k, n) [rad/s].
        phase: (k,) names of `sim_fixtures.Phase`.
        open_axes: (k,) whether any axis was in open mode.
    """

    sent: tuple[bytes, ...]
    position: Array
    velocity: Array
    phase: tuple[str, ...]
    open_axes: NDArray[np.bool_]


class Estimated(NamedTuple):
    """What was identified, by weighted least squares as a campaign does it.

    Attributes:
        result: pooled and per repetition.
        pooled: names of the archives that were fitted, predicted or rested at.
        model: of the arm.
        fitted: what was fitted, one a repetition.
    """

    result: RepeatedEstimate
    pooled: tuple[str, ...]
    model: RobotModel
    fitted: tuple[Samples, ...]


@dataclass(frozen=True, eq=False)
class Observed:
    """One simulated campaign with its faults.

    Attributes:
        seed: that all was drawn from.
        cell: with its limits, drive train and truth.
        plan: what was to be run.
        controller: how the controller behaves.
        schedule: the faults and acts, one line each, as `--script` takes them.
        struck: lines of these that came to pass.
        runs: the process lives, in order.
        arm: the controller's side.
        folder: the campaign's, after the last life.
        found: the estimate from `folder` by the product's own way; None where the campaign was
            not completed, or where `unidentified` says why.
        twin_found: that of the same plan on the same cell without any fault; None of that itself.
        unidentified: why there is none although the campaign was completed; "" otherwise.
    """

    seed: int
    cell: Cell
    plan: CampaignPlan
    controller: ControllerSettings
    schedule: tuple[str, ...]
    struck: tuple[str, ...]
    runs: tuple[Life, ...]
    arm: ArmHistory
    folder: Path
    found: Estimated | None
    twin_found: Estimated | None
    unidentified: str

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
        """How the last life ended, in a word or a sentence."""
        last = self.runs[-1]
        if last.error is not None:
            return f"{type(last.error).__name__}: {last.error}"
        return "complete" if self.complete else "incomplete"


class Broken(NamedTuple):
    """A law that does not hold.

    Attributes:
        law: its name; what shrinking keeps.
        text: what is wrong, with the figures.
    """

    law: str
    text: str


Law = Callable[[Observed], Iterable[Broken]]
