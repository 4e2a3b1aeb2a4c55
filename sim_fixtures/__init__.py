"""The simulated cell: a robot with its controller, the peer of the PC in tests.

It shares no conversion, friction or regressor code with what it tests, only the packet codec, which
is also tested against captures of foreign programs.

The names of `sim_fixtures.api`, which are imported when the first of them is used: who needs one
module does not wait for all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim_fixtures.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """A name of `sim_fixtures.api`."""
    if name == "__all__" or not name.startswith("_"):
        api = import_module("sim_fixtures.api")
        if name in ("__all__", *api.__all__):
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """All names, loaded or not: the reference documents them."""
    return [*globals(), *import_module("sim_fixtures.api").__all__]
