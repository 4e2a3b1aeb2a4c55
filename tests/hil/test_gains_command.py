"""`hil gains`: torque constants from recordings without and with a payload that was weighed."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from hil.cli import app
from hil.errors import InputError
from hil.importers import ColumnMap, Robot, import_log
from hil.importers.column_map import Drive
from identification import FrictionLaw
from tests.hil.simulated_logs import Simulated, simulate

CONSTANTS = np.array([0.12, 0.12, 0.1, 0.08, 0.05, 0.04])  # N·m/A, motor side
RATIO = np.array([100.0, 100.0, -100.0, 60.0, 60.0, -60.0])
MASS, CENTRE = 4.0, (0.0, 0.09, 0.12)
BOTH = ("--loaded", "full.mcap", "--mass", "4", "--centre", "0,0.09,0.12")


def archive(folder: Path, name: str, simulated: Simulated) -> Path:
    """Positions in motor radians and currents in A, without torque constants."""
    np.savez(
        folder / f"{name}.npz",
        q=simulated.position * RATIO,
        i=simulated.torque / (RATIO * CONSTANTS),
        t=simulated.time,
    )
    columns = {
        "time": {"column": "t"},
        "position": {"columns": "q", "side": "motor"},
        "motor_current": {"columns": "i"},
        "drive": {"gear_ratio": tuple(RATIO)},
    }
    return import_log(
        folder / f"{name}.npz",
        folder / f"{name}.mcap",
        robot=Robot.from_urdf(simulated.urdf, friction=FrictionLaw(third=None, offset=True)),
        columns=ColumnMap.model_validate(columns),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gains")
    time = np.arange(0.0, 30.0, 4e-3)
    archive(folder, "empty", simulate("ur5_robot.urdf", time, seed=1))
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    archive(folder, "full", simulate("ur5_robot.urdf", time, seed=2, load=load))
    return folder


def run(folder: Path, *arguments: str) -> tuple[int, str]:
    named = [str(folder / a) if a.endswith(".mcap") else a for a in arguments]
    result = CliRunner().invoke(app, ["gains", *named])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def test_the_constants_lie_in_their_intervals(folder: Path) -> None:
    _, text = run(folder, "empty.mcap", *BOTH, "--json")
    found = json.loads(text)
    assert found["side"] == "motor"
    assert found["payload_kg"] == {"empty.mcap": None, "full.mcap": 4.0}
    known = 0
    for motor, truth in zip(found["motors"], CONSTANTS, strict=True):
        if motor["not_determined"] is None:
            known += 1
            # Smoothing leaves a bias of half a percent.
            error = abs(motor["torque_constant"] - truth)
            assert error < 2.0 * motor["half_interval"] + 0.005 * truth
            assert motor["half_interval"] < 0.1 * truth
    assert known >= 5


def test_what_is_printed_can_be_pasted(folder: Path) -> None:
    status, text = run(folder, "empty.mcap", *BOTH, "--quiet")
    pasted = tomllib.loads(text)["torque_constant"]
    assert (len(pasted) == len(CONSTANTS)) == (status == 0)
    assert "# shoulder_lift_joint ±" in text


def test_an_axis_parallel_to_gravity_is_named_and_gets_no_number(tmp_path: Path) -> None:
    """In slow motion the payload is only weight, which the vertical axis does not carry."""
    time = np.arange(0.0, 150.0, 2e-2)
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    for seed, (name, body) in enumerate({"empty": None, "full": load}.items()):
        slow = simulate("ur5_robot.urdf", time, seed=seed, pace=0.1, load=body)
        noise = 0.1 * np.random.default_rng(seed).standard_normal(slow.torque.shape)  # N·m
        archive(tmp_path, name, replace(slow, torque=slow.torque + noise))
    status, text = run(tmp_path, "empty.mcap", *BOTH, "-q")
    assert status == 5
    assert "nan,  # shoulder_pan_joint: not determined; " in text
    assert "shoulder_lift_joint ±" in text
    pasted = tomllib.loads(text)["torque_constant"]
    assert len(pasted) == len(CONSTANTS)
    with pytest.raises(ValidationError, match="torque_constant"):
        Drive(torque_constant=pasted)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("empty.mcap", "--loaded", "full.mcap"), "--mass: the payload needs a mass above 0"),
        (("empty.mcap", "--mass", "4"), "which recording was made with it"),
        ((*("empty.mcap", *BOTH[:4]), "--centre", "1,2"), "--centre: '1,2' is not 3 numbers"),
    ],
)
def test_what_cannot_be_used_is_refused(
    folder: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        run(folder, *arguments)


def test_a_folder_stands_for_its_archives(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no whole archive; name archives"):
        run(folder, str(tmp_path))
    (tmp_path / "empty.mcap").symlink_to(folder / "empty.mcap")
    _, text = run(folder, str(tmp_path), *BOTH, "--json")
    assert json.loads(text)["payload_kg"] == {"empty.mcap": None, "full.mcap": 4.0}


def test_without_any_payload_nothing_is_determined(folder: Path) -> None:
    with pytest.raises(Exception, match="no recording has a known payload"):
        run(folder, "empty.mcap")
