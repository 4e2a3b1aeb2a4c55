"""Names of a package that are imported when the first of them is used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Final

_HELPERS: Final = frozenset({"TYPE_CHECKING", "annotations", "on_first_use"})


def on_first_use(
    package: str, names_of_module: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names are imported on first use.

    For checkers and editors the package imports the same names under `TYPE_CHECKING`.

    Args:
        package: its `__name__`.
        names_of_module: names by the module that has them.
    """
    module_of = {name: module for module, names in names_of_module.items() for name in names}

    def imported(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name]), name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of} - _HELPERS)

    return imported, names
