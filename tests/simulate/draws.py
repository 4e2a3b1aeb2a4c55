"""Random scripts of simulated campaigns."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple


class Story(NamedTuple):
    """Numbers of the run without faults, from which the parameters of lines are drawn."""

    cycles: int
    moving: tuple[int, ...]  # cycles in which the arm moves
    n_joints: int
    bytes: int  # length of a cyclic packet
    writes: int
    saves: int
    creates: int


Draw = Callable[[random.Random, Story], str]


def _cycle(chance: random.Random, story: Story) -> int:
    """Return a random cycle, mostly one in which the arm moves."""
    if story.moving and chance.random() < 0.75:
        return chance.choice(story.moving)
    return chance.randrange(story.cycles)


def _link(kind: str, most: int) -> Draw:
    def draw(chance: random.Random, story: Story) -> str:
        count = chance.choice((1, 1, 2, 3, most))
        times = "" if count == 1 else f"x{count}"
        way = chance.choice(("", ":to_controller"))
        return f"{kind}@{_cycle(chance, story)}{times}{way}"

    return draw


def _delay(chance: random.Random, story: Story) -> str:
    long = chance.choice(("0.5cycles", "1.5cycles", "3ms", "7ms", "30ms"))
    count = chance.choice((1, 1, 4))
    way = chance.choice(("", ":to_controller"))
    return f"delay@{_cycle(chance, story)}x{count}:{long}{way}"


def _reorder(chance: random.Random, story: Story) -> str:
    return f"reorder@{_cycle(chance, story)}{chance.choice(('', ':to_controller'))}"


def _corrupt(chance: random.Random, story: Story) -> str:
    offset = chance.choice((0, 1, 4, 12, chance.randrange(story.bytes)))
    mask = 1 << chance.randrange(8)
    count = chance.choice((1, 1, 1, 2))
    way = chance.choice(("", "", ":to_controller"))
    return f"corrupt@{_cycle(chance, story)}x{count}:offset={offset}:mask=0x{mask:02x}{way}"


def _axis(kind: str, most: int = 0) -> Draw:
    def draw(chance: random.Random, story: Story) -> str:
        times = f"x{chance.randint(1, most)}" if most else ""
        slip = ":slip" if kind == "following-error" and chance.random() < 0.5 else ""
        axis = chance.randint(1, story.n_joints)
        return f"{kind}@{_cycle(chance, story)}{times}:axis={axis}{slip}"

    return draw


def _at(text: str) -> Draw:
    return lambda chance, story: text.format(at=_cycle(chance, story))


def _pause(chance: random.Random, story: Story) -> str:
    return f"pause@{_cycle(chance, story)}x{chance.randint(1, 60)}:{chance.choice((500, 502))}"


def _stall(chance: random.Random, story: Story) -> str:
    where = chance.choice(("", ":answering"))
    return f"stall@{_cycle(chance, story)}:{chance.randint(5, 48)}ms{where}"


def _stalls(chance: random.Random, story: Story) -> str:
    """Return repeated stalls, as of a virtual machine."""
    at = _cycle(chance, story)
    lines = []
    for _ in range(chance.randint(2, 6)):
        lines.append(f"stall@{at}:{chance.randint(5, 48)}ms")
        at += chance.randint(3, 120)
    return "\n".join(lines)


def _clock(chance: random.Random, story: Story) -> str:
    size = chance.choice((0.002, 0.04, 0.9, 1.5, 3600.0))
    return f"clock@{_cycle(chance, story)}:{chance.choice('+-')}{size:g}s"


def _share(chance: random.Random) -> str:
    return f"{chance.choice((0.0, round(chance.random(), 3), 0.999)):g}"


def _power_cut(chance: random.Random, story: Story) -> str:
    times = chance.choice(("", "x2"))
    return f"power-cut@{_cycle(chance, story)}{times}:keep={_share(chance)}"


def _write(kind: str) -> Draw:
    def draw(chance: random.Random, story: Story) -> str:
        times = chance.choice(("", "x2")) if kind.startswith("disk") else ""
        return f"{kind}@{chance.randint(1, story.writes)}{times}:keep={_share(chance)}"

    return draw


def _save(chance: random.Random, story: Story) -> str:
    when = chance.choice(("left", "before", "after"))
    return f"kill-at-save@{chance.randint(1, story.saves)}:{when}"


def _override(chance: random.Random, story: Story) -> str:
    at = _cycle(chance, story)
    slower = chance.choice((10, 30, 60, 95))
    return f"override@{at}:{slower}\noverride@{at + chance.randint(100, 500)}:100"


def _lurch(chance: random.Random, story: Story) -> str:
    size = chance.choice(("0.0001", "0.01", "-0.3", "6.5", "nan"))
    return f"lurch@{_cycle(chance, story)}{chance.choice(('', 'x3'))}:{size}"


DRAWS: Final[Mapping[str, tuple[float, Draw]]] = {
    "lose": (3.0, _link("lose", 9)),
    "delay": (2.0, _delay),
    "duplicate": (1.5, _link("duplicate", 4)),
    "reorder": (1.5, _reorder),
    "corrupt": (3.0, _corrupt),
    "restart": (
        1.0,
        lambda chance, story: f"restart@{_cycle(chance, story)}:{chance.choice(('cold', 'warm'))}",
    ),
    "drive-drop": (1.0, _at("drive-drop@{at}")),
    "e-stop": (1.0, _at("e-stop@{at}")),
    "axis-leaves": (1.0, _axis("axis-leaves")),
    "following-error": (1.5, _axis("following-error", 120)),
    "saturate": (1.0, _axis("saturate", 120)),
    "push": (1.0, _axis("push", 120)),
    "pause": (1.0, _pause),
    "stall": (2.0, _stall),
    "stalls": (0.7, _stalls),
    "clock": (1.0, _clock),
    "kill": (2.0, _at("kill@{at}")),
    "interrupt": (0.7, _at("interrupt@{at}")),
    "power-cut": (1.0, _power_cut),
    "kill-at-write": (1.5, _write("kill-at-write")),
    "kill-at-save": (1.0, _save),
    "disk-full": (1.2, _write("disk-full")),
    "disk-error": (0.6, _write("disk-error")),
    "short-write": (0.8, _write("short-write")),
    "save-full": (0.6, lambda chance, story: f"save-full@{chance.randint(1, story.saves)}"),
    "create-full": (0.6, lambda chance, story: f"create-full@{chance.randint(1, story.creates)}"),
    "lurch": (1.0, _lurch),
    "stop": (1.2, _at("stop@{at}")),
    "override": (1.0, _override),
    "hold": (1.0, lambda chance, story: f"hold@{_cycle(chance, story)}x{chance.randint(1, 5)}"),
    "hurry": (0.8, lambda chance, story: "hurry@0"),
}
"""Relative frequency of each kind, and the function that draws a line."""
WITH_DRY_RUN: Final = 0.02


def draw_script(chance: random.Random, story: Story) -> tuple[str, ...]:
    """Return a random script, mostly of one to three lines."""
    kinds = list(DRAWS)
    weights = [DRAWS[kind][0] for kind in kinds]
    count = chance.choices((0, 1, 2, 3, 4, 6, 15), (0.3, 3.0, 3.0, 2.0, 1.0, 0.7, 0.4))[0]
    lines: list[str] = []
    for kind in chance.choices(kinds, weights, k=count):
        lines += DRAWS[kind][1](chance, story).splitlines()
    if chance.random() < WITH_DRY_RUN:
        lines.append("with-dry-run@0")
        if chance.random() < 0.5:
            lines.append("declines@0")
    return tuple(dict.fromkeys(lines))
