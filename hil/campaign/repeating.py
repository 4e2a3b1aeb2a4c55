"""A motion is run until it is of use, as often as the cell file allows."""

from __future__ import annotations

from typing import Final, Protocol

from hil.progress import Reporter

from .errors import ArmChangedError, RepetitionsRejectedError
from .execution_runner import Runner
from .intervals import Interval
from .quality import Problem
from .quality_entry import Entering

MOST_BY_HAND: Final = 10
"""Attempts at one motion that a person, or a script in his place, may hold or slow."""


class Warmth(Protocol):
    """Whether the joints are as warm as a motion wants them."""

    def keep(self, runner: Runner, entering: Entering) -> None:
        """Warm the arm up anew if it has cooled down."""
        ...

    def lost(self, began: float) -> Problem | None:
        """What is wrong with a motion that began then [s since 1970]; None if it was warm."""
        ...

    def moved(self) -> None:
        """A motion has ended that keeps the joints warm."""
        ...


class _AnyWarmth:
    """For motions that may be run by a cold arm."""

    def keep(self, runner: Runner, entering: Entering) -> None:
        """Nothing is needed."""

    def lost(self, began: float) -> Problem | None:
        """Nothing is wrong."""
        del began
        return None

    def moved(self) -> None:
        """Nobody keeps account."""


any_warmth: Final = _AnyWarmth()


def play_until_good(
    runner: Runner,
    entering: Entering,
    interval: Interval,
    number: int,
    total: int,
    reporter: Reporter,
    *,
    warmth: Warmth = any_warmth,
) -> str:
    """Run a motion, judge it and enter it; again where it fails its check.

    An attempt that a person held or slowed counts as failed only if the request is still for less
    than full speed: then the next one would go the same way. Others of them are counted apart, for
    a script that slows the arm by rule would have it move for ever.

    Args:
        runner: plays it.
        entering: judges and enters it.
        interval: the motion.
        number: which of its kind, from 1.
        total: of how many.
        reporter: informed of what was rejected.
        warmth: asked before each attempt, and how it was when the motion began.

    Returns:
        Name of the archive that is of use.

    Raises:
        RepetitionsRejectedError: it failed too often.
        ArmChangedError: later attempts agree with each other, and not with those that count.
    """
    watch, reasons, by_hand = runner.watch, list[str](), list[str]()
    while len(reasons) <= runner.cell.campaign.bad_repetitions and len(by_hand) < MOST_BY_HAND:
        warmth.keep(runner, entering)
        name = runner.play(interval, number, total)
        cold = warmth.lost(watch.began)
        problem = entering.enter(interval, name, cold)
        if cold is None:
            warmth.moved()
        if problem is None:
            return name
        watch.expect(interval.trajectory.duration)
        watch.note(f"{interval}: rejected, {problem.sentence}")
        reporter.say(
            f"{interval} ({name}) is rejected: {problem.sentence}; the motion is run again"
        )
        if problem.against is not None:
            raise ArmChangedError(
                str(interval), problem.sentence, problem.against.reference, problem.against.later
            )
        still = not problem.by_hand or watch.request().override < 1.0
        (reasons if still else by_hand).append(problem.sentence)
    raise RepetitionsRejectedError(
        str(interval), reasons if len(by_hand) < MOST_BY_HAND else by_hand
    )
