"""Which tests run when: at every change, at every change of what drives an arm, or with all.

`make test` runs those of no tier, `make test-safety` those of "safety", `make test-all` all.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Final, Literal

Tier = Literal["safety", "long"]

_ROOT: Final = Path(__file__).parent

SAFETY: Final = (
    "disk",
    "drivers",
    "endurance",
    "process_death",
    "simulate",
    "strangers",
    "test_controller_variants.py",
    "test_fault_matrix.py",
)
"""Folders and files on the way to the controller, and of what breaks it."""

LONG: Final[tuple[str, ...]] = ()
"""Files that take too long for every change."""

QUICK: Final[tuple[str, ...]] = ()
"""Files of these folders that run at every change all the same."""


def tier_of(path: Path) -> Tier | None:
    """The tier of a test file; None for those that run at every change."""
    place = PurePosixPath(path.relative_to(_ROOT).as_posix())
    if _within(place, QUICK):
        return None
    if _within(place, SAFETY):
        return "safety"
    return "long" if _within(place, LONG) else None


def _within(place: PurePosixPath, names: tuple[str, ...]) -> bool:
    return any(place.is_relative_to(name) for name in names)
