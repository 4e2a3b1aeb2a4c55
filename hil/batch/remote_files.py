"""Archives that lie in an object store or behind a web server, through fsspec.

Any address fsspec knows is good (``s3://``, ``gs://``, ``http://``, ``file://``, ``memory://``...);
some need a package of their own, which the error names. fsspec is imported when such an address is
given, and not before. What a busy store or network refuses is asked for again, a few times.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from hil.errors import InputError
from hil.version import install_command

from .errors import UnavailableError

T = TypeVar("T")

_SUFFIX: Final = ".mcap"
_VERSIONS: Final = ("ETag", "etag", "md5Hash", "content_md5", "Content-MD5")
"""What stores say of the content of an object, by the names they have for it."""

_PAUSES: Final = (0.5, 2.0)
"""s before a store that failed is asked again: once after each."""

_TRY_LATER: Final = (408, 425, 429)
"""Of HTTP's 4xx those that ask for patience."""


class RemoteFile(NamedTuple):
    """An archive in a store.

    Attributes:
        url: address.
        size: bytes; None where the store does not say.
        version: changes when the object does; "" where the store says nothing of the kind, and
            only its bytes tell.
    """

    url: str
    size: int | None
    version: str


def is_url(text: str) -> bool:
    """Whether a location is an address and not a path."""
    return "://" in text


def listed(url: str) -> list[RemoteFile]:
    """Every archive at or below an address, in the order of their addresses.

    Args:
        url: of an archive, or of a folder (of a web server: one that lists its folders as links).

    Raises:
        InputError: a package for the address is missing.
        UnavailableError: it cannot be read.
    """
    return _asked(url, lambda: _listed(url))


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """A copy of a remote file under its own name, for as long as it is needed.

    It lies in the folder for temporary files (``TMPDIR``); nothing of it is held in memory.

    Raises:
        InputError: a package for the address is missing.
        UnavailableError: it cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        path = Path(folder) / url.rstrip("/").rsplit("/", 1)[-1]
        _asked(url, lambda: _copy(url, path))
        yield path


def _listed(url: str) -> list[RemoteFile]:
    store, root = _store(url)
    found = {root: store.info(root)} if root.endswith(_SUFFIX) else store.find(root, detail=True)
    files = [
        RemoteFile(str(store.unstrip_protocol(path)), info.get("size"), _version(info))
        for path, info in found.items()
        if path.endswith(_SUFFIX)
    ]
    return sorted(files)


def _copy(url: str, path: Path) -> None:
    store, place = _store(url)
    store.get_file(place, str(path))


def _store(url: str) -> tuple[Any, str]:
    """The file system of an address, and the place in it."""
    from fsspec.core import url_to_fs

    store, place = url_to_fs(url)
    return store, str(place)


def _version(info: dict[str, Any]) -> str:
    return next((str(info[name]) for name in _VERSIONS if info.get(name)), "")


def _asked(url: str, question: Callable[[], T]) -> T:
    """Ask a store, and again if it is only indisposed; what it has against that is one sentence."""
    if find_spec("fsspec") is None:
        raise InputError(
            None,
            "an address needs the package fsspec, which is not installed",
            field=url,
            remedy=f"install it with: {install_command('cluster')}",
        )
    for pause in _PAUSES:
        try:
            return question()
        except Exception as error:  # each store has errors of its own
            if _is_final(error):
                raise _refusal(url, error) from error
            time.sleep(pause)
    try:
        return question()
    except Exception as error:
        raise _refusal(url, error) from error


def _is_final(error: Exception) -> bool:
    """Whether a store would say the same another time: what it does not have, or does not give."""
    status = getattr(error.__cause__ or error, "status", None)  # of HTTP
    if isinstance(status, int):
        return 400 <= status < 500 and status not in _TRY_LATER
    if isinstance(error, FileNotFoundError):
        return error.__cause__ is None
    # The last is what fsspec raises where a kind of store cannot do what was asked at all.
    return isinstance(error, ImportError | ValueError | PermissionError | NotImplementedError)


def _refusal(url: str, error: Exception) -> InputError:
    if isinstance(error, ImportError):  # fsspec says which package the protocol needs
        return InputError(None, f"needs another package: {error}", field=url)
    if isinstance(error, FileNotFoundError):
        return UnavailableError(None, "is not there, or its server does not answer", field=url)
    reason = str(error) or type(error).__name__
    return UnavailableError(None, f"cannot be read: {reason}", field=url)
