"""A payload weighed while it is recorded: one motion without it and with it, in ABBA order.

Friction that drifts steadily is then the same in both on average.
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
"""Half the 95 % interval of mass and wrist torque, as a share of them, from which on no pair is
worth it: in 99 of 100 cases they are then within 1 %."""
_NAME: Final = re.compile(r"[A-Za-z0-9][\w.-]{0,63}")

Run = Callable[[Campaign, int, Link | None], object]
"""Runs a campaign up to so many repetitions, on a simulated arm or on the cell's own link."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """A payload after some pairs."""

    found: PayloadFound  #: what it weighs
    pairs: int  #: of one recording without and one with it

    @property
    def width(self) -> tuple[float, float]:
        """Half the 95 % intervals of mass and of the torque of the weight, as shares of them."""
        torque, low, high = self.found.wrist_torque
        least, most = self.found.estimate.intervals[0].tolist()
        return 0.5 * (most - least) / self.found.figures[0], 0.5 * (high - low) / torque

    @property
    def enough(self) -> bool:
        """Whether another pair is not worth it."""
        return max(self.width) <= ENOUGH

    @property
    def sentence(self) -> str:
        """How narrow the intervals are, and whether another pair is worth it."""
        shrunk = math.sqrt(self.pairs / (self.pairs + 1.0))
        mass, torque = (f"{100.0 * share:.2g} %" for share in self.width)
        next_mass, next_torque = (f"{100.0 * shrunk * share:.2g} %" for share in self.width)
        worth = "is not worth it" if self.enough else "is worth it"
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
    """Record pairs until another is not worth it, and weigh after each of them.

    The recordings are two campaigns below the folder of the campaign, with its cell, its plan and,
    where it was passed, its rehearsal. What is there already is not recorded again.

    The campaign's repetitions are the most pairs; the name is that of the payload and of the
    folder. `mount` says whether the payload was mounted (True) or taken off (False); no ends the
    recording.

    Raises:
        InputError: the name is no name of a folder.
        OperatorStopError: the recording was ended before there was a pair.
        HilError: what `Campaign.run` and `find_payload` raise.
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
        problem = f"{name!r} is no name of a payload"
        remedy = "use letters, digits, dots and dashes"
        raise InputError(None, problem, field="--payload", remedy=remedy)
    root = campaign.folder.root / FOLDER / name / side
    made = Campaign.create(root, campaign.cell, campaign.plan, exist_ok=True)
    rehearsal = Rehearsal.load(campaign.folder)
    if rehearsal is not None and rehearsal.covers(made.folder, made.folder.plan_hash):
        rehearsal.save(made.folder.rehearsal)
    return made
