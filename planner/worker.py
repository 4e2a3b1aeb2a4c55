"""Planning in processes of their own, where a crash is an error here and no more.

The solver behind the corners can crash its process on legal input. Whatever must not die, such
as the process that supervises a live arm, plans through `plan_in_child` or `in_child`: the child
is started once, held ready, and started anew after a crash. Searches share out many like tasks
among children by `map_in_children`, when any of them may end its process.

The child is a new interpreter, not a fork: it shares no locks, threads or memory with its parent
and never runs the parent's main module. It is in a session of its own, so that Ctrl-C reaches
only the parent, and ends at once when its parent does, even in the middle of a call (`serve`).
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
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from time import monotonic
from typing import Any, Final, ParamSpec, Self, TypeAlias, TypeVar

from numpy.typing import ArrayLike

from planner.errors import (
    NoCallPending,
    PlannerCrashed,
    PlannerError,
    PlannerNotStarted,
    PlanningTimedOut,
)
from planner.limits import JointLimits
from planner.moves import plan
from planner.piecewise_cubic import PiecewiseCubic

# How much later than its caller gives up a process ends itself, should its caller be gone [s].
_GRACE: Final = 1.0
# A new interpreter has numpy to load; on a busy machine that takes seconds.
_START_TIMEOUT: Final = 60.0
_ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
_SERVE: Final = "import sys; from planner.worker import serve; serve(int(sys.argv[1]))"
# How often a child that died before it could be asked anything is started anew: the reason may be
# somebody else's (a full memory, a kill), and a map may have hours of work behind it.
_FRESH_STARTS: Final = 2


def serve(descriptor: int) -> None:
    """Run the calls that arrive on an inherited socket, until its other end is closed.

    That its caller is gone ends the process in the middle of a call, too: nobody wants the result,
    and whoever begins the same again must not find it at work.
    """
    # A crash is expected here; it must not fill a disk.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    connection: Connection[bytes, bytes] = Connection(descriptor)
    threading.Thread(target=_end_with, args=(descriptor,), daemon=True).start()
    with suppress(EOFError, OSError):
        connection.send_bytes(b"ready")
        while True:
            connection.send_bytes(_outcome(connection.recv_bytes()))


def _end_with(descriptor: int) -> None:
    """End this process as soon as the other end of a socket is closed; what is sent is left there.

    A signal at the parent's death (PR_SET_PDEATHSIG) would come when the thread that started this
    process ends, which is no reason to.
    """
    watched = select.poll()
    watched.register(descriptor, 0)  # a hang-up is always reported
    watched.poll()
    os._exit(0)


def _outcome(message: bytes) -> bytes:
    """Return what a call returned and what it raised, one of them None."""
    try:
        timeout, function, args, kwargs = load(message)
        # Kills even a solver that hangs where no Python runs.
        signal.setitimer(signal.ITIMER_REAL, timeout + _GRACE)
        try:
            return pack((function(*args, **kwargs), None))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except Exception as error:
        if not isinstance(error, PlannerError):  # unexpected: where it happened is needed
            error.add_note(f"in the planning process:\n{traceback.format_exc()}")
        return pack((None, error))


def pack(message: object) -> bytes:
    """Return what is sent to a process, or a part of it, as bytes."""
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(message)
    return buffer.getvalue()


def load(message: bytes) -> Any:
    """Return what `pack` made into bytes."""
    return pickle.loads(message)


class _Pickler(pickle.Pickler):
    """Restores frozen dataclasses through their constructors, and errors of any signature.

    Pickle's own way with the first would forget that arrays are read-only; with the second it
    would call a constructor that wants numbers with the sentence it made of them.
    """

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, Exception):
            return _revived, (type(obj), obj.args, vars(obj))
        if is_dataclass(obj) and not isinstance(obj, type):
            own = fields(obj)
            if all(field.init and not field.kw_only for field in own):
                return type(obj), tuple(getattr(obj, field.name) for field in own)
        return NotImplemented


def _revived(kind: type[Exception], args: tuple[Any, ...], state: dict[str, Any]) -> Exception:
    error = kind.__new__(kind, *args)
    error.args = args
    vars(error).update(state)
    return error


P = ParamSpec("P")
T = TypeVar("T")


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
        NoCallPending: no call was begun in this process.
        Exception: whatever the function itself raised.
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
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
        """Return what the function returns in the child; one that died while idle is replaced."""
        self.begin(function, *args, **kwargs)
        result: T = self.receive()
        return result

    def begin(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Begin a call as `send` does; a child that died before, or as it started, is replaced."""
        for _ in range(_FRESH_STARTS):
            with suppress(PlannerCrashed, PlannerNotStarted):  # nothing of this call
                return self.send(function, *args, **kwargs)
        return self.send(function, *args, **kwargs)

    def send(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Begin a call, whose result `receive` then fetches."""
        message = pack((self._timeout, function, args, kwargs))
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
            raise NoCallPending("the planning process was asked nothing from here")
        try:
            if not self._greeted:
                self._read()
                self._greeted = True
                self.deadline = monotonic() + self._timeout
            result, error = load(self._read())
        except PlanningTimedOut:
            self._restart()
            raise
        except (EOFError, OSError):
            raise self._crashed() from None
        except BaseException:  # interrupted: what the child sends later belongs to nobody
            self.close()
            raise
        if error is not None:
            raise error
        return result

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


Chunk: TypeAlias = Sequence[int]
Outcome: TypeAlias = T | PlannerCrashed | PlanningTimedOut


def chunks_of(count: int, size: int) -> list[range]:
    """Return the indices 0 to count - 1 in runs of `size`, the last one maybe shorter."""
    return [range(begin, min(begin + size, count)) for begin in range(0, count, size)]


def map_in_children(
    children: Sequence[WorkerProcess],
    function: Callable[..., Iterable[T]],
    chunks: Sequence[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
    *,
    done: Callable[[int], None] | None = None,
) -> list[Outcome[T]]:
    """Return, for each index in order, what `stream_in_children` yields of it."""
    found = dict(stream_in_children(children, function, chunks, arguments, done=done))
    return [found[index] for index in range(len(found))]


def stream_in_children(
    children: Sequence[WorkerProcess],
    function: Callable[..., Iterable[T]],
    chunks: Iterable[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
    *,
    done: Callable[[int], None] | None = None,
) -> Generator[tuple[int, Outcome[T]], None, None]:
    """Call a function chunk by chunk in child processes; a crash costs one item, not its chunk.

    A chunk that ends its process, or takes longer than the children's time for one call, is tried
    again item by item, each with the whole time for itself. An item alone that ends its process is
    tried once more before that is believed: somebody else may have ended it. Chunks are handed out
    as children become free, so the function must give an item the same result in any company.

    Args:
        children: at least one; those at work are closed if this is interrupted, and start anew
            when used.
        function: importable in a child; returns one result for each index of its chunk.
        chunks: the indices 0 to count - 1, each once; asked for when a child is free.
        arguments: of the function, for some of the indices.
        done: called with a number of items whenever so many more have their result.

    Yields:
        Each index with its result, or with the error that it met alone, in any order.

    Raises:
        PlannerNotStarted: a child died before it was given anything to do, several times.
        Exception: whatever the function itself raised.
    """
    fresh, again = iter(chunks), deque[Chunk]()
    crashed, not_started = set[int](), Counter[int]()
    idle = list(children)
    busy: dict[Any, tuple[WorkerProcess, Chunk]] = {}
    found: list[tuple[int, Outcome[T]]] = []
    try:
        while True:
            while idle and (chunk := again.popleft() if again else next(fresh, None)) is not None:
                child = idle.pop()
                child.begin(function, *arguments(chunk))
                busy[child.connection] = child, chunk
            if done is not None and found:
                done(len(found))
            yield from found  # children are at work meanwhile
            if not busy:
                return
            nearest = min(child.deadline for child, _ in busy.values()) - monotonic()
            ready = wait(list(busy), max(0.0, nearest))
            late = [link for link, (child, _) in busy.items() if child.deadline <= monotonic()]
            found = []
            for link in {*ready, *late}:
                child, chunk = busy.pop(link)
                idle.append(child)
                try:
                    found += zip(chunk, child.receive(), strict=True)
                    not_started.pop(id(child), None)
                except PlannerNotStarted:
                    not_started[id(child)] += 1
                    if not_started[id(child)] > _FRESH_STARTS:
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
                        found.append((first, error))
    finally:  # after Ctrl-C, a fault of ours or a break: nobody will fetch what is under way
        for child in children:
            if child not in idle:
                child.close()
