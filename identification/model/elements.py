r"""Springs, balancers and gear ripple: torques on a joint beside the rigid body.

They depend on the angle q of the joint or its motor, and count as what the *drive* has to hold: for
a tension F between anchors at the distance l, :math:`F\,dl/dq`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import ModelError

Array = NDArray[np.float64]

_SAME_DISTANCE: Final = 1e-6
"""Share of the distances by which they have to differ: equal ones let the length become zero."""


class ElementError(ModelError):
    """An element whose parameters the others stand for already."""


class Coefficient(NamedTuple):
    """A factor of one shape of torque."""

    symbol: str  # name of the parameter, without the number of the joint
    unit: str  # its unit
    value: float | None  # as given; None where it is not
    identified: bool  # whether it is a parameter


@dataclass(frozen=True)
class Element(ABC):
    """A torque on one joint: coefficients times shapes, c of them identified, the others known."""

    joint: str  # name

    @property
    def turns(self) -> Mapping[str, float]:
        """The angle that it depends on, per angle of each joint by name."""
        return {self.joint: 1.0}

    @property
    @abstractmethod
    def coefficients(self) -> tuple[Coefficient, ...]:
        """All k coefficients."""

    @abstractmethod
    def shapes(self, q: Array) -> Array:
        """Return the torque per unit of each coefficient, at angles (m,): (m, k)."""

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the c identified parameters, without the number of the joint."""
        return tuple(one.symbol for one in self.coefficients if one.identified)

    def columns(self, q: Array) -> Array:
        """Return the torque per unit of each identified parameter, at angles (m,): (m, c)."""
        return self.shapes(q)[:, [one.identified for one in self.coefficients]]

    def known(self, q: Array) -> Array:
        """Return the part of the torque [N·m] that is known (m,)."""
        known = [0.0 if one.identified else one.value or 0.0 for one in self.coefficients]
        return np.asarray(self.shapes(q) @ np.array(known))


@dataclass(frozen=True)
class Anchors:
    """Two anchors in the plane of a joint, one on the base side and one on the link side.

    Raises:
        ModelError: a distance is not positive, or both are the same.
    """

    base: float  #: distance of the anchor on the base side from the axis [m]
    link: float  #: that of the anchor on the link side [m]
    angle: float  #: between the two, seen from the axis, at joint angle zero [rad]

    def __post_init__(self) -> None:
        _require_positive("distance of an anchor from the axis", "m", self.base, self.link)
        _require_finite("angle between the anchors", self.angle)
        if abs(self.base - self.link) <= _SAME_DISTANCE * self.base:
            raise ModelError(
                f"both anchors are {self.base:g} m from the axis: they would meet at one angle;"
                " give the measured distances"
            )

    def length(self, q: Array) -> Array:
        """Return the distance l between the anchors [m] at positions (m,) [rad]."""
        product = 2.0 * self.base * self.link
        return np.sqrt(self.base**2 + self.link**2 - product * np.cos(q + self.angle))

    def lever(self, q: Array) -> Array:
        """Return dl/dq [m/rad] at positions (m,): the lever of a tension."""
        moment = self.base * self.link * np.sin(q + self.angle)
        return np.asarray(moment / self.length(q))


@dataclass(frozen=True)
class TorsionSpring(Element):
    """A spring about the axis; the drive holds ``stiffness (q - rest)``.

    Raises:
        ModelError: a known spring has no stiffness, or a number is not finite.
    """

    rest: float  #: position without torque [rad]
    stiffness: float | None = None  #: [N·m/rad]; of an identified spring nominal, if known
    identified: bool = False  #: whether the stiffness is a parameter

    def __post_init__(self) -> None:
        _require_finite("rest angle", self.rest)
        _require_stiffness(self.stiffness, identified=self.identified)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """The stiffness."""
        return (Coefficient("spring", "N·m/rad", self.stiffness, self.identified),)

    def shapes(self, q: Array) -> Array:
        """Return the deflection (m, 1) [rad]."""
        return np.asarray(q - self.rest)[:, None]


