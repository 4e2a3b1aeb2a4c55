"""Answers to all packets are those of the protocol and of `docs/safety.md`.

One answer to each new well-formed packet, with the next number; the same bytes to a duplicate; none
to stale, foreign or malformed packets; the safe answer for axes that are not open; set-points only
from the first one, at the controller's target, to the end of open mode.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from tests.drivers import oracle
from tests.drivers.oracle import LAST, number_of
from tests.simulate.observed import Life, Observed

from .conversation import Heard, Talk, heard
from .open_mode import Modes, modes_of
from .wire import D1, D2, MODE, Flags, next_number

Mistake = tuple[Flags | np.bool_, str]
"""Rows with a mistake, (m,), and its text."""
_MOST_NAMED: Final = 3
"""Packets named for one kind of mistake; the others are counted."""


def replies(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    for number, (life, one) in enumerate(zip(observed.runs, heard(observed), strict=True), 1):
        for text in _of_life(life, one):
            yield f"life {number}: {text}"


def _of_life(life: Life, one: Heard) -> Iterator[str]:
    for index, what in one.wrong[:_MOST_NAMED]:
        yield f"packet {index} {what}"
    if len(one.wrong) > _MOST_NAMED:
        yield f"and {len(one.wrong) - _MOST_NAMED} more of these"
    yield from _counters(life, one)
    for talk in one.talks:
        for flags, what in _in_session(talk):
            if flags.any():
                at = talk.index[np.flatnonzero(flags)[:_MOST_NAMED]].tolist()
                yield f"{what}: {int(flags.sum())} times, packets {at}"


def _counters(life: Life, one: Heard) -> Iterator[str]:
    """The counters of the session agree with the packets."""
    found, fates = life.counters, one.fates
    answered = fates["echo"] + fates["init"] + fates["cyclic"]
    # The last packet may be counted without an answer, if the process is killed or the link closed.
    last = life.exchanged[-1:]
    slack = int(any(one.given and not one.replies for one in last))
    # Waiting packets that were being read at the end are not counted.
    given = [index for index, other in enumerate(life.exchanged) if other.given]
    pile = [index for index in one.left_out if given and index < given[-1]]
    late, left_out = found.discarded.get("late", 0), len(one.left_out)
    refused = found.stale + found.malformed + found.ended
    for name, number, least, most in (
        ("answered", found.answered, answered, answered + slack),
        ("duplicates", found.duplicates, fates["again"], fates["again"] + slack),
        ("missed", found.missed, one.missed, one.missed + slack * LAST),
        # Duplicates among waiting packets are not counted.
        ("late", late, len(pile) - one.repeated, left_out),
        ("refused", refused, fates["nothing"] - left_out - slack, fates["nothing"] - left_out),
    ):
        if not least <= number <= most:
            yield f"{name} is {number}, and {least} were observed"
    for index in pile:
        if not _newer_answered(life, one, index):
            yield f"packet {index} was superseded, and no newer one was answered"


def _newer_answered(life: Life, one: Heard, index: int) -> bool:
    """Whether the next answered packet, or the previous one, is newer than this one."""
    number = number_of(life.exchanged[index].packet)
    for step in (1, -1):
        at = index + step
        while 0 <= at < len(one.kinds):
            if one.kinds[at] in ("init", "echo", "cyclic"):
                ahead = (number_of(life.exchanged[at].packet) - number) % LAST
                if one.kinds[at] != "cyclic" or 1 <= ahead <= LAST // 2:
                    return True
                break
            at += step
    return False


def _in_session(talk: Talk) -> Iterator[Mistake]:
    """Yield the mistakes in answers to cyclic packets."""
    received, answer, safe = talk.received, talk.answer, talk.safe
    if not len(talk.index):
        return
    yield answer.number != next_number(received.number), "an answer of another number"
    yield answer.function != 0, "function bytes in an answer"
    if safe is None or not talk.init.slots:
        return  # the axis map is invalid
    modes = modes_of(talk)
    arm = int(talk.life.settings.get("arm", 1)) - 1
    own = np.arange(4) == arm
    yield (
        ((answer.status != safe.status) & ~own).any(axis=1)
        | (modes.asked_out & (answer.status[:, arm] != 1)),
        "status bytes that are neither safe nor the request to leave open mode",
    )
    yield modes.asked_out & ~modes.is_open, "the end of open mode asked for outside of it"
    yield from _refusals(talk, modes)
    same = (answer.words == safe.words).all(axis=2)
    if not talk.usable:
        yield ~modes.refused & ~same.all(axis=1), "an arm that cannot be moved: not the safe answer"
        yield modes.is_open & ~modes.refused, "an arm that cannot be moved is open, and not refused"
        return
    yield modes.paused & ~modes.refused & ~same.all(axis=1), "a pause: not the safe answer"
    slots = list(talk.init.slots)
    others = np.setdiff1d(np.arange(talk.init.n_axes), slots)
    yield (
        ~modes.refused & ~same[:, others].all(axis=1),
        "an axis that is no joint: not the safe answer",
    )
    yield from _set_points(talk, modes, same[:, slots])


def _refusals(talk: Talk, modes: Modes) -> Iterator[Mistake]:
    safe, answer, slots = talk.safe, talk.answer, list(talk.init.slots or ())
    assert safe is not None
    refused = modes.refused
    yield refused & ~modes.is_open & ~modes.no_target, "a refusal where nothing is open"
    reported = answer.mode != safe.words[:, :, MODE]
    all_off = (answer.mode == oracle.DRIVE_OFF_REQUEST).all(axis=1)
    own = np.isin(np.arange(talk.init.n_axes), slots)
    following = reported & own & (answer.mode == oracle.FOLLOWING_ERROR)
    one_508 = (reported.sum(axis=1) == 1) & following.any(axis=1)
    yield refused & ~all_off & ~one_508, "a refusal that is neither 505 in all axes nor one 508"
    yield modes.no_target & ~all_off, "held at a target that is not finite"
    numbers = np.ascontiguousarray(safe.words[:, :, D1:])
    finite = np.isfinite(numbers.view(np.float32))
    given = (answer.words[:, :, D1:] == np.where(finite, numbers, 0)).all(axis=(1, 2))
    yield refused & ~given, "a refusal with targets other than the controller's own"


def _set_points(talk: Talk, modes: Modes, same: Flags) -> Iterator[Mistake]:
    """Yield mistakes in set-points; `same` (m, n): whether answers are the safe ones."""
    sent = ~modes.refused & ~modes.paused
    not_open = sent[:, np.newaxis] & ~modes.ready
    yield (not_open & ~same).any(axis=1), "an axis that is not open: not the safe answer"
    begun = _begun(modes)
    yield (
        sent & ~modes.all_ready & ~begun & ~same.all(axis=1),
        "axes that are being opened: not held at their target",
    )
    yield (
        modes.is_open & sent & ~_closed_before(talk, modes),
        "axes are open that were not closed since the last fault, and are not refused",
    )
    words = talk.answer.words[:, list(talk.init.slots or ())]
    open_axes = sent[:, np.newaxis] & modes.all_ready[:, np.newaxis]
    mode = int(talk.life.settings.get("mode", 4))
    wrong = (words[:, :, MODE] != mode) | (words[:, :, D2 + 1 :] != 0).any(axis=2)
    yield (open_axes & wrong).any(axis=1), "a field or mode that open mode 4 does not use"
    numbers = np.ascontiguousarray(words[:, :, D1 : D2 + 1]).view(np.float32)
    yield (open_axes & ~np.isfinite(numbers).all(axis=2)).any(axis=1), "a set-point is not finite"


def _begun(modes: Modes) -> Flags:
    """Rows since which all axes were open, without interruption of open mode, (m,)."""
    rows = np.arange(len(modes.is_open))
    broken = ~modes.is_open | modes.refused | modes.paused
    last_break = np.maximum.accumulate(np.where(broken, rows, -1))
    last_ready = np.maximum.accumulate(np.where(modes.all_ready & ~broken, rows, -1))
    return np.asarray(last_ready > last_break)


def _closed_before(talk: Talk, modes: Modes) -> Flags:
    """Whether all axes were reported closed since the last event that requires it, (m,)."""
    m = len(modes.is_open)
    before, after = 2 * np.arange(m), 2 * np.arange(m) + 1
    closed = modes.closed & ~modes.refused
    lost = modes.refused | modes.paused | (~modes.is_open & ~modes.closed)
    closed_at = np.maximum.accumulate(np.where(closed, after, -1))
    lost_at = np.maximum.accumulate(
        np.maximum(np.where(talk.silent, before, -1), np.where(lost, after, -1))
    )
    return np.asarray(closed_at > lost_at)
