"""Parameters that a machine can have: a section of `results.json`."""

from __future__ import annotations

from hil.results.frozen import Frozen


class LinkResult(Frozen):
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


class ConsistencyResult(Frozen):
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
