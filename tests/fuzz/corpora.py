"""Inputs of the corpora."""

from __future__ import annotations

from tests.fuzz.targets import CORPORA


def inputs(name: str) -> list[bytes]:
    """Return the corpus in the repository, sorted."""
    return [path.read_bytes() for path in sorted((CORPORA / name).iterdir())]
