"""Robot dynamics identification: model, regressor, excitation, estimation, validation.

The names of `identification.api`, which are imported when the first of them is used: who needs one
module does not wait for all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from identification.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """A name of `identification.api`."""
    if name == "__all__" or not name.startswith("_"):
        api = import_module("identification.api")
        if name in ("__all__", *api.__all__):
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """All names, loaded or not: the reference documents them."""
    return [*globals(), *import_module("identification.api").__all__]
