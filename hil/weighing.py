"""Payload identification during recording: one motion without and with the payload, in ABBA order.

A steady drift of friction then has the same mean in both.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hil.campaign import Campaign, Link
from hil.campaign.rehearsal import Rehearsal
from hil.errors import InputError, OperatorStopError
from hil.identify.payload_run import PayloadFound, find_payload
from hil.progress import Reporter
from hil.simulation import simulated_link

FOLDER: Final = "payload"
SIDES: Final = ("bare", "loaded")
ENOUGH: Final = 0.0076
"""Half the 95 % interval of mass and wrist torque, relative, at which recording ends: in 99 of 100
cases the error is then below 1 %."""
_NAME: Final = re.compile(r"[A-Za-z0-9][\w.-]{0,63}")

Run = Callable[[Campaign, int, Link | None], object]
"""Runs a campaign up to a number of repetitions, on a simulated arm or on the cell's link."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """Estimate of a payload after some pairs of recordings."""

    found: PayloadFound
    pairs: int

    @property
    def width(self) -> tuple[float, float]:
        """Half the relative 95 % intervals of mass and of the torque of the weight."""
        torque, low, high = self.found.wrist_torque
        least, most = self.found.estimate.intervals[0].tolist()
        return 0.5 * (most - least) / self.found.figures[0], 0.5 * (high - low) / torque

    @property
    def enough(self) -> bool:
        """Whether the intervals are narrow enough to end."""
        return max(self.width) <= ENOUGH

    @property
    def sentence(self) -> str:
        """Text with the intervals now and after another pair."""
        shrunk = math.sqrt(self.pairs / (self.pairs + 1.0))
        mass, torque = (f"{100.0 * share:.2g} %" for share in self.width)
        next_mass, next_torque = (f"{100.0 * shrunk * share:.2g} %" for share in self.width)
        worth = "is not needed" if self.enough else "is recommended"
        return (
            f"{self.pairs} {'pair' if self.pairs == 1 else 'pairs'}: mass"
            f" {self.found.figures[0]:.4g} kg ± {mass}, torque of its weight at the flange"
            f" {self.found.wrist_torque[0]:.3g} N·m ± {torque}; another pair {worth}"
            f" (about ± {next_mass} and ± {next_torque})"
        )


def weigh(
    campaign: Campaign,
    name: str,
    *,
    run: Run,
    mount: Callable[[bool], bool],
    reporter: Reporter,
) -> Weighed:
    """Record pairs until the intervals are narrow enough, and estimate after each of them.

    The recordings are two campaigns `name` below the folder of the campaign, with its cell, plan
    and passed rehearsal. Existing recordings are not repeated; the campaign's repetitions limit the
    number of pairs. `mount` asks whether the payload was mounted (True) or removed (False); False
    ends.

    Raises:
        InputError: the name is not a valid folder name.
        OperatorStopError: the operator ended before the first pair.
        HilError: raised by `Campaign.run` and `find_payload`.
    """
    bare, loaded = sides = [_side(campaign, name, side) for side in SIDES]
    simulated = campaign.cell.controller.transport == "simulated"
    mounted: bool | None = None
    weighed = None
    for pair in range(1, campaign.cell.campaign.repetitions + 1):
        for load in (False, True) if pair % 2 else (True, False):
            if sides[load].folder.whole("excitation", pair - 1) is not None:
                continue
            if load is not mounted and not mount(load):
                if weighed is None:
                    raise OperatorStopError(f"{sides[load].folder.root}: nothing was recorded.")
                return weighed
            mounted = load
            link = None
            if simulated:
                link = simulated_link(campaign.cell, loaded=load, session=2 * pair + load)
            run(sides[load], pair, link)
        roots = [side.folder.root for side in (bare, loaded)]
        weighed = Weighed(find_payload(roots[:1], roots[1:], reporter), pair)
        reporter.say(weighed.sentence)
        if weighed.enough:
            break
    assert weighed is not None  # a campaign has a repetition at least
    return weighed


def _side(campaign: Campaign, name: str, side: str) -> Campaign:
    if not _NAME.fullmatch(name):
        problem = f"{name!r} is not a valid name of a payload"
        remedy = "use letters, digits, dots and dashes"
        raise InputError(None, problem, field="--payload", remedy=remedy)
    root = campaign.folder.root / FOLDER / name / side
    made = Campaign.create(root, campaign.cell, campaign.plan, exist_ok=True)
    rehearsal = Rehearsal.load(campaign.folder)
    if rehearsal is not None and rehearsal.covers(made.folder, made.folder.plan_hash):
        rehearsal.save(made.folder.rehearsal)
    return made
