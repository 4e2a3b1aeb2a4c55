"""Robots of which only the Denavit-Hartenberg parameters are known."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.cell import Cell
from hil.cli import app
from hil.errors import InputError
from hil.identify.surroundings import nominal_of
from hil.importers import Convention, Robot, urdf_of_dh
from identification.model.kinematics import chain_from_urdf
from tests.hil.simulated_logs import urdf_path

Array = NDArray[np.float64]

HEADER = "joint,type,a,alpha,d,theta_offset"
MIXED = (
    ("turn", "revolute", 0.2, 0.7, 0.4, 0.3),
    ("slide", "prismatic", -0.1, -1.2, 0.15, 1.1),
    ("elbow", "revolute", 0.05, 3.0, 0.0, -2.0),
    ("wrist", "revolute", 0.0, -0.4, -0.3, 0.0),
)
UR5 = """joint,type,a,alpha_deg,d,theta_offset
shoulder_pan_joint,revolute,0,90,0.089159,0
shoulder_lift_joint,revolute,-0.425,0,0,0
elbow_joint,revolute,-0.39225,0,0,0
wrist_1_joint,revolute,0,90,0.10915,0
wrist_2_joint,revolute,0,-90,0.09465,0
wrist_3_joint,revolute,0,0,0.0823,0
"""
PANDA = """# as its maker gives them, after Craig
joint;type;a_mm;alpha_deg;d_mm;theta_offset_deg
panda_joint1;revolute;0;0;333;0
panda_joint2;revolute;0;-90;0;0
panda_joint3;revolute;0;90;316;0
panda_joint4;revolute;82.5;90;0;0
panda_joint5;revolute;-82.5;-90;384;0
panda_joint6;revolute;0;90;0;0
panda_joint7;revolute;88;90;0;0
"""


def table(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def written(rows: tuple[tuple[object, ...], ...]) -> str:
    return "\n".join([HEADER, *(",".join(map(str, row)) for row in rows)]) + "\n"


def about_z(angle: float, along: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, along], [0, 0, 0, 1.0]])


def about_x(angle: float, along: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, along], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def flange(convention: Convention, q: Array) -> Array:
    """Forward kinematics of MIXED, row by row."""
    place = np.eye(4)
    for (_, kind, a, alpha, d, offset), value in zip(MIXED, q, strict=True):
        turns = kind == "revolute"
        z = about_z(offset + value * turns, d + value * (not turns))
        x = about_x(alpha, a)
        place = place @ (z @ x if convention == "standard" else x @ z)
    return place


def placement(model: pin.Model, q: Array, frame: str) -> Array:
    """Of a frame of a URDF in its base; a joint without limits counts by cosine and sine."""
    full = np.concatenate(
        [
            [np.cos(one), np.sin(one)] if joint.nq == 2 else [one]
            for joint, one in zip(model.joints[1:], q, strict=True)
        ]
    )
    data = model.createData()
    pin.framesForwardKinematics(model, data, full)
    return np.array(data.oMf[model.getFrameId(frame)].homogeneous)


class TestKinematics:
    @pytest.mark.parametrize("convention", ["standard", "modified"])
    def test_is_that_of_the_rows(self, tmp_path: Path, convention: Convention) -> None:
        """Of turning and sliding joints, for any posture."""
        model = pin.buildModelFromXML(
            urdf_of_dh(table(tmp_path / "dh.csv", written(MIXED)), convention)
        )
        for q in np.random.default_rng(2).uniform(-3.0, 3.0, (20, 4)):
            assert placement(model, q, "flange") == pytest.approx(flange(convention, q), abs=1e-12)

    def test_of_a_ur5_is_that_of_its_urdf(self, tmp_path: Path) -> None:
        """Standard: up to the frames in which base and tool are given."""
        ours = pin.buildModelFromXML(urdf_of_dh(table(tmp_path / "ur5.csv", UR5), "standard"))
        theirs = pin.buildModelFromUrdf(str(urdf_path("ur5_robot.urdf")))
        base, tools = about_z(np.pi, 0.0), []
        for q in np.random.default_rng(3).uniform(-3.0, 3.0, (10, 6)):
            there = base @ placement(theirs, q, "tool0")
            tools.append(np.linalg.solve(there, placement(ours, q, "flange")))
        assert np.ptp(tools, axis=0).max() < 1e-3  # m; the URDF rounds its lengths

    def test_of_a_panda_is_that_of_its_urdf(self, tmp_path: Path) -> None:
        """Modified, with lengths in mm and angles in degrees: the frames are the same."""
        ours = pin.buildModelFromXML(urdf_of_dh(table(tmp_path / "panda.csv", PANDA), "modified"))
        theirs = pin.buildModelFromUrdf(str(urdf_path("panda.urdf")))
        for q in np.random.default_rng(4).uniform(-1.0, 1.0, (10, 7)):
            expected = placement(theirs, np.append(q, [0.0, 0.0]), "panda_link7")
            assert placement(ours, q, "link_7") == pytest.approx(expected, abs=1e-9)

    def test_nothing_is_known_of_masses_and_limits(self, tmp_path: Path) -> None:
        """So that no nominal model is made of what nobody said."""
        robot = Robot.from_urdf(table(tmp_path / "dh.csv", written(MIXED)), convention="standard")
        cell = Cell.from_texts(robot.cell, robot.urdf, Path("cell.toml"))
        assert robot.joint_names == ("turn", "slide", "elbow", "wrist")
        assert not cell.model.nominal.any()
        assert nominal_of(cell) is None


class TestRefusals:
    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            ("", r"has no row of a joint; write joint,type,a,alpha,d,theta_offset"),
            (f"{HEADER}\n", "has no row of a joint"),
            ("joint,type,a,alpha,d\nj,revolute,0,0,0\n", "header: has no column theta_offset"),
            (
                f"{HEADER},alpha_deg\nj,revolute,0,0,0,0,90\n",
                "header: has columns alpha and alpha_deg",
            ),
            (
                f"{HEADER}\nj,spherical,0,0,0,0\n",
                "type: line 2 has the type 'spherical'; write rev",
            ),
            (
                f"{HEADER}\nj,revolute,0,90,0,0\n",
                "alpha: line 2 has '90'.*call the column alpha_deg",
            ),
            (f"{HEADER}\nj,revolute,400,0,0,0\n", "a: line 2 has '400'.*call the column a_mm"),
            (f"{HEADER}\nj,revolute,0,0,0,\n", "theta_offset: line 2 has nothing"),
            (f"{HEADER}\nj,revolute,0,nan,0,0\n", "alpha: line 2 has 'nan'"),
            (f"{HEADER}\n,revolute,0,0,0,0\n", "joint: line 2 has no name"),
            (f"{HEADER}\nj,revolute,0,0,0,0\nj,revolute,0,0,0,0\n", "joint: has two joints 'j'"),
        ],
    )
    def test_name_line_field_and_remedy(self, tmp_path: Path, text: str, sentence: str) -> None:
        with pytest.raises(InputError, match=rf"dh\.csv: {sentence}"):
            urdf_of_dh(table(tmp_path / "dh.csv", text), "standard")

    def test_a_file_that_is_none_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"none\.csv: cannot be read"):
            urdf_of_dh(tmp_path / "none.csv", "standard")

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            (["--dh", "dh.csv"], "--convention: is not given; --dh needs standard"),
            (["--dh", "dh.csv", "--convention", "craig"], "'craig' is unknown"),
            (["--dh", "dh.csv", "--urdf", "r.urdf"], "--urdf and --dh: exclude each other"),
            ([], "--urdf or --dh: one of them is needed"),
        ],
    )
    def test_options_that_do_not_fit(self, options: list[str], sentence: str) -> None:
        result = CliRunner().invoke(app, ["new", *options])
        assert isinstance(result.exception, InputError)
        assert sentence in str(result.exception)


class TestCommands:
    def test_new_writes_a_cell_and_its_urdf(self, tmp_path: Path) -> None:
        path = table(tmp_path / "panda.csv", PANDA)
        arguments = ["new", "--dh", str(path), "--convention", "modified", "--json"]
        result = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "cell.toml")])
        assert result.exit_code == 0, result.output
        summary = json.loads(result.output)
        assert summary["joints"] == [f"panda_joint{j}" for j in range(1, 8)]
        assert "limits.lower_deg" in summary["unknown"]
        assert any("no masses" in note for note in summary["notes"])
        cell = tomllib.loads((tmp_path / "cell.toml").read_text())
        assert cell["cell"]["urdf"] == "cell.urdf"
        chain = chain_from_urdf((tmp_path / "cell.urdf").read_text())
        assert list(chain.joint_names) == summary["joints"]
        assert path.read_text() == PANDA

    def test_a_log_is_imported_with_it(self, tmp_path: Path) -> None:
        """As with a URDF; joints that were not recorded can be locked."""
        time = np.arange(200) / 100.0
        q = np.sin(time[:, None] * [1.0, 2.0, 3.0])
        np.savez(tmp_path / "log.npz", t=time, q=q)
        (tmp_path / "map.toml").write_text(
            'joints = ["turn", "elbow", "wrist"]\n[time]\ncolumn = "t"\n[position]\ncolumns = "q"\n'
        )
        path = table(tmp_path / "dh.csv", written(MIXED))
        arguments = ["import", "log", str(tmp_path / "log.npz"), "-o", str(tmp_path / "log.mcap")]
        arguments += ["--map", str(tmp_path / "map.toml"), "--dh", str(path), "--lock-others"]
        result = CliRunner().invoke(app, [*arguments, "--convention", "modified"])
        assert result.exit_code == 0, result.exception
        assert "locked, rad or m: slide at 0" in result.output
        archive = open_archive(tmp_path / "log.mcap")
        assert archive.joint_names == ("turn", "elbow", "wrist")
        assert np.array_equal(archive.columns["position"], q)
