"""What was fuzzed so far: a line for each piece, summed up for a reader."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.journal import Journal, entries


@dataclass(frozen=True)
class Piece:
    """One life of a fuzzing process.

    Attributes:
        ended: "whole", "stopped" where the user ended it, or how it ended early: "crash",
            "timeout", "memory", "killed".
    """

    target: str  # what was fuzzed
    seconds: float  # it lasted
    inputs: int  # executed
    edges: int  # covered at its end, as libFuzzer counts them
    features: int  # likewise; an edge run through more often is another feature
    corpus: int  # inputs kept, at its end
    memory: int  # resident at its end [MB]
    ended: str = "whole"
    reproduced: bool = False  # whether what ended it early ends the target again in a fresh process


def append(path: Path, piece: Piece) -> None:
    """Add a piece; it survives the death of this process and of the computer."""
    with Journal(path) as journal:
        journal.add(**asdict(piece))


def pieces(path: Path) -> list[Piece]:
    """All pieces.

    Raises:
        JournalError: it cannot be read, or a line is none.
    """
    return entries(path, lambda said: Piece(**said), "piece of fuzzing")


def summary(found: Iterable[Piece]) -> dict[str, dict[str, Any]]:
    """Per target: inputs and seconds summed, coverage at its largest."""
    totals: dict[str, dict[str, Any]] = {}
    for piece in found:
        total = totals.setdefault(
            piece.target,
            {"pieces": 0, "seconds": 0.0, "inputs": 0, "edges": 0, "features": 0, "corpus": 0,
             "memory": 0, "ended_early": 0, "not_reproduced": 0},
        )  # fmt: skip
        total["pieces"] += 1
        total["seconds"] = round(total["seconds"] + piece.seconds, 1)
        total["inputs"] += piece.inputs
        for name in ("edges", "features", "corpus", "memory"):
            total[name] = max(total[name], getattr(piece, name))
        early = piece.ended not in ("whole", "stopped")
        total["ended_early"] += early
        total["not_reproduced"] += early and not piece.reproduced
    return totals


def seconds_of(found: Iterable[Piece], target: str) -> float:
    """How long a target was fuzzed."""
    return sum(piece.seconds for piece in found if piece.target == target)
