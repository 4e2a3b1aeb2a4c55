"""Options and commands that messages of an identification, an export and an archive print, typed.

The logs are simulated: a planar arm of three joints with the bodies of its URDF.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from typer.testing import Result

from hil.base.errors import InputError
from tests.hil.cli.remedies import message, typed
from tests.hil.importers.moving_log import JOINTS, URDF
from tests.hil.simulated_logs import write_log

Array = NDArray[np.float64]
DRY = np.array([0.5, 0.4, 0.3])  # N·m
FOURTH = (
    "<link name='hand'><inertial><mass value='0.1'/><inertia ixx='1e-3' iyy='1e-3' izz='1e-3'"
    " ixy='0' ixz='0' iyz='0'/></inertial></link><joint name='lift' type='revolute'>"
    "<parent link='lankle'/><child link='hand'/><origin xyz='0 0 0.4'/><axis xyz='0 1 0'/>"
    "<limit lower='-3' upper='3' effort='99' velocity='9'/></joint></robot>"
)


def motion(seed: int, duration: float = 16.0) -> tuple[Array, ...]:
    """Time, position, velocity and acceleration at 100 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.01)
    rate = random.uniform(1.0, 5.0, (3, 3))
    angle = rate * time[:, None, None] + random.uniform(0.0, 6.0, rate.shape)
    position = 0.3 * np.sin(angle).sum(axis=1)
    velocity = 0.3 * (rate * np.cos(angle)).sum(axis=1)
    return time, position, velocity, -0.3 * (rate**2 * np.sin(angle)).sum(axis=1)


def log(
    path: Path, seed: int = 0, *, late: float = 0.0, load: float = 0.0, spikes: float = 0.0
) -> Path:
    """Write a log with dry friction that grows by `load` of the torque; spikes in N·m."""
    model = pin.buildModelFromXML(URDF)
    data = model.createData()
    random = np.random.default_rng([seed, 1])
    time, position, velocity, acceleration = motion(seed)
    states = zip(position, velocity, acceleration, strict=True)
    rigid = np.array([pin.rnea(model, data, *state) for state in states])
    torque = rigid + (DRY + load * np.abs(rigid)) * np.tanh(velocity / 1e-3) + 0.2 * velocity
    torque = np.column_stack([np.interp(time - late, time, column) for column in torque.T])
    torque += 0.01 * torque.std(axis=0) * random.standard_normal(torque.shape)
    hit = random.random(torque.shape) < 0.005
    torque += spikes * hit * random.standard_normal(torque.shape)
    return write_log(path, ["t", "q{}", "tau{}"], time, position, torque)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of one URDF, a log, an archive and the result of its identification."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(URDF)
    (folder / "longer.urdf").write_text(URDF.replace("</robot>", FOURTH))
    source = log(folder / "log.csv")
    done = typed("identify", source, "--urdf", folder / "arm.urdf", "-q")
    assert done.exit_code == 0, message(done)
    return folder


@pytest.fixture
def archive(folder: Path) -> Path:
    (path,) = (folder / "log").glob("*.mcap")
    return path


def findings(result: Path) -> dict[str, dict[str, Any]]:
    """What is not good in the results of an identification, by name of the check."""
    results = json.loads((result / "results.json").read_text())
    return {
        finding["check"]: finding
        for finding in results["judgement"]["findings"]
        if finding["level"] != "good"
    }


def steps(result: Path) -> str:
    return " ".join(finding["next_step"] for finding in findings(result).values())


def refusal(result: Result) -> str:
    """The message of an input that is refused; the program exits with status 2."""
    assert isinstance(result.exception, InputError), message(result)
    return message(result)


