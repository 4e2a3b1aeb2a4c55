"""A played campaign to be put out of order, and what the laws say of it then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.simulate.judging import LAWS
from tests.simulate.laws.judged import judge_whole
from tests.simulate.observed import Broken, Observed
from tests.simulate.playing import NEIGHBOURS, play, twin_of
from tests.simulate.script import parse_script

SEED = 5
FAULTS = (
    "duplicate@300x2",
    "reorder@340",
    "corrupt@380:offset=1:mask=0x10",
    "lose@420",
    "override@460:60",
    "override@520:100",
    "kill@900",
)
ALL = {**LAWS, "judge": judge_whole}


def played(root: Path) -> Observed:
    """The campaign, in a folder below `root`."""
    return play(SEED, twin_of(SEED // NEIGHBOURS, root), root, parse_script(FAULTS))


def found(observed: Observed, law: str) -> str:
    """What one family of laws has to say, in one text."""
    said: list[Broken] = list(ALL[law](observed))
    assert all(one.law == law for one in said)
    return "; ".join(one.text for one in said)


def with_life(observed: Observed, number: int, **changes: Any) -> Observed:
    lives = list(observed.runs)
    lives[number] = replace(lives[number], **changes)
    return replace(observed, runs=tuple(lives))
