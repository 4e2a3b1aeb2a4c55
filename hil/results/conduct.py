"""How a campaign was run: a section of `results.json`."""

from __future__ import annotations

from hil.results.frozen import Frozen


class StepResult(Frozen):
    """One step of a campaign."""

    step: str
    done: bool
    words: str
    """What is known of it."""
    details: list[str]


class RecordedResult(Frozen):
    """One motion, as its archive has it."""

    archive: str
    kind: str
    when: str | None
    """Begin, ISO 8601 (UTC); null in virtual time."""
    seconds: float
    cycles: int
    missed: int
    """Packets that never arrived."""
    late: int
    """Answers that were late."""
    not_taken: int
    """Answers that the controller did not take."""
    lost: int
    """Cycles that were exchanged and not archived."""
    outcome: str
    why: str
    """Why it ended so."""


class WarmUpResult(Frozen):
    """Friction while the arm warmed up, motion by motion."""

    verdict: str
    """One of `warm`, `not warm`, `going on`."""
    threshold: float
    """Change per motion that counts as warm, as a share."""
    friction: list[list[float | None]]
    """Of each motion and joint, N·m or N; null for a joint that hardly moves."""
    change: list[float | None]
    """Largest change per motion of any joint, as a share; null before it can be determined."""


class ConductResult(Frozen):
    """How a campaign was run."""

    steps: list[StepResult]
    warm_up: WarmUpResult | None
    recorded: list[RecordedResult]
    """Every archive of the manifest, in the order in which they were made."""
