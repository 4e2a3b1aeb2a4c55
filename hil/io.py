"""Files and folders: SHA-256 digests, and the lock of a folder that goes with its process."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from hil.reading import opened

_FLAGS: Final = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""The folder may come from elsewhere: no link is followed, and no pipe waited for."""
_PAUSE: Final = 0.02


def digest(content: str | bytes) -> str:
    """Digest of a text, as UTF-8, or of bytes."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def json_digest(value: Any) -> str:
    """Digest of a JSON value; the order of keys does not count."""
    return digest(json.dumps(value, sort_keys=True))


def file_digest(path: Path) -> str:
    """Digest of all bytes of a file.

    Raises:
        OSError: there is none, it is no regular file, or it cannot be read.
    """
    with opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def locked(
    path: Path, refusal: Callable[[OSError], Exception], *, patience: float = 0.0
) -> Iterator[None]:
    """Hold an exclusive lock until this is left.

    Args:
        path: a folder, or a file, which is made if it is not there.
        refusal: makes the error that is raised: of a BlockingIOError where another process holds
            the lock, else of what the disk refuses.
        patience: time to wait for another process [s].
    """
    kind = os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT
    try:
        descriptor = os.open(path, _FLAGS | kind, 0o644)
    except OSError as error:
        raise refusal(error) from error
    try:
        try:
            _acquire(descriptor, fcntl.LOCK_EX, patience)
        except OSError as error:
            raise refusal(error) from error
        yield
    finally:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Whether another process holds the lock on a file at this moment."""
    try:
        descriptor = os.open(path, _FLAGS | os.O_RDONLY)
    except OSError:  # nobody ever did, or it is not ours to look
        return False
    try:
        _acquire(descriptor, fcntl.LOCK_SH, 0.0)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def _acquire(descriptor: int, kind: int, patience: float) -> None:
    deadline = time.monotonic() + patience
    while True:
        try:
            return fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(_PAUSE)
