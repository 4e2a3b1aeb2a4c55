"""Percentages in messages."""

from __future__ import annotations

import numpy as np
import pytest

from identification.text import filled, percentage


class TestPercentages:
    @pytest.mark.parametrize(
        ("share", "decimals", "text"),
        [(0.0147, 1, "1.5 %"), (0.2, 0, "20 %"), (-0.05, 0, "-5 %"), (np.nan, 1, "nan %")],
    )
    def test_have_a_space_before_the_sign(self, share: float, decimals: int, text: str) -> None:
        assert percentage(share, decimals) == text

    def test_of_a_template_have_it_too(self) -> None:
        text = filled("{a:+.1%} and {b[0]:.2g} {c.real:.0%}", a=0.1, b=[3.0], c=np.float64(1.0))
        assert text == "+10.0 % and 3 100 %"
