"""The COMAU SMART NS 16-1.65: true parameters, Table 2 of the paper, URDF, cell file.

Standard DH, T_i = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). Link frame i has the axes of DH frame i and
its origin at O_{i-1}, a point of the joint axis, to which the parameters of Table 2 refer.

Table 2 determines a_1, a_2, a_3, d_4 and the twists alpha_2 ... alpha_5, not the sign of alpha_1
(a mirror image has the same table), d_1, d_6, the zero positions and the directions of rotation.
Chosen are alpha_1 = -90 deg with z0 up, d_1 and d_6 of the data sheet, and published directions.
With the forearm level, the elbow offset a_3 then puts the forearm *below* the elbow axis and home
turns the flange up, the mirror image of the real arm; dynamics and identification are the same.

At controller angles of zero, links 2 and 3 are upright; at -90 deg of axis 3 the forearm is level.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import degrees
from pathlib import Path
from types import MappingProxyType

TRUTH_PATH = Path(__file__).with_name("truth.json")
TENSOR_KEYS = ("xx", "xy", "xz", "yy", "yz", "zz")


@dataclass(frozen=True)
class LinkInertia:
    """Inertial parameters of a link about O_{i-1}, in the axes of link frame i: kg, kg m, kg m2.

    `first_moment` is mass times centre of mass; off-diagonal entries of `tensor` (xx, xy, xz, yy,
    yz, zz) are minus the products of inertia.
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
    """True parameters of the simulated NS 16.

    Rotor inertias on the link side [kg m2], Coulomb friction [N m], viscous friction [N m s/rad]
    (the unit of the printed values is assumed to be N m s/deg), `third` the factor of sgn(qd) qd^2
    [N m s2/rad2].
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


Terms = dict[str, float]

TABLE2_PATH = Path(__file__).with_name("table2.csv")
N_ESSENTIAL = 40

A = (0.300, 0.700, 0.185, 0.0, 0.0, 0.0)  # link lengths a_i, m
D = (0.600, 0.0, 0.0, -0.624, 0.0, 0.135)  # link offsets d_i, m
_A1, _A2, _A3 = A[:3]
_D4 = -D[3]


@dataclass(frozen=True)
class Table2Row:
    """One row of Table 2, SI units; the unit of rows f1 is not stated in print."""

    id: int  # 1 ... 58 as printed
    parameter: str  # interpretation of the printed symbol; rows 41 ... 52 are interleaved in print
    pivot: str  # standard parameter whose regressor column is that of this row ("" for friction)
    sign: int  # +1 or -1, the factor of that column
    terms: Mapping[str, float]  # grouped standard parameters with their factors, pivot included
    pi_a: float  # estimate of method A
    pi_b: float  # estimate of method B
    pi_c: float | None  # the manufacturer's value


def _masses(first: int, factor: float) -> Terms:
    """Return `factor` times the mass of every link from `first` to the last."""
    return {f"m{i}": factor for i in range(first, 7)}


# Rows 23-40; the first term of each is the pivot.
_GROUPED: dict[int, Terms] = {
    23: {
        "I1yy": 1.0, "I1m": 1.0, "m2": _A1**2, "I2yy": 1.0, "m3": _A1**2 + _A2**2, "I3zz": 1.0,
        **_masses(4, _A1**2 + _A2**2 + _A3**2),
    },
    24: {"mc2x": 1.0, **_masses(3, _A2)},
    25: {"I2xx": 1.0, "I2yy": -1.0, **_masses(3, -(_A2**2))},
    26: {"I2xz": 1.0, "mc3y": _A2},
    27: {"I2zz": 1.0, "I2m": 1.0, **_masses(3, _A2**2)},
    28: {"mc3x": 1.0, **_masses(4, _A3)},
    29: {"mc3z": -1.0, "mc4y": 1.0, **_masses(5, _D4)},
    30: {
        "I3xx": 1.0, "I3zz": -1.0, "m4": -(_A3**2), "I4zz": 1.0,
        **_masses(5, _D4**2 - _A3**2),
    },
    31: {"I3xz": -1.0, "mc4y": -_A3, **_masses(5, -_A3 * _D4)},
    32: {"I3yy": 1.0, "m4": _A3**2, "I4zz": 1.0, **_masses(5, _A3**2 + _D4**2)},
    33: {"mc4z": 1.0, "mc5y": -1.0},
    34: {"I4xx": 1.0, "I4zz": -1.0, "I5zz": 1.0},
    35: {"I4yy": 1.0, "I5zz": 1.0},
    36: {"I4yz": 1.0, "mc5y": _D4},
    37: {"mc5z": 1.0, "mc6z": 1.0},
    38: {"I5xx": 1.0, "I5zz": -1.0, "I6yy": 1.0},
    39: {"I5yy": 1.0, "I6yy": 1.0},
    40: {"I6xx": 1.0, "I6yy": -1.0},
}  # fmt: skip


@cache
def table2() -> tuple[Table2Row, ...]:
    """Return the 58 rows in the order of the table."""
    rows = []
    with TABLE2_PATH.open(encoding="utf-8", newline="") as stream:
        for record in csv.DictReader(stream):
            row_id = int(record["id"])
            terms: Terms = {}
            if row_id <= N_ESSENTIAL:
                terms = _GROUPED.get(row_id, {record["parameter"]: 1.0})
            pivot = next(iter(terms), "")
            rows.append(
                Table2Row(
                    id=row_id,
                    parameter=record["parameter"],
                    pivot=pivot,
                    sign=int(terms.get(pivot, 1.0)),
                    terms=MappingProxyType(terms),
                    pi_a=float(record["pi_a"]),
                    pi_b=float(record["pi_b"]),
                    pi_c=float(record["pi_c"]) if record["pi_c"] else None,
                )
            )
    return tuple(rows)


FOLDER = Path(__file__).parent
URDF_PATH = FOLDER / "ns16.urdf"
CELL_PATH = FOLDER / "cell.toml"

TABLE2 = table2()


def _numbers(values: Sequence[float]) -> str:
    """Return numbers with as many digits (up to 17) as restore the same doubles."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)


def inertial(link: LinkInertia, scale: float = 1.0) -> str:
    """Return the line of a URDF with the inertia of a link divided by `scale`."""
    entries = zip(TENSOR_KEYS, link.tensor_at_centre, strict=True)
    text = " ".join(f'i{key}="{_numbers([value / scale])}"' for key, value in entries)
    return (
        f'    <inertial><origin xyz="{_numbers(link.centre_of_mass)}" rpy="0 0 0"/>'
        f'<mass value="{_numbers([link.mass / scale])}"/><inertia {text}/></inertial>\n'
    )


def urdf_text(inertia_scale: Sequence[float] = (1.0,) * 6) -> str:
    """Return the URDF with the true inertias divided by `inertia_scale`; ns16.urdf is nominal.

    Link frame i is at O_{i-1} with the axes of DH frame i, so that the standard parameters of joint
    frame i in a rigid-body library are those of the paper: mass, first moment, and the tensor about
    the origin of the frame. Joint i is at p_{i-1} of link i-1, rotated by Rx(alpha_i); its axis is
    Rx(-alpha_i) z, because DH rotates about z before the twist.
    """
    links = zip(load_truth().links, inertia_scale, strict=True)
    lines = URDF_PATH.read_text(encoding="utf-8").splitlines(keepends=True)
    for at, line in enumerate(lines):
        if line.lstrip().startswith("<inertial>"):
            lines[at] = inertial(*next(links))
    return "".join(lines)
