"""Write ns16.urdf from the figures: `python -m sim_fixtures.ns16.build_urdf`.

The file has the nominal inertias: the planted ones over `[simulation] inertia_scale` of cell.toml.

Link frame i stands at O_{i-1} with the axes of DH frame i, so that the standard parameters that a
rigid-body library reads from joint frame i *are* those of the paper: mass, first moment, and the
tensor about the frame's origin. Joint i stands at p_{i-1} of link i-1, turned by Rx(alpha_i); its
axis is Rx(-alpha_i) z, because DH turns about z before it twists.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, radians
from typing import Literal

import numpy as np

from sim_fixtures.errors import FixtureError
from sim_fixtures.ns16 import CELL_PATH, URDF_PATH, LinkInertia, geometry, load_truth

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class Cylinder:
    """Cylinder along an axis of its link frame, between two coordinates on that axis [m]."""

    axis: Axis
    start: float
    end: float
    radius: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    collides: bool = True
    visible: bool = True


@dataclass(frozen=True)
class Sphere:
    """Sphere around the origin of its link frame [m]."""

    radius: float
    collides: bool = True
    visible: bool = True


Shape = Cylinder | Sphere

RGBA: dict[str, str] = {
    "orange": "0.93 0.36 0.08 1",
    "grey": "0.30 0.32 0.34 1",
    "steel": "0.70 0.72 0.74 1",
}

COLOURS: dict[str, str] = {
    "base_link": "grey",
    "link_1": "orange",
    "link_2": "orange",
    "link_3": "orange",
    "link_4": "orange",
    "link_5": "grey",
    "link_6": "steel",
}

SHAPES: dict[str, tuple[Shape, ...]] = {
    "base_link": (Cylinder("z", 0.0, 0.34, 0.20),),
    # y1 points down: the column below the shoulder, then the hub of joint 2.
    "link_1": (
        Cylinder("y", -0.06, 0.24, 0.15),
        Cylinder("x", 0.0, 0.30, 0.09),
        Cylinder("z", -0.13, 0.13, 0.11, offset=(0.300, 0.0, 0.0)),
    ),
    # The upper arm stands beside the plane of the forearm, which folds past it.
    "link_2": (
        Cylinder("z", 0.12, 0.26, 0.10),
        Cylinder("x", 0.0, 0.70, 0.07, offset=(0.0, 0.0, 0.19)),
        Cylinder("z", 0.09, 0.26, 0.09, offset=(0.700, 0.0, 0.0)),
    ),
    # The forearm leaves the elbow along -z3; its motors stand behind the elbow.
    "link_3": (
        Cylinder("y", -0.09, 0.08, 0.08),
        Cylinder("x", 0.0, 0.185, 0.07),
        Cylinder("z", -0.22, 0.16, 0.085, offset=(0.185, 0.0, 0.0)),
    ),
    "link_4": (
        Cylinder("y", 0.24, 0.47, 0.05, visible=False),
        Cylinder("y", 0.22, 0.58, 0.06, collides=False),
    ),
    "link_5": (Sphere(0.06),),
    "link_6": (
        Cylinder("z", 0.07, 0.135, 0.04),
        Cylinder("z", 0.0, 0.07, 0.03, collides=False),
    ),
}


EFFORT = (2100.0, 2800.0, 755.0, 63.0, 151.0, 138.0)
"""Joint torque limits [N m]: what the assumed drives of the cell file give at their limits."""

_HEADER = """\
<?xml version="1.0"?>
<!-- Written by `python -m sim_fixtures.ns16.build_urdf`; edit geometry.py, shapes.py, truth.json.
     Inertias are nominal: those of truth.json over `[simulation] inertia_scale` of cell.toml.
     Joint angles are the DH angles of Table 2, not the angles of the teach pendant.
     Rotor inertias are not part of a URDF; see truth.json. Efforts and velocities are assumed. -->
<robot name="ns16">
"""

# Rotations that carry a cylinder's own axis, z, onto an axis of the link.
_CYLINDER_RPY = {"x": (0.0, pi / 2, 0.0), "y": (-pi / 2, 0.0, 0.0), "z": (0.0, 0.0, 0.0)}


def _numbers(values: Sequence[float]) -> str:
    """Write numbers with as many digits (up to 17) as carry a double without loss."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)


def _origin(xyz: Sequence[float], rpy: Sequence[float] = (0.0, 0.0, 0.0)) -> str:
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'


