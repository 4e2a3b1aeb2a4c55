"""Robot descriptions and bodies for tests of the model."""

from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest

from identification.model.pseudo_inertia import Body, inertial_parameters
from sim_fixtures.ns16 import load_truth
from tests.identification.two_link import values_of


def robot_text(path):
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("the example-robot-data package is not installed")
    root = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    return (root / path).read_text(encoding="utf-8")


def random_urdf(seed, n_joints=7):
    """A random tree: any axis, any placement, all four kinds of joint that are allowed."""
    random = np.random.default_rng(seed)
    parts = ['<robot name="random"><link name="l0"/>']

    def numbers(*values):
        return " ".join(f"{value:.6f}" for value in values)

    for i in range(1, n_joints + 1):
        kind = random.choice(
            ["revolute", "prismatic", "continuous", "fixed"], p=[0.4, 0.3, 0.2, 0.1]
        )
        if i == 1:
            kind = "revolute"
        parent = int(random.integers(max(0, i - 3), i))  # branches now and then
        half = random.normal(size=(3, 3))
        inertia = half @ half.T + np.eye(3)
        axis = np.eye(3)[random.integers(3)] if random.random() < 0.5 else random.normal(size=3)
        parts.append(
            f'<link name="l{i}"><inertial><origin xyz="{numbers(*random.normal(size=3))}"/>'
            f'<mass value="{random.uniform(1, 5):.6f}"/><inertia ixx="{inertia[0, 0]}" '
            f'ixy="{inertia[0, 1]}" ixz="{inertia[0, 2]}" iyy="{inertia[1, 1]}" '
            f'iyz="{inertia[1, 2]}" izz="{inertia[2, 2]}"/></inertial></link>'
            f'<joint name="j{i}" type="{kind}"><parent link="l{parent}"/><child link="l{i}"/>'
            f'<origin xyz="{numbers(*random.normal(size=3))}" '
            f'rpy="{numbers(*random.normal(size=3))}"/>'
            f'<axis xyz="{numbers(*axis)}"/>'
            '<limit lower="-9" upper="9" effort="9" velocity="9"/></joint>'
        )
    return "".join(parts) + "</robot>"


def link(name, shape="", at="0 0 0", *, rpy="0 0 0", mass=1, inertia=(1, 1, 1), centre="0 0 0"):
    """A link with a diagonal inertia, and with a collision shape if one is given."""
    xx, yy, zz = inertia
    place = f'<collision><origin xyz="{at}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>'
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"/></inertial>'
        f"{place if shape else ''}</link>"
    )


def joint(name, parent, child, axis="0 0 1", kind="revolute", at="0 0 0", rpy="0 0 0", ends=2):
    """A joint from `-ends` to `ends`."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        f'<limit lower="{-ends}" upper="{ends}" effort="1" velocity="1"/></joint>'
    )


def robot(*parts):
    return f'<robot name="r">{"".join(parts)}</robot>'


def one_joint(kind, axis="0 0 1"):
    return robot('<link name="a"/>', link("b", mass=2), joint("strange", "a", "b", axis, kind))


def ns16_values(model, coulomb=None, viscous=None):
    """Parameters of the simulated NS 16, zero in the third term; `model` is of its description."""
    truth = load_truth()
    friction = [truth.coulomb if coulomb is None else coulomb]
    friction.append(truth.viscous if viscous is None else viscous)
    friction += [np.zeros(len(model.friction.terms) - 12)]
    return values_of(model, np.concatenate(friction), truth.rotor_inertia)


def some_bodies(n, seed=0):
    """Possible standard parameters that have nothing to do with the robot, rotors last."""
    rng = np.random.default_rng(seed)
    standard = np.empty((n, 11))
    for row in standard:
        points = rng.normal(scale=0.1, size=(9, 3))
        mass = rng.uniform(0.5, 20.0)
        spread = np.cov(points.T) * mass
        tensor = np.trace(spread) * np.eye(3) - spread
        row[:10] = inertial_parameters(Body(mass, rng.normal(scale=0.2, size=3), tensor))
        row[10] = rng.uniform(0.0, 1.0)
    return standard.reshape(-1)


NS16_TURNS = np.diag([-120.0, 150.0, -130.0, -80.0, 80.0, -50.0]) @ (
    np.eye(6) + np.array([[0.0] * 6] * 4 + [[0, 0, 0, -0.2, 0, 0], [0, 0, 0, 0.16, -0.3, 0]])
)
"""Turns of the motors per turn of the joints; motors 5 and 6 turn with the joints before them."""
