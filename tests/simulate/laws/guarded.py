"""Set-points satisfy the bounds of the guard, and are sent only where allowed.

The checks of the session tests (`tests.drivers.judge`), applied to all packets of all lives.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator

import numpy as np

from drivers.c4g_packets import LAST_NUMBER
from drivers.events import MotionEnded
from tests.drivers.judge import Conduct
from tests.drivers.oracle import number_of
from tests.simulate.observed import Observed

from .conversation import Talk, heard


def guard(observed: Observed) -> Iterator[str]:
    """Check the law of this module; it names the first violation of each session."""
    for number, conversation in enumerate(heard(observed), 1):
        entitled = False
        for talk in conversation.talks:
            if talk.init.arms is None or not talk.init.slots:
                continue
            conduct = _conduct(observed, talk, entitled)
            try:
                for index in _judged(talk, conduct):
                    at = index
            except AssertionError as error:
                violated = traceback.extract_tb(error.__traceback__)[-1].line
                text = str(error).partition("\n")[0] or violated
                yield f"life {number}, after packet {at}: {text}"
                break
            entitled = conduct.entitled


def _conduct(observed: Observed, talk: Talk, entitled: bool) -> Conduct:
    limits = observed.cell.guard_limits
    settings = talk.life.settings
    init = talk.init
    assert init.arms is not None and init.slots is not None
    return Conduct(
        limits,
        observed.cell.drive_train,
        int(settings.get("mode", 4)),
        int(settings.get("arm", 1)),
        init.slots,
        init.arms,
        threshold=np.fmin(limits.following_error, init.threshold),
        current=np.fmin(limits.current, init.current),
        period=observed.cell.period,
        max_gap=int(settings.get("max_gap", 2)),
        usable=talk.usable,
        entitled=entitled,
    )


def _judged(talk: Talk, conduct: Conduct) -> Iterator[int]:
    """Check packet by packet with the requests in between; yield the index before each."""
    ended = [event.cycle for event in talk.events if isinstance(event, MotionEnded)]
    # The end of a motion with a packet precedes requests after it.
    news = [(talk.at_cycle(cycle) + 1, 0, "ended") for cycle in ended]
    news += [(act.before, 1, act.name) for act in talk.life.acts if act.before > talk.at]
    news.sort(key=lambda entry: entry[:2])
    last = talk.at
    for row, index in enumerate(talk.index.tolist()):
        yield last
        while news and news[0][0] <= index:
            _note(conduct, news.pop(0)[2])
        if talk.silent[row]:
            conduct.interrupted()
        record = talk.records[row]
        exchanged = talk.life.exchanged[index]
        # Superseded packets count as missing. The session counts those with a corrupted number
        # twice, as stale and as missing, unless they are no packets at all.
        newest, *between = talk.life.exchanged[last:index]
        between = [other for other in between if other.packet != newest.packet]  # no duplicates
        gap = int(record["gap"])
        missed = max(gap, len(between))
        last = index
        given = [other.packet for other in between if other.given]
        stale = [packet for packet in given if 1 <= number_of(packet) <= LAST_NUMBER]
        at_most = gap + len(stale)
        conduct.judge(exchanged.packet, exchanged.replies[0], record, missed, at_most)


def _note(conduct: Conduct, what: str) -> None:
    """Apply a request, or the end of a motion."""
    if what in ("request", "ended"):
        conduct.entitled = what == "request"
        conduct.stopping = conduct.held = conduct.overridden = False
    elif what == "stop":
        conduct.stopping = conduct.entitled
    elif what in ("hold", "resume"):
        conduct.held = conduct.entitled
    elif what == "override":
        conduct.overridden = True
