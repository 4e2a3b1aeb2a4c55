from __future__ import annotations

import operator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner import PlanningChild, map_in_children
from planner.children import chunks_of


@given(st.integers(0, 200), st.integers(1, 50))
def test_chunks_hold_every_index_once_in_order_and_only_the_last_is_short(count, size):
    chunks = chunks_of(count, size)
    assert [index for chunk in chunks for index in chunk] == list(range(count))
    assert all(len(chunk) == size for chunk in chunks[:-1])
    assert all(1 <= len(chunk) <= size for chunk in chunks)


def test_results_come_in_order_whoever_was_free():
    with PlanningChild() as one, PlanningChild() as other:
        results = map_in_children(
            [one, other], np.negative, chunks_of(50, 3), lambda chunk: (np.array(chunk),)
        )
    assert results == [-index for index in range(50)]


def test_what_the_function_raises_ends_the_map_and_the_children_go_on():
    with PlanningChild() as child:
        with pytest.raises(ZeroDivisionError):
            map_in_children([child], operator.truediv, chunks_of(3, 2), lambda _: (1, 0))
        assert map_in_children([child], list, chunks_of(3, 2), lambda chunk: (chunk,)) == [0, 1, 2]
