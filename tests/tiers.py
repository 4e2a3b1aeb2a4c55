"""Cases of one test in two tiers: some for every change, all with `make test-all`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def quick_ones(quick: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """Return cases for `parametrize`, all but the quick ones marked as long.

    Args:
        quick: cases that run for every change.
        cases: all of them, in order; a tuple is one case of several arguments.
    """
    return [
        case
        if case in quick
        else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.long)
        for case in cases
    ]
