"""Simulated campaigns keep all laws, whatever befalls them: the first eight seeds."""

from __future__ import annotations

import pytest

from tests.simulate.seeds import failures

pytestmark = pytest.mark.safety


def test_no_law_is_broken() -> None:
    assert failures(0) == []
