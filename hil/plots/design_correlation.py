"""The correlation matrix that a motion promises, drawn as the paper's Fig. 2."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.plots import style

Array = NDArray[np.float64]

_JOINT = re.compile(r"\d+")


def draw_correlation(axes: Axes, scale: Axes, matrix: Array, names: Sequence[str]) -> None:
    """Draw ``|psi_ij| / sqrt(psi_ii psi_jj)``, black for 1 and white for 0, in blocks of links.

    Args:
        axes: for the matrix.
        scale: for the shades.
        matrix: correlations of the parameters without friction (b, b); NaN where a motion leaves
            a parameter without excitation.
        names: of the parameters (b,).
    """
    b = len(names)
    known = bool(np.all(np.isfinite(matrix)))
    if known:
        axes.imshow(np.abs(matrix), cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none")
    else:
        axes.set_xlim(-0.5, b - 0.5)
        axes.set_ylim(b - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.text(
            0.5,
            0.5,
            "no correlations:\nthis motion leaves a parameter\n(or a sum of some) unexcited",
            transform=axes.transAxes,
            ha="center",
            va="center",
            color=style.LIMIT,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 5.0},
        )
    _blocks(axes, names)
    _scale(scale)


def blocks(names: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return (label, first, one after the last) of neighbours that belong to the same joint."""
    found = []
    for joint, members in groupby(range(len(names)), key=lambda k: _joint(names[k])):
        indices = list(members)
        found.append((joint, indices[0], indices[-1] + 1))
    return found


def _joint(name: str) -> str:
    match = _JOINT.search(name)
    return "" if match is None else match.group()


def _blocks(axes: Axes, names: Sequence[str]) -> None:
    found = blocks(names)
    for _, first, _ in found[1:]:
        for line in (axes.axhline, axes.axvline):
            line(first - 0.5, color=style.POSITION, linewidth=0.7)
    middles = [(first + last - 1) / 2.0 for _, first, last in found]
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(middles, [label for label, _, _ in found], color=style.INK)
    axes.tick_params(length=0.0, pad=3.0)
    axes.set_xlabel("parameters by joint, friction left out")
    for spine in axes.spines.values():
        spine.set_color(style.MUTED)


def _scale(axes: Axes) -> None:
    """The shades as an image of their own: a colour bar would be 256 rectangles."""
    shades = np.linspace(1.0, 0.0, 64)[:, None]
    axes.imshow(
        shades, cmap="gray_r", vmin=0.0, vmax=1.0, aspect="auto", extent=(0.0, 1.0, 0.0, 1.0)
    )
    axes.set_xticks([])
    axes.yaxis.tick_right()
    axes.set_yticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    axes.tick_params(length=0.0, pad=2.0)
    for spine in axes.spines.values():
        spine.set_color(style.MUTED)
