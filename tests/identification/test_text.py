"""Percentages, numbers and durations in messages."""

from __future__ import annotations

import numpy as np
import pytest

from identification.text import duration_text, interval_text, number, percentage


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


class TestNumbers:
    @pytest.mark.parametrize(
        ("value", "digits", "text"),
        [
            (1324.4, 3, "1324"), (999.6, 3, "1000"), (27.53, 3, "27.5"), (-1850.0, 2, "-1850"),
            (0.0123, 2, "0.012"), (2.5e-6, 2, "2.5e-06"), (3.2e7, 3, "3.2e+07"), (np.inf, 3, "inf"),
        ],
    )  # fmt: skip
    def test_have_no_exponent_below_a_million(self, value: float, digits: int, text: str) -> None:
        assert number(value, digits) == text

    @pytest.mark.parametrize(
        ("seconds", "text"),
        [(27.53, "27.5 s"), (299.9, "300 s"), (1324.0, "22 min"), (12_300.0, "3.4 h")],
    )
    def test_of_a_duration_have_the_unit_that_people_use(self, seconds: float, text: str) -> None:
        assert duration_text(seconds) == text

    def test_of_an_interval_name_its_ends(self) -> None:
        assert interval_text(0.3, 1.25) == "0.3 to 1.25"
        assert interval_text(0.3, np.inf) == "above 0.3"
