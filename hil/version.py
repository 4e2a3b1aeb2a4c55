"""Which software made a file."""

from __future__ import annotations

import json
import shlex
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, version
from urllib.parse import unquote, urlsplit

_PACKAGES = ("hil", "numpy", "scipy", "pin", "ruckig", "pymoo", "cma", "mcap")


@cache
def software() -> dict[str, str]:
    """Versions of this package and of those its numbers depend on."""
    return {name: version(name) for name in _PACKAGES}


def install_command(extra: str) -> str:
    """What to type for an extra: from the checkout that `hil` was installed from, where it was."""
    try:
        direct = json.loads(distribution("hil").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        direct = {}
    url = urlsplit(direct.get("url", ""))
    if url.scheme != "file" or "dir_info" not in direct:
        return f"pip install 'hil[{extra}]'"
    editable = "-e " if direct["dir_info"].get("editable") else ""
    return f"pip install {editable}{shlex.quote(f'{unquote(url.path)}[{extra}]')}"
