"""The PC's end of the link to the robot's controller: packets, session, transports, drive train.

A sans-I/O core (`Session`, guarded by a `Guard`) that any `Transport` feeds through `exchange`;
knows nothing of plans, robot dynamics or files. Every refusal is a class of `drivers.errors`.

The names of `drivers.api`, which are imported when the first of them is used: who needs one
module does not wait for all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """A name of `drivers.api`."""
    if name == "__all__" or not name.startswith("_"):
        api = import_module("drivers.api")
        if name in ("__all__", *api.__all__):
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """All names, loaded or not: the reference documents them."""
    return [*globals(), *import_module("drivers.api").__all__]
