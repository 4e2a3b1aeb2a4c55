"""Which versions of the corner solver (community ruckig) this package was measured with.

Its margins against crashes are measurements of one series of versions, not properties of the
algorithm. So another version is not merely warned of: no corner is planned with it. Whatever
does not fly by (stops, playing, reading of plans) works with any version.
"""

from __future__ import annotations

from typing import Final

import ruckig

from planner.errors import UnsupportedSolver

SERIES: Final = "0.19"


def is_supported(version: str) -> bool:
    """Whether a version is of the series measured."""
    return version.split(".")[:2] == SERIES.split(".")


_VERSION: Final = str(getattr(ruckig, "__version__", "unknown"))
_SUPPORTED: Final = is_supported(_VERSION)


def require_solver() -> None:
    """Return if the installed solver is of the series measured.

    Raises:
        UnsupportedSolver: it is of another one.
    """
    if not _SUPPORTED:
        raise UnsupportedSolver(_VERSION, SERIES)
