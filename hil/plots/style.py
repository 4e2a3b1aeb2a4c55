"""Style of pictures; colours are distinguishable in print and for colour-blind readers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib as mpl
from matplotlib.axes import Axes

from hil.report.drawing import drawing

INK, MUTED, RULE, SHADE = "#1a1a1a", "#666666", "#dddddd", "#f0e8d2"
LIMIT = "#b3261e"
POSITION, VELOCITY, ACCELERATION = "#0072b2", "#00795a", "#b0530b"
SMALL, TEXT, TITLE = 7.5, 9.0, 12.0


@contextmanager
def page() -> Iterator[None]:
    """Draw with fixed settings, one thread at a time."""
    with drawing():
        mpl.rcParams.update(
            {
                "font.size": TEXT,
                "axes.edgecolor": MUTED,
                "axes.linewidth": 0.7,
                "axes.labelcolor": INK,
                "axes.titlesize": TEXT,
                "xtick.color": MUTED,
                "ytick.color": MUTED,
                "xtick.labelsize": SMALL,
                "ytick.labelsize": SMALL,
                "figure.facecolor": "white",
            }
        )
        yield


def bare(axes: Axes) -> None:
    """Remove the upper and right spine, and draw a light grid."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(True, color=RULE, linewidth=0.5)
    axes.set_axisbelow(True)
