"""Design of exciting motions: criteria, constraints, searches.

The names of `identification.excitation.api`, which are imported when the first of them is used: who
needs one module does not wait for all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from identification.excitation.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """A name of `identification.excitation.api`."""
    if name == "__all__" or not name.startswith("_"):
        api = import_module("identification.excitation.api")
        if name in ("__all__", *api.__all__):
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """All names, loaded or not: the reference documents them."""
    return [*globals(), *import_module("identification.excitation.api").__all__]
