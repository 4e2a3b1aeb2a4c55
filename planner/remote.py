"""What runs in a planning process, and how calls travel to it and back."""

from __future__ import annotations

import io
import os
import pickle
import resource
import select
import signal
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, cast

from planner.errors import PlannerError

# How much later than its caller gives up a process ends itself, should its caller be gone.
_GRACE = 1.0
# Bytes of the number of a call, which stands before the call and before its answer.
_NUMBER = 8


class Task(NamedTuple):
    """A call, and how long it may take [s]."""

    timeout: float
    function: Callable[..., object]
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]


class Answer(NamedTuple):
    """What a call returned or raised."""

    result: object
    error: Exception | None


def serve(descriptor: int) -> None:
    """Answer calls that arrive on an inherited socket, until its other end is closed.

    That its caller is gone ends the process in the middle of a call, too: nobody wants the answer,
    and whoever begins the same again must not find it at work.
    """
    # A crash is expected here; it must not fill a disk.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    connection: Connection[bytes, bytes] = Connection(descriptor)
    threading.Thread(target=_end_with, args=(descriptor,), daemon=True).start()
    try:
        connection.send_bytes(b"ready")
        while True:
            number, message = unnumbered(connection.recv_bytes())
            connection.send_bytes(numbered(number, _answer(message)))
    except (EOFError, OSError):
        return


def _end_with(descriptor: int) -> None:
    """End this process as soon as the other end of a socket is closed; what is sent is left there.

    A signal at the parent's death (PR_SET_PDEATHSIG) would come when the thread that started this
    process ends, which is no reason to.
    """
    watched = select.poll()
    watched.register(descriptor, 0)  # a hang-up is always told
    watched.poll()
    os._exit(0)


def numbered(number: int, message: bytes) -> bytes:
    """Return a message under the number of its call: outside of it, so that it is always known."""
    return number.to_bytes(_NUMBER, "big") + message


def unnumbered(message: bytes) -> tuple[int, bytes]:
    """Return the number of a call and the message that stood under it."""
    return int.from_bytes(message[:_NUMBER], "big"), message[_NUMBER:]


def pack(message: object) -> bytes:
    """Return a message as bytes: a `Task`, an `Answer`, or what one of them is to carry."""
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(message)
    return buffer.getvalue()


def load(message: bytes) -> Any:
    """Return the message that `pack` made into bytes."""
    return pickle.loads(message)


def _answer(message: bytes) -> bytes:
    try:
        timeout, function, args, kwargs = cast(Task, load(message))
        # Kills even a solver that hangs where no Python runs.
        signal.setitimer(signal.ITIMER_REAL, timeout + _GRACE)
        try:
            result = function(*args, **kwargs)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        return pack(Answer(result, None))
    except Exception as error:
        if not isinstance(error, PlannerError):  # unexpected: where it happened is needed
            error.add_note(f"in the planning process:\n{traceback.format_exc()}")
        return pack(Answer(None, error))


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