def _shape(shape: Shape) -> str:
    """Return origin and geometry of one shape."""
    if isinstance(shape, Cylinder):
        middle = list(shape.offset)
        middle["xyz".index(shape.axis)] += 0.5 * (shape.start + shape.end)
        length = shape.end - shape.start
        geometry_xml = f'<cylinder radius="{shape.radius:g}" length="{length:g}"/>'
        origin = _origin([round(value, 9) for value in middle], _CYLINDER_RPY[shape.axis])
    else:
        geometry_xml = f'<sphere radius="{shape.radius:g}"/>'
        origin = _origin((0.0, 0.0, 0.0))
    return f"{origin}<geometry>{geometry_xml}</geometry>"


def _inertial(link: LinkInertia, name: str, scale: float = 1.0) -> str:
    """Return the element of a link over `scale`; raise FixtureError where no body could have it."""
    xx, xy, xz, yy, yz, zz = link.tensor_at_centre
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if link.mass <= 0.0 or moments[0] <= 0.0 or moments[2] >= moments[0] + moments[1]:
        raise FixtureError(f"{name}: no rigid body has mass {link.mass} and moments {moments}")
    tensor = " ".join(
        f'i{key}="{_numbers([value / scale])}"'
        for key, value in zip(
            ("xx", "xy", "xz", "yy", "yz", "zz"), link.tensor_at_centre, strict=True
        )
    )
    return (
        f"    <inertial>{_origin(link.centre_of_mass)}"
        f'<mass value="{_numbers([link.mass / scale])}"/><inertia {tensor}/></inertial>\n'
    )


def _link(name: str, inertia: LinkInertia | None, scale: float = 1.0) -> str:
    """Return one link with its inertia, over `scale`, and shapes."""
    parts = [f'  <link name="{name}">\n']
    if inertia is not None:
        parts.append(_inertial(inertia, name, scale))
    material = f'<material name="{COLOURS[name]}"/>'
    for shape in SHAPES[name]:
        if shape.visible:
            parts.append(f"    <visual>{_shape(shape)}{material}</visual>\n")
        if shape.collides:
            parts.append(f"    <collision>{_shape(shape)}</collision>\n")
    parts.append("  </link>\n")
    return "".join(parts)


def _joint(i: int) -> str:
    """Return revolute joint `i` (0-based) between link i and link i + 1."""
    parent = "base_link" if i == 0 else f"link_{i}"
    xyz = (0.0, 0.0, geometry.D[0]) if i == 0 else geometry.next_origin(i - 1)
    lower, upper = geometry.joint_limits_deg()[i]
    return (
        f'  <joint name="joint_{i + 1}" type="revolute">\n'
        f'    <parent link="{parent}"/><child link="link_{i + 1}"/>\n'
        f"    {_origin(xyz, (geometry.ALPHA_QUARTER_TURNS[i] * pi / 2, 0.0, 0.0))}\n"
        f'    <axis xyz="{_numbers(geometry.joint_axis(i))}"/>\n'
        f'    <limit lower="{_numbers([radians(lower)])}" upper="{_numbers([radians(upper)])}"'
        f' effort="{EFFORT[i]:g}" velocity="{_numbers([radians(geometry.VELOCITY_DEG[i])])}"/>\n'
        f"  </joint>\n"
    )


def build_urdf(inertia_scale: Sequence[float] = (1.0,) * 6) -> str:
    """Return the URDF text with the planted inertias of links 1 ... 6 over `inertia_scale`."""
    truth = load_truth()
    parts = [_HEADER]
    for name, rgba in RGBA.items():
        parts.append(f'  <material name="{name}"><color rgba="{rgba}"/></material>\n')
    parts.append(_link("base_link", None))
    for i, (link, scale) in enumerate(zip(truth.links, inertia_scale, strict=True)):
        parts += [_joint(i), _link(f"link_{i + 1}", link, scale)]
    parts.append(
        '  <link name="flange"/>\n'
        '  <joint name="flange_mount" type="fixed">\n'
        '    <parent link="link_6"/><child link="flange"/>\n'
        f"    {_origin((0.0, 0.0, geometry.D[5]))}\n"
        "  </joint>\n</robot>\n"
    )
    return "".join(parts)


def nominal_urdf() -> str:
    """Return the text of ns16.urdf."""
    cell = tomllib.loads(CELL_PATH.read_text(encoding="utf-8"))
    return build_urdf(cell["simulation"]["inertia_scale"])


def main() -> None:
    """Write the file beside this module."""
    URDF_PATH.write_text(nominal_urdf(), encoding="utf-8")


if __name__ == "__main__":
    main()
