"""A thread of this process that executes the tasks of few archives, in place of a Dask cluster.

Dask's own cluster in a thread takes half a second to import, to start and to end, which is twice
as long as a batch of a hundred cached archives. Its scheduler without a cluster, `dask.get`, takes
0.09 s to import, a quarter of a batch of two hundred.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class ThreadFuture(Future[Any]):
    """A future with what a `Cluster` uses of one of Dask."""

    def __init__(self, key: str) -> None:
        super().__init__()
        self.key = key

    @property
    def status(self) -> str:
        """How the task ended, in Dask's words; it must have."""
        return "error" if self.exception() is not None else "finished"


class ThreadClient:
    """What a `Cluster` uses of a client of Dask: tasks are executed in the order of submission."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1)

    def submit(
        self, function: Callable[..., Any], *arguments: Any, key: str, pure: bool
    ) -> ThreadFuture:
        """Submit a call; futures in its arguments, also in lists of them, become their results."""
        del pure  # no result is looked up by its arguments
        future = ThreadFuture(key)
        self._pool.submit(_execute, future, function, arguments)
        return future

    def close(self) -> None:
        """Wait for the task that is executed, and cancel the others."""
        self._pool.shutdown(cancel_futures=True)


def _execute(
    future: ThreadFuture, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    try:
        result = function(*map(_with_results, arguments))
    except BaseException as error:  # of any kind: somebody waits for the future
        future.set_exception(error)
    else:
        future.set_result(result)


def _with_results(argument: Any) -> Any:
    if isinstance(argument, ThreadFuture):
        return argument.result()
    return [*map(_with_results, argument)] if isinstance(argument, list) else argument
