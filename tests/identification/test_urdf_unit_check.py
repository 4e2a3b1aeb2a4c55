"""A description in grams or millimetres contradicts itself; one in SI units never does."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import pytest

from identification.model.urdf_unit_check import WrongUnit, wrong_units
from tests.hil.simulated_logs import urdf_path
from tests.tiers import quick_ones

ARMS = ("ur5_robot.urdf", "panda.urdf", "so101.urdf", "kinova.urdf", "z1.urdf")
MASS = {"mass": 1e3}
LENGTHS = {"length": 1e3, "centre of mass": 1e3}
IN_OTHER_UNITS: dict[str, Mapping[str, float]] = {
    "grams": MASS,
    "grams, also in inertias": {**MASS, "inertia": 1e3},
    "grams, and g·mm²": {**MASS, "inertia": 1e9},
    "g·mm²": {"inertia": 1e9},
    "kg·mm²": {"inertia": 1e6},
    "millimetres": LENGTHS,
    "millimetres, also in inertias": {**LENGTHS, "inertia": 1e6},
    "centimetres": {"length": 100.0, "centre of mass": 100.0},
    "centres of mass in millimetres": {"centre of mass": 1e3},
    "centres of mass in centimetres": {"centre of mass": 100.0},
    "grams, with centres of mass in millimetres": {
        **MASS, "centre of mass": 1e3, "inertia": 1e9,
    },
}  # fmt: skip


def written(text: str, factors: Mapping[str, float]) -> str:
    """The same description in other units."""
    root = ElementTree.fromstring(text)

    def scale(element: ElementTree.Element | None, quantity: str, *names: str) -> None:
        for name in names if element is not None else ():
            numbers = [float(word) for word in element.get(name, "").split()]
            if numbers:
                scaled = [number * factors.get(quantity, 1.0) for number in numbers]
                element.set(name, " ".join(map(repr, scaled)))

    for joint in root.iter("joint"):
        scale(joint.find("origin"), "length", "xyz")
        if joint.get("type") == "prismatic":
            scale(joint.find("limit"), "length", "lower", "upper")
    for inertial in root.iter("inertial"):
        scale(inertial.find("origin"), "centre of mass", "xyz")
        scale(inertial.find("mass"), "mass", "value")
        scale(inertial.find("inertia"), "inertia", "ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    return ElementTree.tostring(root, encoding="unicode")


def descriptions() -> list[Path]:
    files = importlib.metadata.files("example-robot-data") or ()
    return sorted(Path(str(file.locate())) for file in files if file.suffix == ".urdf")


@pytest.mark.parametrize("path", descriptions(), ids=lambda path: path.stem)
def test_a_public_description_does_not_contradict_itself(path: Path) -> None:
    """Arms, hands, legged robots and humanoids, some with placeholders for inertias."""
    assert wrong_units(path.read_text()) == ()


@pytest.mark.parametrize("arm", quick_ones([*ARMS][:1], ARMS))
@pytest.mark.parametrize("kind", IN_OTHER_UNITS)
def test_other_units_are_named(arm: str, kind: str) -> None:
    factors = IN_OTHER_UNITS[kind]
    found = wrong_units(written(urdf_path(arm).read_text(), factors))
    assert {each.quantity: 1.0 / each.factor for each in found} == pytest.approx(dict(factors))


def test_the_place_where_it_shows_most_is_named() -> None:
    text = urdf_path("ur5_robot.urdf").read_text()
    (found,) = wrong_units(written(text, MASS))
    assert found == WrongUnit("mass", "g", 1e-3, ("link", "upper_arm_link"), 8393.0)
    (length, offset) = wrong_units(written(text, LENGTHS))
    assert length.element == ("joint", "elbow_joint")
    assert length.value == pytest.approx(425.0 + 10.0, abs=20.0)
    assert offset.element[0] == "link"


@pytest.mark.parametrize("text", ["<robot name='a'/>", "<robot><link name='a'/></robot>"])
def test_without_masses_nothing_is_concluded(text: str) -> None:
    assert wrong_units(text) == ()


def test_numbers_that_are_none_are_left_to_the_reader() -> None:
    text = "<robot><link name='a'><inertial><mass value='x'/><origin xyz='1'/></inertial></link>"
    assert wrong_units(text + "<joint><parent/><child link='a'/></joint></robot>") == ()


def test_a_loop_of_joints_ends() -> None:
    joint = "<joint name='{}'><parent link='{}'/><child link='{}'/><origin xyz='1 0 0'/></joint>"
    text = joint.format("a", "x", "y") + joint.format("b", "y", "x")
    assert wrong_units(f"<robot>{text}</robot>") == ()
