"""Random faults of link, controller and operator on a motion of a UR5e: one seed, one session.

    python -m tests.simulate.ur [--seed N] [--count N]

Archives, disk and processes do not depend on the link; they are those of `tests.simulate`.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from drivers.errors import RequestError
from sim_fixtures.faults import split_faults
from sim_fixtures.ur.controller import UrFault, parse_ur_fault
from tests.fault_matrix.ur_runs import UrRun, controller
from tests.faults import parse_script
from tests.laws.evidence import Evidence
from tests.laws.table import Scenario, judged
from tests.simulate.draws import DRAWS as OF_CAMPAIGNS
from tests.simulate.draws import Draw, Story

CYCLES: Final = 480
"""Of the motion without faults; faults are drawn in these."""
_STORY: Final = Story(
    cycles=CYCLES, moving=tuple(range(115, 380)), n_joints=6, bytes=68, writes=1, saves=1,
    creates=1,
)  # fmt: skip
_OF_LINK: Final = ("lose", "delay", "duplicate")
_OF_OPERATOR: Final = ("stop", "override", "hold")
_AT_CONTROLLER: Final[Mapping[str, str]] = {
    "stop": "", "safeguard": "", "emergency-stop": "", "power-off": "", "pause": "", "resume": "",
    "halt": "", "restart": "", "freedrive": "x20", "slider": "x70", "push": "x40",
}  # fmt: skip
PREFIX: Final = "ur:"
"""Prefix of faults of the controller and of the person at its pendant."""


def _of_controller(kind: str) -> Draw:
    def draw(chance: random.Random, story: Story) -> str:
        at = chance.choice(story.moving) if chance.random() < 0.7 else chance.randrange(2, CYCLES)
        size = _AT_CONTROLLER[kind]
        if kind in ("slider", "push") and chance.random() < 0.5:
            size = f"x{chance.choice((0, 99, 250))}"
        return f"{PREFIX}{kind}@{at}{size}"

    return draw


def _corrupt(chance: random.Random, story: Story) -> str:
    offset, mask = 4 + chance.randrange(story.bytes - 4), 1 << chance.randrange(8)
    at = chance.choice(story.moving)
    return f"corrupt@{at}:offset={offset}:mask=0x{mask:02x}:to_controller"


DRAWS: Final[Mapping[str, tuple[float, Draw]]] = {
    **{kind: OF_CAMPAIGNS[kind] for kind in (*_OF_LINK, *_OF_OPERATOR)},
    "corrupt": (1.0, _corrupt),
    **{f"{PREFIX}{kind}": (0.7, _of_controller(kind)) for kind in _AT_CONTROLLER},
}
"""Relative frequency of each kind, and the function that draws a line."""


def draw_script(seed: int) -> tuple[str, ...]:
    """Return the lines of a seed."""
    chance = random.Random(f"ur seed {seed}")
    kinds = list(DRAWS)
    count = chance.choices((1, 2, 3, 4, 8), (2, 3, 3, 2, 1))[0]
    lines: list[str] = []
    for kind in chance.choices(kinds, [DRAWS[kind][0] for kind in kinds], k=count):
        lines += DRAWS[kind][1](chance, _STORY).splitlines()
    return tuple(dict.fromkeys(lines))


@dataclass
class SeededRun(UrRun):
    """A run with acts of an operator by cycle."""

    acts: list[tuple[int, str, float]] = field(default_factory=list)

    def _operate(self) -> None:
        while self.acts and self.acts[0][0] <= self.transport.cycle:
            _, kind, value = self.acts.pop(0)
            try:
                match kind:
                    case "stop":
                        self.session.stop("the operator stopped it")
                    case "hold":
                        self.session.hold()
                    case "release":
                        self.session.resume()
                    case "override":
                        self.session.override(value)
            except RequestError:
                continue  # no motion to act upon


def play(lines: Sequence[str]) -> SeededRun:
    """Play a script."""
    ours = [line for line in lines if line.startswith(PREFIX)]
    at_controller: list[UrFault] = [parse_ur_fault(line.removeprefix(PREFIX)) for line in ours]
    script = parse_script(line for line in lines if line not in ours)
    acts = [(event.at, event.kind, event.value / 100.0) for event in script.of("cycle")]
    # A hold ends by itself after some time.
    acts += [(at + 100, "release", 0.0) for at, kind, _ in acts if kind == "hold"]
    link: tuple[Any, ...] = split_faults([fault for _, fault in script.faults])[0]
    last = max(
        [
            *(fault.cycle + fault.count * (fault.kind == "freedrive") for fault in at_controller),
            *(at for at, _, _ in acts),
            *(fault.cycle + fault.count for fault in link),
            1,
        ]
    )
    run = SeededRun(controller(*at_controller), True, acts=sorted(acts))
    run.play(link, last, last + 1)
    return run


def scenario(seed: int, outcomes: Callable[[str], object] = lambda _: None) -> Scenario:
    """Return a seed as a scenario; `outcomes` is given what became of the motion."""
    lines = draw_script(seed)

    def seen() -> Evidence:
        run = play(lines)
        outcomes(run.outcome.partition(":")[0].partition(" ")[0])
        found = [*run.session.broken]
        if not run.recovery.startswith("completed"):
            found.append(f"a new motion afterwards: {run.recovery}")
        return Evidence(rests=tuple(run.rests), session=tuple(found))

    return Scenario(f"python -m tests.simulate.ur --seed {seed}", lines, seen)


def violations(seed: int, ends: Counter[str]) -> list[str]:
    """Play a seed; return a sentence and the script for each law that was broken."""
    played = scenario(seed, lambda outcome: ends.update([outcome]))
    script = "  ".join(played.lines)
    return [f"{played.name}: {law}: {text}\n    {script}" for law, text in judged(played)]


def play_seeds(description: str, play: Callable[[int, Counter[str]], Sequence[str]]) -> None:
    """Play the seeds of the command line; print what breaks a law, and how the runs ended.

    Args:
        description: of the command; its first line is shown.
        play: plays a seed, counts how its runs ended, and returns the violations.
    """
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1)
    options = parser.parse_args()
    ends: Counter[str] = Counter()
    broken = 0
    for seed in range(options.seed, options.seed + options.count):
        for text in play(seed, ends):
            broken += 1
            sys.stdout.write(f"{text}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{options.count} seeds, {broken} violations; {dict(ends)}\n")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    play_seeds(__doc__, violations)
