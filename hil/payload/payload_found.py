"""An identified payload, as values; `payload_messages` words them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from typing import Final, NamedTuple

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.pipeline.notes import Note
from hil.pipeline.torque_scale import TorqueScale
from identification.estimators.payload_estimate import NAMES, PayloadEstimate, figures_of
from identification.hypotheses.gravity_direction import GravityDirection
from identification.model.pseudo_inertia import Body
from identification.validation.finding import Finding

UNITS: Final = dict(zip(NAMES, ["kg", *["m"] * 3, *["kg·m²"] * 6], strict=True))
"""Unit of each figure of a payload."""


class PayloadFigure(NamedTuple):
    """A figure of a payload with its 95 % interval."""

    name: str
    value: float | None  #: None: not determined
    low: float
    high: float

    @property
    def unit(self) -> str:
        """Unit of value and interval."""
        return UNITS[self.name]


class OutsideInterval(NamedTuple):
    """An expected value outside the 95 % interval of its figure."""

    figure: PayloadFigure
    expected: float


class PlainStep(Enum):
    """What to do about an expected value outside its interval, without figures."""

    CHECK_CONSTANTS = auto()  #: with a known load
    RECORD_BARE = auto()  #: to estimate torque constants from the known load


@dataclass(frozen=True)
class ScaledTorque:
    """The scale of the torque that explains a known mass."""

    factor: float  #: torque over the one that a load of this mass has
    mass: float  #: [kg]


@dataclass(frozen=True)
class CorrectMapScale:
    """Correct the scale of the torque in the column map, as no currents were recorded."""

    factor: float  #: new scale over the present one


@dataclass(frozen=True)
class EstimateConstants:
    """Estimate torque constants from the same recordings, with the known load."""

    bare: tuple[Path, ...]
    loaded: tuple[Path, ...]
    frame: str
    load: Mapping[str, float]  #: by `NAMES`; without inertia where it is not determined


NextStep = PlainStep | ScaledTorque | CorrectMapScale | EstimateConstants


@dataclass(frozen=True)
class BareCheck:
    """What the bare recordings are other than described."""

    joints: tuple[str, ...]  #: names of the arm's
    mounting: GravityDirection | None  #: direction of gravity that is likelier than the stated one
    findings: tuple[Finding, ...]  #: certain ("wrong") and doubtful

    @property
    def certain(self) -> tuple[Finding, ...]:
        """Findings that are certain."""
        return tuple(each for each in self.findings if each.level == "wrong")

    @property
    def uncertain(self) -> tuple[Finding, ...]:
        """The other findings."""
        return tuple(each for each in self.findings if each.level != "wrong")


@dataclass(frozen=True, eq=False)
class PayloadFound:
    """An identified payload."""

    estimate: PayloadEstimate
    body: Body
    frame: str  #: link in whose frame `body` is
    gravity: float  #: magnitude [m/s²]
    bare: tuple[str, ...]  #: names of the archives without payload
    loaded: tuple[str, ...]  #: names of the archives with payload
    scale: TorqueScale  #: how well the torques are known
    bare_check: BareCheck
    #: as typed: archives or folders without and with payload
    typed: tuple[tuple[Path, ...], tuple[Path, ...]]
    with_currents: bool  #: whether all archives hold motor currents
    warnings: tuple[Note, ...]  #: of the recordings

    @property
    def values(self) -> Array:
        """Values of `NAMES` (10,)."""
        return figures_of(self.body)

    @property
    def figures(self) -> tuple[PayloadFigure, ...]:
        """Values and intervals, in the order of `NAMES`."""
        rows = zip(NAMES, self.values.tolist(), self.estimate.intervals.tolist(), strict=True)
        return tuple(
            PayloadFigure(name, value if self.determines(name) else None, low, high)
            for name, value, (low, high) in rows
        )

    @property
    def wrist_torque(self) -> tuple[float, float, float]:
        """Maximum torque of its weight about the frame's origin and its interval [N·m]."""
        value, low, high = (self.gravity * part for part in self.estimate.moment)
        return value, low, high

    @property
    def is_doubtful(self) -> bool:
        """Whether the recordings are other than described, so that nothing should be set."""
        return self.bare_check.mounting is not None or bool(self.bare_check.certain)

    def determines(self, *names: str) -> bool:
        """Return whether all figures are determined."""
        return not set(names) & set(self.estimate.undetermined)

    def outside(self, expected: Mapping[str, float]) -> tuple[OutsideInterval, ...]:
        """Return the expected values, by names, that lie outside their intervals.

        Raises:
            InputError: a name is unknown.
        """
        figures = {figure.name: figure for figure in self.figures}
        for name in expected:
            if name not in figures:
                problem = f"{name!r} is not a property of a payload"
                remedy = f"use one of {', '.join(NAMES)}, for example mass=4.0"
                raise InputError(None, problem, field="--check", remedy=remedy)
        return tuple(
            OutsideInterval(figures[name], value)
            for name, value in expected.items()
            if not figures[name].low <= value <= figures[name].high
        )

    def next_steps(self, expected: Mapping[str, float]) -> tuple[NextStep, ...]:
        """Return what to do if an expected value is outside its interval."""
        mass = expected.get("mass")
        if mass is None:
            return (PlainStep.CHECK_CONSTANTS,)
        ratio = mass / self.body.mass
        scaled = ScaledTorque(1.0 / ratio, mass)
        if not self.with_currents:
            return scaled, CorrectMapScale(ratio)
        if not self.bare:
            return scaled, PlainStep.RECORD_BARE
        return scaled, EstimateConstants(*self.typed, self.frame, self._known_load(expected))

    def _known_load(self, expected: Mapping[str, float]) -> dict[str, float]:
        """Return the figures of a load of known mass, the others as found or expected."""
        # The same factor is in mass and inertia, and not in the centre.
        ratio = expected["mass"] / self.body.mass
        factors = [ratio, 1.0, 1.0, 1.0, *[ratio] * 6]
        return {
            name: expected.get(name, float(factor * value))
            for name, factor, value in zip(NAMES, factors, self.values, strict=True)
            if name in NAMES[:4] or self.determines(*NAMES[4:])
        }
