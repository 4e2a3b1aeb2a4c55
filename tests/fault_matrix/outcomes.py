"""What comes of every fault in every situation.

    completed         the motion requested first came to its end
    stopped           it came to rest on its path, and open mode was left
    lost: why         it ended because drive, open mode or link went away; nothing moves after that
    505 X, 508 X      error X was raised: all axes are asked to drive off, or one is reported
    waits             it has not begun and waits for the drive, or for axes to open
    open, closed      no motion was requested: open mode went on, or was ended by the controller
    silence           no motion was requested: the link counts as lost
    no start          the init packet got no answer, and the controller ended the session
    (n)               packets missed, which the records show

Three outcomes divided by strokes belong to a controller that meanwhile holds the last target,
continues at the last velocity, or drops the drive. Spans such as "init .. closed" are
of neighbouring situations.
"""

from __future__ import annotations

from typing import Final

from tests.fault_matrix.faulty_runs import SITUATIONS, SPEEDS

_SPANS: Final[dict[str, dict[str, str]]] = {
    "packet lost": {
        "sync": "completed",
        "init packet": "no start",
        "init": "completed",
        "drive off .. opening": "completed (1)",
        "open at rest": "open (1)",
        "moving .. exiting": "completed (1)",
    },
    "3 packets lost": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed (3)",
        "open at rest": "open (3)",
        "moving": "stopped (3)",
        "exiting": "completed (3)",
    },
    "5 packets lost": {
        "sync": "completed",
        "init packet": "no start",
        "init .. closed": "completed (5)",
        "opening": "lost: closed (5) / lost: closed (5) / lost: drive off (5)",
        "open at rest": "closed (5)",
        "moving": "lost: closed (5) / lost: closed (5) / lost: drive off (5)",
        "exiting": "completed (5)",
    },
    "link dead for 0.2 s": {
        "sync .. init packet": "no start",
        "init .. opening": "lost: silence",
        "open at rest": "silence",
        "moving": "lost: silence",
        "exiting": "completed",
    },
    "answer lost": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "3 answers lost": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed",
        "open at rest": "open",
        "moving": "stopped / completed / stopped",
        "exiting": "completed",
    },
    "5 answers lost": {
        "sync": "completed",
        "init packet": "no start",
        "init .. closed": "completed",
        "opening": "lost: closed / lost: closed / lost: drive off",
        "open at rest": "closed",
        "moving": "lost: closed / lost: closed / lost: drive off",
        "exiting": "completed",
    },
    "packet late": {
        "sync .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "packet past its cycle": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed (1)",
        "open at rest": "open (1)",
        "moving .. exiting": "completed (1)",
    },
    "answer late": {
        "sync .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "answer past its cycle": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "packet doubled": {
        "sync .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "answer doubled": {
        "sync .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "packets swapped": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed (1)",
        "open at rest": "open (1)",
        "moving .. exiting": "completed (1)",
    },
    "answers swapped": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "number a little ahead": {
        "sync": "completed",
        "init packet": "no start",
        "init .. closed": "completed (many)",
        "opening": "lost: closed (many) / lost: closed (many) / lost: drive off (many)",
        "open at rest": "closed (many)",
        "moving": "lost: closed (many) / lost: closed (many) / lost: drive off (many)",
        "exiting": "completed (many)",
    },
    "number far ahead": {
        "sync": "completed",
        "init packet": "no start",
        "init": "completed",
        "drive off .. opening": "completed (1)",
        "open at rest": "open (1)",
        "moving .. exiting": "completed (1)",
    },
    "status corrupted": {
        "sync .. drive off": "completed",
        "driving on .. opening": "lost: drive off",
        "open at rest": "closed",
        "moving": "lost: drive off",
        "exiting": "completed",
    },
    "mode corrupted": {
        "sync": "completed",
        "init packet": "no start",
        "init .. drive off": "completed",
        "driving on .. opening": "lost: mode",
        "open at rest": "505 ModeRefused",
        "moving": "505 AxisLeft",
        "exiting": "completed",
    },
    "target corrupted": {
        "sync .. closed": "completed",
        "opening .. exiting": "508 FollowingError",
    },
    "position corrupted": {
        "sync .. closed": "completed",
        "opening .. exiting": "508 FollowingError",
    },
    "answer's number corrupted": {
        "sync": "completed",
        "init packet": "no start",
        "init .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "answer's status corrupted": {
        "sync .. closed": "completed",
        "opening": "lost: closed",
        "open at rest": "closed",
        "moving": "lost: closed",
        "exiting": "completed",
    },
    "answer's mode corrupted": {
        "sync .. opening": "completed",
        "open at rest": "open",
        "moving .. exiting": "completed",
    },
    "answer's target corrupted": {
        "sync .. closed": "completed",
        "opening": "lost: drive off",
        "open at rest": "closed",
        "moving": "lost: drive off",
        "exiting": "completed",
    },
    "cold restart": {
        "sync .. init packet": "waits",
        "init .. opening": "lost: silence",
        "open at rest": "silence",
        "moving": "lost: silence",
        "exiting": "completed",
    },
    "warm restart": {
        "sync": "lost: restart",
        "init packet .. init": "waits",
        "drive off .. opening": "lost: restart",
        "open at rest": "closed",
        "moving": "lost: restart",
        "exiting": "completed",
    },
    "drive drop": {
        "sync .. drive off": "completed",
        "driving on .. opening": "lost: drive off",
        "open at rest": "closed",
        "moving": "lost: drive off",
        "exiting": "completed",
    },
    "emergency stop": {
        "sync .. drive off": "completed",
        "driving on .. opening": "lost: drive off",
        "open at rest": "closed",
        "moving": "lost: drive off",
        "exiting": "completed",
    },
    "axis leaves open mode": {
        "sync .. closed": "completed",
        "opening": "waits",
        "open at rest": "closed",
        "moving": "505 AxisLeft",
        "exiting": "completed",
    },
    "axis jams": {
        "sync .. opening": "508 FollowingError",
        "open at rest": "open",
        "moving": "508 FollowingError",
        "exiting": "completed",
    },
    "encoder slips": {
        "sync .. opening": "505 FirstSetPoint",
        "open at rest .. exiting": "508 FollowingError",
    },
    "current near its limit": {
        "sync .. opening": "505 NotAtStandstill",
        "open at rest .. moving": "505 CurrentLimit",
        "exiting": "completed",
    },
    "pause 502": {
        "sync .. driving on": "completed",
        "closed .. opening": "lost: pause",
        "open at rest": "closed",
        "moving": "lost: pause",
        "exiting": "completed",
    },
    "pause 500": {
        "sync .. driving on": "completed",
        "closed .. opening": "lost: pause",
        "open at rest": "closed",
        "moving": "lost: pause",
        "exiting": "completed",
    },
}


