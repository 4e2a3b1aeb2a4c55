"""What came of a seed, as it is kept in a journal and summed up over many."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

from tests.simulate.drawing import DRAWS
from tests.simulate.judging import LAWS, judged
from tests.simulate.observed import Broken, Observed
from tests.simulate.playing import Twin, UndisturbedError, play, twin_of
from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.script import kind_of, parse_script
from tests.simulate.shrinking import shrunk
from tests.simulate.situations import EXPECTED, situations


@dataclass(frozen=True)
class Verdict:
    """One seed.

    Attributes:
        shrunk: the smallest script that breaks the first of these laws; () if none was broken.
    """

    seed: int  # its number
    scene: str  # arm and plan, in words
    script: tuple[str, ...]  # what was drawn
    struck: tuple[str, ...]  # kinds of the lines that came to pass, each as often as it did
    met: tuple[str, ...]  # situations that came about, see `situations`
    runs: tuple[str, ...]  # how each run ended: "complete", "incomplete" or the name of an error
    cycles: int  # that the controller took, in all
    broken: tuple[tuple[str, str], ...] = ()  # laws and what is wrong, as (law, text)
    shrunk: tuple[str, ...] = ()
    redrawn: int = 0  # scenes that were of no use before that of this seed's group
    seconds: float = 0.0  # processor time

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """From what `to_dict` returned, through JSON.

        Raises:
            KeyError, TypeError, ValueError: it is none.
        """
        lists = ("script", "struck", "met", "runs", "shrunk")
        broken = tuple((str(law), str(text)) for law, text in data["broken"])
        return cls(**data | {name: tuple(data[name]) for name in lists} | {"broken": broken})


class Stage:
    """Where seeds of one process are played; the run without faults is shared by neighbours.

    Args:
        root: folder for the campaigns, which are taken away again.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._twin = lru_cache(maxsize=1)(self._made)

    def _made(self, group: int) -> Twin:
        for old in self._root.glob("twin_*"):
            shutil.rmtree(old)
        twin = twin_of(group, self._root)
        if broken := judged(twin.seen):
            raise UndisturbedError("; ".join(f"{one.law}: {one.text}" for one in broken))
        return twin

    def twin(self, seed: int) -> Twin:
        """The run without faults of a seed's group, which keeps every law.

        Raises:
            UndisturbedError: it does not, or ends otherwise than any may.
        """
        return self._twin(seed // NEIGHBOURS)

    def observed(self, seed: int, lines: Iterable[str] | None = None) -> Observed:
        """A seed, played; its folder stays until `clear`."""
        script = None if lines is None else parse_script(lines)
        twin = self.twin(seed)
        self.clear()
        return play(seed, twin, self._root, script)

    def clear(self) -> None:
        """Take the folders of seeds away."""
        for old in self._root.glob("seed_*"):
            shutil.rmtree(old)

    def verdict(self, seed: int, *, shrink: bool = True) -> Verdict:
        """Play a seed, judge it, and make its script small where it fails."""
        begun = time.process_time()
        try:
            seen = self.observed(seed)
        except UndisturbedError as error:
            return Verdict(seed, "", (), (), (), (), 0, (("undisturbed", str(error)),))
        broken = judged(seen)
        plain = shrunk(seen.schedule, self._fails(seed, broken[0])) if broken and shrink else ()
        self.clear()
        return Verdict(
            seed=seed,
            scene=self.twin(seed).scene.words,
            script=seen.schedule,
            struck=tuple(kind_of(line) for line in seen.struck),
            met=situations(seen),
            runs=runs_of(seen),
            cycles=len(seen.arm.sent),
            broken=tuple((one.law, one.text) for one in broken),
            shrunk=plain,
            redrawn=self.twin(seed).redrawn,
            seconds=time.process_time() - begun,
        )

    def _fails(self, seed: int, broken: Broken) -> Any:
        def fails(lines: tuple[str, ...]) -> bool:
            return any(one.law == broken.law for one in judged(self.observed(seed, lines)))

        return fails


def runs_of(seen: Observed) -> tuple[str, ...]:
    """How each run ended, in a word."""
    return tuple(
        type(life.error).__name__
        if life.error is not None
        else "complete"
        if life.result is not None and life.result.complete
        else "incomplete"
        for life in seen.runs
    )


@dataclass
class Tally:
    """Verdicts, summed up.

    Attributes:
        struck: how often each kind of line came to pass.
        met: in how many seeds each situation came about.
    """

    ran: int = 0  # seeds
    failed: list[int] = field(default_factory=list)  # the numbers of those that broke a law
    struck: Counter[str] = field(default_factory=Counter)
    met: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)  # how often a run ended in each way
    campaigns: Counter[str] = field(default_factory=Counter)  # how often the last one did
    broken: Counter[str] = field(default_factory=Counter)  # how often each law was broken
    redrawn: dict[int, int] = field(default_factory=dict)  # scenes of no use, by group of seeds
    cycles: int = 0  # of all controllers
    seconds: float = 0.0  # of processor time

    def add(self, verdict: Verdict) -> None:
        """Count one more."""
        self.ran += 1
        self.struck.update(verdict.struck)
        self.met.update(verdict.met)
        self.ends.update(verdict.runs)
        self.campaigns[verdict.runs[-1] if verdict.runs else "nothing"] += 1
        self.broken.update({law for law, _ in verdict.broken})
        self.redrawn[verdict.seed // NEIGHBOURS] = verdict.redrawn
        self.cycles += verdict.cycles
        self.seconds += verdict.seconds
        if verdict.broken:
            self.failed.append(verdict.seed)

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it. What never came about is named: nothing was tried of it."""
        return {
            "ran": self.ran,
            "failed": len(self.failed),
            "seeds_failed": sorted(self.failed),
            "struck": dict(sorted(self.struck.items())),
            "never_struck": sorted(set(DRAWS) - {"stalls"} - set(self.struck)),
            "met": dict(sorted(self.met.items())),
            "never_met": sorted(set(EXPECTED) - set(self.met)),
            "laws": sorted(LAWS),
            "laws_broken": dict(sorted(self.broken.items())),
            "runs_ended": dict(sorted(self.ends.items())),
            "campaigns_ended": dict(sorted(self.campaigns.items())),
            "scenes": len(self.redrawn),
            "scenes_redrawn": sum(self.redrawn.values()),
            "cycles": self.cycles,
            "processor_seconds": round(self.seconds, 1),
        }
