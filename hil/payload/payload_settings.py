"""Settings of controllers for a payload, in the units and the frame of their manuals.

What a controller cannot take, and what is not determined, is a comment in its language.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from identification.model.pseudo_inertia import Body

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


NOT_DETERMINED: Final = "not determined: enter the maker's, or record faster motion"
KGF_CM_S2: Final = 0.0980665
"""1 kgf·cm·s² in kg·m²: 9.80665 N times 0.01 m·s²."""


class ControllerLoad(NamedTuple):
    """A payload in the flange frame of a controller, and which of its values are determined."""

    body: Body
    with_centre: bool
    with_inertia: bool

    @property
    def mass(self) -> str:
        """As text [kg]."""
        return f"{self.body.mass:.3f}"

    def centre(self, unit: float, digits: int) -> list[str]:
        """Return the coordinates of the centre of mass as text, in a unit [m]."""
        return [f"{part / unit:.{digits}f}" for part in self.body.centre]


def controller_settings(load: ControllerLoad) -> dict[str, str]:
    """Return the lines that set a payload, by controller."""
    return {name: form(load) for name, form in _FORMS.items()}


def principal_axes(inertia: Array) -> tuple[Array, Rotation]:
    """Return principal moments (3,) of a tensor (3, 3), and the rotation of their axes.

    The columns of the rotation are the axes in the frame of the tensor. Of the 24 ways to name and
    direct them it is the one that turns the frame least.
    """
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    best_moments = moments
    best_axes = axes
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turned = axes[:, order] * signs
            right_handed = np.linalg.det(turned) > 0.0
            better = np.linalg.det(best_axes) < 0.0 or np.trace(turned) > np.trace(best_axes)
            if right_handed and better:
                best_moments = moments[list(order)]
                best_axes = turned
    from scipy.spatial.transform import Rotation  # 0.2 s, of which `hil run` needs nothing

    return best_moments, Rotation.from_matrix(best_axes)


def _comau(load: ControllerLoad) -> str:
    lines = [f"$TOOL_MASS := {load.mass}"]
    if load.with_centre:
        lines.append(f"$TOOL_CNTR := POS({', '.join(load.centre(1e-3, 2))}, 0, 0, 0, '')")
    else:
        lines.append(f"-- $TOOL_CNTR {NOT_DETERMINED}")
    if not load.with_inertia:
        return "\n".join([*lines, f"-- $TOOL_INERTIA {NOT_DETERMINED}"])
    figures = enumerate(_six(load), 1)
    return "\n".join([*lines, *(f"$TOOL_INERTIA[{k}] := {figure}" for k, figure in figures)])


def _ur(load: ControllerLoad) -> str:
    if not load.with_centre:
        return f"# centre of mass {NOT_DETERMINED}"
    centre = ", ".join(load.centre(1.0, 5))
    if not load.with_inertia:
        return f"set_target_payload({load.mass}, [{centre}])\n# inertia {NOT_DETERMINED}"
    return f"set_target_payload({load.mass}, [{centre}], [{', '.join(_six(load))}])"


def _franka(load: ControllerLoad) -> str:
    if not load.with_centre:
        return f"// centre {NOT_DETERMINED}"
    call = f"robot.setLoad({load.mass}, {{{', '.join(load.centre(1.0, 5))}}}, "
    if not load.with_inertia:
        names = "{Ixx, Ixy, Ixz, Ixy, Iyy, Iyz, Ixz, Iyz, Izz});"
        return f"// inertia {NOT_DETERMINED}:\n// {call}{names}"
    nine = ", ".join(f"{part:.5f}" for part in load.body.inertia.T.ravel())
    return f"{call}{{{nine}}});"


def _kuka(load: ControllerLoad) -> str:
    """Return an entry of `$config.dat`: principal moments, axes by Rz(A) Ry(B) Rx(C)."""
    if not load.with_centre:
        return f"; centre of mass {NOT_DETERMINED}"
    centre = ",".join(f"{name} {part}" for name, part in _named(load.centre(1e-3, 2)))
    if not load.with_inertia:
        entry = f"{{M {load.mass},CM {{{centre},A a,B b,C c}},J {{X jx,Y jy,Z jz}}}}"
        return f"; inertia {NOT_DETERMINED}:\n; LOAD_DATA[1]={entry}"
    moments, rotation = principal_axes(load.body.inertia)
    angles = rotation.as_euler("ZYX", degrees=True)
    turned = ",".join(
        f"{name} {angle:.3f}" for name, angle in zip("ABC", angles.tolist(), strict=True)
    )
    three = ",".join(f"{name} {part}" for name, part in _named(_figures(moments)))
    return f"LOAD_DATA[1]={{M {load.mass},CM {{{centre},{turned}}},J {{{three}}}}}"


def _abb(load: ControllerLoad) -> str:
    """Return loaddata of RAPID: principal moments, and their axes as a quaternion, real first."""
    if not load.with_centre:
        return f"! cog {NOT_DETERMINED}"
    begin = f"PERS loaddata payload := [{load.mass}, [{', '.join(load.centre(1e-3, 2))}], "
    frame = "! in the frame of tool0: as tload of a tool, or for GripLoad while tool0 is active"
    if not load.with_inertia:
        end = "[q1, q2, q3, q4], ix, iy, iz];"
        return f"{frame}\n! inertia {NOT_DETERMINED}:\n! {begin}{end}"
    moments, rotation = principal_axes(load.body.inertia)
    x, y, z, w = rotation.as_quat(canonical=True).tolist()
    four = ", ".join(f"{part:.6f}" for part in (w, x, y, z))
    return f"{frame}\n{begin}[{four}], {', '.join(_figures(moments))}];"


def _fanuc(load: ControllerLoad) -> str:
    """Return the lines of the screen MOTION, DETAIL; it takes no products of inertia."""
    lines = [f"PAYLOAD          [kg]        {load.mass}"]
    if not load.with_centre:
        return "\n".join([*lines, f"! PAYLOAD CENTER {NOT_DETERMINED}"])
    for name, part in _named(load.centre(0.01, 3)):
        lines.append(f"PAYLOAD CENTER {name} [cm]        {part}")
    if not load.with_inertia:
        return "\n".join([*lines, f"! PAYLOAD INERTIA {NOT_DETERMINED}"])
    tensor = load.body.inertia
    for name, moment in zip("XYZ", np.diag(tensor).tolist(), strict=True):
        lines.append(f"PAYLOAD INERTIA {name} [kgfcms^2] {moment / KGF_CM_S2:.4f}")
    products = ", ".join(
        f"{name} {tensor[row, column]:.5f}"
        for name, row, column in (("Ixy", 0, 1), ("Ixz", 0, 2), ("Iyz", 1, 2))
    )
    return "\n".join([*lines, f"! the screen takes no products of inertia: {products} kg·m²"])


def _named(parts: list[str]) -> list[tuple[str, str]]:
    return list(zip("XYZ", parts, strict=True))


def _figures(moments: Array) -> list[str]:
    return [f"{part:.5f}" for part in moments.tolist()]


def _six(load: ControllerLoad) -> list[str]:
    """Return Ixx, Iyy, Izz, Ixy, Ixz, Iyz as text [kg·m²]."""
    tensor = load.body.inertia
    return [f"{part:.5f}" for part in (*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2])]


_FORMS: Final[Mapping[str, Callable[[ControllerLoad], str]]] = {
    "COMAU": _comau,
    "UR": _ur,
    "Franka": _franka,
    "KUKA": _kuka,
    "ABB": _abb,
    "FANUC": _fanuc,
}
