"""Files of the identified model, and `hil export`."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from pydantic import BaseModel
from typer.testing import CliRunner

import hil
from hil.cli import app
from hil.importers.column_map import ColumnMap
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.pipeline import stored_identification
from hil.pipeline.identification import Identification
from hil.report.output_files import EXPORT_FILES, Exports
from hil.results.results import Results
from hil.results.servo_result import ServoResults
from identification.export.parameter_files import parameters_json
from identification.model.kinematics import chain_from_urdf
from identification.model.motion import Motion
from tests.hil.identified_arm import (
    TWO_LINK,
    IdentifiedArm,
    a_motion,
    identified_arm,
    write_exports,
)
from tests.hil.simulated_logs import simulate, urdf_path, write_log

Array = NDArray[np.float64]

SLIDER = """<robot name="slider"><link name="base"/>
<joint name="slide" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="cart"><inertial><origin xyz="0.02 0 0.1"/><mass value="4"/>
<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="swing" type="continuous"><parent link="cart"/><child link="arm"/><axis xyz="0 1 0"/>
<dynamics damping="0.7" friction="0.3"/></joint>
<link name="arm"><inertial><origin xyz="0 0.01 -0.3"/><mass value="1.5"/>
<inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>
"""
ALL = {"parameters.json", "parameters.csv", "parameters_covariance.csv", "identified.urdf"}
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
PROVENANCE = {"robot": "arm", "archives": "run_1.mcap sha256 0a1b", "verdict": "good: 1.1%"}


@pytest.fixture(scope="module")
def arm() -> IdentifiedArm:
    return identified_arm(TWO_LINK)


def exported(arm: IdentifiedArm, folder: Path) -> Exports:
    names = arm.essential.estimate.names
    consistent = arm.consistency.consistent
    return write_exports(
        folder, arm.cell, arm.estimate, consistent, essential=names, provenance=PROVENANCE
    )


def parameters_of(arm: IdentifiedArm, folder: Path) -> dict[str, Any]:
    """`parameters.json` of the exported arm."""
    exported(arm, folder)
    return json.loads((folder / "parameters.json").read_text())


def command(*arguments: object) -> Any:
    """Run `hil` with these arguments, with any verdict."""
    result = CliRunner().invoke(app, [str(word) for word in arguments])
    assert result.exit_code in (0, 5), result.output
    return result


def test_files_with_provenance_are_written(arm: IdentifiedArm, tmp_path: Path) -> None:
    written = exported(arm, tmp_path)
    assert ALL == set(EXPORT_FILES) == {path.name for path in tmp_path.iterdir()}
    assert not written.withheld
    assert set(written.result.written) == ALL
    assert json.loads((tmp_path / "parameters.json").read_text())["provenance"] == PROVENANCE
    for name in ALL - {"parameters.json"}:
        assert "sha256 0a1b" in (tmp_path / name).read_text(), name


def table(path: Path) -> list[dict[str, str]]:
    lines = path.read_text().splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def test_only_consistent_parameters_become_a_urdf(arm: IdentifiedArm, tmp_path: Path) -> None:
    """Otherwise an old URDF is removed."""
    exported(arm, tmp_path)
    (tmp_path / "mine.urdf").write_text("mine")
    written = write_exports(tmp_path, arm.cell, arm.estimate, "no convergence")
    assert set(written.withheld) == {"identified.urdf"}
    assert "no convergence" in written.withheld["identified.urdf"]
    left = {path.name for path in tmp_path.iterdir()}
    assert left == (ALL - set(written.withheld)) | {"mine.urdf"}
    broken = arm.consistency.consistent.standard.copy()
    broken[arm.cell.model.layout.links[1, 9]] = -1.0
    impossible = replace(arm.consistency.consistent, standard=broken)
    written = write_exports(tmp_path, arm.cell, arm.estimate, impossible)
    assert "not physically consistent" in written.withheld["identified.urdf"]
    assert not (tmp_path / "identified.urdf").exists()


def test_names_cannot_break_a_file(arm: IdentifiedArm, tmp_path: Path) -> None:
    """Names of archives and in a URDF."""
    evil = {"archives": 'a --> ---> <robot> """ \x00\x1b[2J\nimport os\udc80 b', "robot": "€"}
    write_exports(tmp_path, arm.cell, arm.estimate, arm.consistency.consistent, provenance=evil)
    model = arm.cell.model
    assert chain_from_urdf((tmp_path / "identified.urdf").read_text()).n_joints == model.n_joints
    assert len(table(tmp_path / "parameters.csv")) == model.n_parameters
    evil = "a---&gt;'&quot;&quot;&quot; &lt;script&gt;alert(1)&lt;/script&gt;#"
    urdf = TWO_LINK.replace("shoulder", evil).replace('"upper"', f'"{evil}"')
    arm = identified_arm(urdf)
    written = exported(arm, tmp_path)
    assert not written.withheld
    chain = chain_from_urdf((tmp_path / "identified.urdf").read_text())
    assert chain.joint_names == arm.cell.joint_names
    assert len(table(tmp_path / "parameters.csv")) == arm.cell.model.n_parameters


def test_a_joint_at_rest_keeps_its_description(tmp_path: Path) -> None:
    arm = identified_arm(SLIDER, still=(1,))
    assert {"f0_2", "f1_2"} <= set(arm.estimate.undetermined)
    exported(arm, tmp_path)
    text = (tmp_path / "identified.urdf").read_text()
    assert '<dynamics damping="0.7" friction="0.3"/>' in text
    assert "not determined by the data" in text
    rows = {row["name"]: row for row in table(tmp_path / "parameters.csv")}
    assert float(rows["f0_2"]["std"]) == np.inf
    rows = json.loads((tmp_path / "parameters.json").read_text())["parameters"]
    assert {p["name"] for p in rows if not p["determined"]} == set(arm.estimate.undetermined)
    arm = identified_arm(TWO_LINK, still=(1,))
    consistent = arm.consistency.consistent
    determined = np.isfinite(arm.estimate.std)
    assert np.all(np.abs(consistent.shift[determined]) < 1.0)
    assert np.abs(consistent.standard).max() < 100.0


# docs/results.md explains every field; its programs run unchanged

DOCUMENT = Path(__file__).parents[3] / "docs" / "results.md"
CODE = re.compile(r"```(\w+)\n(.*?)```", re.S)


@pytest.fixture(scope="module")
def text() -> str:
    return DOCUMENT.read_text(encoding="utf-8")


def named(text: str) -> set[str]:
    return set(re.findall(r"`([^`\n]+)`", CODE.sub("", text)))


def fields(model: type[BaseModel]) -> Iterator[str]:
    """Return the names of all fields, with those of nested models."""
    for name, info in model.model_fields.items():
        yield name
        pending = [info.annotation]
        while pending:
            part = pending.pop()
            pending += getattr(part, "__args__", ())
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from fields(part)


def test_every_file_and_field_is_explained(text: str, arm: IdentifiedArm) -> None:
    document = parameters_json(arm.cell.model, arm.estimate, consistent=arm.consistency.consistent)
    content = json.loads(document)
    explained = named(text)
    assert set(fields(Results)) <= explained
    assert set(fields(ServoResults)) <= explained
    assert set(content) | set(content["parameters"][0]) | set(content["standard"]) <= explained
    tensor = {"Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz"}
    assert set(content["standard"]["links"][0]) - tensor <= explained
    assert ALL | {"results.json", "report.html"} <= explained


def test_the_python_example_predicts_the_torque_of_the_model(
    text: str, arm: IdentifiedArm, tmp_path: Path
) -> None:
    """Verbatim, in a separate process, from the files."""
    folder = tmp_path / "runs" / "demo"
    folder.mkdir(parents=True)
    write_exports(folder, arm.cell, arm.estimate, arm.consistency.consistent)
    (program,) = (code for language, code in CODE.findall(text) if language == "python")
    command_line = [sys.executable, "-I", "-c", program]
    done = subprocess.run(command_line, cwd=tmp_path, capture_output=True, text=True, check=True)
    shown = np.fromstring(done.stdout.strip().strip("[]"), sep=" ")
    motion = replace(Motion.at_rest(np.zeros((1, 2))), velocity=np.full((1, 2), 0.5))
    values = arm.consistency.consistent.estimate.values
    (expected,) = arm.cell.model.torque(values, motion)
    np.testing.assert_allclose(shown, expected, rtol=1e-6)


@pytest.mark.long
def test_the_python_example_fixes_a_gripper(text: str, tmp_path: Path) -> None:
    """Verbatim, of an arm whose fingers were not recorded."""
    folder = tmp_path / "runs" / "demo"
    motion = simulate("panda.urdf", np.arange(0.0, 8.0, 0.02), locked=FINGERS)
    log = write_log(
        tmp_path / "log.csv",
        ["t", "q{}", "v{}", "tau{}"],
        *(motion.time, motion.position, motion.velocity, motion.torque),
    )
    hil.identify(log, urdf=urdf_path("panda.urdf")).save(folder)
    (program,) = (code for language, code in CODE.findall(text) if language == "python")
    command_line = [sys.executable, "-I", "-c", program]
    done = subprocess.run(command_line, cwd=tmp_path, capture_output=True, text=True, check=True)
    shown = np.fromstring(" ".join(done.stdout.split()).strip("[]"), sep=" ")
    arm = hil.load(folder)
    model = arm.model
    rest, speed = np.zeros(7), np.full(7, 0.5)
    rigid = pin.rnea(model, model.createData(), rest, speed, rest)
    dry = np.asarray(model.upperDryFrictionLimit) + np.asarray(model.damping) * speed
    assert arm.results.joint_names == list(motion.joint_names)
    np.testing.assert_allclose(shown, rigid + dry, atol=0.03 * np.abs(rigid + dry).max())


@pytest.fixture(scope="module")
def log(arm: IdentifiedArm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the arm, imported."""
    folder = tmp_path_factory.mktemp("log")
    motion = a_motion(2, 1)
    torque = arm.cell.model.torque(arm.truth, motion)
    np.savetxt(folder / "log.csv", np.column_stack([motion.time, motion.position, torque]))
    (folder / "map.toml").write_text(
        "[time]\ncolumn = 0\n[position]\ncolumns = [1, 2]\n[torque]\ncolumns = [3, 4]\n"
    )
    (folder / "arm.urdf").write_text(TWO_LINK)
    return import_log(
        folder / "log.csv",
        folder / "log.mcap",
        robot=Robot.from_urdf(folder / "arm.urdf"),
        columns=ColumnMap.load(folder / "map.toml"),
    )


class TestCommand:
    """Files and output of the command."""

    def test_an_arm(self, log: Path, tmp_path: Path) -> None:
        output = tmp_path / "deep" / "arm.urdf"
        printed = json.loads(command("export", log, "--to", "urdf", "-o", output, "--json").stdout)
        assert printed["path"] == str(output)
        assert printed["read_back"] < 1e-6
        assert "rotor inertias" in printed["left_out"]
        text = output.read_text()
        assert "verdict: " in text
        assert "log.mcap sha256" in text

    def test_torques_left_out_have_the_names_of_their_joints(
        self, log: Path, tmp_path: Path
    ) -> None:
        lines = command("export", log, "--to", "urdf", "-o", tmp_path / "arm.urdf").stdout
        torques = r"shoulder [-+.e\d]+, elbow [-+.e\d]+ N·m rms\n"
        assert re.search(f"left out: rotor inertias: {torques}", lines)
        assert re.search(f"whole torque of the recorded motion: {torques}", lines)

    def test_without_mujoco_the_file_is_not_read_back(
        self, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "mujoco", None)
        monkeypatch.chdir(tmp_path)
        output = command("export", log, "--to", "mjcf").stdout
        assert "not read back: MuJoCo is not installed" in output
        assert (tmp_path / "identified.xml").read_text().startswith("<mujoco")


@pytest.fixture(scope="module")
def identified(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an archive and the files of its identification."""
    folder = tmp_path_factory.mktemp("folder")
    shutil.copy(log, folder)
    command("identify", folder, "-q")
    return folder


class TestReuse:
    """`hil export` of a folder with the files of an identification."""

    @pytest.fixture
    def folder(self, identified: Path, tmp_path: Path) -> Path:
        return Path(shutil.copytree(identified, tmp_path / "folder"))

    @pytest.mark.long
    def test_the_file_is_that_of_a_new_identification(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        new = folder / "new.urdf"
        stored = folder / "stored.urdf"
        again = command("export", folder, "--to", "urdf", "--again", "-o", new)
        assert "parameters: from" not in again.stdout

        def identify(*_: object, **__: object) -> Identification:
            raise AssertionError("the parameters are there")

        monkeypatch.setattr(stored_identification, "identify_paths", identify)
        reused = command("export", folder, "--to", "urdf", "-o", stored)
        shown = " ".join(reused.stdout.split())
        assert f"parameters: from {folder}/results.json and parameters.json" in shown
        assert stored.read_text() == new.read_text()

    def test_files_of_other_archives_are_not_used(self, folder: Path, log: Path) -> None:
        place = log.parent
        import_log(
            place / "log.csv",
            folder / "another.mcap",
            robot=Robot.from_urdf(place / "arm.urdf"),
            columns=ColumnMap.load(place / "map.toml"),
            use="validation",
        )
        shown = command("export", folder, "--to", "urdf").stdout
        assert "identified again: its archives are not the ones" in shown

    @pytest.mark.parametrize(
        ("name", "change", "reason"),
        [
            ("parameters.json", None, "there is no parameters.json"),
            ("results.json", "{", "its files cannot be read"),
            pytest.param(
                *("parameters.json", "[]", "its files cannot be read"), marks=pytest.mark.long
            ),
        ],
    )
    def test_unusable_files_are_named(
        self, folder: Path, name: str, change: str | None, reason: str
    ) -> None:
        (folder / name).unlink()
        if change is not None:
            (folder / name).write_text(change)
        assert f"identified again: {reason}" in command("export", folder, "--to", "urdf").stdout

    def test_parameters_of_another_identification_are_not_used(self, folder: Path) -> None:
        path = folder / "parameters.json"
        content = json.loads(path.read_text())
        content["provenance"]["verdict"] = "good: of another day"
        path.write_text(json.dumps(content))
        shown = command("export", folder, "--to", "urdf").stdout
        assert "do not belong to one identification" in shown


def test_dates_and_free_fields_reach_every_output(
    arm: IdentifiedArm, log: Path, tmp_path: Path
) -> None:
    """From the cell file over the archive's attachment."""
    place = log.parent
    (tmp_path / "arm.urdf").write_text(TWO_LINK)
    fields = 'operator = "A. <Person>"\nserial_number = "SN 17"\nnotes = "cover off"\n'
    (tmp_path / "cell.toml").write_text(
        f'[cell]\nname = "arm"\nurdf = "arm.urdf"\n{fields}[robot]\n'
    )
    text = (place / "map.toml").read_text()
    rows = np.loadtxt(place / "log.csv")
    rows[:, 0] += 1_700_000_000.0
    np.savetxt(tmp_path / "log.csv", rows, fmt="%.9f")
    (tmp_path / "map.toml").write_text(text)
    path = import_log(
        tmp_path / "log.csv",
        tmp_path / "log.mcap",
        robot=Robot.from_cell(tmp_path / "cell.toml"),
        columns=ColumnMap.load(tmp_path / "map.toml"),
    )
    command("identify", path, "-o", tmp_path / "result", "-q")
    occasion = Results.load(tmp_path / "result" / "results.json").occasion
    assert occasion is not None
    assert occasion.recorded_from == "2023-11-14T22:13:20+00:00"
    assert occasion.identified_at.startswith("20")
    assert occasion.serial_number == "SN 17"
    table = (tmp_path / "result" / "parameters.csv").read_text()
    for line in ("# recorded: 2023-11-14", "# operator: A. <Person>", "# notes: cover off"):
        assert line in table
    page = (tmp_path / "result" / "report.html").read_text()
    for part in ("A. &lt;Person&gt;", "SN 17", "2023-11-14 22:13"):
        assert part in page
