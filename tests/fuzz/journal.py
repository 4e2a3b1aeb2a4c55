"""What was fuzzed so far: a line of JSON for each piece, added durably, summed up for a reader."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Piece:
    """One life of a fuzzing process.

    Attributes:
        target: what was fuzzed.
        seconds: it lasted.
        inputs: executed.
        edges: covered at its end, as libFuzzer counts them.
        features: likewise; an edge run through more often is another feature.
        corpus: inputs kept, at its end.
        memory: resident at its end [MB].
        ended: "whole", "stopped" where the user ended it, or how it ended early: "crash",
            "timeout", "memory", "killed".
        reproduced: whether what ended it early ends the target again in a fresh process.
    """

    target: str
    seconds: float
    inputs: int
    edges: int
    features: int
    corpus: int
    memory: int
    ended: str = "whole"
    reproduced: bool = False


def append(path: Path, piece: Piece) -> None:
    """Add a piece; it survives the death of this process and of the computer.

    A line that a killed process left half written is closed first.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as stream:
        stream.seek(0, os.SEEK_END)
        if stream.tell():
            stream.seek(-1, os.SEEK_END)
            if stream.read(1) != b"\n":
                stream.write(b"\n")
        stream.write(json.dumps(asdict(piece)).encode() + b"\n")
        stream.flush()
        os.fsync(stream.fileno())


def pieces(path: Path) -> list[Piece]:
    """All pieces; a line torn by a kill is left out."""
    found = []
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            found.append(Piece(**json.loads(line)))
        except (ValueError, TypeError):
            continue
    return found


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
