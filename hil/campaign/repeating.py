"""A motion is run until it is of use, as often as the cell file allows."""

from __future__ import annotations

from hil.progress import Reporter

from .errors import RepetitionsRejectedError
from .execution_runner import Runner
from .intervals import Interval
from .quality_entry import Entering


def play_until_good(
    runner: Runner,
    entering: Entering,
    interval: Interval,
    number: int,
    total: int,
    reporter: Reporter,
) -> str:
    """Run a motion, judge it and enter it; again where it fails its check.

    An attempt that a person held or slowed counts only if the wish is still for less than full
    speed: then the next one would go the same way.

    Args:
        runner: plays it.
        entering: judges and enters it.
        interval: the motion.
        number: which of its kind, from 1.
        total: of how many.
        reporter: told of what was rejected.

    Returns:
        Name of the archive that is of use.

    Raises:
        RepetitionsRejectedError: it failed too often.
    """
    watch, reasons = runner.watch, list[str]()
    while len(reasons) <= runner.cell.campaign.bad_repetitions:
        name = runner.play(interval, number, total)
        problem = entering.enter(interval, name)
        if problem is None:
            return name
        watch.time_left += interval.trajectory.duration
        watch.note(f"{interval}: rejected, {problem.sentence}")
        reporter.say(f"{name} is rejected: {problem.sentence}; the motion is run again")
        if not problem.by_hand or watch.wish().override < 1.0:
            reasons.append(problem.sentence)
    raise RepetitionsRejectedError(str(interval), reasons)
