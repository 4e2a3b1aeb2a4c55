"""The judge of the session's own tests, on the whole conversation of some campaigns.

It looks at one packet after the other and takes some ten times as long as the laws on arrays, with
which it shares nothing but the oracle: what one of the two overlooks the other may find.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from drivers.events import MotionEnded
from tests.drivers.judge import Conduct
from tests.simulate.observed import Act, Broken, Observed

from .conversation import Heard, Talk, heard

LAW: Final = "judge"
EVERY: Final = 64
"""One seed of so many is judged."""


def judged(observed: Observed) -> Iterator[Broken]:
    """See above."""
    if observed.seed % EVERY == 0:
        yield from judged_whole(observed)


def judged_whole(observed: Observed) -> Iterator[Broken]:
    """Every packet of every life."""
    for number, one in enumerate(heard(observed), 1):
        entitled = False
        for talk in one.talks:
            if talk.safe is None or not talk.init.slots:
                continue
            judging = _Judging(observed, one, talk, entitled)
            try:
                for row in range(len(talk.index)):
                    judging.judge(row)
            except AssertionError as error:
                text = str(error).partition("\n")[0]
                yield Broken(LAW, f"life {number}, packet {talk.index[row]}: {text}")
                break
            entitled = judging.conduct.entitled


class _Judging:
    """Tells the judge what it has to know beside the packets."""

    def __init__(self, observed: Observed, one: Heard, talk: Talk, entitled: bool) -> None:
        self._talk, life, cell = talk, talk.life, observed.cell
        limits = cell.guard_limits
        arms, slots = talk.init.arms, talk.init.slots
        assert arms is not None and slots is not None
        self.conduct = Conduct(
            limits,
            cell.drive_train,
            int(life.settings.get("mode", 4)),
            int(life.settings.get("arm", 1)),
            slots,
            arms,
            threshold=np.fmin(limits.following_error, talk.init.threshold),
            current=np.fmin(limits.current, talk.init.current),
            period=cell.period,
            max_gap=int(life.settings.get("max_gap", 2)),
            usable=talk.usable,
            entitled=entitled,
        )
        ended = [event.cycle for event in talk.events if isinstance(event, MotionEnded)]
        # What ended with one packet is over before whatever is asked for after it.
        told = [(talk.at_cycle(cycle) + 1, 0, None) for cycle in ended]
        asked = [(act.before, 1, act) for act in life.acts if act.before > talk.at]
        self._told = sorted([*told, *asked], key=lambda one: one[:2])
        self._last = talk.at

    def judge(self, row: int) -> None:
        """One packet of the session; AssertionError where a law is broken."""
        talk, conduct = self._talk, self.conduct
        index = int(talk.index[row])
        while self._told and self._told[0][0] <= index:
            self._tell(self._told.pop(0)[2])
        if talk.silent[row]:
            conduct.interrupted()
        record = talk.records[row]
        unanswered = int(record["gap"]) + index - self._last - 1
        self._last = index
        one = talk.life.exchanged[index]
        conduct.judge(one.packet, one.replies[0], record, unanswered > conduct.max_gap)

    def _tell(self, act: Act | None) -> None:
        """An act, or None for the end of a motion."""
        conduct = self.conduct
        if act is None:
            conduct.entitled = conduct.stopping = conduct.overridden = False
        elif act.name == "request":
            conduct.entitled, conduct.stopping, conduct.overridden = True, False, False
        elif act.name in ("stop", "hold", "resume"):
            conduct.stopping = conduct.entitled
        elif act.name == "override":
            conduct.overridden = True
