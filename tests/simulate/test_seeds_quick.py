"""Simulated campaigns keep all laws, whatever befalls them: eight seeds for every change."""

from __future__ import annotations

from tests.simulate.many import stage_folder
from tests.simulate.seeds_in_ci import GROUPS, failures


def test_no_law_is_broken() -> None:
    with stage_folder() as root:
        assert failures(GROUPS[0], root) == []
