"""A plugin of pytest for `make mutants`: the quickest tests first, so that a change is found soon.

mutmut gives the tests of a change in no order; a conversation of seconds may come before the test
of milliseconds that finds it.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

STATISTICS = Path("mutmut-stats.json")
"""Durations of the tests, which mutmut measures first; in the folder in which it runs them."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if STATISTICS.exists():
        durations = json.loads(STATISTICS.read_text())["duration_by_test"]
        items.sort(key=lambda item: durations.get(item.nodeid, 0.0))
