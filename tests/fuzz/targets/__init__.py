"""What is fuzzed: for each target a function of bytes that raises only where a law is broken."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Protocol

NAMES = ("codec", "session", "cell_file", "archive", "importers", "urdf", "documents")
"""All targets, each a module of this package with a `TARGET`."""


class Mutation(Protocol):
    """Changes an input; the same seed makes the same change."""

    def __call__(self, data: bytes, most: int, seed: int) -> bytes:
        """An input of at most `most` bytes made of `data`."""


@dataclass(frozen=True)
class Target:
    """One of them.

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
    """A temporary folder for a target's files, which goes when the process ends."""
    made = Path(tempfile.mkdtemp(name))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def load(name: str) -> Target:
    """The target of a name out of `NAMES`, whose packages are imported now."""
    target: Target = import_module(f"tests.fuzz.targets.{name}").TARGET
    return target
