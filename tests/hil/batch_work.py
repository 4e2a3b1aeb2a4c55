"""Work for the workers of a batch: no archives, but all their woes. Their processes import it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.batch.workers import ArchiveTask, Part
from hil.errors import ArchiveError

Array = NDArray[np.float64]


def identity() -> str:
    """Digest of the code, of a worker that has other code where its environment says so."""
    return os.environ.get("TEST_IDENTITY", "the code of the test")


def add(first: Array, second: Array) -> Array:
    return first + second


def numbers(seed: int) -> Part[Array, int]:
    """Numbers of very different size, of which another order has another sum."""
    rng = np.random.default_rng(seed)
    return Part(rng.standard_normal(500) * 10.0 ** rng.uniform(-8, 8, 500), seed)


def slow_numbers(seed: int) -> Part[Array, int]:
    time.sleep(0.1)
    return numbers(seed)


def marked(path: str) -> Part[Array, int]:
    """Leaves a file behind that says it was begun."""
    Path(path).touch()
    return slow_numbers(int(Path(path).name))


def from_file(path: str) -> Part[Array, int]:
    if not Path(path).exists():
        raise ArchiveError(path, "cannot be read: No such file or directory")
    return numbers(int(Path(path).read_text()))


def faulty(_: int) -> Part[Array, int]:
    return [][0]


def crash(_: int) -> Part[Array, int]:
    os.kill(os.getpid(), signal.SIGSEGV)
    raise AssertionError


def hang(_: int) -> Part[Array, int]:
    time.sleep(600.0)
    raise AssertionError


def kill_worker(_: int) -> Part[Array, int]:
    """Kill the worker, as the kernel does where memory runs out."""
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(600.0)
    raise AssertionError


def task(function, argument) -> ArchiveTask[Array, int]:
    return ArchiveTask(f"{function.__name__}-{argument}.mcap", function, (argument,))
