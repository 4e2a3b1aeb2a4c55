"""Noise for every cycle, drawn in blocks."""

from __future__ import annotations

import numpy as np

_BLOCK = 1024


class NoiseSource:
    """White Gaussian noise, one value per axis and call."""

    def __init__(self, deviation: float, n_axes: int, rng: np.random.Generator) -> None:
        """Start a source of its own; `deviation` is the standard deviation."""
        self._deviation = deviation
        self._rng = rng
        self._n_axes = n_axes
        self._block: list[list[float]] = []
        self._silence = [0.0] * n_axes

    def draw(self) -> list[float]:
        """Return the next values, (n,)."""
        if self._deviation == 0.0:
            return self._silence
        if not self._block:
            shape = (_BLOCK, self._n_axes)
            self._block = (self._rng.standard_normal(shape) * self._deviation).tolist()
        return self._block.pop()