class TestJointsThatWereNotRecorded:
    @pytest.mark.long
    def test_the_last_ones_are_locked(self, folder: Path) -> None:
        line = ["identify", folder / "log.csv", "--urdf", folder / "longer.urdf", "-q"]
        refused = message(typed(*line))
        (option,) = re.findall(r"--locked \w+", refused)
        assert option == "--locked lift"
        assert typed(*line, *option.split(), "-o", folder / "locked").exit_code == 0

    @pytest.mark.long
    def test_all_others_are_locked_with_a_map_that_has_joints(self, folder: Path) -> None:
        line = ["import", "log", folder / "log.csv", "--urdf", folder / "longer.urdf"]
        line += ["--lock-others", "-o", folder / "others.mcap"]
        columns = (folder / "log" / "map.toml").read_text()
        (folder / "bare.toml").write_text(columns.replace("joints =", "# joints ="))
        refused = message(typed(*line, "--map", folder / "bare.toml"))
        assert "--lock-others needs joints = [...]" in refused
        (folder / "joints.toml").write_text(f"joints = {list(JOINTS)}\n{columns}")
        done = typed(*line, "--map", folder / "joints.toml")
        assert done.exit_code == 0, message(done)

    @pytest.mark.long
    def test_a_position_that_is_none(self, folder: Path) -> None:
        line = ["identify", folder / "log.csv", "--urdf", folder / "longer.urdf", "-q"]
        refused = message(typed(*line, "--locked", "lift=half"))
        (example,) = re.findall(r"--locked \w+=[\d.]+", refused)
        option = example.replace("joint_7", "lift").split()
        assert typed(*line, *option, "-o", folder / "bent").exit_code == 0


class TestIdentify:
    def test_a_log_without_its_arm(self, folder: Path) -> None:
        refused = message(typed("identify", folder / "log.csv"))
        assert "--urdf ARM.urdf" in refused
        # With the URDF it is the identification of the fixture.

    @pytest.mark.parametrize(
        ("options", "remedy"),
        [
            pytest.param(("--estimator", "iv"), "--estimator wls", marks=pytest.mark.long),
            (("--friction", "coulomb,dust"), "--friction"),
            pytest.param(("--fit-all", "--predict"), "omit --fit-all", marks=pytest.mark.long),
        ],
    )
    def test_options_that_do_not_fit(
        self, archive: Path, tmp_path: Path, options: Sequence[str], remedy: str
    ) -> None:
        line = ["identify", archive, "-q", "-o", tmp_path / "result"]
        other = tmp_path / "b.mcap"
        other.write_bytes(archive.read_bytes() if "--predict" not in options else b"")
        if "--predict" in options:
            source = log(tmp_path / "b.csv", 1)
            urdf = archive.parents[1] / "arm.urdf"
            typed("import", "log", source, "--urdf", urdf, "--force", "-o", other)
            options = (*options, str(other))
        assert remedy in refusal(typed(*line, *options))
        corrected = {
            "--estimator wls": ("--estimator", "wls"),
            "--friction": ("--friction", "coulomb,viscous"),
            "omit --fit-all": ("--predict", str(other)),
        }[remedy]
        assert typed(*line, *corrected).exit_code == 0

    @pytest.mark.long
    def test_a_model_that_predicts_only_what_was_fitted(
        self, archive: Path, tmp_path: Path
    ) -> None:
        typed("identify", archive, "--fit-all", "-q", "-o", tmp_path / "fit")
        (option,) = re.findall(r"hil identify (--predict) ARCHIVE", steps(tmp_path / "fit"))
        other = tmp_path / "b.mcap"
        urdf = archive.parents[1] / "arm.urdf"
        done = typed("import", "log", log(tmp_path / "b.csv", 1), "--urdf", urdf, "-o", other)
        assert done.exit_code == 0, message(done)
        predicted = typed("identify", archive, option, other, "-q", "-o", tmp_path / "result")
        assert predicted.exit_code == 0
        assert option not in steps(tmp_path / "result")

    @pytest.mark.long
    def test_a_torque_that_is_late(self, folder: Path, tmp_path: Path) -> None:
        line = ["identify", log(tmp_path / "late.csv", late=0.03), "--urdf", folder / "arm.urdf"]
        line += ["-q", "-o", tmp_path / "result"]
        typed(*line, "--delay", "0")
        (option,) = {*re.findall(r"`hil identify (--delay \w+)`", steps(tmp_path / "result"))}
        option = option.replace("SECONDS", "0.03")
        assert typed(*line, *option.split()).exit_code == 0
        results = json.loads((tmp_path / "result" / "results.json").read_text())
        assert results["delays"]["applied"] == pytest.approx([0.03] * 3, abs=1e-3)

    @pytest.mark.long
    def test_friction_that_grows_with_the_load(self, folder: Path, tmp_path: Path) -> None:
        line = ["identify", log(tmp_path / "worm.csv", load=0.2), "--urdf", folder / "arm.urdf"]
        line += ["-q", "-o", tmp_path / "result"]
        typed(*line, "--friction", "coulomb,viscous,offset")
        (option,) = re.findall(r"as in `(--friction [\w,]+)`", steps(tmp_path / "result"))
        assert typed(*line, *option.split()).exit_code == 0
        assert "friction over load" not in findings(tmp_path / "result")

    @pytest.mark.long
    def test_isolated_outliers(self, folder: Path, tmp_path: Path) -> None:
        line = ["identify", log(tmp_path / "spikes.csv", spikes=60.0), "--urdf"]
        line += [folder / "arm.urdf", "-q", "-o", tmp_path / "result"]
        typed(*line)
        (option,) = {*re.findall(r"identify (--estimator \w+)", steps(tmp_path / "result"))}
        robust = typed(*line, *option.split())
        assert robust.exit_code in (0, 5), message(robust)
        results = json.loads((tmp_path / "result" / "results.json").read_text())
        assert results["estimator"]["name"] == option.split()[1]


