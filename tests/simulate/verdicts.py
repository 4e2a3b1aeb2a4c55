"""Scenarios of simulated campaigns: verdict on a seed, reduction of scripts, summary of many."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Self

from drivers.events import Event, GapSeen, InitReceived, LinkLost, MotionEnded, RepliesLost
from drivers.punctuality import BUNCHED, LEFT_OUT
from tests.faults import kind_of, parse_script
from tests.laws.evidence import Broken, Evidence
from tests.laws.table import Scenario, broken, judged
from tests.simulate.draws import DRAWS
from tests.simulate.laws import LAWS
from tests.simulate.observed import Life, Observed
from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.world import Twin, UndisturbedError, play, twin_of


def broken_by(seen: Observed) -> list[Broken]:
    """Return the laws that a campaign breaks."""
    return broken(Evidence(simulated=seen))


MOST_TRIES: Final = 40  # largest number of campaigns simulated for the reduction

Fails = Callable[[tuple[str, ...]], bool]


def shrunk(lines: Sequence[str], fails: Fails, tries: int = MOST_TRIES) -> tuple[str, ...]:
    """Return a failing script with as few lines as found in some tries."""
    left = [tries]
    current = tuple(lines)

    def still(candidate: tuple[str, ...]) -> bool:
        left[0] -= 1
        return left[0] >= 0 and fails(candidate)

    size = max(1, len(current) // 2)
    while size:  # halves first, then lines
        start = 0
        while start < len(current):
            candidate = current[:start] + current[start + size :]
            if still(candidate):
                current = candidate
            else:
                start += size
        size //= 2
    return current


def _events(life: Life, kind: type[Event]) -> list[Any]:
    return [event for _, event in life.events if isinstance(event, kind)]


def _ended(outcome: str) -> Callable[[Life, Observed], bool]:
    return lambda life, _: any(
        motion_end.outcome == outcome for motion_end in _events(life, MotionEnded)
    )


MET: Final[dict[str, Callable[[Life, Observed], Any]]] = {
    "a duplicate was answered": lambda life, _: life.counters.duplicates,
    "a stale packet was left out": lambda life, _: life.counters.stale,
    "a malformed packet was left out": lambda life, _: life.counters.malformed,
    "packets piled up": lambda life, _: {LEFT_OUT, BUNCHED} & life.counters.discarded.keys(),
    "packets were missed": lambda life, _: life.counters.missed,
    "more were missed than allowed": lambda life, seen: any(
        gap.missed > seen.cell.controller.max_gap for gap in _events(life, GapSeen)
    ),
    "replies were not accepted": lambda life, _: _events(life, RepliesLost),
    "a set-point was refused": lambda life, _: life.counters.refused,
    "the link fell silent": lambda life, _: _events(life, LinkLost),
    "the controller began anew in mid-run": lambda life, _: _events(life, InitReceived)[1:],
    "motion completed": _ended("completed"),
    "motion stopped": _ended("stopped"),
    "motion refused": _ended("refused"),
    "motion lost": _ended("lost"),
    "the process died": lambda life, _: life.died,
    "the process died with a torn archive": lambda life, _: life.died and any(life.torn.values()),
    "the disk failed": lambda life, _: life.disk,
    "a whole archive was adopted": lambda life, _: life.result and life.result.adopted,
    "a motion was rejected": lambda life, _: life.result and life.result.rejected,
    "a dry run was accepted": lambda life, _: life.result and life.result.dry_run == "accepted",
    "several runs completed it": lambda _, seen: seen.complete and len(seen.runs) > 1,
    "no run completed it": lambda _, seen: not seen.complete,
}
"""Situations to which laws apply, each with its condition on a life of a campaign."""


def situations(seen: Observed) -> tuple[str, ...]:
    """Return the situations of `MET` that occurred."""
    return tuple(name for name, met in MET.items() if any(met(life, seen) for life in seen.runs))


@dataclass(frozen=True)
class Verdict:
    """Result of one seed."""

    seed: int
    scene: str = ""  # description of arm and plan
    script: tuple[str, ...] = ()
    struck: tuple[str, ...] = ()  # kinds of the lines that occurred
    met: tuple[str, ...] = ()  # situations that occurred
    runs: tuple[str, ...] = ()  # "complete", "incomplete" or the name of an error
    cycles: int = 0  # of the controller
    broken: tuple[tuple[str, str], ...] = ()  # (law, text)
    shrunk: tuple[str, ...] = ()  # reduced script that breaks the first of these laws
    redrawn: int = 0  # rejected scenes of the group
    seconds: float = 0.0  # processor time

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Restore a verdict from JSON; KeyError, TypeError or ValueError if it is invalid."""
        lists = ("script", "struck", "met", "runs", "shrunk")
        broken = tuple((str(law), str(text)) for law, text in data["broken"])
        return cls(**data | {name: tuple(data[name]) for name in lists} | {"broken": broken})


