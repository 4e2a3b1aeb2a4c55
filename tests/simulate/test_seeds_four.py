"""Simulated campaigns keep all laws, whatever befalls them: quarter four of two hundred seeds."""

from __future__ import annotations

import pytest

from tests.simulate.many import stage_folder
from tests.simulate.seeds_in_ci import failures, groups


@pytest.mark.parametrize("group", groups(3))
def test_no_law_is_broken(group: int) -> None:
    with stage_folder() as root:
        assert failures(group, root) == []
