"""Which software made a file."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version

_PACKAGES = ("hil", "numpy", "scipy", "pin", "ruckig", "pymoo", "cma", "mcap")


@cache
def software() -> dict[str, str]:
    """Versions of this package and of those its numbers depend on."""
    return {name: version(name) for name in _PACKAGES}
