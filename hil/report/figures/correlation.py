"""The correlation matrix of the base parameters, shaded as the paper's Fig. 2."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.report.figures.canvas import TICK_SIZE, blank, place
from hil.report.figures.palette import INK, MUTED
from hil.report.figures.svg import Panel, drawing, label, to_panel
from hil.results import Results

_LABELS, _SCALE = 84.0, 78.0
_SIDE = 560.0
_SMALLEST_CELL, _LARGEST_CELL = 11.0, 26.0


def correlation_matrix(results: Results) -> Panel | None:
    """|Ψ_ij| / sqrt(Ψ_ii Ψ_jj): 0 white, 1 black; friction left out, as in the paper."""
    n = results.n_base
    if n == 0:
        return None
    matrix = np.array(results.correlation, dtype=np.float64)[:n, :n]
    return matrix_panel(matrix, [p.label for p in results.parameters[:n]], key="c")


def matrix_panel(
    matrix: NDArray[np.float64], labels: Sequence[str], *, key: str, title: str = ""
) -> Panel:
    """|ρ| of a normalised matrix (n, n), one label for each row; `key` is the panel's own."""
    n, matrix = len(labels), np.abs(matrix)
    names = [label(text) for text in labels]
    above = int(np.sum(np.triu(matrix, 1) > 0.9))
    alt = (
        f"Absolute correlation between {n} base parameters, white for 0 and black for 1;"
        f" {above} of {n * (n - 1) // 2} pairs exceed 0.9."
    )
    side = n * min(max(_SIDE / n, _SMALLEST_CELL), _LARGEST_CELL)
    with drawing():
        figure = blank(_LABELS + side + _SCALE, _LABELS + side + 6.0)
        axes = place(figure, _LABELS, _LABELS, side, side)
        axes.imshow(matrix, cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none", aspect="auto")
        _label_cells(axes, names, side / n)
        _scale(place(figure, _LABELS + side + 22.0, _LABELS, 14.0, min(side, 200.0)))
        note = f"{above} of {n * (n - 1) // 2} pairs above 0.9" if title else ""
        return to_panel(figure, key=key, title=title, note=note, alt=alt)


def _label_cells(axes: Axes, names: list[str], cell: float) -> None:
    size = min(TICK_SIZE, 0.76 * cell)
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(names)))
    axes.set_xticklabels(
        names, rotation=90, rotation_mode="anchor", ha="left", va="center", fontsize=size
    )
    axes.set_yticks(range(len(names)))
    axes.set_yticklabels(names, fontsize=size)
    axes.tick_params(length=0.0, pad=4.0)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(MUTED)


def _scale(axes: Axes) -> None:
    """The shade scale, as an image of its own (a colour bar would be 256 rectangles)."""
    shades = np.linspace(1.0, 0.0, 64)[:, None]
    axes.imshow(
        shades, cmap="gray_r", vmin=0.0, vmax=1.0, aspect="auto", extent=(0.0, 1.0, 0.0, 1.0)
    )
    axes.set_xticks([])
    axes.yaxis.tick_right()
    axes.set_yticks([0.0, 0.5, 1.0])
    axes.set_yticklabels(["0", "0.5", "1"], color=INK)
    axes.set_title("|ρ|", fontsize=TICK_SIZE, color=MUTED, pad=6.0)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(MUTED)
