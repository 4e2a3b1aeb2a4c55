"""A motion of a UR5e keeps all laws, whatever befalls it: seeds of link, controller, operator."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.laws.table import judged
from tests.simulate import ur_campaign
from tests.simulate.ur import DRAWS, draw_script, scenario
from tests.simulate.ur_campaign import CampaignStage, violations

pytestmark = pytest.mark.safety

SEEDS = range(60)
CAMPAIGNS = range(4)


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


def test_whole_campaigns_keep_all_laws() -> None:
    """Ended by a fault of link, controller or operator, and completed by a second run."""
    stage = CampaignStage.set_up()
    ends: Counter[str] = Counter()
    broken = [text for seed in CAMPAIGNS for text in violations(stage, seed, ends)]
    assert broken == []
    assert len(ends) > 1, "some faults must end a run"


def test_campaign_seeds_have_all_kinds_of_faults() -> None:
    assert ur_campaign.draw_script(7) == ur_campaign.draw_script(7) != ur_campaign.draw_script(8)
    lines = [line for seed in range(200) for line in ur_campaign.draw_script(seed)]
    assert {line.partition("@")[0] for line in lines} == {*DRAWS} - {"override", "hold"}


def test_a_seed_is_a_script() -> None:
    assert draw_script(7) == draw_script(7) != draw_script(8)
