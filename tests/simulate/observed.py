"""Observation of one simulated campaign from outside: the input of the laws."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers import Counters
from drivers.events import Event
from hil.campaign.campaign_run import RunResult
from hil.campaign.plan import CampaignPlan
from hil.cell import Cell
from identification import RobotModel, Samples
from identification.estimators.least_squares import RepeatedEstimate
from sim_fixtures import ControllerSettings

Array = NDArray[np.float64]
Digests = Mapping[str, str]
"""File name (in the archives folder; or "manifest.json") to SHA-256 of its bytes."""


class Exchanged(NamedTuple):
    """A packet that the PC received, and its replies before the next one."""

    now: float  # time of the PC's clock [s], with clock faults
    cycle: int  # cycle of the controller, counted over all lives
    packet: bytes  # as received
    replies: tuple[bytes, ...]  # in order; () for packets superseded by a newer one
    record: int  # its row in `Life.records`; -1 for none
    given: bool  # whether it was passed to the session


class Act(NamedTuple):
    """An accepted call of a method of the session by the PC."""

    before: int  # index of the next exchanged packet
    name: str  # "request", "stop", "override", "hold", "resume", "discarded" or "tick"
    detail: tuple[Any, ...]  # its arguments


@dataclass(frozen=True, eq=False)
class Life:
    """One process of the PC: one `Campaign.open(...).run(...)` over its own link.

    A life of a complete campaign never connects: then everything is empty.

    Attributes:
        records: (m,) of `drivers.cycle_dtype`, all that the session committed, in order.
        events: each with the index of the exchanged packet with or after which it came.
        error: exception of the run, also `Killed` or `KeyboardInterrupt`.
        died: the process was killed within a cycle: the last packet may be unanswered, and records
            in memory are lost.
        before, after: digests of the files in the folder at the beginning and at the end (after
            truncations).
    """

    exchanged: tuple[Exchanged, ...]  # in the order of their arrival
    records: NDArray[np.void]
    acts: tuple[Act, ...]  # calls of the session
    events: tuple[tuple[int, Event], ...]
    counters: Counters  # of the session when the life ended
    settings: Mapping[str, Any]  # keyword arguments of the session
    first_cycle: int  # cycle of the controller at the beginning, counted over all lives
    last_cycle: int  # and at the end
    result: RunResult | None  # None if the run raised or died
    error: BaseException | None
    died: bool
    archives: tuple[str, ...]  # names of the archives created in this life, in order
    torn: Mapping[str, int]  # archive name to bytes that the kill removed from the end of the file
    refused: frozenset[str]  # archives with a failed write
    disk: tuple[str, ...]  # kinds of disk faults in this life
    before: Digests
    after: Digests


@dataclass(frozen=True, eq=False)
class ArmHistory:
    """State of the controller in each cycle, over all lives, between them and after the last."""

    sent: tuple[bytes, ...]  # (k,) packets as the controller sent them, b"" for none
    position: Array  # (k, n) joint angles [rad] at the beginning of the cycle
    velocity: Array  # (k, n) [rad/s]
    phase: tuple[str, ...]  # (k,) names of `sim_fixtures.Phase`
    open_axes: NDArray[np.bool_]  # (k,) whether any axis was in open mode


class Estimated(NamedTuple):
    """Estimate of the campaign by weighted least squares."""

    result: RepeatedEstimate  # pooled and per repetition
    pooled: tuple[str, ...]  # names of the archives used
    model: RobotModel  # of the arm
    fitted: tuple[Samples, ...]  # fitted samples of each repetition


@dataclass(frozen=True, eq=False)
class Observed:
    """One simulated campaign with its faults.

    Attributes:
        found: the estimate from `folder` by the product; None if the campaign is not complete, or
            for the reason `unidentified`.
        twin_found: the estimate of the same campaign without faults; None for the latter.
    """

    seed: int
    cell: Cell
    plan: CampaignPlan
    controller: ControllerSettings
    schedule: tuple[str, ...]  # lines of the script
    struck: tuple[str, ...]  # lines that occurred
    runs: tuple[Life, ...]  # in order
    arm: ArmHistory
    folder: Path  # of the campaign, after the last life
    found: Estimated | None
    twin_found: Estimated | None
    unidentified: str  # why a complete campaign has no estimate; "" otherwise

    @property
    def pooled(self) -> tuple[str, ...]:
        """Names of the archives of the estimate."""
        return () if self.found is None else self.found.pooled

    @property
    def complete(self) -> bool:
        """Whether the last run reported that the campaign is complete."""
        last = self.runs[-1].result
        return last is not None and last.complete

    @property
    def ended(self) -> str:
        last = self.runs[-1]
        if last.error is not None:
            return f"{type(last.error).__name__}: {last.error}"
        return "complete" if self.complete else "incomplete"


Law = Callable[[Observed], Iterable[str]]
"""Yields a text for each violation."""
