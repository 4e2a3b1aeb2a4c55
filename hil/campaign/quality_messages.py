"""Why a completed motion is rejected, in words."""

from __future__ import annotations

from typing import Final, assert_never

from hil.control.messages import slip_words
from identification.text import percentage

from .quality_problems import (
    MAX_MISSED_SHARE,
    ColdStart,
    HeldOrSlowed,
    IncompleteArchive,
    MissedPackets,
    MovedAtRest,
    OtherRepetition,
    OthersAgree,
    QualityProblem,
    ReplacedRepetitions,
    SaturatedCurrent,
    Slipped,
    StuckJoint,
)

_SCALES: Final = {"position": "the following-error threshold", "current": "its rms current"}


def problem_words(problem: QualityProblem) -> str:
    """Return why a motion is rejected, as a clause."""
    match problem:
        case MissedPackets(missed, cycles):
            return (
                f"{missed} of {cycles} packets were missed; {percentage(MAX_MISSED_SHARE)} are"
                " allowed"
            )
        case StuckJoint(joint, start, commanded):
            return (
                f"{joint} is stuck: its position stops changing {start:.2f} s after the start,"
                f" while its command moves by {commanded:.3g} rad"
            )
        case SaturatedCurrent(joint, duration):
            return f"the current of {joint} was at its limit for {duration * 1e3:.0f} ms"
        case IncompleteArchive(archived, cycles):
            return f"only {archived} of its {cycles} cycles are archived"
        case HeldOrSlowed(time):
            return (
                f"it was held or slowed about {time:.1f} s after its start, so it does not count"
                " as a repetition; leave the override at 100 %"
            )
        case MovedAtRest(joint, speed, allowed):
            return (
                f"{joint} moved at {speed:.2g} rad/s when the arm should stand still; at most"
                f" {allowed:.2g} rad/s are allowed"
            )
        case OtherRepetition(quantity, joint, repetitions, difference, allowed):
            return (
                f"the {quantity} of {joint} differs from the {repetitions} previous repetitions by"
                f" {percentage(difference, 2)} of {_SCALES[quantity]} (rms);"
                f" {percentage(allowed, 2)} are allowed"
            )
        case ColdStart(rest):
            return f"{rest_words(rest)} when it began and was assumed to be cold"
        case Slipped(jump):
            return slip_words(jump)
        case OthersAgree(attempts, only_missed):
            why = ": packets were missed in it, and none in the other recordings"
            return (
                f"{', '.join(attempts)} and the next repetition agree with each other, not with"
                f" this{why if only_missed else ''}"
            )
        case never:
            assert_never(never)


def replaced_words(replaced: ReplacedRepetitions) -> str:
    """Return which accepted repetitions were rejected, and why."""
    names = replaced.archives
    later = f"{replaced.later} later ones agree with each other and not with"
    if len(names) == 1:
        return (
            f"{names[0]} was the only accepted repetition, and was rejected because {later} it:"
            " it was disturbed, or the arm was changed after it"
        )
    return (
        f"packets were missed in all accepted repetitions ({', '.join(names)}); they were rejected"
        f" because {later} them, and missed none: all of them were disturbed, or the arm was"
        " changed after them"
    )


def rest_words(rest: float | None) -> str:
    """Return how long the arm had rested [s], as the beginning of a sentence."""
    if rest is None:
        return "the arm had rested for an unknown time"
    return f"the arm had rested for {rest / 60.0:.0f} min"
