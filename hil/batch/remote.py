"""Archives in an object store or behind a web server, at any address that fsspec knows.

Some need a package of their own, which the error names. fsspec is imported with the first address.
"""

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
"""What stores say of the content of an object, by the names they have for it."""


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
        InputError: it cannot be read, or a package for it is missing.
    """
    with _store(url) as (store, root):
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


@contextmanager
def local_file(location: str) -> Iterator[Path]:
    """The file at a path; a copy of a remote one under its own name, for as long as it is needed.

    The copy lies in the folder for temporary files (``TMPDIR``); nothing of it is held in memory.

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
    """The file system of an address, and the place in it."""
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
    except Exception as error:  # each store has errors of its own, and names missing packages
        reason = str(error) or type(error).__name__
        raise InputError(None, f"cannot be read: {reason}", field=url) from error
