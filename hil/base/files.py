"""Files and folders written atomically, locks, and SHA-256 digests."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryDirectory
from typing import Any, Final

from hil.base.errors import InputError, OutputError
from hil.base.safe_input import open_file


def make_folder(path: Path) -> None:
    """Create a folder and its parents if missing; InputError if it is not writable."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            path, f"cannot be created ({error.strerror})", remedy="choose another folder"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(path, "cannot be written to", remedy="choose another folder")


def user_cache() -> Path:
    """Return the folder of the user for what can be computed again, which need not exist."""
    xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (xdg if xdg.is_absolute() else Path.home() / ".cache") / "hil"


@contextmanager
def lock_folder(root: Path, work: str, option: str) -> Iterator[None]:
    """Create a folder and lock it against other processes with the same work, or raise InputError.

    The lock is on the folder itself and ends with this process. `work` is a noun for the work,
    `option` the command-line option that names another folder.
    """
    make_folder(root)

    def refusal(error: OSError) -> InputError:
        if isinstance(error, BlockingIOError):
            problem = f"a {work} is running in it"
            remedy = f"wait until it ends, stop it (Ctrl-C), or choose another folder ({option})"
        else:
            problem = f"cannot be locked ({error.strerror})"
            remedy = f"give a folder on a disk of this PC ({option})"
        return InputError(root, problem, remedy=remedy)

    with file_lock(root, refusal):
        yield


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content`; after a crash it has the old or the new content."""
    with replace_file(path, path.with_suffix(path.suffix + ".tmp")) as temporary:
        _write_through(temporary, content)
    _sync(path.parent)


@contextmanager
def replace_file(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Replace `path` by the yielded file next to it; keep `path` if writing fails."""
    temporary = temporary or path.with_name(f".{path.name[:200]}.{token_hex(4)}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def write_output(path: Path, content: str | bytes) -> None:
    """Write as `write_atomically`; errors become OutputError."""
    try:
        write_atomically(path, content)
    except OSError as error:
        problem = f"{path.name} cannot be written ({error.strerror or error})"
        raise OutputError(path.parent, problem) from error


@contextmanager
def convert_write_errors(folder: Path) -> Iterator[None]:
    """Convert errors of writing to `InputError`; files written before remain."""
    try:
        yield
    except OSError as error:
        problem = f"cannot be written to ({os.strerror(error.errno) if error.errno else error})"
        remedy = "make room, or choose another folder"
        raise InputError(folder, problem, remedy=remedy) from error


def write_files(folder: Path, contents: Mapping[str, str | bytes | None]) -> None:
    """Replace files of an existing folder (None removes one); OutputError if that is not possible.

    All new files are complete before the first is replaced: a full disk changes nothing.
    """
    try:
        in_the_way = next((name for name in contents if (folder / name).is_dir()), None)
        if in_the_way is not None:
            raise IsADirectoryError(errno.EISDIR, f"{in_the_way} is a folder")
        with TemporaryDirectory(prefix=".hil-", dir=folder, ignore_cleanup_errors=True) as stage:
            for name, content in contents.items():
                if content is not None:
                    _write_through(Path(stage, name), content)
            for name, content in contents.items():
                if content is None:
                    (folder / name).unlink(missing_ok=True)
                else:
                    Path(stage, name).replace(folder / name)
    except OSError as error:
        raise OutputError(folder, f"cannot be written to ({error.strerror})") from error
    _sync(folder)


def write_into(folder: Path, contents: Mapping[str, str | bytes]) -> tuple[Path, ...]:
    """Write files into a folder, which is created if missing; return their paths.

    Raises:
        InputError: the folder cannot be created.
        OutputError: the files cannot be written.
    """
    make_folder(folder)
    write_files(folder, contents)
    return tuple(folder / name for name in contents)


def _write_through(path: Path, content: str | bytes) -> None:
    """Write a new file and wait until it is on the disk.

    An existing one is removed first: in an untrusted folder it may be a link or a pipe.
    """
    path.unlink(missing_ok=True)
    with path.open("xb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk; OSError if that is not supported."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync(path: Path) -> None:
    """Do the same where supported."""
    with suppress(OSError):
        sync_folder(path)


_OPEN_FLAGS: Final = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""In untrusted folders, no link is followed and no pipe blocks."""
_LOCK_POLL_PERIOD: Final = 0.02


def digest(content: str | bytes) -> str:
    """Return the SHA-256 of a text, as UTF-8, or of bytes."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def json_digest(value: Any) -> str:
    """Return the SHA-256 of a JSON value, independent of the order of keys."""
    return digest(json.dumps(value, sort_keys=True))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a regular file, or raise OSError."""
    with open_file(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def file_lock(
    path: Path, refusal: Callable[[OSError], Exception], *, patience: float = 0.0
) -> Iterator[None]:
    """Hold an exclusive lock on a folder or a file (created if missing); wait `patience` s.

    `refusal` returns the error to raise for a BlockingIOError (another process) or an error of the
    disk.
    """
    kind = os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT
    try:
        descriptor = os.open(path, _OPEN_FLAGS | kind, 0o644)
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


def _acquire(descriptor: int, kind: int, patience: float) -> None:
    deadline = time.monotonic() + patience
    while True:
        try:
            return fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(_LOCK_POLL_PERIOD)
