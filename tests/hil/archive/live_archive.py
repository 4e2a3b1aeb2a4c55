"""An archive that is being written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from drivers.cycle_records import cycle_dtype
from drivers.drive_train import DriveTrain
from hil.archive import live
from hil.archive.live import LiveView, Serve

NAMES = ("shoulder", "elbow")
PERIOD = 0.001


def drives() -> DriveTrain:
    ones = np.ones(2)
    return DriveTrain(
        gear_ratio=np.array([100.0, -50.0]),
        calibration=0.0 * ones,
        joint_sign=ones,
        joint_offset=0.0 * ones,
        torque_constant=np.array([0.5, 0.25]),
        current_limit=20.0 * ones,
    )


def records(first: int, count: int) -> np.ndarray[Any, np.dtype[np.void]]:
    rows = np.zeros(count, cycle_dtype(2))
    rows["cycle"] = np.arange(first, first + count)
    rows["position"] = rows["cycle"][:, None] * [1e-3, -1e-3]
    rows["target_current"] = [2.0, 4.0]
    return rows


@contextmanager
def served(rate: float = 50.0) -> Iterator[live.LivePublisher]:
    publisher = live.LivePublisher(Serve(1, LiveView(port=0, rate=rate), NAMES, PERIOD, drives()))
    try:
        yield publisher
    finally:
        publisher.close()
