"""Motion planning through via points, as a joint interpolator of an industrial controller does it.

`plan` turns via points into a `PiecewiseCubic`, `plan_moves` does so with settings for each move,
`Interpolator` step by step while targets arrive. `TrajectoryPlayer` returns one set-point per
controller cycle, at an override that may change, and stops a motion on its path.

The names of `planner.api`, which are imported when the first of them is used: who needs one
module does not wait for all.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from planner.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """A name of `planner.api`."""
    if name == "__all__" or not name.startswith("_"):
        api = import_module("planner.api")
        if name in ("__all__", *api.__all__):
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """All names, loaded or not: the reference documents them."""
    return [*globals(), *import_module("planner.api").__all__]