def _spread(spans: dict[str, str]) -> dict[str, tuple[str, ...]]:
    """Outcomes per situation; "a .. b" means all from a to b."""
    outcomes = {}
    for span, text in spans.items():
        first, _, last = span.partition(" .. ")
        begin, end = SITUATIONS.index(first), SITUATIONS.index(last or first)
        for situation in SITUATIONS[begin : end + 1]:
            assert situation not in outcomes, f"{situation} twice"
            outcomes[situation] = tuple(text.split(" / "))
    return outcomes


EXPECTED: Final = {fault: _spread(spans) for fault, spans in _SPANS.items()}
"""Outcomes by fault and situation: one, or one for each behaviour of the controller."""


def row(fault: str, outcomes: dict[str, tuple[str, ...]]) -> str:
    """One line of the table in Markdown."""
    cells = [" / ".join(outcomes[situation]) for situation in SITUATIONS]
    return f"| {fault} | " + " | ".join(cells) + " |\n"


HEADING: Final = (
    "| fault | " + " | ".join(SITUATIONS) + " |\n" + "|---" * (len(SITUATIONS) + 1) + "|\n"
)

_WENT_ON: Final = "stopped / completed / stopped"
AT_SPEED: Final = {
    "3 packets lost": ("stopped",) * 4,
    "5 packets lost": ("stopped",) * 4,
    "3 answers lost": (_WENT_ON,) * 4,
    "5 answers lost": (_WENT_ON,) * 4,
}
"""Outcomes by fault, at each share of full speed."""


def at_speed() -> str:
    """The table of `AT_SPEED` in Markdown."""
    speeds = [f"{share:.0%}".replace("%", " %") for share in SPEEDS]
    lines = ["| fault | " + " | ".join(speeds) + " |", "|---" * (len(speeds) + 1) + "|"]
    lines += [f"| {fault} | {' | '.join(texts)} |" for fault, texts in AT_SPEED.items()]
    return "\n".join(lines) + "\n"
