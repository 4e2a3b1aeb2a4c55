from __future__ import annotations

import operator
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner import (
    PlannerCrashed,
    WorkerProcess,
    chunks_of,
    map_in_children,
    stream_in_children,
)


@pytest.fixture
def importable(monkeypatch):
    """A child finds the functions of these tests under the name that they have here."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


@given(st.integers(0, 200), st.integers(1, 50))
def test_chunks_hold_every_index_once_in_order_and_only_the_last_is_short(count, size):
    chunks = chunks_of(count, size)
    assert [index for chunk in chunks for index in chunk] == list(range(count))
    assert all(len(chunk) == size for chunk in chunks[:-1])
    assert all(1 <= len(chunk) <= size for chunk in chunks)


def test_results_come_in_order_whoever_was_free():
    with WorkerProcess() as one, WorkerProcess() as other:
        results = map_in_children(
            [one, other], np.negative, chunks_of(50, 3), lambda chunk: (np.array(chunk),)
        )
    assert results == [-index for index in range(50)]


def test_what_the_function_raises_ends_the_map_and_the_children_go_on():
    with WorkerProcess() as child:
        with pytest.raises(ZeroDivisionError):
            map_in_children([child], operator.truediv, chunks_of(3, 2), lambda _: (1, 0))
        assert map_in_children([child], list, chunks_of(3, 2), lambda chunk: (chunk,)) == [0, 1, 2]


def killed_so_often(indices, folder, often):
    """Negate, but for the item 5, end the process so many times as if from outside."""
    for index in indices:
        count = len(list(Path(folder).iterdir()))
        if index == 5 and count < often:
            (Path(folder) / str(count)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return [-index for index in indices]


@pytest.mark.parametrize("size", [1, 4])
def test_an_item_whose_process_was_killed_from_outside_is_tried_again(size, tmp_path, importable):
    """A chunk of one as much as one of several, in whose company it was killed before."""
    with WorkerProcess() as child:
        results = map_in_children(
            [child],
            killed_so_often,
            chunks_of(9, size),
            lambda chunk: (list(chunk), str(tmp_path), 1 if size == 1 else 2),
        )
    assert results == [-index for index in range(9)]


def test_an_item_that_ends_every_process_is_believed_at_last(tmp_path, importable):
    with WorkerProcess() as child:
        results = map_in_children(
            [child],
            killed_so_often,
            chunks_of(9, 1),
            lambda chunk: (list(chunk), str(tmp_path), 99),
        )
    assert isinstance(results[5], PlannerCrashed)
    assert results[4] == -4 and results[6] == -6
    assert len(list(tmp_path.iterdir())) == 2


def test_a_child_killed_while_it_starts_is_started_again():
    with WorkerProcess() as one, WorkerProcess() as other:
        os.kill(one.pid, signal.SIGKILL)
        results = map_in_children([one, other], list, chunks_of(9, 3), lambda chunk: (chunk,))
    assert results == list(range(9))


def test_what_is_done_is_told_as_it_comes():
    told = []
    with WorkerProcess() as child:
        map_in_children([child], list, chunks_of(7, 3), lambda chunk: (chunk,), done=told.append)
    assert told == [3, 3, 1]


class TestStreamInChildren:
    def test_asks_for_a_chunk_when_a_child_is_free(self):
        asked = []

        def chunks():
            for index in range(50):
                asked.append(index)
                yield [index]

        with WorkerProcess() as child:
            results = stream_in_children([child], list, chunks(), lambda chunk: (chunk,))
            assert next(results) == (0, 0)
            assert asked == [0, 1]
            assert sorted(results) == [(index, index) for index in range(1, 50)]

    def test_a_break_costs_no_child_that_is_idle(self):
        with WorkerProcess() as one, WorkerProcess() as other:
            results = stream_in_children([one, other], list, [[0]], lambda chunk: (chunk,))
            assert next(results) == (0, 0)
            pids = one.pid, other.pid
            results.close()
            assert (one.pid, other.pid) == pids
