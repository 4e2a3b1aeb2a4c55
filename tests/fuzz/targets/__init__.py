"""Targets of fuzzing: for each a function of bytes that raises only where a law is violated."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

NAMES = ("codec", "session", "cell_file", "archive", "importers", "urdf", "documents")
"""All targets, each a module of this package with a `TARGET`."""
CORPORA = Path(__file__).parents[1] / "corpora"
"""Inputs in the repository, a folder per target."""


Mutation = Callable[[bytes, int, int], bytes]
"""Changes an input: its bytes, the largest length, and the seed that determines the change."""


@dataclass(frozen=True)
class Target:
    """One target.

    Attributes:
        run: raises where a law is violated; else returns whether the input is accepted, False
            where it is refused as documented.
        seeds: first inputs, made by the product's own writers; all of them are accepted.
    """

    run: Callable[[bytes], bool]
    seeds: Callable[[], list[bytes]]
    mutate: Mutation  # changes that get past checksums and grammars
    most: int = 1 << 14  # bytes of the longest input
    replayed: int = 200  # changed inputs that the test of the corpora tries


def place_of(name: str) -> Path:
    """Create a temporary folder for a target's files, removed when the process ends."""
    made = Path(tempfile.mkdtemp(name))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def load(name: str) -> Target:
    """Import and return the target of a name in `NAMES`."""
    target: Target = import_module(f"tests.fuzz.targets.{name}").TARGET
    return target
