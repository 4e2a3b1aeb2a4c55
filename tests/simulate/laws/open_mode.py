"""Open mode: modes in the packets of a session, and the stretches with set-points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tests.drivers import oracle

from .conversation import Talk
from .wire import CLOSED, D1, MODE, PAUSES, REFUSALS, Array, Flags


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of the axes of the arm in the packets of a session, (m,) or (m, n)."""

    ready: Flags  # (m, n) joints in the configured mode, with the drive on
    all_ready: Flags
    is_open: Flags  # some axis in any open mode, with the drive on
    paused: Flags  # some axis, with the drive on
    closed: Flags  # all axes, with the drive on
    no_target: Flags  # a held axis of any arm has a target that is not finite
    refused: Flags  # answered by 505 or 508 that is not an echo
    asked_out: Flags  # answered with the request for the end of open mode


@lru_cache(maxsize=64)
def modes_of(talk: Talk) -> Modes:
    """Return the modes of a session with a valid axis map."""
    safe, slots = talk.safe, list(talk.init.slots or ())
    assert safe is not None and slots
    arm = int(talk.life.settings.get("arm", 1))
    wanted = talk.received.mode[:, slots]
    on = talk.received.status[:, arm - 1] == oracle.DRIVE_ON
    ready = (wanted == int(talk.life.settings.get("mode", 4))) & on[:, np.newaxis]
    target = talk.received.d[:, :, D1 - 1]
    answered, echoed = talk.answer.words[:, slots, MODE], safe.words[:, slots, MODE]
    return Modes(
        ready=ready,
        all_ready=ready.all(axis=1),
        is_open=on & np.isin(wanted, oracle.OPEN).any(axis=1),
        paused=on & np.isin(wanted, PAUSES).any(axis=1),
        closed=on & np.isin(wanted, CLOSED).all(axis=1),
        no_target=np.asarray((safe.held & ~np.isfinite(target)).any(axis=1)),
        refused=(np.isin(answered, REFUSALS) & (answered != echoed)).any(axis=1),
        asked_out=talk.answer.status[:, arm - 1] != safe.status[:, arm - 1],
    )


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive packets from the first set-point on, while any axis is open and none refused."""

    talk: Talk
    rows: slice  # of the session
    leading: int  # rows with set-points in all axes, before the end of open mode is requested
    sent: Array  # (k, n) D1 of the answers, motor revolutions
    step: Array  # (k, n) D2 of the answers
    received: Array  # (5, k, n) D1..D5 of the packets
    before: Array  # (n,) D1 of the previous answer
    step_before: Array  # (n,) D2 of it
    carried: int = 0  # packets missed before a motion resumed where the controller extrapolated it

    @property
    def again(self) -> Flags:
        """(k,) repeated set-points, with the same step as before."""
        same = (np.diff(self.sent, axis=0, prepend=np.nan) == 0.0).all(axis=1)
        same &= (np.diff(self.step, axis=0, prepend=np.nan) == 0.0).all(axis=1)
        return np.asarray(same & self.step.any(axis=1))

    @property
    def at(self) -> NDArray[np.intp]:
        """Index of each packet among those exchanged."""
        return self.talk.index[self.rows]


@lru_cache(maxsize=64)
def stretches(talk: Talk) -> tuple[Stretch, ...]:
    """Return the stretches of a session."""
    if talk.safe is None or not talk.usable or not talk.init.slots:
        return ()
    modes = modes_of(talk)
    going = modes.is_open & ~modes.refused & ~modes.paused
    edges = np.flatnonzero(np.diff(np.concatenate(([False], going, [False])).astype(np.int8)))
    found = []
    for start, stop in edges.reshape(-1, 2).tolist():
        first = start + int(np.argmax(modes.all_ready[start:stop]))
        if modes.all_ready[first]:
            found.append(_stretch(talk, modes, slice(first, stop)))
    return tuple(found)


def _stretch(talk: Talk, modes: Modes, rows: slice) -> Stretch:
    slots = list(talk.init.slots or ())
    led = modes.all_ready[rows].copy()
    led[1:] &= ~np.logical_or.accumulate(modes.asked_out[rows])[:-1]
    leading = len(led) if led.all() else int(np.argmin(led))
    sent, step = np.moveaxis(talk.answer.d[rows][:, slots, :2].astype(np.float64), 2, 0)
    received = np.moveaxis(talk.received.d[rows][:, slots, :5].astype(np.float64), 2, 0)
    return Stretch(talk, rows, leading, sent, step, received, sent[0], step[0])
