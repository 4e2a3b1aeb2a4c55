"""The ordinary fit that the board compares with."""

from __future__ import annotations

import numpy as np

from benchmarks.plain_fit import low_passed


def test_a_log_slower_than_the_cut_off_is_not_filtered() -> None:
    """At 15 rows a second nothing is above 10 Hz; at 30 something is."""
    values = np.random.default_rng(0).standard_normal((60, 2))
    slow, fast = (low_passed(np.arange(60) / rate, values, 10.0) for rate in (15.0, 30.0))
    np.testing.assert_array_equal(slow, values)
    assert fast.std() < 0.95 * values.std()
