"""The planted truth of the NS 16: full-precision standard parameters and friction."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from math import degrees
from pathlib import Path

TRUTH_PATH = Path(__file__).with_name("truth.json")
TENSOR_KEYS = ("xx", "xy", "xz", "yy", "yz", "zz")


@dataclass(frozen=True)
class LinkInertia:
    """Inertial parameters of a link about O_{i-1}, in the axes of link frame i.

    Attributes:
        mass: kg.
        first_moment: mass times centre of mass, kg m.
        tensor: (xx, xy, xz, yy, yz, zz) of the inertia tensor, kg m2; off-diagonal entries are
            minus the products of inertia.
    """

    mass: float
    first_moment: tuple[float, float, float]
    tensor: tuple[float, float, float, float, float, float]

    @property
    def centre_of_mass(self) -> tuple[float, float, float]:
        """Return the centre of mass in the link frame [m]."""
        x, y, z = self.first_moment
        return (x / self.mass, y / self.mass, z / self.mass)

    @property
    def tensor_at_centre(self) -> tuple[float, float, float, float, float, float]:
        """Return the tensor about the centre of mass (Steiner), same order as `tensor`."""
        x, y, z = self.centre_of_mass
        xx, xy, xz, yy, yz, zz = self.tensor
        m = self.mass
        return (
            xx - m * (y * y + z * z),
            xy + m * x * y,
            xz + m * x * z,
            yy - m * (x * x + z * z),
            yz + m * y * z,
            zz - m * (x * x + y * y),
        )


@dataclass(frozen=True)
class Ns16Truth:
    """What is planted in the simulated NS 16.

    Attributes:
        links: inertial parameters of links 1 ... 6.
        rotor_inertia: on the link side, kg m2.
        coulomb: N m.
        viscous: N m s/rad; the printed figures read as N m s/deg, which is an assumption.
        third: factor of sgn(qd) qd^2, N m s2/rad2.
    """

    links: tuple[LinkInertia, ...]
    rotor_inertia: tuple[float, ...]
    coulomb: tuple[float, ...]
    viscous: tuple[float, ...]
    third: tuple[float, ...]


@cache
def load_truth() -> Ns16Truth:
    """Read truth.json."""
    data = json.loads(TRUTH_PATH.read_text(encoding="utf-8"))
    links = tuple(
        LinkInertia(mass, (x, y, z), tuple(tensor[key] for key in TENSOR_KEYS))
        for mass, (x, y, z), tensor in zip(
            data["mass"], data["first_moment"], data["inertia"], strict=True
        )
    )
    friction = data["friction"]
    return Ns16Truth(
        links=links,
        rotor_inertia=tuple(data["rotor_inertia"]),
        coulomb=tuple(friction["coulomb"]),
        # 1 N m s/deg is 180/pi N m s/rad
        viscous=tuple(degrees(printed) for printed in friction["viscous_printed"]),
        third=tuple(friction["third"]),
    )


def standard_parameters() -> dict[str, float]:
    """Return every standard parameter by name: m1, mc1x, ..., I1xx, ..., I6zz, then I1m ... I6m."""
    truth = load_truth()
    named: dict[str, float] = {}
    for i, link in enumerate(truth.links, start=1):
        named[f"m{i}"] = link.mass
        named |= {f"mc{i}{a}": v for a, v in zip("xyz", link.first_moment, strict=True)}
        named |= {f"I{i}{k}": v for k, v in zip(TENSOR_KEYS, link.tensor, strict=True)}
    named |= {f"I{i}m": value for i, value in enumerate(truth.rotor_inertia, start=1)}
    return named
