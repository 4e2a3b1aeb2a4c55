"""Percentiles from bins: never too short, and not much too long."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.exchange.control import BINS, SHORTEST, bin_of, quantile, upper_edge

WIDTH = 2.0**0.25
"""From one bin to the next, a fifth at most."""
LONGEST = upper_edge(BINS - 2)

latencies = st.floats(SHORTEST, LONGEST)


def counted(seconds) -> list[int]:
    counts = [0] * BINS
    for one in seconds:
        counts[bin_of(one)] += 1
    return counts


@given(latencies)
def test_each_latency_is_at_most_the_edge_of_its_bin_and_above_that_of_the_one_before(seconds):
    edge = upper_edge(bin_of(seconds))
    assert seconds <= edge * (1.0 + 1e-12)
    assert edge <= max(seconds, SHORTEST) * WIDTH * (1.0 + 1e-12)


@pytest.mark.parametrize("seconds", [0.0, -1e-3, math.nan, SHORTEST])
def test_what_is_shorter_than_the_first_edge_or_no_number_is_in_the_first_bin(seconds):
    assert bin_of(seconds) == 0


@pytest.mark.parametrize("seconds", [1.0, 1e300, math.inf])
def test_what_is_longer_than_all_is_in_the_last_which_has_no_end(seconds):
    assert bin_of(seconds) == BINS - 1
    assert upper_edge(BINS - 1) == math.inf
    assert 5e-3 < LONGEST < 6e-3


@given(st.lists(latencies, min_size=1), st.floats(0.0, 1.0, exclude_min=True))
def test_a_quantile_is_not_exceeded_by_its_share_and_by_no_more_than_a_bin_too_long(found, share):
    told = quantile(counted(found), share)
    assert told is not None
    needed = sorted(found)[max(0, math.ceil(share * len(found) - 1e-9) - 1)]
    assert needed <= told * (1.0 + 1e-12)
    assert told <= needed * WIDTH * (1.0 + 1e-12)


def test_a_share_of_nothing_is_the_shortest_there_was():
    assert quantile(counted([1e-3]), 0.0) == upper_edge(bin_of(1e-3))


def test_without_an_answer_there_is_none():
    assert quantile([0] * BINS, 0.5) is None
