"""docs/results.md names every field, and its program runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from pydantic import BaseModel

from hil.results import Results
from identification.export.parameters import parameters_dict

from .identified_arm import IdentifiedArm, identified_arm, write_exports
from .test_exports import ALL, TWO_LINK, table

DOCUMENT = Path(__file__).parents[2] / "docs" / "results.md"
CODE = re.compile(r"```(\w+)\n(.*?)```", re.S)


@pytest.fixture(scope="module")
def text() -> str:
    return DOCUMENT.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def arm() -> IdentifiedArm:
    return identified_arm(TWO_LINK)


def named(text: str) -> set[str]:
    return set(re.findall(r"`([^`\n]+)`", CODE.sub("", text)))


def fields(model: type[BaseModel]) -> Iterator[str]:
    """Names of all fields, those of nested models included."""
    for name, info in model.model_fields.items():
        yield name
        pending = [info.annotation]
        while pending:
            part = pending.pop()
            pending += getattr(part, "__args__", ())
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from fields(part)


def test_every_field_of_results_json_is_explained(text: str) -> None:
    assert set(fields(Results)) <= named(text)


def test_every_field_of_parameters_json_is_explained(text: str, arm: IdentifiedArm) -> None:
    content = parameters_dict(arm.cell.model, arm.estimate, consistent=arm.consistency.consistent)
    assert set(content) <= named(text)
    assert set(content["parameters"][0]) <= named(text)
    assert set(content["standard"]) <= named(text)
    tensor = {"Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz"}
    assert set(content["standard"]["links"][0]) - tensor <= named(text)


def test_every_file_is_listed(text: str) -> None:
    assert ALL | {"results.json", "report.html"} <= named(text)


def test_the_python_example_predicts_the_torque_of_the_model(
    text: str, arm: IdentifiedArm, tmp_path: Path
) -> None:
    """Word for word, in a process of its own, on the files alone."""
    folder = tmp_path / "runs" / "demo"
    folder.mkdir(parents=True)
    write_exports(folder, arm.cell, arm.estimate, arm.consistency.consistent)
    (program,) = (code for language, code in CODE.findall(text) if language == "python")
    done = subprocess.run(
        [sys.executable, "-I", "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    shown = np.fromstring(done.stdout.strip().strip("[]"), sep=" ")
    zero, speed = np.zeros((1, 2)), np.full((1, 2), 0.5)
    values = arm.consistency.consistent.estimate.values
    (expected,) = arm.cell.model.torque(values, zero, speed, zero)
    np.testing.assert_allclose(shown, expected, rtol=1e-6)


def test_the_formula_for_the_centre_of_mass_is_that_of_the_urdf(
    arm: IdentifiedArm, tmp_path: Path
) -> None:
    """Reading standard.csv as the document says gives the inertial of the written URDF."""
    write_exports(tmp_path, arm.cell, arm.estimate, arm.consistency.consistent)
    root = ElementTree.parse(tmp_path / "identified.urdf").getroot()
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for cells in table(tmp_path / "standard.csv"):
        row = {name: float(cells[name]) for name in cells if name not in ("joint", "reference")}
        child = joints[cells["joint"]].find("child")
        assert child is not None
        inertial = root.find(f"link[@name='{child.get('link')}']/inertial")
        assert inertial is not None
        centre = np.array([row["mcx"], row["mcy"], row["mcz"]]) / row["m"]
        about = np.array([[row["Ixx"], row["Ixy"], row["Ixz"]],
                          [row["Ixy"], row["Iyy"], row["Iyz"]],
                          [row["Ixz"], row["Iyz"], row["Izz"]]], float)  # fmt: skip
        about -= row["m"] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        origin, tensor = inertial.find("origin"), inertial.find("inertia")
        assert origin is not None and tensor is not None
        assert (origin.get("rpy") or "0 0 0").split() == ["0", "0", "0"]
        written = [float(x) for x in str(origin.get("xyz")).split()]
        np.testing.assert_allclose(written, centre, atol=1e-12)
        assert float(str(tensor.get("iyy"))) == pytest.approx(about[1, 1], rel=1e-9)
        assert float(str(tensor.get("ixz"))) == pytest.approx(about[0, 2], abs=1e-12)
