"""Springs, balancers and periodic torques: torques that depend on the angle of a joint or motor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.errors import ModelError

_DISTANCE_TOLERANCE: Final = 1e-6  # relative; equal distances allow a length of zero


class ElementError(ModelError):
    """An element whose parameters cannot be separated from others."""


class Coefficient(NamedTuple):
    """A factor of a torque function."""

    symbol: str  # name of the parameter, without the number of the joint
    unit: str
    value: float | None  # given value, if any
    identified: bool  # whether it is a parameter


@dataclass(frozen=True)
class Element(ABC):
    r"""A torque of the drive of one joint, :math:`F\,dl/dq` for a tension F at a length l.

    k coefficients times functions of an angle, c of them identified.
    """

    joint: str  # name

    @property
    def turns(self) -> Mapping[str, float]:
        """Derivative of the angle with respect to each joint angle, by joint name."""
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
        return tuple(
            coefficient.symbol for coefficient in self.coefficients if coefficient.identified
        )

    def columns(self, q: Array) -> Array:
        """Return the torque per unit of each identified parameter, at angles (m,): (m, c)."""
        return self.shapes(q)[:, [coefficient.identified for coefficient in self.coefficients]]

    def known_torque(self, q: Array) -> Array:
        """Return the known part of the torque [N·m] (m,)."""
        values = [
            0.0 if coefficient.identified else coefficient.value or 0.0
            for coefficient in self.coefficients
        ]
        return np.asarray(self.shapes(q) @ np.array(values))


@dataclass(frozen=True)
class Anchors:
    """Two anchors in the plane of a joint (ModelError if their distances are equal)."""

    base: float  #: distance of the anchor on the base side from the axis [m]
    link: float  #: distance of the anchor on the link side from the axis [m]
    angle: float  #: between the two at joint angle zero [rad]

    def __post_init__(self) -> None:
        if abs(self.base - self.link) <= _DISTANCE_TOLERANCE * self.base:
            raise ModelError(
                f"both anchors are {self.base:g} m from the axis, so that their distance is zero at"
                " one angle; give the measured distances"
            )

    def length(self, q: Array) -> Array:
        """Return the distance l between the anchors [m] at positions (m,) [rad]."""
        product = 2.0 * self.base * self.link
        return np.sqrt(self.base**2 + self.link**2 - product * np.cos(q + self.angle))

    def lever(self, q: Array) -> Array:
        """Return the lever dl/dq [m/rad] at positions (m,)."""
        moment = self.base * self.link * np.sin(q + self.angle)
        return np.asarray(moment / self.length(q))


@dataclass(frozen=True)
class TorsionSpring(Element):
    """A torsion spring; the torque of the drive is ``stiffness (q - rest)``.

    Raises:
        ModelError: a known spring has no stiffness.
    """

    rest: float  #: position without torque [rad]
    stiffness: float | None = None  #: [N·m/rad]; nominal, if identified
    identified: bool = False  #: whether the stiffness is a parameter

    def __post_init__(self) -> None:
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
    """A spring between two anchors with tension ``stiffness (l - free_length) + preload``.

    Raises:
        ModelError: a known spring has no stiffness.
    """

    anchors: Anchors  #: fixed points
    free_length: float  #: [m]
    stiffness: float | None = None  #: [N/m]; nominal, if identified
    #: tension at the free length [N]; None: a parameter of an identified spring, else zero
    preload: float | None = None
    identified: bool = False  #: whether the stiffness is a parameter

    def __post_init__(self) -> None:
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
        lever = self.anchors.lever(q)
        extension = self.anchors.length(q) - self.free_length
        return np.column_stack([lever * extension, lever])


@dataclass(frozen=True)
class GasCylinder(Element):
    """An isothermal gas cylinder between two anchors.

    Its pressure is ``pressure volume / (volume - s area)`` after a compression stroke s from
    `length`.

    Raises:
        ModelError: the gas has no volume left at some angle.
    """

    anchors: Anchors  #: fixed points
    length: float  #: distance between the anchors at the given pressure and volume [m]
    area: float  #: of the piston, or of a gas spring's rod [m²]
    pressure: float  #: above ambient [Pa]
    volume: float  #: of the gas [m³]
    pulls: bool = True  #: the anchors together (hydraulic balancer), or apart (gas spring)
    identified: bool = False  #: whether a factor of its torque is a parameter

    def __post_init__(self) -> None:
        base = self.anchors.base
        link = self.anchors.link
        end = base + link if self.pulls else abs(base - link)
        volume = float(self._volume_left(np.array(end)))
        if not volume > 0.0:
            raise ModelError(
                f"the gas has {volume:.3g} m³ left where the anchors are {end:.3g} m apart; correct"
                " volume, area, length or the distances of the anchors"
            )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """A factor of the computed torque."""
        return (Coefficient("balancer" if self.pulls else "gas_spring", "1", 1.0, self.identified),)

    def shapes(self, q: Array) -> Array:
        """Return the computed torque (m, 1) [N·m]."""
        volume = self._volume_left(self.anchors.length(q))
        force = self.area * self.pressure * self.volume / volume
        torque = (1.0 if self.pulls else -1.0) * self.anchors.lever(q) * force
        return np.asarray(torque)[:, None]

    def _volume_left(self, length: Array) -> Array:
        """Volume of the gas [m³] at a distance between the anchors."""
        stroke = length - self.length if self.pulls else self.length - length
        return np.asarray(self.volume - stroke * self.area)


@dataclass(frozen=True)
class PeriodicTorque(Element):
    """A torque periodic in an angle; cosine and sine of each order are identified.

    The gear does not transmit it.
    """

    orders: tuple[int, ...]  #: periods per turn
    prefix: ClassVar[str]  #: of the parameters' names

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Such as ``ripple_cos2`` and ``ripple_sin2`` of the second order."""
        return tuple(
            Coefficient(f"{self.prefix}_{wave}{order}", "N·m", None, True)
            for order in self.orders
            for wave in ("cos", "sin")
        )

    def shapes(self, q: Array) -> Array:
        """Return cosine and sine of each order (m, 2 orders)."""
        angles = q[:, None] * np.array(self.orders, dtype=np.float64)
        waves = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return waves.reshape(len(q), 2 * len(self.orders))


