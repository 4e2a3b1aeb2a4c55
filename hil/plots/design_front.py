"""The front of a search: what more information costs in coupling."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.plots import style
from hil.report.figures.svg import label

Array = NDArray[np.float64]

_MARKERS = "DsP^vX"
_MARGIN = 0.09


class FrontPoints(Protocol):
    """The front of a search: its k motions' measures."""

    @property
    def log10_det(self) -> Array:
        """Information (k,)."""
        ...

    @property
    def coupling_index(self) -> Array:
        """I_c (k,)."""
        ...


def draw_front(
    axes: Axes,
    front: FrontPoints | None,
    chosen: tuple[float, float],
    references: Mapping[str, tuple[float, float]],
) -> None:
    """Draw the front, the chosen motion, and named ones to compare with.

    Args:
        axes: where.
        front: the front of (log10 det, I_c), if there is one.
        chosen: (log10 det, I_c) of the motion that was chosen.
        references: (log10 det, I_c) of others by name.
    """
    if front is not None and len(front.coupling_index) > 1:
        _line(axes, front)
    look = {"markersize": 13.0, "markerfacecolor": style.LIMIT, "markeredgecolor": "white"}
    _point(axes, "chosen", chosen, marker="*", zorder=4.0, **look)
    look = {"markersize": 6.0, "markerfacecolor": "white", "markeredgecolor": style.INK}
    for k, (name, measures) in enumerate(references.items()):
        marker = _MARKERS[k % len(_MARKERS)]
        _point(axes, label(name), measures, marker=marker, zorder=3.0, **look)
    axes.margins(_MARGIN)
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10], min_n_ticks=3))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], min_n_ticks=3))
    axes.set_xlabel("coupling index I_c (less is better)")
    axes.set_ylabel("log₁₀(det ΦᵀΦ / Nᵖ) (more is better)")
    if axes.lines:
        axes.legend(
            loc="best", frameon=True, framealpha=0.9, edgecolor="none", fontsize=style.SMALL
        )
    style.bare(axes)


def _line(axes: Axes, front: FrontPoints) -> None:
    order = np.argsort(front.coupling_index, kind="stable")
    axes.plot(
        front.coupling_index[order],
        front.log10_det[order],
        drawstyle="steps-post",  # what is had at most for a coupling index up to that
        color=style.POSITION,
        linewidth=1.0,
        marker="o",
        markersize=3.4,
        label=f"front, {len(order)} motions",
        clip_on=False,
    )


def _point(axes: Axes, name: str, measures: tuple[float, float], **look: Any) -> None:
    """Draw one motion; one that leaves a parameter unexcited has no place on the page."""
    determinant, index = measures
    if np.isfinite(determinant) and np.isfinite(index):
        axes.plot(
            index,
            determinant,
            linestyle="none",
            markeredgewidth=1.0,
            label=f"{name} ({determinant:.1f}, {index:.1f})",
            clip_on=False,
            **look,
        )
