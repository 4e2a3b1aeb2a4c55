"""Linear algebra on one thread, unless the environment sets another number.

The matrices of an identification are small: threads would wait for each other for most of the time,
and the rounding of sums would depend on their number.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from threadpoolctl import threadpool_limits

VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Of the environment, read by the libraries when they are loaded."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit libraries that are loaded already, as in a notebook; also a decorator."""
    if any(variable in os.environ for variable in VARIABLES):
        yield
        return
    with threadpool_limits(1, user_api="blas"):
        yield