@dataclass(frozen=True)
class TorqueRipple(PeriodicTorque):
    """A torque periodic in the angle of the joint's motor: cogging, gear teeth, wave generators.

    The effect of a coupled motor on other joints is neglected.
    """

    motor: tuple[tuple[str, float], ...]  #: turns of the motor per turn of each joint, by name
    prefix = "ripple"

    @property
    def turns(self) -> Mapping[str, float]:
        """Derivative of the motor's angle with respect to each joint angle."""
        return dict(self.motor)


@dataclass(frozen=True)
class PositionTorque(PeriodicTorque):
    """A torque periodic in the joint's own angle: cables, the error of a torque sensor.

    A torque that repeats once per turn resembles a weight, and is left to the bodies.
    """

    orders: tuple[int, ...] = (2, 3, 4)
    prefix = "position"


class PlacedElement(NamedTuple):
    """An element among the joints and parameters of an arm."""

    element: Element
    joint: int  # that it acts on, from 0
    turns: tuple[float, ...]  # derivative of its angle with respect to each joint angle (n,)
    part: slice  # of its parameters among the e of all elements

    def columns(self, q: Array) -> Array:
        """Return the columns (m, c) at joint positions (m, n)."""
        return self.element.columns(np.asarray(q @ np.array(self.turns)))

    def known_torque(self, q: Array) -> Array:
        """Return the known torque [N·m] (m,) at joint positions (m, n)."""
        return self.element.known_torque(np.asarray(q @ np.array(self.turns)))


@dataclass(frozen=True)
class JointElements:
    """All elements of an arm: e identified parameters, element by element."""

    placed: tuple[PlacedElement, ...] = ()  #: in the order of the parameters

    @classmethod
    def of(
        cls, elements: Sequence[Element], joint_names: Sequence[str], revolute: Sequence[bool]
    ) -> JointElements:
        """Assign elements to joints.

        Raises:
            ModelError: there is no such joint, or it is prismatic.
        """
        placed = []
        first = 0
        for element in elements:
            if element.joint not in joint_names:
                raise ModelError(
                    f"there is no joint {element.joint!r} for an element to act on; there are"
                    f" {', '.join(joint_names)}"
                )
            joint = joint_names.index(element.joint)
            if not revolute[joint]:
                raise ModelError(
                    f"joint {element.joint!r} is prismatic; springs and balancers need a revolute"
                    " joint",
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
        return tuple(placed.element for placed in self.placed)

    @property
    def identified(self) -> tuple[PlacedElement, ...]:
        """Elements with parameters."""
        return tuple(placed for placed in self.placed if placed.element.symbols)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the e parameters: ``spring_2``, ``spring_2b`` for another on that joint."""
        first = [
            f"{s}_{placed.joint + 1}" for placed in self.placed for s in placed.element.symbols
        ]
        before = [first[:k].count(name) for k, name in enumerate(first)]
        return tuple(
            name + (chr(ord("a") + k) if k else "") for name, k in zip(first, before, strict=True)
        )

    @property
    def _coefficients(self) -> list[Coefficient]:
        return [c for element in self.elements for c in element.coefficients if c.identified]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the e parameters."""
        return tuple(coefficient.unit for coefficient in self._coefficients)

    @property
    def nominal(self) -> Array:
        """Given values of the e parameters, else zero."""
        return np.array(
            [coefficient.value or 0.0 for coefficient in self._coefficients], dtype=np.float64
        )

    def known_torque(self, q: Array) -> Array:
        """Return the known part of the torque (m, n) [N·m] at positions (m, n)."""
        torque = np.zeros(q.shape)
        for placed in self.placed:
            torque[:, placed.joint] += placed.known_torque(q)
        return torque


def _require_stiffness(stiffness: float | None, *, identified: bool) -> None:
    if stiffness is None and not identified:
        raise ModelError(
            "the spring has neither a stiffness nor identified = true; give one of the two"
        )
