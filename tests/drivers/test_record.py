from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers import CycleRing, cycle_dtype
from drivers.record import COMMANDED, MEASURED


def put(ring: CycleRing, count: int, first: int = 0) -> None:
    for cycle in range(first, first + count):
        ring.cycle[ring.slot] = cycle
        ring.commit()


def test_a_record_has_the_documented_fields():
    dtype = cycle_dtype(6)
    scalars = {"cycle": "i8", "number": "i4", "arrival": "f8", "gap": "i4", "interval": "i4"}
    for name, kind in {**scalars, "state": "u1", "status": "u1"}.items():
        assert dtype[name] == np.dtype(kind)
    assert dtype["mode"] == np.dtype(("i4", (6,)))
    for name in (*MEASURED, *COMMANDED):
        assert dtype[name] == np.dtype(("f8", (6,)))


def test_block_views_and_fields_are_the_same_memory():
    ring = CycleRing(3, 4)
    ring.measured[2] = np.arange(24).reshape(8, 3)
    ring.commanded[2] = [[-1, -2, -3], [-4, -5, -6]]
    row = ring.rows[2]
    for index, name in enumerate(MEASURED):
        np.testing.assert_array_equal(row[name], [3 * index, 3 * index + 1, 3 * index + 2])
    np.testing.assert_array_equal(row["commanded_position"], [-1, -2, -3])
    np.testing.assert_array_equal(row["commanded_velocity"], [-4, -5, -6])
    assert not ring.rows[1]["position"].any()


@given(st.lists(st.integers(0, 12), max_size=20))
def test_what_is_drained_is_everything_but_what_was_overwritten(batches):
    ring = CycleRing(1, 8)
    written, drained = 0, []
    for batch in batches:
        put(ring, batch, written)
        written += batch
        drained += ring.drain()["cycle"].tolist()
    assert ring.overflow == written - len(drained)
    assert drained == sorted(set(drained))
    lost = sum(max(0, batch - 8) for batch in batches)
    assert ring.overflow == lost


def test_the_newest_records_are_kept_when_nobody_drains():
    ring = CycleRing(2, 8)
    put(ring, 20)
    assert ring.overflow == 12
    assert ring.drain()["cycle"].tolist() == list(range(12, 20))
    assert ring.overflow == 12


def test_last_looks_back_over_what_was_drained():
    ring = CycleRing(2, 8)
    put(ring, 5)
    ring.drain()
    put(ring, 2, 5)
    assert ring.last(4)["cycle"].tolist() == [3, 4, 5, 6]
    assert ring.last(50)["cycle"].tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert ring.drain()["cycle"].tolist() == [5, 6]


def test_drained_records_are_copies():
    ring = CycleRing(1, 4)
    put(ring, 4)
    drained = ring.drain()
    put(ring, 4, 100)
    assert drained["cycle"].tolist() == [0, 1, 2, 3]
