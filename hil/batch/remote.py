"""Archives in an object store or behind a web server, through fsspec.

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
from typing import Any, Final, TypeVar

from hil.errors import InputError
from hil.version import install_command

from .types import UnavailableError

T = TypeVar("T")

_SUFFIX: Final = ".mcap"
_VERSIONS: Final = ("ETag", "etag", "md5Hash", "content_md5", "Content-MD5")
"""What stores say of the content of an object, by the names they have for it."""

_PAUSES: Final = (0.5, 2.0)
"""s before a store that failed is asked again: once after each."""

_TRY_LATER: Final = (408, 425, 429)
"""Of HTTP's 4xx those that ask for patience."""


def is_url(text: str) -> bool:
    """Whether a location is an address and not a path."""
    return "://" in text


def archives_below(url: str) -> list[tuple[str, str]]:
    """Every archive at or below an address, in the order of their addresses.

    Args:
        url: of an archive, or of a folder (of a web server: one that lists its folders as links).

    Returns:
        Address and version of each. The version changes when the object does; it is "" where the
        store says nothing of the kind, and only its bytes tell.

    Raises:
        InputError: a package for the address is missing.
        UnavailableError: it cannot be read.
    """

    def found(store: Any, root: str) -> list[tuple[str, str]]:
        alone = root.endswith(_SUFFIX)
        infos = {root: store.info(root)} if alone else store.find(root, detail=True)
        return sorted(
            (
                str(store.unstrip_protocol(path)),
                next((str(info[name]) for name in _VERSIONS if info.get(name)), ""),
            )
            for path, info in infos.items()
            if path.endswith(_SUFFIX)
        )

    return _asked(url, found)


@contextmanager
def local_file(location: str) -> Iterator[Path]:
    """The file at a path; a copy of a remote one under its own name, for as long as it is needed.

    The copy lies in the folder for temporary files (``TMPDIR``); nothing of it is held in memory.

    Raises:
        InputError: a package for the address is missing.
        UnavailableError: it cannot be read.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        path = Path(folder) / location.rstrip("/").rsplit("/", 1)[-1]
        _asked(location, lambda store, place: store.get_file(place, str(path)))
        yield path


def _asked(url: str, question: Callable[[Any, str], T]) -> T:
    """Ask the file system of an address about the place in it; again if that fails for a while."""
    if find_spec("fsspec") is None:
        raise InputError(
            None,
            "an address needs the package fsspec, which is not installed",
            field=url,
            remedy=f"install it with: {install_command('cluster')}",
        )
    from fsspec.core import url_to_fs

    for pause in (*_PAUSES, None):
        try:
            store, place = url_to_fs(url)
            return question(store, str(place))
        except Exception as error:  # each store has errors of its own
            if pause is None or _is_final(error):
                raise _refusal(url, error) from error
            time.sleep(pause)
    raise AssertionError


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