@dataclass(frozen=True)
class ExtensionSpring(Element):
    """A spring between two anchors, of tension ``stiffness (l - free_length) + preload``.

    Raises:
        ModelError: a known spring has no stiffness, or a number is not finite.
    """

    anchors: Anchors  #: where it is fixed
    free_length: float  #: [m]
    stiffness: float | None = None  #: [N/m]; of an identified spring nominal, if known
    #: tension at the free length [N]; an identified spring without it gets a parameter for it, a
    #: known spring none
    preload: float | None = None
    identified: bool = False  #: whether the stiffness is a parameter

    def __post_init__(self) -> None:
        _require_finite("free length or preload", self.free_length, self.preload or 0.0)
        _require_stiffness(self.stiffness, identified=self.identified)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Stiffness and preload."""
        free = self.identified and self.preload is None
        return (
            Coefficient("spring", "N/m", self.stiffness, self.identified),
            Coefficient("preload", "N", self.preload, free),
        )

    def shapes(self, q: Array) -> Array:
        """Return lever times extension [m²/rad], and the lever [m/rad] (m, 2)."""
        lever, extension = self.anchors.lever(q), self.anchors.length(q) - self.free_length
        return np.column_stack([lever * extension, lever])


@dataclass(frozen=True)
class GasCylinder(Element):
    """A piston against gas between two anchors, of constant temperature.

    With the stroke s, by which the anchors compress the gas from the length at which pressure and
    volume are given, the pressure is ``pressure volume / (volume - s area)``.

    Raises:
        ModelError: a figure is not positive, or the gas has no volume left at some angle.
    """

    anchors: Anchors  #: where it is fixed
    length: float  #: distance between the anchors at which pressure and volume are given [m]
    area: float  #: of the piston, or of a gas spring's rod [m²]
    pressure: float  #: over that outside [Pa]
    volume: float  #: of the gas [m³]
    #: whether it pulls the anchors together, its gas being compressed as they part (hydraulic
    #: balancer), or pushes them apart (gas spring)
    pulls: bool = True
    identified: bool = False  #: whether a factor of its torque is a parameter

    def __post_init__(self) -> None:
        for name, unit in (("length", "m"), ("area", "m²"), ("pressure", "Pa"), ("volume", "m³")):
            _require_positive(name, unit, getattr(self, name))
        base, link = self.anchors.base, self.anchors.link
        end = base + link if self.pulls else abs(base - link)
        left = float(self._volume_left(np.array(end)))
        if not left > 0.0:
            raise ModelError(
                f"the gas has {left:.3g} m³ left where the anchors are {end:.3g} m apart; correct"
                " volume, area, length or the distances of the anchors"
            )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """A factor of the stated law."""
        return (Coefficient("balancer" if self.pulls else "gas_spring", "1", 1.0, self.identified),)

    def shapes(self, q: Array) -> Array:
        """Return the torque of the stated law (m, 1) [N·m]."""
        left = self._volume_left(self.anchors.length(q))
        force = self.area * self.pressure * self.volume / left
        torque = (1.0 if self.pulls else -1.0) * self.anchors.lever(q) * force
        return np.asarray(torque)[:, None]

    def _volume_left(self, length: Array) -> Array:
        """Volume of the gas [m³] at a distance between the anchors."""
        stroke = length - self.length if self.pulls else self.length - length
        return np.asarray(self.volume - stroke * self.area)


@dataclass(frozen=True)
class TorqueRipple(Element):
    """A torque that repeats with the turns of the joint's motor: cogging, teeth, wave generators.

    Each order has a cosine and a sine of the motor's angle, so that amplitude and phase are
    identified. The phase holds as long as nobody takes the gear apart. That a coupled motor passes
    some of it on to other joints is left out.
    """

    #: turns of the motor per turn of each joint that turns it, with the joints' names
    motor: tuple[tuple[str, float], ...]
    orders: tuple[int, ...]  #: periods per turn of the motor

    @property
    def turns(self) -> Mapping[str, float]:
        """The motor's angle, per angle of each joint."""
        return dict(self.motor)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """``ripple_cos2`` and ``ripple_sin2`` of the second order; no maker states them."""
        return tuple(
            Coefficient(f"ripple_{wave}{order}", "N·m", None, True)
            for order in self.orders
            for wave in ("cos", "sin")
        )

    def shapes(self, q: Array) -> Array:
        """Return cosine and sine of each order (m, 2 orders)."""
        angles = q[:, None] * np.array(self.orders, dtype=np.float64)
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(len(q), -1)


