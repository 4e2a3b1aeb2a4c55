"""The operator of a run in virtual time, loads on its arm, and the archives that it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.transports.simulated import SimulatedTransport
from hil.archive import open_archive
from hil.campaign import (
    Campaign,
    VirtualLink,
)
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.operator import RunStatus
from hil.campaign.campaign_run import RunResult
from hil.control.motion_watch import OperatorRequest
from hil.control.simulated_cell import simulated_controller, simulated_link
from tests.hil.fast_cell import set_points

Array = NDArray[np.float64]
Make = Callable[..., Campaign]
Requests = Callable[[RunStatus], OperatorRequest]


class Operator:
    """Operator at the screen: his requests by the status of the run, and his answer."""

    can_answer = True

    def __init__(
        self, requests: Requests = lambda _: OperatorRequest(), *, accepts: bool = True
    ) -> None:
        self.accepts = accepts
        self.requests = requests
        self.seen: list[RunStatus] = []
        self.asked: list[DryRunRecord] = []

    def show(self, status: RunStatus) -> None:
        self.seen.append(status)

    def request(self) -> OperatorRequest:
        return self.requests(self.seen[-1]) if self.seen else OperatorRequest()

    def accept_dry_run(self, summary: DryRunRecord) -> bool:
        self.asked.append(summary)
        return self.accepts


@dataclass
class Push:
    """A load on the upper arm for 0.1 s, or for so many cycles."""

    cycle: int
    load: float = 0.15
    cycles: int = 50

    def apply_to(self, on: Any) -> None:
        on.disturb("load", 1, self.load, self.cycles)


def run_pushed(campaign: Campaign, fault: Push) -> RunResult:
    """Run a campaign with a load on the arm."""
    controller = simulated_controller(campaign.cell, faults=[fault])  # type: ignore[list-item]
    link = VirtualLink.over(SimulatedTransport(controller), campaign.cell, controller.finish)
    return campaign.run(link, unrehearsed=True, durable=False)


def cycles_of(campaign: Campaign, archive: str) -> Array:
    """The cycles of a motion (k,)."""
    opened = open_archive(campaign.folder.archives / archive, fields=["cycle"])
    return np.asarray(opened.columns["cycle"])


def middle_of(campaign: Campaign, archive: str) -> int:
    """The cycle in the middle of a motion."""
    return int(np.mean(cycles_of(campaign, archive)[[0, -1]]))


def kinds(result: RunResult) -> list[str]:
    return [name.split("_")[0] for name in result.archives]


def outcomes(campaign: Campaign) -> dict[str, str]:
    """The outcome of each repetition."""
    entries = campaign.folder.manifest()
    return {e.name[11:-5]: e.outcome for e in entries if e.name.startswith("excitation")}


class Real:
    """A link in virtual time that reports a real arm."""

    only_simulated = False

    def __init__(self, campaign: Campaign) -> None:
        self._link = simulated_link(campaign.cell, instead_of_hardware=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)


def peak_speed(campaign: Campaign, name: str) -> Array:
    """Of a motion, as a share of the joints' speed limits (n,)."""
    commanded = set_points(open_archive(campaign.folder.archives / name))
    speed = np.abs(np.diff(commanded, axis=0)).max(axis=0) / campaign.cell.period
    return np.asarray(speed / campaign.cell.joint_limits.velocity)


def slowing(times: range, phase: str = "repetition", number: int = 1) -> Requests:
    """Half the speed in one motion, at these times that it is shown."""
    shown = list[RunStatus]()

    def requests(status: RunStatus) -> OperatorRequest:
        this = (status.phase, status.number) == (phase, number)
        if this and status.motion is not None:
            shown.append(status)
        return OperatorRequest(0.5 if len(shown) in times else 1.0)

    return requests
