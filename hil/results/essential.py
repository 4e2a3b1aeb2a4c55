"""Which parameters the motion needs: a section of `results.json`."""

from __future__ import annotations

import math

from hil.results.frozen import Frozen


class EliminationStepResult(Frozen):
    """The model after one more parameter was taken out."""

    removed: str | None
    """None for the model it all begins with."""
    left: int
    spread: float
    """Largest over smallest relative standard deviation of those left."""
    in_sample: float
    """Relative torque error on the fitted motion."""
    held_out: float
    """Relative torque error on the held-out motion."""
    largest_relative_std: float
    """Of those left."""


class EssentialParameter(Frozen):
    """One parameter of the essential model, as estimated with the others of it."""

    name: str
    unit: str
    estimate: float
    std: float

    @property
    def relative_std(self) -> float:
        """Std / |estimate|."""
        return self.std / abs(self.estimate) if self.estimate else math.inf


class BlindResult(Frozen):
    """Parameters chosen inside the fitted motion alone, tried on the held-out motion."""

    left: int
    """How many were chosen."""
    essential: float
    """Relative torque error of these on the held-out motion, which had no say in the choice."""
    full: float
    """That of all parameters."""


class EssentialResult(Frozen):
    """Which parameters the motion needs."""

    reason: str
    """Why the cut is where it is."""
    cut: int
    """Index of the step chosen."""
    steps: list[EliminationStepResult]
    """The whole path, down to one parameter."""
    refused: list[str]
    """Less well known than the rule of thumb allows, but needed by the held-out motion."""
    parameters: list[EssentialParameter]
    by_spread_left: int
    """Number of parameters that relative standard deviations alone leave (Pham and Gautier)."""
    by_spread_held_out: float
    """Held-out error of those."""
    blind: BlindResult | None
