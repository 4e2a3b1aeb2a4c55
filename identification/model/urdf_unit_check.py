"""Whether a URDF is in SI units, by the URDF alone: grams, millimetres and g·mm² are found.

An arm's masses, lengths, centres of mass and inertias bound each other: no body is much larger than
the arm, none is lighter than air or many times denser than lead. A description that no arm can have
is examined in other units, which are named only where they make it an arm as arms are built.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Final, Literal
from xml.etree.ElementTree import Element

import numpy as np

from identification.arrays import Array
from identification.model.urdf_text import urdf_tree

Quantity = Literal["mass", "length", "centre of mass", "inertia"]

_LENGTHS: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_UNITS: Final[Mapping[Quantity, Mapping[str, float]]] = {
    "mass": {"kg": 1.0, "g": 1e-3},
    "length": _LENGTHS,
    "centre of mass": _LENGTHS,
    "inertia": {
        "kg·m²": 1.0, "g·m²": 1e-3, "kg·cm²": 1e-4, "kg·mm²": 1e-6, "g·cm²": 1e-7, "g·mm²": 1e-9,
    },
}  # fmt: skip
"""Factors to SI units."""


@dataclass(frozen=True)
class _Range:
    """Bounds of a figure: no arm lies beyond `possible`, existing arms within `usual`.

    Of 89 descriptions of arms, hands, legged robots and humanoids none is beyond the bounds that
    are usual by more than the few with placeholders for inertias.
    """

    possible: tuple[float, float]
    usual: tuple[float, float]

    def is_possible(self, value: float) -> bool:
        low, high = self.possible
        return low <= value <= high

    def is_usual(self, value: float) -> bool:
        low, high = self.usual
        return low <= value <= high

    def distance(self, value: float) -> float:
        """Decades from the middle of what is usual."""
        return abs(math.log10(max(value, 1e-30)) - 0.5 * math.log10(math.prod(self.usual)))


_EXTENT: Final = _Range((0.0, 50.0), (0.1, 8.0))  # m
_MASS: Final = _Range((0.0, 1e6), (0.05, 5000.0))  # kg, of all bodies
# kg/m³, mass over the cube of the extent
_MASS_OVER_EXTENT_CUBED: Final = _Range((0.01, 2000.0), (0.5, 300.0))
_OFFSET: Final = _Range((0.0, 5.0), (0.02, 2.0))  # farthest centre of mass over the longest chain
_GYRATION: Final = _Range((1e-3, 20.0), (0.02, 1.0))  # over the extent, mean over the mass
_DENSITY: Final = _Range((0.05, 5e4), (20.0, 15e3))  # kg/m³, of ellipsoids with these inertias
_ISOTROPIC_RATIO: Final = 1.0 + 1e-9  # ratio of the moments of inertia of a ball
_UNIT_CHANGE_COST: Final = 0.5  # decades that another unit for one more quantity costs


@dataclass(frozen=True)
class WrongUnit:
    """A quantity of a description that is not in its SI unit.

    Attributes:
        quantity: what is in another unit, everywhere in the description.
        unit: in which it seems to be.
        factor: to SI units.
        element: the link or the joint where it shows most, ``link`` or ``joint`` with its name.
        value: that is written there.
    """

    quantity: Quantity
    unit: str
    factor: float
    element: tuple[Literal["link", "joint"], str]
    value: float


@dataclass(frozen=True, eq=False)
class _Description:
    """Figures of a description, as written.

    Attributes:
        joints: with an origin.
        lengths: distance of each joint from the one before it, with the travel of a slide.
        chain: longest sum of these from the base.
        links: with a mass.
        mass, offset, inertia: of these; distance of the centre of mass from the frame of the link;
            principal moments of inertia (k, 3).
    """

    joints: tuple[str, ...]
    lengths: Array
    chain: float
    links: tuple[str, ...]
    mass: Array
    offset: Array
    inertia: Array = field(repr=False)

    def is_possible(self) -> bool:
        """Whether an arm can have these figures in SI units."""
        return all(limits.is_possible(value) for limits, value in self._figures(_SI_FACTORS))

    def distance(self, factors: Sequence[float]) -> float:
        """Return decades from the usual arm in other units, infinite beyond what is usual."""
        figures = [*self._figures(factors)]
        if not all(limits.is_usual(value) for limits, value in figures):
            return math.inf
        return sum(limits.distance(value) for limits, value in figures)

    def _figures(self, factors: Sequence[float]) -> Iterator[tuple[_Range, float]]:
        of_mass, of_length, of_offset, of_inertia = factors
        offset = of_offset * float(self.offset.max(initial=0.0))
        chain = of_length * self.chain
        extent = chain + offset
        if extent <= 0.0:
            return
        yield _EXTENT, extent
        if chain > 0.0 and offset > 0.0:
            yield _OFFSET, offset / chain
        mass = of_mass * self.mass
        if not mass.size:
            return
        yield _MASS, float(mass.sum())
        yield _MASS_OVER_EXTENT_CUBED, float(mass.sum()) / extent**3
        inertia = of_inertia * self.inertia
        bodies = inertia[:, -1] > _ISOTROPIC_RATIO * inertia[:, 0]  # others are placeholders
        if mass[bodies].sum() < 0.5 * mass.sum():
            return
        gyration = math.sqrt(float(inertia[bodies, -1].sum() / mass[bodies].sum()))
        yield _GYRATION, gyration / extent
        density = _median(_densities(mass[bodies], inertia[bodies]), mass[bodies])
        if math.isfinite(density):
            yield _DENSITY, density


_SI_FACTORS: Final = (1.0, 1.0, 1.0, 1.0)


@lru_cache(maxsize=8)
def wrong_units(urdf: str) -> tuple[WrongUnit, ...]:
    """Return the quantities of a URDF that are not in SI units; none where an arm has such sizes.

    Raises:
        ModelError: the text is not XML.
    """
    description = _described(urdf_tree(urdf))
    if description.is_possible():
        return ()

    def cost(names: Sequence[str]) -> float:
        changed = sum(factor != 1.0 for factor in _factors(names))
        return description.distance(_factors(names)) + _UNIT_CHANGE_COST * changed

    best = min(product(*_UNITS.values()), key=cost)
    if not math.isfinite(cost(best)):
        return ()
    found = zip(_UNITS, best, _factors(best), strict=True)
    return tuple(
        _where(description, quantity, unit, factor)
        for quantity, unit, factor in found
        if factor != 1.0
    )


def _factors(names: Sequence[str]) -> list[float]:
    """Return the factors of the units of each quantity, in their order."""
    return [table[name] for table, name in zip(_UNITS.values(), names, strict=True)]


def _where(description: _Description, quantity: Quantity, unit: str, factor: float) -> WrongUnit:
    """Return where a quantity shows most that it is in another unit."""
    values = {
        "mass": description.mass,
        "length": description.lengths,
        "centre of mass": description.offset,
        "inertia": description.inertia[:, -1],
    }[quantity]
    largest = int(np.argmax(values))
    if quantity == "length":
        return WrongUnit(
            quantity, unit, factor, ("joint", description.joints[largest]), float(values[largest])
        )
    return WrongUnit(
        quantity, unit, factor, ("link", description.links[largest]), float(values[largest])
    )


def _described(root: Element) -> _Description:
    """Return the figures of a description."""
    before: dict[str, tuple[str, float]] = {}
    joints = []
    for joint in root.findall("joint"):
        parent, child = (_text(joint.find(end), "link") for end in ("parent", "child"))
        length = float(np.linalg.norm(_vector(joint.find("origin"), "xyz")))
        limit = joint.find("limit")
        if joint.get("type") == "prismatic" and limit is not None:
            length += abs(_number(limit, "upper") - _number(limit, "lower"))
        before[child] = (parent, length)
        joints.append((joint.get("name", ""), length))
    links = []
    for link in root.findall("link"):
        inertial = link.find("inertial")
        mass = 0.0 if inertial is None else _number(inertial.find("mass"), "value")
        if inertial is None or mass <= 0.0:
            continue
        offset = float(np.linalg.norm(_vector(inertial.find("origin"), "xyz")))
        links.append((link.get("name", ""), mass, offset, _moments(inertial.find("inertia"))))
    return _Description(
        tuple(name for name, _ in joints),
        np.array([length for _, length in joints]),
        max((_chain(name, before) for name in before), default=0.0),
        tuple(name for name, *_ in links),
        np.array([mass for _, mass, *_ in links]),
        np.array([offset for *_, offset, _ in links]),
        np.array([moments for *_, moments in links]).reshape(-1, 3),
    )


def _chain(link: str, before: dict[str, tuple[str, float]]) -> float:
    """Return the sum of the lengths from the base to a link."""
    length = 0.0
    for _ in before:  # as often as there are joints, also in a loop
        if link not in before:
            break
        link, part = before[link]
        length += part
    return length


def _moments(inertia: Element | None) -> Array:
    """Return the principal moments of inertia (3,), ascending."""
    xx, xy, xz, yy, yz, zz = (
        _number(inertia, name) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return np.asarray(np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])))


def _densities(mass: Array, inertia: Array) -> Array:
    """Return the densities of ellipsoids with these masses (k,) and principal moments (k, 3)."""
    second = np.maximum(0.5 * inertia.sum(axis=1, keepdims=True) - inertia, 0.0)
    volume = 4.0 / 3.0 * np.pi * np.prod(np.sqrt(5.0 * second / mass[:, None]), axis=1)
    infinite = np.full_like(mass, np.inf)
    return np.asarray(np.divide(mass, volume, out=infinite, where=volume > 0.0))


def _median(values: Array, weights: Array) -> float:
    """Return the weighted median."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


def _text(element: Element | None, name: str) -> str:
    return "" if element is None else element.get(name, "")


def _number(element: Element | None, name: str) -> float:
    """Return a number of an element, 0 where there is none."""
    return float(_vector(element, name, size=1)[0])


def _vector(element: Element | None, name: str, size: int = 3) -> Array:
    """Return numbers of an element (size,), zeros where there are others than these."""
    words = _text(element, name).split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        return np.zeros(size)
    return values if len(values) == size and np.isfinite(values).all() else np.zeros(size)
