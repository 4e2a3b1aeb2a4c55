"""Planning in a process of its own, where a crash is an error here and no more.

The solver behind the corners can crash its process on legal input. Whatever must not die, such
as the process that supervises a live arm, plans through `plan_in_child` or `in_child`: the child
is started once, held ready, and started anew after a crash. Search workers (`planner.children`) are
made of the same children.

The child is a new interpreter, not a fork: it shares no locks, threads or memory with its parent
and never runs the parent's main module. It is in a session of its own, so that Ctrl-C reaches
only the parent, and ends at once when its parent does, even in the middle of a call.
"""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from time import monotonic
from typing import Any, Final, ParamSpec, Self, TypeVar

from numpy.typing import ArrayLike

from planner.errors import (
    PlannerCrashed,
    PlannerNotStarted,
    PlannerOutOfStep,
    PlanningTimedOut,
)
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic
from planner.plan import plan
from planner.remote import Task, load, numbered, pack, unnumbered

P = ParamSpec("P")
T = TypeVar("T")

# A new interpreter has numpy to load; on a busy machine that takes seconds.
_START_TIMEOUT = 60.0
_ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
_SERVE = "import sys; from planner.remote import serve; serve(int(sys.argv[1]))"


class WorkerProcess:
    """A process that calls functions for this one, one at a time.

    A function is known to the child by the name it is imported under, so it must belong to a
    module that can be imported (not to a script being run). Arguments and results are copied.
    A fork of this process that goes on using the handle gets a child of its own.

    Args:
        timeout: Longest time one call may take [s].

    Attributes:
        deadline: When the call that was begun must have ended, on the monotonic clock [s].

    Raises, in `call`, `send` and `receive`:
        PlannerCrashed: the process died (in `call`: over it); a new one is on its way.
        PlannerNotStarted: it died before it could be asked anything; why is on stderr.
        PlanningTimedOut: the call took too long; likewise a new one is on its way.
        PlannerOutOfStep: there is an answer, but not to the call begun last in this process.
        Exception: whatever the function itself raised.
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
        self._number = 0
        self._owner = os.getpid()
        self._timeout = timeout
        self._process: subprocess.Popen[bytes] | None = None
        self._greeted = False
        self.deadline = 0.0
        self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def connection(self) -> Connection[Any, Any]:
        """Becomes readable when `receive` has something to return or to raise."""
        return self._connection

    @property
    def pid(self) -> int | None:
        """Process id; None once closed."""
        self._disown()
        return self._process.pid if self._process is not None else None

    def call(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Return what the function returns in the child.

        A child that has answered before and died while it was idle is replaced.
        """
        try:
            self.send(function, *args, **kwargs)
        except PlannerCrashed:  # nothing of this call: the system may have needed its memory
            self.send(function, *args, **kwargs)
        result: T = self.receive()
        return result

    def send(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Begin a call, whose result `receive` then fetches."""
        self._number += 1
        message = numbered(self._number, pack(Task(self._timeout, function, args, kwargs)))
        self._disown()
        if self._process is None:
            self._start()
        self.deadline = monotonic() + self._timeout + (0.0 if self._greeted else _START_TIMEOUT)
        try:
            self._connection.send_bytes(message)
        except OSError:  # it died while it had nothing to do
            raise self._crashed() from None
        except BaseException:
            self.close()
            raise

    def receive(self) -> Any:
        """Return the result of the call that `send` began, or raise what it raised."""
        self._disown()
        if self._process is None:
            raise PlannerOutOfStep
        try:
            if not self._greeted:
                self._read()
                self._greeted = True
                self.deadline = monotonic() + self._timeout
            number, message = unnumbered(self._read())
            if number != self._number:
                raise PlannerOutOfStep
            answer = load(message)
        except (PlanningTimedOut, PlannerOutOfStep):
            self._restart()
            raise
        except (EOFError, OSError):
            raise self._crashed() from None
        except BaseException:  # interrupted: what the child sends later belongs to nobody
            self.close()
            raise
        if answer.error is not None:
            raise answer.error
        return answer.result

    def close(self) -> None:
        """End the process; a later call starts a new one."""
        self._disown()
        if self._process is None:
            return
        self._connection.close()
        self._process.kill()
        self._process.wait()
        self._process = None

    def _disown(self) -> None:
        """In a fork, let go of the child of the process it was forked from, and leave it alive."""
        if self._owner == os.getpid():
            return
        self._owner = os.getpid()
        if self._process is not None:
            self._connection.close()  # this copy of it only
            self._process.returncode = 0  # there is nothing here to wait for
            self._process = None

    def _read(self) -> bytes:
        if not self._connection.poll(max(0.0, self.deadline - monotonic())):
            raise PlanningTimedOut(self._timeout)
        return self._connection.recv_bytes()

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _SERVE, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env={
                    **os.environ,
                    **_ONE_THREAD,
                    # What this process can import, that one can.
                    "PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path),
                },
            )
        self._greeted = False

    def _restart(self) -> None:
        self.close()
        self._start()

    def _crashed(self) -> PlannerCrashed | PlannerNotStarted | PlanningTimedOut:
        """Return the error that tells how the process ended; start another if it ever ran."""
        assert self._process is not None
        try:
            status = self._process.wait(1.0)
        except subprocess.TimeoutExpired:  # it closed its end, yet lives: of no use either way
            status = -signal.SIGKILL
        if not self._greeted:
            self.close()
            return PlannerNotStarted(status)
        self._restart()
        if status == -signal.SIGALRM:  # by its own clock
            return PlanningTimedOut(self._timeout)
        return PlannerCrashed(status)


_lock = threading.Lock()
_warm: list[WorkerProcess] = []


def in_child(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Return what a function of this package returns, called in a child process held ready.

    Calls from several threads take turns. A call that takes longer than 10 s is ended.

    Raises:
        PlannerCrashed: the child died; the next call finds a new one.
        PlannerNotStarted: it could not even be started.
        PlanningTimedOut: it took too long.
        Exception: whatever the function itself raised.
    """
    with _lock:
        return _warm_child().call(function, *args, **kwargs)


def in_child_now(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Return the same, for who cannot wait until a process has started: none is replaced.

    Raises:
        PlannerCrashed: the child died, over this call or before it.
        Exception: as `in_child`.
    """
    with _lock:
        child = _warm_child()
        child.send(function, *args, **kwargs)
        result: T = child.receive()
        return result


def _warm_child() -> WorkerProcess:
    if not _warm:
        _warm.append(WorkerProcess())
    return _warm[0]


def plan_in_child(
    via_points: ArrayLike, limits: JointLimits, *, speed: ArrayLike = 1.0, fly: float = 0.5
) -> PiecewiseCubic:
    """Plan as `planner.plan` does, in a child process; see `in_child` for what it may raise."""
    return in_child(plan, via_points, limits, speed=speed, fly=fly)


def close_child() -> None:
    """End the child that `in_child` keeps warm; the next call starts another."""
    with _lock:
        while _warm:
            _warm.pop().close()


def _after_fork() -> None:
    """Let go of what a fork has a copy of: the child, and a lock that a thread may have held."""
    global _lock
    _lock = threading.Lock()
    while _warm:
        _warm.pop().close()


atexit.register(close_child)
os.register_at_fork(after_in_child=_after_fork)