class TestExport:
    def test_it_says_how_to_identify_again(self, archive: Path, tmp_path: Path) -> None:
        line = ["export", archive.parent, "--to", "urdf", "-o", tmp_path / "arm.urdf"]
        done = typed(*line)
        assert done.exit_code == 0, message(done)
        (option,) = re.findall(r"(--again) identifies again", done.output)
        again = typed(*line, option)
        assert again.exit_code == 0 and option not in again.output

    @pytest.mark.long
    def test_arms_drawn_of_an_estimate_without_posterior(
        self, archive: Path, tmp_path: Path
    ) -> None:
        line = ["export", archive, "--to", "urdf", "--ensemble", "2", "-o", tmp_path / "arms"]
        refused = refusal(typed(*line, "--estimator", "wls"))
        names = re.search(r"--estimator: .*use (\w+) or (\w+)", refused)
        assert names is not None, refused
        for name in names.groups():
            assert typed(*line, "--estimator", name).exit_code == 0, name


class TestArchive:
    @pytest.fixture
    def truncated(self, archive: Path, tmp_path: Path) -> Path:
        path = tmp_path / "cut off.mcap"
        path.write_bytes(archive.read_bytes()[:-400])
        return path

    @pytest.mark.parametrize("arguments", [("archive", "check"), ("archive", "info")])
    def test_a_truncated_one_is_repaired(self, arguments: Sequence[str], truncated: Path) -> None:
        printed = message(typed(*arguments, truncated))
        (line,) = {*re.findall(r"hil (archive repair [^`\n]*)", printed)}
        repaired = typed(*shlex.split(line))
        assert repaired.exit_code in (0, 3), message(repaired)
        (output,) = re.findall(r"wrote (.*\.mcap)", repaired.output)
        assert typed("archive", "check", output).exit_code == 0

    def test_two_places_for_a_repair(self, truncated: Path, tmp_path: Path) -> None:
        line = ["archive", "repair", truncated]
        options = ("--output", tmp_path / "whole.mcap"), ("--in-place",)
        refused = refusal(typed(*line, *options[0], *options[1]))
        assert "--in-place: contradicts --output; give one" in refused
        for option in options:
            assert typed(*line, *option).exit_code in (0, 3)