class PlacedElement(NamedTuple):
    """An element among the joints and parameters of an arm."""

    element: Element  # which
    joint: int  # that it acts on, from 0
    turns: tuple[float, ...]  # the angle that it depends on, per angle of each joint (n,)
    part: slice  # where its parameters stand among the e of all elements

    def columns(self, q: Array) -> Array:
        """Return the columns (m, c) at joint positions (m, n)."""
        return self.element.columns(np.asarray(q @ np.array(self.turns)))

    def known(self, q: Array) -> Array:
        """Return the known torque [N·m] (m,) at joint positions (m, n)."""
        return self.element.known(np.asarray(q @ np.array(self.turns)))


@dataclass(frozen=True)
class JointElements:
    """All elements of an arm: e identified parameters, element by element."""

    placed: tuple[PlacedElement, ...] = ()  #: in the order of the parameters

    @classmethod
    def of(
        cls, elements: Sequence[Element], joint_names: Sequence[str], revolute: Sequence[bool]
    ) -> JointElements:
        """Find the joints of elements.

        Raises:
            ModelError: there is no such joint, or it slides.
        """
        placed, first = [], 0
        for element in elements:
            if element.joint not in joint_names:
                raise ModelError(
                    f"there is no joint {element.joint!r} for an element to act on; there are"
                    f" {', '.join(joint_names)}"
                )
            joint = joint_names.index(element.joint)
            if not revolute[joint]:
                raise ModelError(
                    f"joint {element.joint!r} slides; springs and balancers are for joints that"
                    " turn",
                    joint=element.joint,
                )
            part = slice(first, first + len(element.symbols))
            turns = tuple(element.turns.get(name, 0.0) for name in joint_names)
            placed.append(PlacedElement(element, joint, turns, part))
            first = part.stop
        return cls(tuple(placed))

    @property
    def elements(self) -> tuple[Element, ...]:
        """The elements in the order of the parameters."""
        return tuple(one.element for one in self.placed)

    @property
    def identified(self) -> tuple[PlacedElement, ...]:
        """Those that have parameters."""
        return tuple(one for one in self.placed if one.element.symbols)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the e parameters: ``spring_2``, then ``spring_2b`` of another on that joint."""
        first = [f"{s}_{one.joint + 1}" for one in self.placed for s in one.element.symbols]
        before = [first[:k].count(name) for k, name in enumerate(first)]
        return tuple(
            name + (chr(ord("a") + k) if k else "") for name, k in zip(first, before, strict=True)
        )

    @property
    def _coefficients(self) -> list[Coefficient]:
        return [c for one in self.elements for c in one.coefficients if c.identified]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the e parameters."""
        return tuple(one.unit for one in self._coefficients)

    @property
    def nominal(self) -> Array:
        """Values of the e parameters as far as they are given, else zero."""
        return np.array([one.value or 0.0 for one in self._coefficients], dtype=np.float64)

    def torque(self, values: Array, q: Array) -> Array:
        """Return the torque (m, n) [N·m] for e parameter values, without what is known."""
        torque = np.zeros(q.shape)
        for one in self.identified:
            torque[:, one.joint] += one.columns(q) @ values[one.part]
        return torque

    def known(self, q: Array) -> Array:
        """Return the known part of the torque (m, n) [N·m] at positions (m, n)."""
        torque = np.zeros(q.shape)
        for one in self.placed:
            torque[:, one.joint] += one.known(q)
        return torque


def _require_positive(what: str, unit: str, *values: float) -> None:
    for value in values:
        if not 0.0 < value < math.inf:
            raise ModelError(f"the {what} is {value!r} {unit}; it must be finite and positive")


def _require_finite(what: str, *values: float) -> None:
    if not all(map(math.isfinite, values)):
        raise ModelError(f"the {what} is not finite; give a number")


def _require_stiffness(stiffness: float | None, *, identified: bool) -> None:
    if stiffness is None and not identified:
        raise ModelError(
            "the spring has neither a stiffness nor identified = true; give one of the two"
        )
    _require_finite("stiffness", stiffness or 0.0)
