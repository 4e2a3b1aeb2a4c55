"""Archives that lie in an object store or behind a web server, through fsspec.

Any address fsspec knows is good (``s3://``, ``gs://``, ``http://``, ``file://``, ``memory://``...);
some need a package of their own, which the error names. fsspec is imported when such an address is
given, and not before.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from hil.errors import InputError

T = TypeVar("T")

_SUFFIX: Final = ".mcap"
_VERSIONS: Final = ("ETag", "etag", "md5Hash", "content_md5", "Content-MD5")
"""What stores say of the content of an object, by the names they have for it."""


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
        InputError: the address cannot be read, or a package for it is missing.
    """
    return _asked(url, lambda: _listed(url))


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """A copy of a remote file under its own name, for as long as it is needed.

    It lies in the folder for temporary files (``TMPDIR``); nothing of it is held in memory.

    Raises:
        InputError: the address cannot be read, or a package for it is missing.
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
    """Ask a store; whatever it has against that is one sentence."""
    if find_spec("fsspec") is None:
        raise InputError(
            None,
            "an address needs the package fsspec, which is not installed",
            field=url,
            remedy="install it with: pip install 'hil[cluster]'",
        )
    try:
        return question()
    except ImportError as error:  # fsspec says which package the protocol needs
        raise InputError(None, f"needs another package: {error}", field=url) from error
    except FileNotFoundError as error:
        raise InputError(None, "is not there, or its server does not answer", field=url) from error
    except Exception as error:  # each store has errors of its own
        reason = str(error) or type(error).__name__
        raise InputError(None, f"cannot be read: {reason}", field=url) from error
