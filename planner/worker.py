"""Planning in child processes, whose crash is an exception in the parent.

ruckig can crash its process on valid input. A process that must not die, such as the supervisor of
a live arm, plans through `plan_in_child` or `in_child`, in a child that is started once and again
after a crash. Searches distribute tasks among children by `map_in_children`.

The child is a new interpreter, not a fork: it shares no locks, threads or memory with its parent
and never runs the parent's main module. It is in its own session, so that Ctrl-C reaches only the
parent, and it ends when its parent does, even during a call (`serve`).
"""

from __future__ import annotations

import atexit
import io
import os
import pickle
import resource
import select
import signal
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from time import monotonic
from typing import Any, Final, ParamSpec, Self, TypeAlias, TypeVar

from numpy.typing import ArrayLike

from planner.errors import PlannerCrashed, PlannerError, PlannerNotStarted, PlanningTimedOut
from planner.limits import JointLimits
from planner.moves import plan
from planner.piecewise_cubic import PiecewiseCubic

# Time after the timeout of a call at which the child kills itself [s].
_KILL_GRACE: Final = 1.0
# Time for a new interpreter to load numpy on a busy machine [s].
_START_TIMEOUT: Final = 60.0
_ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
_SERVE: Final = "import sys; from planner.worker import serve; serve(int(sys.argv[1]))"
# Consecutive starts that may fail, for an external reason such as full memory.
_MAX_FAILED_STARTS: Final = 2


def serve(descriptor: int) -> None:
    """Run the calls that arrive on an inherited socket.

    The process ends when the other end of the socket is closed, even during a call.
    """
    # Crashes are expected and must not fill the disk.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    connection: Connection[bytes, bytes] = Connection(descriptor)
    threading.Thread(target=_exit_on_hangup, args=(descriptor,), daemon=True).start()
    with suppress(EOFError, OSError):
        connection.send_bytes(b"ready")
        while True:
            connection.send_bytes(_outcome(connection.recv_bytes()))


def _exit_on_hangup(descriptor: int) -> None:
    """End this process when the other end of a socket is closed; leave received data there.

    PR_SET_PDEATHSIG would also end it with the *thread* of the parent that started it.
    """
    watched = select.poll()
    watched.register(descriptor, 0)  # hang-ups are always reported
    watched.poll()
    os._exit(0)


def _outcome(message: bytes) -> bytes:
    """Run a call; return its result and its exception, one of them None, packed."""
    try:
        timeout, function, args, kwargs = load(message)
        # SIGALRM also ends a solver that hangs in native code.
        signal.setitimer(signal.ITIMER_REAL, timeout + _KILL_GRACE)
        try:
            return pack((function(*args, **kwargs), None))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except Exception as error:
        if not isinstance(error, PlannerError):  # unexpected: add the traceback
            error.add_note(f"in the planning process:\n{traceback.format_exc()}")
        return pack((None, error))


def pack(message: object) -> bytes:
    """Return a message to a process as bytes."""
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(message)
    return buffer.getvalue()


def load(message: bytes) -> Any:
    """Return the message that `pack` serialised."""
    return pickle.loads(message)


class _Pickler(pickle.Pickler):
    """Pickles frozen dataclasses by their constructors, and exceptions of any signature.

    Without constructors arrays would lose their read-only flag; by default exceptions are restored
    from their message, which their constructors may not accept.
    """

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, Exception):
            return _restored, (type(obj), obj.args, vars(obj))
        if is_dataclass(obj) and not isinstance(obj, type):
            members = fields(obj)
            if all(field.init and not field.kw_only for field in members):
                return type(obj), tuple(getattr(obj, field.name) for field in members)
        return NotImplemented


def _restored(kind: type[Exception], args: tuple[Any, ...], state: dict[str, Any]) -> Exception:
    error = kind.__new__(kind, *args)
    error.args = args
    vars(error).update(state)
    return error


P = ParamSpec("P")
T = TypeVar("T")


