from __future__ import annotations

from tests.process_death.command import require_unbroken


def test_whoever_is_killed_the_arm_rests_and_the_campaign_is_completed() -> None:
    require_unbroken(25, 25)
