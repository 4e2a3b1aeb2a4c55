"""A Dask cluster as far as a batch needs one. Dask is imported here, and only when it is called."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from time import monotonic
from typing import Any, Final

from hil.errors import HilError, InputError
from hil.version import install_command

LOOK: Final = 2.0
"""s between looks at the cluster while nothing comes from it."""


class ClusterError(HilError):
    """The cluster is gone, or cannot be used."""


class Cluster:
    """The client's end of a cluster.

    Args:
        address: of its scheduler, such as ``tcp://host:8786``.
        patience: longest time to wait for a scheduler, and for a worker [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time.
    """

    def __init__(self, address: str, patience: float) -> None:
        self._patience = patience
        self._client = _connected(address, patience)
        self._threads = 1
        self._last_look = -LOOK
        self._last_seen = monotonic()
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            self.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None
        except BaseException:
            self.close()
            raise

    @property
    def connected(self) -> bool:
        """Whether the scheduler is there."""
        return bool(self._client.status == "running")

    @property
    def n_workers(self) -> int:
        """How many workers there are now."""
        return len(self._client.nthreads())

    def threads(self) -> int:
        """Threads of the workers, as of a moment ago; at least one."""
        if monotonic() - self._last_look > LOOK:
            self._last_look = monotonic()
            self._threads = max(1, sum(self._client.nthreads().values()))
        return self._threads

    def on_all(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """What a function returns or raises, by worker."""
        found: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        return found

    def submit(
        self, ended: Callable[[], None], function: Callable[..., Any], *arguments: Any, **how: Any
    ) -> Any:
        """Give out a call; its future.

        Args:
            ended: called, by another thread, when the call has ended in any way.
            function: importable on the workers.
            arguments: of the function; futures among them, also in lists, become their results.
            how: keywords of the function, and ``retries`` and ``priority`` of the call.
        """
        future = self._client.submit(function, *arguments, pure=False, **how)
        future.add_done_callback(lambda _: ended())
        return future

    def again(self, ended: Callable[[], None], future: Any) -> None:
        """Give out a call that failed once more."""
        future.retry()
        future.add_done_callback(lambda _: ended())

    def cancel(self, futures: Iterable[Any]) -> None:
        """Drop calls and results."""
        if self.connected:
            self._client.cancel(list(futures))

    def seen(self) -> None:
        """Something came from the cluster."""
        self._last_seen = monotonic()

    def check(self) -> None:
        """See whether there is still somebody to wait for.

        Raises:
            ClusterError: no scheduler, or no worker, for longer than the patience.
        """
        if self.connected and self.n_workers:
            self.seen()
        elif monotonic() - self._last_seen > self._patience:
            missing = "all workers" if self.connected else "the scheduler"
            raise ClusterError(
                f"{missing} of the Dask cluster went away and did not come back within "
                f"{self._patience:g} s; what was finished is kept in the cache"
            )

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()


def killed(future: Any) -> bool:
    """Whether a call failed because every worker that took it up died."""
    from distributed import KilledWorker

    return isinstance(future.exception(), KilledWorker)


def require_dask() -> None:
    """Refuse what could not be computed, before time is spent on it.

    Raises:
        InputError: Dask is not installed.
    """
    if find_spec("distributed") is None:
        raise InputError(
            None,
            "a cluster needs the package distributed, which is not installed",
            field="--dask",
            remedy=f"install it with: {install_command('cluster')}",
        )


def _connected(address: str, patience: float) -> Any:
    require_dask()
    from distributed import Client

    client: Any = Client
    try:
        return client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            None,
            f"no Dask scheduler answers at {address} ({str(error) or type(error).__name__})",
            field="--dask",
            remedy="start one with: dask scheduler",
        ) from error
