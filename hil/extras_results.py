"""What `results.json` says beyond the estimate: essential parameters, consistency, exports."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


class EliminationStepResult(_Frozen):
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


class EssentialParameter(_Frozen):
    """One parameter of the essential model, as estimated with the others of it."""

    name: str
    unit: str
    estimate: float
    std: float


class BlindResult(_Frozen):
    """Parameters chosen inside the fitted motion alone, tried on the held-out motion."""

    left: int
    """How many were chosen."""
    essential: float
    """Relative torque error of these on the held-out motion, which had no say in the choice."""
    full: float
    """That of all parameters."""


class EssentialResult(_Frozen):
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


class LinkResult(_Frozen):
    """A link of the physically consistent model, about its joint's origin, SI units."""

    joint: str
    mass: float
    centre: list[float]
    """Centre of mass in the joint's frame, m."""
    rotor_inertia: float | None
    room: float
    """Smallest second moment over the nominal body's: 1 as there, 0 at the edge of possible."""
    reference: str
    """What stood for its nominal body."""


class ConsistencyResult(_Frozen):
    """The nearest parameters that a machine can have, and what they cost."""

    sentence: str
    impossible: bool
    costly: bool
    held_out: float
    """Relative torque error of the consistent model on held-out motion."""
    unconstrained_held_out: float
    in_sample: float
    unconstrained_in_sample: float
    moved: list[str]
    """Parameters moved by more than three standard deviations."""
    shift: list[float]
    """How far each parameter was moved, in its standard deviations."""
    bounds: list[str]
    links: list[LinkResult]
    status: str


class ExportResult(_Frozen):
    """Files for other tools, in the folder of `results.json`."""

    written: list[str]
    withheld: dict[str, str]
    """File name and why it was not written."""
