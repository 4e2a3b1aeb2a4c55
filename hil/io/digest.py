"""SHA-256 of texts, JSON values and files, in hexadecimal digits."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from hil.reading import opened


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
