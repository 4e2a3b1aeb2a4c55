"""What came while no archive was open: the newest of it, of the session that began last."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.packet_records import PACKET_DTYPE
from drivers.record import cycle_dtype
from hil.archive.process import RECENT, Recent


def records(*cycles: int) -> NDArray[np.void]:
    rows = np.zeros(len(cycles), cycle_dtype(2))
    rows["cycle"] = cycles
    return rows


def packets(*cycles: int) -> NDArray[np.void]:
    """Both directions of each cycle."""
    rows = np.zeros(2 * len(cycles), PACKET_DTYPE)
    rows["cycle"] = np.repeat(cycles, 2)
    return rows


@pytest.mark.parametrize("batch", [7, 20, 333, 2 * RECENT])
def test_records_and_their_packets_go_together(batch: int) -> None:
    recent, cycles = Recent(), range(3 * RECENT)
    for begin in cycles[::batch]:
        part = cycles[begin : begin + batch]
        recent.keep(records(*part), [], packets(*part))
    kept, _, kept_packets = recent.take_session()
    assert RECENT <= len(kept) < RECENT + batch
    assert kept["cycle"].tolist() == list(cycles[-len(kept) :])
    assert kept_packets["cycle"].tolist() == np.repeat(kept["cycle"], 2).tolist()


def test_only_the_session_that_began_last_counts_and_is_given_once() -> None:
    recent = Recent()
    recent.keep(records(7, 8, 0, 1), [], packets(7, 8, 0, 1))
    recent.keep(records(2), [], packets(2))
    kept, events, kept_packets = recent.take_session()
    assert kept["cycle"].tolist() == [0, 1, 2]
    assert kept_packets["cycle"].tolist() == [0, 0, 1, 1, 2, 2]
    assert not events
    assert not len(recent.take_session().records)
