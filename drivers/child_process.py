"""A child process: a new interpreter in its own session, with inherited descriptors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.cycle_records import create_memory

_MAX_OUTPUT_BYTES: Final = 1 << 20  # bytes of output that are read


class _Text:
    """Memory that a child writes its output to."""

    def __init__(self, name: str) -> None:
        self.descriptor = create_memory(name, 0)
        self._final: str | None = None

    def read(self) -> str:
        """Return it up to now; after `close`, up to then."""
        if self._final is not None:
            return self._final
        size = min(os.fstat(self.descriptor).st_size, _MAX_OUTPUT_BYTES)
        return os.pread(self.descriptor, size, 0).decode(errors="replace")

    def close(self) -> None:
        """Release the memory; may be called again."""
        if self._final is None:
            self._final = self.read()
            os.close(self.descriptor)


class ChildProcess:
    """A Python program as a child; nothing of this process' main module is imported again in it.

    It is in its own session, so that the end of the terminal and Ctrl-C reach only the parent, and
    has no standard input. It imports from the same folders. Its standard output and error go to
    memory. Its death is seen by `alive`; how it detects that of the parent is its own affair (a
    heartbeat, or the end of a socket).

    Args:
        arguments: of the interpreter, such as ``("-m", "package.module")``.
        descriptors: that it inherits, by the same numbers.
        environment: changes of the environment.

    Raises:
        OSError: the system refuses it.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        *,
        descriptors: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._output = _Text("hil-child-stdout")
        self._errors = _Text("hil-child-stderr")
        try:
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=self._output.descriptor,
                stderr=self._errors.descriptor,
                pass_fds=descriptors,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": _import_path(), **(environment or {})},
            )
        except BaseException:
            self.close()
            raise
        self.pid = self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    @property
    def status(self) -> int | None:
        """Its exit status, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def errors(self) -> str:
        """Its standard error up to now; after `close`, up to then."""
        return self._errors.read()

    @property
    def output(self) -> str:
        """Its standard output up to now; after `close`, up to then."""
        return self._output.read()

    @property
    def last_error(self) -> str:
        """The last line of its standard error, or its exit status."""
        lines = self.errors.strip().splitlines()
        return lines[-1] if lines else f"exit status {self.status}"

    def wait(self, timeout: float | None = None) -> int | None:
        """Return its exit status, None if it still runs after `timeout` s."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout)
        return None

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.alive:
            self._process.send_signal(number)

    def terminate(self) -> None:
        """Request its end by SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self, timeout: float | None = None) -> None:
        """Kill it, and wait for its end, at most `timeout` s: it may hang in the kernel."""
        self._process.kill()
        self.wait(timeout)

    def close(self) -> None:
        """Release the memory of what it wrote; may be called again."""
        self._output.close()
        self._errors.close()


def _import_path() -> str:
    """Return the import path of this process: what is sent are objects of imported classes."""
    return os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
