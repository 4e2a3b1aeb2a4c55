"""What a trend says in words."""

from __future__ import annotations

import pytest

from hil.fleet.messages import limit_text
from hil.fleet.trend import LimitReached
from hil.fleet.trend_limits import TrendLimit

LIMIT = TrendLimit("friction", 0.5)


class TestLimitReached:
    @pytest.mark.parametrize(
        ("earliest", "latest", "text"),
        [
            ("2026-06-02", "2026-09-30", "July 2026 (June 2026 to September 2026)"),
            ("2026-07-02", "2026-07-30", "July 2026"),
            ("2026-07-02", None, "July 2026 (July 2026 to later)"),
        ],
    )
    def test_has_an_interval_that_is_longer_than_its_month(self, earliest, latest, text):
        reached = LimitReached(LIMIT, "2026-07-14", earliest, latest)
        assert limit_text(reached) == f"reaches friction +50 % in {text}"
