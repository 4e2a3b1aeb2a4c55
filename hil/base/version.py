"""Which software made a file."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version

__version__ = version("hil")
_PACKAGES = ("hil", "numpy", "scipy", "pin", "ruckig", "pymoo", "mcap")


@cache
def software() -> dict[str, str]:
    """Versions of this package and of the packages its numbers depend on."""
    return {name: version(name) for name in _PACKAGES}


def install_command(extra: str) -> str:
    """Return the command that installs an extra from the checkout of this package."""
    return f"pip install -e '.[{extra}]'  # in the checkout of hil"
