"""Identification from archives; called as a function, from recordings of any kind.

``hil.identify("log.csv", urdf="arm.urdf")`` is :func:`hil.identified_arm.identify`.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .options import Options

if TYPE_CHECKING:
    from hil.identified_campaign import identify_campaign, identify_paths

    from .run import Identification, identify_archives

__all__ = [
    "Identification",
    "Options",
    "identify_archives",
    "identify_campaign",
    "identify_paths",
]


def __getattr__(name: str) -> Any:
    """Import what needs the report pages on first use: batch workers never use it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    campaigns = name in ("identify_campaign", "identify_paths")
    home = "hil.identified_campaign" if campaigns else f"{__name__}.run"
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    """Return all names, also those that are not loaded yet."""
    return [*globals(), *__all__]


class _Callable(ModuleType):
    """This package, which is also the function of the same name."""

    @property
    def __wrapped__(self) -> Any:
        """The function, whose arguments `inspect` and notebooks show."""
        return import_module("hil.identified_arm").identify

    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        """Identify from recordings, see :func:`hil.identified_arm.identify`."""
        return self.__wrapped__(*arguments, **settings)


sys.modules[__name__].__class__ = _Callable
