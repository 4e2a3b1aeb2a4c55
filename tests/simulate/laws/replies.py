"""Answers to all packets are those of the protocol and of `docs/safety.md#safety-rules`.

One answer to each new well-formed packet, with the next number; the same bytes to a duplicate; none
to stale, foreign or malformed packets. The contents of answers are the law `guard`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from drivers.punctuality import BUNCHED, LEFT_OUT
from tests.drivers.oracle import LAST, number_of
from tests.simulate.observed import Life, Observed

from .conversation import Heard, heard
from .wire import next_number

_MOST_NAMED: Final = 3
"""Packets named for one kind of mistake; the others are counted."""


def replies(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    for number, (life, conversation) in enumerate(
        zip(observed.runs, heard(observed), strict=True), 1
    ):
        for text in _of_life(life, conversation):
            yield f"life {number}: {text}"


def _of_life(life: Life, conversation: Heard) -> Iterator[str]:
    for index, what in conversation.wrong[:_MOST_NAMED]:
        yield f"packet {index} {what}"
    if len(conversation.wrong) > _MOST_NAMED:
        yield f"and {len(conversation.wrong) - _MOST_NAMED} more of these"
    yield from _counters(life, conversation)
    for talk in conversation.talks:
        if (talk.answer.number != next_number(talk.received.number)).any():
            yield "an answer of another number"
        if talk.answer.function.any():
            yield "function bytes in an answer"


def _counters(life: Life, conversation: Heard) -> Iterator[str]:
    """The counters of the session agree with the packets."""
    counters = life.counters
    fates = conversation.fates
    answered = fates["echo"] + fates["init"] + fates["cyclic"]
    # The last packet may be counted without an answer, if the process is killed or the link closed.
    last = life.exchanged[-1:]
    slack = int(any(exchanged.given and not exchanged.replies for exchanged in last))
    # Waiting packets that were being read at the end are not counted.
    given = [index for index, other in enumerate(life.exchanged) if other.given]
    pile = [index for index in conversation.left_out if given and index < given[-1]]
    late = counters.discarded.get(LEFT_OUT, 0) + counters.discarded.get(BUNCHED, 0)
    left_out = len(conversation.left_out)
    refused = counters.stale + counters.malformed + counters.ended
    for name, number, least, most in (
        ("replied", counters.replied, answered, answered + slack),
        ("duplicates", counters.duplicates, fates["again"], fates["again"] + slack),
        ("missed", counters.missed, conversation.missed, conversation.missed + slack * LAST),
        # Duplicates among waiting packets are not counted.
        ("late", late, len(pile) - conversation.repeated, left_out),
        ("refused", refused, fates["nothing"] - left_out - slack, fates["nothing"] - left_out),
    ):
        if not least <= number <= most:
            yield f"{name} is {number}, and {least} were observed"
    for index in pile:
        if not _newer_answered(life, conversation, index):
            yield f"packet {index} was superseded, and no newer one was answered"


def _newer_answered(life: Life, conversation: Heard, index: int) -> bool:
    """Whether the next answered packet, or the previous one, is newer than this one."""
    number = number_of(life.exchanged[index].packet)
    for step in (1, -1):
        at = index + step
        while 0 <= at < len(conversation.kinds):
            if conversation.kinds[at] in ("init", "echo", "cyclic"):
                ahead = (number_of(life.exchanged[at].packet) - number) % LAST
                if conversation.kinds[at] != "cyclic" or 1 <= ahead <= LAST // 2:
                    return True
                break
            at += step
    return False
