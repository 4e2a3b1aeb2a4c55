"""Simulated campaigns in CI: eight seeds for every change, the others in pieces."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.verdicts import Stage

GROUPS: Final = (
    *(0, 1, 2, 3, 4, 6, 8, 11, 13, 14, 15, 16, 18),
    *(19, 20, 22, 23, 28, 29, 30, 32, 33, 37, 83, 85, 148, 200),
)  # Of eight seeds each: arms of one to seven joints, mostly in the longer cycle: it costs less
PIECES: Final = 4


def groups(piece: int) -> list[int]:
    """The groups of one piece, spread; all but the quick one."""
    return list(GROUPS[1 + piece :: PIECES])


def failures(group: int, root: Path) -> list[str]:
    """Play the seeds of a group; a sentence for each law that was broken, with what to type."""
    stage = Stage(root)
    found = []
    for seed in range(group * NEIGHBOURS, (group + 1) * NEIGHBOURS):
        verdict = stage.verdict(seed, shrink=False)
        found += [
            f"python -m tests.simulate --seed {seed}: {law}: {text}" for law, text in verdict.broken
        ]
    return found
