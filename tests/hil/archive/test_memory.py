"""Archives are read and repaired chunk by chunk, whatever their length."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.record import cycle_dtype
from hil.archive import ArchiveWriter, open_archive
from hil.archive.check import check_archive
from hil.archive.repair import repair

CYCLES = 8_000
CONTENT = CYCLES * 1100  # bytes of messages, about
WORK = 3_000_000


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = np.zeros(CYCLES, cycle_dtype(6))
    rows["cycle"] = np.arange(CYCLES)
    rows["position"] = np.random.default_rng(1).normal(size=(CYCLES, 6))
    file = tmp_path_factory.mktemp("memory") / "move_000_a1.mcap"
    names = tuple(f"joint_{i}" for i in range(6))
    with ArchiveWriter(file, joint_names=names, period=0.001, metadata={}, durable=False) as w:
        for start in range(0, CYCLES, 1000):
            w.write(rows[start : start + 1000])
        w.close("completed")
    return file


def peak(action: Callable[[], object]) -> int:
    """Most bytes that an action had allocated at a time."""
    tracemalloc.start()
    kept = action()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    del kept
    return most


def test_reading_one_column_takes_little_more_than_the_column(path):
    column = CYCLES * 8
    assert CONTENT > 2.5 * WORK
    assert peak(lambda: open_archive(path, fields=["cycle"])) < 3 * column + WORK


def test_a_range_takes_little_whatever_the_length(path):
    assert peak(lambda: open_archive(path, start=1.0, stop=1.1)) < WORK


def test_checking_and_repairing_hold_a_chunk_at_a_time(path):
    assert peak(lambda: check_archive(path)) < WORK
    torn = path.with_name("torn.mcap")
    torn.write_bytes(path.read_bytes()[:-5000])
    assert peak(lambda: repair(torn)) < WORK
