"""Friction, rotors and limits of an arm with torque as files of simulators, with ranges."""

from __future__ import annotations

import ast
import json
import runpy
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.campaign.campaign import Campaign
from hil.cli import app

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, identified_campaign: Campaign) -> Path:
    """A campaign with the files of its identification."""
    copy = tmp_path_factory.mktemp("drives") / "campaign"
    shutil.copytree(identified_campaign.folder.root, copy)
    run("identify", copy, "-q")
    return copy


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, [*map(str, arguments)])


def links_of(folder: Path) -> list[dict[str, Any]]:
    """Return the physically consistent links."""
    document = json.loads((folder / "parameters.json").read_text())
    links: list[dict[str, Any]] = document["standard"]["links"]
    return links


def constants(path: Path) -> dict[str, Any]:
    """Return the dictionaries of a Python file."""
    return {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }


def test_isaac_lab_gets_the_identified_drives_without_gains(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "arm.py"
    done = run("export", folder, "--to", "isaaclab", "-o", path, "--ranges")
    assert done.exit_code in (0, 5), done.output
    values = constants(path)
    assert "STIFFNESS" not in values and "DELAY" not in values
    for name, link in zip(values["JOINTS"], links_of(folder), strict=True):
        assert values["ARMATURE"][name] == pytest.approx(link["rotor_inertia"], rel=1e-5)
        viscous = link["friction"]["f1"]
        assert values["VISCOUS_FRICTION"][name] == pytest.approx(max(0.0, viscous), rel=1e-5)
        assert values["FRICTION"][name] >= values["DYNAMIC_FRICTION"][name]
    ranges = json.loads((tmp_path / "arm.ranges.json").read_text())["ranges"]
    for name in values["JOINTS"]:
        entry = ranges["VISCOUS_FRICTION"][name]
        assert entry["low"] <= values["VISCOUS_FRICTION"][name] <= entry["high"]
        assert entry["from"] == "data"


def test_genesis_gets_drives_with_ranges_and_draws(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "arm.py"
    done = run("export", folder, "--to", "genesis", "-o", path, "--ranges", "--ensemble", 5)
    assert done.exit_code in (0, 5), done.output
    values = runpy.run_path(str(path))
    assert "KP" not in values and "DELAY" not in values  # a log of torques shows no servo
    document = json.loads((tmp_path / "arm.ranges.json").read_text())
    for k, link in enumerate(links_of(folder)):
        name = values["JOINTS"][k]
        assert values["ARMATURE"][name] == pytest.approx(link["rotor_inertia"], rel=1e-5)
        for field in ("ARMATURE", "DAMPING", "FRICTIONLOSS"):
            entry = document["ranges"][field][name]
            assert entry["low"] <= values[field][name] <= entry["high"]
            draws = [draw[k] for draw in document["draws"][field]]
            assert len(set(draws)) == 5 and min(draws) >= 0.0


def test_draws_of_drives_are_those_of_the_arms_of_an_ensemble(folder: Path, tmp_path: Path) -> None:
    """An ensemble of Isaac Lab's drives and one of MJCFs, of one seed, are the same arms."""
    drives, arms = tmp_path / "drives.py", tmp_path / "arms"
    for to, path in (("isaaclab", drives), ("mjcf", arms)):
        line = ("export", folder, "--to", to, "-o", path, "--ranges", "--ensemble", 3)
        done = run(*line)
        assert done.exit_code in (0, 5), done.output
    of_drives, of_arms = (
        json.loads(path.with_suffix(".ranges.json").read_text())["draws"] for path in (drives, arms)
    )
    assert of_drives["ARMATURE"] == of_arms["armature"]
    files = sorted(arms.glob("*.xml"))
    assert len(files) == 3
    for k, path in enumerate(files):
        joints = ElementTree.parse(path).getroot().iter("joint")
        armature = [float(each.attrib["armature"]) for each in joints if "armature" in each.attrib]
        assert armature == pytest.approx(of_arms["armature"][k], rel=1e-5)


def test_ranges_are_written_next_to_an_mjcf(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    done = run("export", folder, "--to", "mjcf", "-o", path, "--ranges")
    assert done.exit_code in (0, 5), done.output
    document = json.loads((tmp_path / "arm.ranges.json").read_text())
    assert set(document["ranges"]) == {"forcerange", "frictionloss", "damping", "armature"}
    joints = ElementTree.parse(path).getroot().iter("joint")
    stated = {node.get("name"): node for node in joints}
    for name, entry in document["ranges"]["armature"].items():
        armature = float(stated[name].attrib["armature"])
        assert entry["value"] == pytest.approx(armature, rel=1e-5)


def test_an_own_urdf_gets_friction_and_stays_otherwise(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "own.urdf"
    joint = "<joint name='{}' type='revolute'><axis xyz='0 1 0'/></joint>"
    joints = "".join(joint.format(link["joint"]) for link in links_of(folder))
    path.write_text(f"<robot name='own'>{joints}<link name='camera'/></robot>")
    before = path.read_text()
    copy = tmp_path / "copy.urdf"
    done = run("export", folder, "--to", "urdf", "--into", path, "-o", copy)
    assert done.exit_code in (0, 5), done.output
    assert path.read_text() == before
    done = run("export", folder, "--to", "urdf", "--into", path)
    assert path.read_text() == copy.read_text()
    root = ElementTree.parse(path).getroot()
    assert root.find("link[@name='camera']") is not None
    for joint in root.findall("joint"):
        dynamics = joint.find("dynamics")
        assert dynamics is not None and float(dynamics.attrib["damping"]) >= 0.0


def test_a_file_to_change_needs_a_format_of_descriptions(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "own.xml"
    path.write_text("<mujoco/>")
    done = run("export", folder, "--to", "isaaclab", "--into", path)
    assert isinstance(done.exception, InputError)
    assert "--into" in str(done.exception)
