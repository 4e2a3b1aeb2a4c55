"""Arrays that are near others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.near import near

ONES = np.ones((3, 2))


@pytest.mark.parametrize("change", [0.0, 0.9e-6, 1.1e-6, np.nan, np.inf])
@pytest.mark.parametrize("tolerances", [{}, {"abs": 1e-6}, {"rel": 1e-7}, {"rel": 0.1, "abs": 0.2}])
def test_it_is_as_approx(change: float, tolerances: dict[str, Any]) -> None:
    changed = ONES.copy()
    changed[1, 1] += change
    assert (changed == near(ONES, **tolerances)) == (changed == pytest.approx(ONES, **tolerances))
    assert (near(changed, **tolerances) == ONES) == (pytest.approx(changed, **tolerances) == ONES)


def test_another_shape_is_not_near() -> None:
    assert ONES[:1] != near(ONES)