class Stage:
    """Runs seeds in a folder; the run without faults is shared by a group of seeds."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._twin = lru_cache(maxsize=1)(self._made)

    def _made(self, group: int) -> Twin:
        for old in self._root.glob("twin_*"):
            shutil.rmtree(old)
        twin = twin_of(group, self._root)
        if problems := broken_by(twin.seen):
            raise UndisturbedError("; ".join(f"{law}: {text}" for law, text in problems))
        return twin

    def twin(self, seed: int) -> Twin:
        """Return the run without faults of a seed's group.

        Raises:
            UndisturbedError: it failed or broke a law.
        """
        return self._twin(seed // NEIGHBOURS)

    def observed(self, seed: int, lines: Iterable[str] | None = None) -> Observed:
        """Run a seed; its folder remains until `clear`."""
        script = None if lines is None else parse_script(lines)
        twin = self.twin(seed)
        self.clear()
        return play(seed, twin, self._root, script)

    def scenario(self, seed: int, lines: Iterable[str] | None = None) -> Scenario:
        """Return a seed, with its own script or another one, as a scenario."""
        script = None if lines is None else tuple(lines)

        def play_seed() -> Evidence:
            return Evidence(simulated=self.observed(seed, script))

        return Scenario(f"python -m tests.simulate --seed {seed}", script or (), play_seed)

    def clear(self) -> None:
        for old in self._root.glob("seed_*"):
            shutil.rmtree(old)

    def verdict(self, seed: int, *, shrink: bool = True) -> Verdict:
        """Run a seed, check the laws, and reduce its script if one is broken."""
        begun = time.process_time()
        try:
            seen = self.observed(seed)
        except UndisturbedError as error:
            return Verdict(seed, broken=(("undisturbed", str(error)),))
        problems = broken_by(seen)

        def fails(lines: tuple[str, ...]) -> bool:
            violations = judged(self.scenario(seed, lines))
            return any(violation.law == problems[0].law for violation in violations)

        smallest = shrunk(seen.schedule, fails) if problems and shrink else ()
        self.clear()
        return Verdict(
            seed=seed,
            scene=self.twin(seed).scene.words,
            script=seen.schedule,
            struck=tuple(kind_of(line) for line in seen.struck),
            met=situations(seen),
            runs=runs_of(seen),
            cycles=len(seen.arm.sent),
            broken=tuple((violation.law, violation.text) for violation in problems),
            shrunk=smallest,
            redrawn=self.twin(seed).redrawn,
            seconds=time.process_time() - begun,
        )


def runs_of(seen: Observed) -> tuple[str, ...]:
    return tuple(
        type(life.error).__name__
        if life.error is not None
        else "complete"
        if life.result is not None and life.result.complete
        else "incomplete"
        for life in seen.runs
    )


def summary(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Return the JSON summary of verdicts, with the kinds and situations that did not occur."""

    def counts(values: Iterable[str]) -> dict[str, int]:
        return dict(sorted(Counter(values).items()))

    failed = sorted(verdict.seed for verdict in verdicts if verdict.broken)
    struck = counts(kind for verdict in verdicts for kind in verdict.struck)
    met = counts(name for verdict in verdicts for name in verdict.met)
    scenes = {verdict.seed // NEIGHBOURS: verdict.redrawn for verdict in verdicts}
    return {
        "ran": len(verdicts),
        "failed": len(failed),
        "seeds_failed": failed,
        "struck": struck,
        "never_struck": sorted(set(DRAWS) - {"stalls"} - set(struck)),
        "met": met,
        "never_met": sorted(set(MET) - set(met)),
        "laws": sorted(LAWS),
        "laws_broken": counts(
            law for verdict in verdicts for law in {law for law, _ in verdict.broken}
        ),
        "runs_ended": counts(how for verdict in verdicts for how in verdict.runs),
        "campaigns_ended": counts(
            verdict.runs[-1] if verdict.runs else "nothing" for verdict in verdicts
        ),
        "scenes": len(scenes),
        "scenes_redrawn": sum(scenes.values()),
        "cycles": sum(verdict.cycles for verdict in verdicts),
        "processor_seconds": round(sum(verdict.seconds for verdict in verdicts), 1),
    }
