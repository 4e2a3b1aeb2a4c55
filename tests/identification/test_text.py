"""Percentages in messages."""

from __future__ import annotations

import numpy as np
import pytest

from identification.text import percentage


class TestPercentages:
    @pytest.mark.parametrize(
        ("share", "decimals", "text"),
        [(0.0147, 1, "1.5 %"), (0.2, 0, "20 %"), (-0.05, 0, "-5 %"), (np.nan, 1, "nan %")],
    )
    def test_have_a_space_before_the_sign(self, share: float, decimals: int, text: str) -> None:
        assert percentage(share, decimals) == text

    @pytest.mark.parametrize(("share", "text"), [(0.1, "+10.0 %"), (-0.1, "-10.0 %")])
    def test_of_a_change_have_a_sign(self, share: float, text: str) -> None:
        assert percentage(share, 1, signed=True) == text
