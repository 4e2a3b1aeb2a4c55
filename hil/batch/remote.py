"""Archives at any address that fsspec supports; it is imported with the first address."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from hil.errors import InputError
from hil.version import install_command

_SUFFIX: Final = ".mcap"
_VERSIONS: Final = ("ETag", "etag", "md5Hash", "content_md5", "Content-MD5")
"""Names of the version of an object in different stores."""


def is_url(text: str) -> bool:
    """Return whether a location is an address and not a path."""
    return "://" in text


def archives_below(url: str) -> list[tuple[str, str]]:
    """Return address and version of every archive at or below an address, sorted.

    The version changes when the object does; it is "" where the store states none. A web server
    must list its folders as links.

    Raises:
        InputError: it cannot be read, or a package for it is missing.
    """
    found = []
    with _store(url) as (store, root):
        alone = root.endswith(_SUFFIX)
        infos = {root: store.info(root)} if alone else store.find(root, detail=True)
        for path, info in infos.items():
            if path.endswith(_SUFFIX):
                version = next((str(info[name]) for name in _VERSIONS if info.get(name)), "")
                found.append((str(store.unstrip_protocol(path)), version))
    return sorted(found)


@contextmanager
def local_file(location: str) -> Iterator[Path]:
    """Yield the file of a path, or a temporary copy of a remote one in ``TMPDIR``.

    Raises:
        InputError: it cannot be read, or a package for it is missing.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        path = Path(folder) / location.rstrip("/").rsplit("/", 1)[-1]
        with _store(location) as (store, place):
            store.get_file(place, str(path))
        yield path


@contextmanager
def _store(url: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of an address, and the path in it."""
    if find_spec("fsspec") is None:
        remedy = f"install it with: {install_command('cluster')}"
        problem = "an address needs the package fsspec, which is not installed"
        raise InputError(None, problem, field=url, remedy=remedy)
    from fsspec.core import url_to_fs

    try:
        store, place = url_to_fs(url)
        yield store, str(place)
    except FileNotFoundError as error:
        raise InputError(None, "is not there, or its server does not answer", field=url) from error
    except Exception as error:  # stores have their own errors
        reason = str(error) or type(error).__name__
        raise InputError(None, f"cannot be read: {reason}", field=url) from error
