"""Re-identification on a Dask cluster, whose workers may join, leave and die."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import CancelledError, Future
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeVar

from hil.errors import HilError, InputError
from hil.version import install_command

from .types import Unused
from .workers import ArchiveTask, Workers, software_versions

T = TypeVar("T")

_RETRIES: Final = 3  # of a task whose worker failed
_AHEAD: Final = 64  # tasks that are submitted, or more with more workers


class ClusterError(HilError):
    """The cluster is lost or cannot be used."""


class DaskWorkers(Workers):
    """The workers of a Dask cluster, which is imported when this is used.

    Args:
        address: of the scheduler, such as ``tcp://host:8786``.
        patience: longest wait for scheduler and workers [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time.
    """

    local = False

    def __init__(self, address: str, *, patience: float = 30.0) -> None:
        if find_spec("distributed") is None:
            problem = "a cluster needs the package distributed, which is not installed"
            remedy = f"install it with: {install_command('cluster')}"
            raise InputError(None, problem, field="--dask", remedy=remedy)
        from distributed import Client, KilledWorker

        client: Any = Client
        try:
            self._client = client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:
            problem = f"no Dask scheduler answers at {address} ({error or type(error).__name__})"
            remedy = "start one with: dask scheduler"
            raise InputError(None, problem, field="--dask", remedy=remedy) from error
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            self._client.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None
        threads = int(sum(self._client.nthreads().values()))
        executor = self._client.get_executor(pure=False, retries=_RETRIES)
        super().__init__(executor, max(_AHEAD, 4 * threads))
        self.died, self.software = (KilledWorker,), software_versions()

    def close(self) -> None:
        """Disconnect from the cluster."""
        self._executor.shutdown(wait=False)  # cancels what has not ended
        self._client.close()

    def require_folders(self, folders: Sequence[Path]) -> None:
        """Check that every worker has these folders under the same names.

        Raises:
            ClusterError: one does not.
        """
        for folder in folders:
            path = folder.resolve()
            for worker, seen in self._client.run(Path.exists, path, on_error="return").items():
                if seen is not True:
                    raise ClusterError(
                        f"the worker {worker} does not see {path}; share it with the workers under"
                        " the same name"
                    )

    def _result(self, task: ArchiveTask[T], future: Future[T | Unused]) -> T | Unused:
        try:
            return super()._result(task, future)
        except HilError:
            raise
        except CancelledError as error:
            raise ClusterError(
                "the Dask scheduler dropped the work: it was ended or restarted; finished results"
                " are in the cache"
            ) from error
        except Exception as error:
            raise ClusterError(
                f"a worker cannot run a task ({type(error).__name__}: {error}); install the same"
                " hil and constraints.txt on all machines"
            ) from error
