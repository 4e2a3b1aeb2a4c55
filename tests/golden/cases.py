"""Golden results: what is identified and designed, and the numbers of it that must not move.

The archives in `fast/` were recorded by an earlier version of this software, and have to stay
readable. After a change that is meant to move numbers, ``python -m tests.golden`` writes the
results again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from typer.testing import CliRunner

from benchmarks.published import Published
from hil.base.progress import Silent
from hil.campaign.plan import design
from hil.cli import app
from hil.results.results import Results
from tests.hil.fast_cell import fast_cell

HERE: Final = Path(__file__).parent
FAST: Final = HERE / "fast"
RECORDINGS: Final = HERE.parents[2] / "shared" / "data"


def identify(folder: Path, *arguments: str) -> dict[str, Any]:
    """Values, standard deviations, choices and verdict of an identification."""
    status = CliRunner().invoke(app, ["identify", *arguments, "--output", str(folder)]).exit_code
    results = Results.load(folder / "results.json")
    return {
        "names": [parameter.name for parameter in results.parameters],
        "values": [parameter.estimate for parameter in results.parameters],
        "std": [parameter.std for parameter in results.parameters],
        "errors": [prediction.all_rows_relative_error for prediction in results.validation],
        "choices": [choice.candidates[choice.chosen] for choice in results.choices],
        "checks": sorted({finding.check for finding in results.judgement.findings}),
        "status": status,
    }


def campaign(scratch: Path) -> dict[str, Any]:
    """The archives of `fast/` as one campaign."""
    return identify(scratch, *sorted(map(str, FAST.glob("*.mcap"))))


def keys_of(content: Any, place: str = "") -> set[str]:
    """Places of all keys in the content of a JSON file; entries of a list share theirs."""
    if isinstance(content, list):
        return set().union(*(keys_of(entry, f"{place}[]") for entry in content))
    if not isinstance(content, dict):
        return set()
    places = {f"{place}.{key}" for key in content}
    return places.union(*(keys_of(entry, f"{place}.{key}") for key, entry in content.items()))


def keys(scratch: Path) -> list[str]:
    """Keys of `results.json`, which other programs read."""
    campaign(scratch)
    return sorted(keys_of(json.loads((scratch / "results.json").read_text(encoding="utf-8"))))


def batch(scratch: Path) -> dict[str, Any]:
    """The same archives by a batch."""
    arguments = ["batch", str(FAST), "--json", "--quiet", "--cache", "none", "--workers", "1"]
    printed = CliRunner().invoke(app, arguments)
    (arm,) = json.loads(printed.stdout)["arms"].values()
    return {**next(iter(arm["campaigns"].values()))["parameters"], "status": printed.exit_code}


def quick_design(scratch: Path) -> dict[str, Any]:
    """A motion for the small arm."""
    motion = design(fast_cell(scratch), Silent()).excitation.trajectory
    position, *_ = motion.sample(np.array([motion.duration / 3]))
    return {"duration": motion.duration, "position": position[0].tolist()}


def recording(name: str) -> Callable[[Path], dict[str, Any]]:
    """The first log of a published robot, in sample."""

    def case(scratch: Path) -> dict[str, Any]:
        robot = Published.named(name)
        log = next(iter(robot.logs))
        archive = robot.imported(log, RECORDINGS / (robot.folder or name), scratch / "log.mcap")
        return identify(scratch / "found", str(archive), "--fit-all")

    return case


CASES: Final[dict[str, Callable[[Path], Any]]] = {
    "campaign": campaign,
    "keys": keys,
    "batch": batch,
    "design": quick_design,
}
PUBLISHED: Final = {name: recording(name) for name in ("ur10_unisa", "tx40", "kr300")}
