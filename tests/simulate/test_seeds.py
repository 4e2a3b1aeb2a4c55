"""Simulated campaigns keep all laws, whatever befalls them: two hundred seeds."""

from __future__ import annotations

from typing import Final

import pytest

from tests.simulate.seeds import failures

pytestmark = pytest.mark.safety

GROUPS: Final = (
    *(1, 2, 3, 4, 6, 8, 11, 13, 14, 15, 16, 18, 19),
    *(20, 22, 23, 28, 29, 30, 32, 33, 37, 83, 85, 148, 200),
)
"""Of eight seeds each: arms of one to seven joints, mostly in the longer cycle: it costs less."""


@pytest.mark.parametrize("group", GROUPS)
def test_no_law_is_broken(group: int) -> None:
    assert failures(group) == []
