"""A motion of a UR5e keeps all laws, whatever befalls it: seeds of link, controller, operator."""

from __future__ import annotations

import pytest

from tests.laws.table import judged
from tests.simulate.ur import DRAWS, draw_script, scenario

pytestmark = pytest.mark.safety

SEEDS = range(60)


@pytest.mark.parametrize("first", SEEDS[::20])
def test_no_law_is_broken(first: int) -> None:
    broken = [
        f"{played.name}: {law}: {text}"
        for played in map(scenario, range(first, first + 20))
        for law, text in judged(played)
    ]
    assert broken == []


def test_seeds_have_every_kind_of_fault() -> None:
    lines = [line for seed in SEEDS for line in draw_script(seed)]
    struck = {line.partition("@")[0] for line in lines}
    assert struck == {*DRAWS}


def test_a_seed_is_a_script() -> None:
    assert draw_script(7) == draw_script(7) != draw_script(8)