class WorkerProcess:
    """A child process that calls functions of importable modules, one at a time.

    Arguments and results are copied. A call takes up to `timeout` s, the present one until
    `deadline` on the monotonic clock [s]; `connection` is readable when `receive` can return or
    raise.

    Raises, in `call`, `begin` and `receive`:
        PlannerCrashed: the child died; the next call starts another.
        PlannerNotStarted: the child died before its first call; the reason is on stderr.
        PlanningTimedOut: the call took too long; the next one starts another child.
        Exception: raised by the function.
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
        self._timeout = timeout
        self._process: subprocess.Popen[bytes] | None = None
        self._ready = False
        self.deadline = 0.0
        self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """Process id; None without a process."""
        return self._process.pid if self._process is not None else None

    def call(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Return the result of a function called in the child."""
        self.begin(function, *args, **kwargs)
        result: T = self.receive()
        return result

    def begin(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Begin a call, in a new child if the last one died; `receive` returns its result."""
        message = pack((self._timeout, function, args, kwargs))
        if self._process is None or (self._ready and self.connection.poll()):  # its end is closed
            self.close()
            self._start()
        self.deadline = monotonic() + self._timeout + (0.0 if self._ready else _START_TIMEOUT)
        try:
            self.connection.send_bytes(message)
        except ConnectionError:  # the child died meanwhile, which `receive` reports
            pass
        except BaseException:
            self.close()
            raise

    def wait(self, seconds: float) -> bool:
        """Return whether `receive` can return or raise within a number of seconds."""
        if not self._ready:
            if not self.connection.poll(seconds):
                return False
            with suppress(EOFError, ConnectionError):  # it died, which `receive` reports
                self.connection.recv_bytes()
                self._ready = True
                self.deadline = monotonic() + self._timeout
        return self.connection.poll(seconds)

    def receive(self) -> Any:
        """Return the result of the call that `begin` began, or raise its exception."""
        try:
            if not self._ready:
                self._read()
                self._ready = True
                self.deadline = monotonic() + self._timeout
            result, error = load(self._read())
        except (EOFError, ConnectionError):
            raise self._crashed() from None
        except BaseException:  # too late or interrupted: no other call may receive the result
            self.close()
            raise
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """End the process; a later call starts a new one."""
        if self._process is not None:
            self.connection.close()
            self._process.kill()
            self._process.wait()
            self._process = None

    def _read(self) -> bytes:
        if not self.connection.poll(max(0.0, self.deadline - monotonic())):
            raise PlanningTimedOut(self._timeout)
        return self.connection.recv_bytes()

    def _start(self) -> None:
        self.connection, other_end = Pipe()
        with other_end:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _SERVE, str(other_end.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[other_end.fileno()],
                start_new_session=True,
                env={
                    **os.environ,
                    **_ONE_THREAD,
                    "PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path),
                },
            )
        self._ready = False

    def _crashed(self) -> PlannerCrashed | PlannerNotStarted | PlanningTimedOut:
        """Return the error for the exit status of the child."""
        assert self._process is not None
        try:
            status = self._process.wait(1.0)
        except subprocess.TimeoutExpired:  # it closed its end of the socket without ending
            status = -signal.SIGKILL
        self.close()
        if not self._ready:
            return PlannerNotStarted(status)
        if status == -signal.SIGALRM:
            return PlanningTimedOut(self._timeout)
        return PlannerCrashed(status)


_lock = threading.Lock()
_warm: list[WorkerProcess] = []
# A fork that shared the child with its parent could receive the parent's results.
os.register_at_fork(after_in_child=_warm.clear)


def in_child(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Return the result of a function called in a shared child process, within 10 s.

    Calls from several threads are made one after the other. Raises as `WorkerProcess`.
    """
    with _lock:
        if not _warm:
            _warm.append(WorkerProcess())
        return _warm[0].call(function, *args, **kwargs)


def plan_in_child(
    via_points: ArrayLike, limits: JointLimits, *, speed: ArrayLike = 1.0, fly: float = 0.5
) -> PiecewiseCubic:
    """Plan as `planner.plan` does, in a child process.

    Args:
        via_points: positions (n_points, n_joints) [rad].
        limits: of the joints.
        speed: share of each joint's velocity limit.
        fly: how far corners are rounded, from 0 to 1.

    Raises:
        PlannerError: see `in_child`.
    """
    return in_child(plan, via_points, limits, speed=speed, fly=fly)


@atexit.register
def close_child() -> None:
    """End the shared child; the next call of `in_child` starts another."""
    with _lock:
        while _warm:
            _warm.pop().close()


Chunk: TypeAlias = Sequence[int]
Outcome: TypeAlias = T | PlannerCrashed | PlanningTimedOut


def chunks_of(count: int, size: int) -> list[range]:
    """Return the indices 0 to count - 1 in ranges of `size`; the last one may be shorter."""
    return [range(begin, min(begin + size, count)) for begin in range(0, count, size)]


def map_in_children(
    children: Sequence[WorkerProcess],
    function: Callable[..., Iterable[T]],
    chunks: Sequence[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
    *,
    done: Callable[[int], None] | None = None,
) -> list[Outcome[T]]:
    """Return the results of `stream_in_children` by index.

    Args:
        children: processes that work.
        function: called with the arguments of a chunk.
        chunks: of the work.
        arguments: of the function for a chunk.
        done: called with the number of results that have just come.
    """
    outcomes = dict(stream_in_children(children, function, chunks, arguments, done=done))
    return [outcomes[index] for index in range(len(outcomes))]


def stream_in_children(
    children: Sequence[WorkerProcess],
    function: Callable[..., Iterable[T]],
    chunks: Iterable[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
    *,
    done: Callable[[int], None] | None = None,
) -> Generator[tuple[int, Outcome[T]], None, None]:
    """Call a function chunk by chunk in child processes; a crash costs one item, not its chunk.

    The items of a chunk that crashes its process or times out are tried again one by one. A
    single item that crashes its process is tried once more, since the process may have been ended
    for another reason. The result of an item must not depend on the other items of its chunk.

    Args:
        children: at least one; on an interrupt, those at work are closed.
        function: importable in a child; returns one result for each index of its chunk.
        chunks: the indices 0 to count - 1, each once; iterated when a child is free.
        arguments: returns the arguments of the function for a chunk.
        done: called with the number of newly finished items.

    Yields each index with its result or its own error, in any order; raises PlannerNotStarted if a
    child died before its first call several times, and what the function raises.
    """
    fresh = iter(chunks)
    again = deque[Chunk]()
    crashed = set[int]()
    not_started = 0
    idle = list(children)
    busy: dict[Any, tuple[WorkerProcess, Chunk]] = {}
    outcomes: list[tuple[int, Outcome[T]]] = []
    try:
        while True:
            while idle and (chunk := again.popleft() if again else next(fresh, None)) is not None:
                child = idle.pop()
                child.begin(function, *arguments(chunk))
                busy[child.connection] = child, chunk
            if done is not None and outcomes:
                done(len(outcomes))
            yield from outcomes  # while children are at work
            if not busy:
                return
            nearest = min(child.deadline for child, _ in busy.values()) - monotonic()
            ready = wait(list(busy), max(0.0, nearest))
            late = [link for link, (child, _) in busy.items() if child.deadline <= monotonic()]
            outcomes = []
            for link in {*ready, *late}:
                child, chunk = busy.pop(link)
                idle.append(child)
                try:
                    outcomes += zip(chunk, child.receive(), strict=True)
                    not_started = 0
                except PlannerNotStarted:
                    not_started += 1
                    if not_started > _MAX_FAILED_STARTS:
                        raise
                    again.append(chunk)
                except (PlannerCrashed, PlanningTimedOut) as error:
                    first = chunk[0]
                    if len(chunk) > 1:
                        again.extend([index] for index in chunk)
                    elif isinstance(error, PlannerCrashed) and first not in crashed:
                        crashed.add(first)
                        again.append(chunk)
                    else:
                        outcomes.append((first, error))
    finally:  # after an exception, or if the generator is closed
        for child in children:
            if child not in idle:
                child.close()
