"""Which late set-points of a UR the machine itself explains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import machine_stalls
from benchmarks.machine_stalls import merged, stalled_within
from benchmarks.turnaround_ends import WARM_UP
from benchmarks.turnaround_ur import PERIOD, summary

CYCLES = WARM_UP + 400
AT = WARM_UP + 200
"""Cycle of the fault of each case."""
NO_STALL = np.empty((0, 2))


def times(stalls: dict[int, np.ndarray]) -> dict[str, Any]:
    """A run in which each set-point comes 0.3 ms after its frame."""
    sent = PERIOD * np.arange(CYCLES, dtype=float)
    sent[0] = np.nan
    status = SimpleNamespace(late_packets=0, late=0, rejected=0)
    realtime = SimpleNamespace(
        scheduling="SCHED_FIFO 50", memory_locked=True, cpu_awake=True, refused=()
    )
    return {
        "sent": sent, "due": sent, "came": sent + 3e-4, "ended": CYCLES - 1,
        "exchange_cycle": np.arange(CYCLES - 1), "exchange_arrival": sent[1:] + 5e-5,
        "scheduling": "SCHED_FIFO 60", "status": status, "before": status, "realtime": realtime,
        "stalls": stalls, "page_faults": 0, "steal": 0, "busy": 0.2, "load": (0.1, 0.1, 0.1),
        "endings": [], "log": "",
    }  # fmt: skip


def found(run: dict[str, Any]) -> tuple[int, int, int]:
    figures = summary(run, CYCLES)
    return figures["late"], figures["late_by_stalls"], figures["late_otherwise"]


def test_a_punctual_run_has_no_late_set_point() -> None:
    assert found(times({0: NO_STALL, 1: NO_STALL})) == (0, 0, 0)


@pytest.mark.parametrize("processor", [0, 1])
def test_late_by_a_stall_of_any_processor(
    processor: int,
) -> None:
    run = times({0: NO_STALL, 1: NO_STALL})
    begin = run["sent"][AT] + 1e-4
    run["stalls"][processor] = np.array([[begin, begin + 0.0019]])
    run["came"][AT] = run["sent"][AT] + 0.0022
    assert found(run) == (1, 1, 0)


def test_late_for_longer_than_the_machine_stalled() -> None:
    run = times({0: NO_STALL, 1: NO_STALL})
    begin = run["sent"][AT] + 1e-4
    run["stalls"][1] = np.array([[begin, begin + 0.0004]])
    run["came"][AT] = run["sent"][AT] + 0.0026
    assert found(run) == (1, 0, 1)


def test_a_stall_at_another_time_excuses_nothing() -> None:
    run = times({0: NO_STALL, 1: NO_STALL})
    run["stalls"][0] = np.array([[run["sent"][AT - 50], run["sent"][AT - 50] + 0.01]])
    run["came"][AT] = run["sent"][AT] + 0.0026
    assert found(run) == (1, 0, 1)


def test_a_frame_left_out_is_late_until_the_next_set_point() -> None:
    run = times({0: NO_STALL, 1: NO_STALL})
    run["came"][AT] = np.nan
    run["came"][AT + 1] = run["sent"][AT + 1] + 5e-4
    assert found(run) == (1, 0, 1)
    begin = run["sent"][AT] + 1e-4
    run["stalls"][0] = np.array([[begin, begin + 0.002]])
    assert found(run) == (1, 1, 0)


def test_stalls_that_overlap_count_once() -> None:
    stalls = {0: np.array([[1.0, 1.5], [4.0, 4.1]]), 1: np.array([[1.2, 2.0]])}
    union = merged(stalls)
    assert union.tolist() == [[1.0, 2.0], [4.0, 4.1]]
    seconds = stalled_within(union, np.array([0.0, 1.5, 3.0]), np.array([5.0, 4.05, 3.5]))
    assert seconds == pytest.approx([1.1, 0.55, 0.0])


def test_stalls_of_all_processors_are_counted_apart() -> None:
    stalls = {0: np.array([[1.0, 1.5], [4.0, 4.1]]), 1: np.array([[1.2, 2.0]])}
    figures = machine_stalls.figures(stalls, 0.3)
    assert figures["stalls_of_all"] == 1
    assert (figures["stalls_of_0"], figures["stalls_of_0_above_a_cycle"]) == (2, 1)
