"""`hil payload`, with the commands of `docs/payload.md`, and `hil gains`; what both refuse."""

from __future__ import annotations

import json
import shlex
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner, Result

from hil import weighing
from hil.campaign import Campaign
from hil.campaign.link import Link
from hil.cell import Cell, CellError
from hil.cli import app
from hil.errors import ArchiveError, InputError, OperatorStopError
from hil.identify.options import FIXED
from hil.identify.payload_run import PayloadFound, find_payload
from hil.importers.column_map import Drive
from hil.progress import Silent
from hil.simulation import carrying
from identification import FrictionLaw
from identification.model.kinematics import pinocchio_model
from tests.docs.test_commands import QUICK
from tests.docs.typed import ROOT, commands
from tests.hil.fast_cell import fast_campaign, fast_cell
from tests.hil.simulated_logs import Simulated, archive_of, simulate

MASS, CENTRE = 4.0, np.array([0.0, 0.09, 0.12])
TENSOR = np.diag([0.01, 0.02, 0.015])
LAW = FrictionLaw(third=None, offset=True)
BOTH = ("--loaded", "full.mcap", "--mass", "4", "--centre", "0,0.09,0.12")


def record(folder: Path, name: str, mass: float, seed: int) -> Path:
    time = np.arange(0.0, 12.0, 8e-3)
    load = None if mass == 0.0 else pin.Inertia(mass, CENTRE, TENSOR * mass / MASS)
    return archived(folder / name, simulate("ur5_robot.urdf", time, seed=seed, load=load))


def archived(path: Path, made: Simulated) -> Path:
    arrays = {"t": made.time, "q": made.position, "tau": made.torque}
    return archive_of(path, made.urdf, law=LAW, **arrays)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("payload")
    record(folder, "empty.mcap", 0.0, 1)
    record(folder, "full.mcap", MASS, 2)
    record(folder, "other.mcap", 2.0, 3)
    return folder


def run(folder: Path, *arguments: str, command: str = "payload") -> tuple[int, str]:
    named = [str(folder / a) if a.endswith(".mcap") else a for a in arguments]
    result = CliRunner().invoke(app, [command, *named])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def weigh(folder: Path, bare: list[str], loaded: list[str]) -> PayloadFound:
    """Identify with stated settings: their automatic choice takes seconds."""
    sides = [[folder / f"{name}.mcap" for name in names] for names in (bare, loaded)]
    return find_payload(*sides, Silent(), options=FIXED)


@pytest.fixture(scope="module")
def printed(folder: Path) -> dict[str, object]:
    status, text = run(
        folder, "empty.mcap", "--loaded", "full.mcap", "--json", "--check", "mass=4.5"
    )
    assert status == 5
    found: dict[str, object] = json.loads(text)
    return found


CARRIED = """
[simulation.payload]
mass = 2.0
centre = [0.3, 0.0, 0.05]
inertia = [0.004, 0.0, 0.0, 0.006, 0.0, 0.005]
"""
BY_HAND = {"design": ("--settings", "quick.toml"), "run": ("--accept-dry-run",)}
"""Words that a test adds to a command: a short search, the operator's answer."""


class TestPage:
    def test_every_command_of_the_page_runs(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """docs/payload.md, in a folder with the recordings that it names."""
        monkeypatch.chdir(folder)
        for name, source in (("bare", "empty.mcap"), ("gripper", "full.mcap")):
            (folder / name).mkdir()
            (folder / name / source).write_bytes((folder / source).read_bytes())
        for file in ("cell.toml", "robot.urdf"):
            (folder / file).write_bytes((ROOT / "examples" / "two_joints" / file).read_bytes())
        with (folder / "cell.toml").open("a") as cell:
            cell.write(CARRIED)
        (folder / "quick.toml").write_text(QUICK)
        for program, *words in commands(ROOT / "docs" / "payload.md"):
            assert program == "hil"
            words += BY_HAND.get(words[0], ())
            result = CliRunner().invoke(app, words)
            assert result.exit_code == 0, (shlex.join(words), result.output, result.exception)
        model = pinocchio_model((folder / "gripper.urdf").read_text())
        assert model.inertias[0].mass == pytest.approx(MASS, rel=0.01)


class TestFigures:
    def test_intervals_are_near_the_truth(self, printed: dict[str, dict[str, dict]]) -> None:
        """Smoothing leaves a bias of some tenths of a percent."""
        figures = printed["figures"]
        assert figures["mass"]["value"] == pytest.approx(MASS, rel=0.01)
        low, high = figures["mass"]["interval"]
        assert low < figures["mass"]["value"] < high
        assert printed["frame"] == "tool0"
        assert np.trace(TENSOR) == pytest.approx(
            sum(figures[name]["value"] for name in ("Ixx", "Iyy", "Izz")), rel=0.3
        )

    def test_a_value_outside_its_interval_is_reported(self, printed: dict[str, list[str]]) -> None:
        (sentence,) = printed["outside"]
        assert sentence.startswith("mass 4.5 kg is outside the 95 % interval")

    def test_each_controller_has_its_own_units(self, printed: dict[str, dict]) -> None:
        """COMAU uses mm, UR and Franka m; Franka the complete matrix."""
        typed, figures = printed["controllers"], printed["figures"]
        centre = [figures[name]["value"] for name in ("cx", "cy", "cz")]
        assert f"$TOOL_CNTR := POS({1e3 * centre[0]:.2f}, {1e3 * centre[1]:.2f}" in typed["COMAU"]
        assert f"$TOOL_INERTIA[2] := {figures['Iyy']['value']:.5f}" in typed["COMAU"]
        assert typed["UR"].startswith(f"set_target_payload({figures['mass']['value']:.3f}, [")
        six = typed["UR"].split("[")[2].strip("])").split(", ")
        assert six[:2] == [f"{figures[name]['value']:.5f}" for name in ("Ixx", "Iyy")]
        nine = typed["Franka"].split("{")[2].strip("});").split(", ")
        assert (len(nine), nine[1], nine[4]) == (9, nine[3], six[1])


class TestRefusals:
    @pytest.mark.parametrize(
        ("bare", "loaded", "sentence"),
        [
            (["empty"], ["full", "other"], r"other\.mcap.*another payload: .* kg less"),
            (["empty", "other"], ["full"], r"other\.mcap.*another tool: .* kg more"),
            (["empty"], ["empty"], "is a copy of"),
        ],
    )
    def test_mixed_recordings_are_named(
        self, folder: Path, bare: list[str], loaded: list[str], sentence: str
    ) -> None:
        with pytest.raises(InputError, match=sentence):
            weigh(folder, bare, loaded)

    def test_another_arm_is_named(self, folder: Path, tmp_path: Path) -> None:
        time = np.arange(0.0, 6.0, 8e-3)
        other = archived(tmp_path / "ur10.mcap", simulate("ur10_robot.urdf", time, seed=1))
        with pytest.raises(ArchiveError, match=r"ur10\.mcap.*another arm .* robot\.urdf"):
            find_payload([folder / "empty.mcap"], [other], Silent())

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (("empty.mcap",), "give both: hil payload BARE"),
            (("empty.mcap", *BOTH[:2], "--check", "mass"), "'mass' is not NAME=NUMBER"),
            (("empty.mcap", "--shape", "ball", "1", "1", "1"), "ball 1 1 1 is not a shape"),
        ],
    )
    def test_incomplete_arguments_are_refused(
        self, folder: Path, arguments: tuple[str, ...], sentence: str
    ) -> None:
        with pytest.raises(InputError, match=sentence):
            run(folder, *arguments)


def payload_campaign(folder: Path) -> Campaign:
    """Campaign of the small cell, whose simulated arm carries 2 kg in loaded runs."""
    cell = fast_cell(folder, repetitions=2)
    carrying = Cell.from_texts(cell.text + CARRIED, cell.urdf, cell.path)
    return fast_campaign(folder / "campaign", carrying)


def run_campaign(campaign: Campaign, *words: str) -> Result:
    command = ["run", str(campaign.folder.root), *words]
    return CliRunner().invoke(app, command, catch_exceptions=False)


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return payload_campaign(tmp_path_factory.mktemp("designed"))


@pytest.fixture(scope="module")
def pairs(designed: Campaign) -> dict[str, Any]:
    result = run_campaign(designed, "--payload", "weight", "--accept-dry-run", "--json")
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


class TestRun:
    """Bare and loaded runs in ABBA order, with the gates of every run."""

    def test_the_load_of_the_simulated_arm_is_identified(self, pairs: dict[str, Any]) -> None:
        low, high = pairs["figures"]["mass"]["interval"]
        assert pairs["figures"]["mass"]["value"] == pytest.approx(2.0, rel=0.02)
        assert 0.0 < high - low < 0.2
        low, high = pairs["figures"]["cx"]["interval"]
        assert low < 0.3 < high
        assert pairs["frame"] == "fore"
        assert set(pairs["undetermined"]) >= {"cy", "Ixy", "Iyz"}

    def test_each_side_is_a_campaign_with_a_dry_run(
        self, designed: Campaign, pairs: dict[str, Any]
    ) -> None:
        assert not list(designed.folder.archives.iterdir())
        for side in weighing.SIDES:
            own = Campaign.open(designed.folder.root / "payload" / "weight" / side)
            kinds = [path.name.split("_")[0] for path in own.folder.archives.iterdir()]
            assert kinds.count("excitation") == pairs["pairs"]
            assert kinds.count("dryrun") == 1
            assert "validation" not in kinds

    def test_complete_recordings_are_not_repeated(
        self, designed: Campaign, pairs: dict[str, Any]
    ) -> None:
        def run(*_: object) -> None:
            pytest.fail("no recording was missing")

        again = weighing.weigh(
            designed, "weight", run=run, mount=lambda _: False, reporter=Silent()
        )
        assert again.pairs == pairs["pairs"]

    def test_order_is_abba_until_the_interval_is_small(
        self, folder: Path, designed: Campaign, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The operator is asked to mount the payload only when it changes."""
        found = weigh(folder, ["empty"], ["full"])
        monkeypatch.setattr(weighing, "find_payload", lambda *_: found)
        done, asked = list[str](), list[bool]()

        def run(side: Campaign, repetitions: int, link: Link | None) -> None:
            assert link is not None
            done.append(f"{side.folder.root.name} {repetitions}")

        def mount(load: bool) -> bool:
            asked.append(load)
            return True

        monkeypatch.setattr(weighing, "ENOUGH", 0.0)
        weighed = weighing.weigh(designed, "x", run=run, mount=mount, reporter=Silent())
        assert done == ["bare 1", "loaded 1", "loaded 2", "bare 2"]
        assert asked == [False, True, False]
        assert "another pair is recommended" in weighed.sentence
        monkeypatch.setattr(weighing, "ENOUGH", 0.5)
        weighed = weighing.weigh(designed, "y", run=run, mount=mount, reporter=Silent())
        assert weighed.pairs == 1
        assert "another pair is not needed" in weighed.sentence

    def test_a_missing_operator_ends_the_recording(self, designed: Campaign) -> None:
        with pytest.raises(OperatorStopError, match="nothing was recorded"):
            weighing.weigh(
                designed, "z", run=lambda *_: None, mount=lambda _: False, reporter=Silent()
            )

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (("--payload", "../x"), "is not a valid name of a payload"),
            (("--payload", "x", "--dry-run"), "includes dry run"),
        ],
    )
    def test_invalid_options_are_refused(
        self, designed: Campaign, words: tuple[str, ...], sentence: str
    ) -> None:
        with pytest.raises(InputError, match=sentence):
            run_campaign(designed, *words)

    def test_a_real_arm_needs_an_operator(self, designed: Campaign, tmp_path: Path) -> None:
        cell = designed.cell
        link = 'transport = "udp"\nhost = "127.0.0.1"'
        real = Cell.from_texts(
            cell.text.replace('transport = "simulated"', link), cell.urdf, cell.path
        )
        campaign = Campaign.create(tmp_path / "real", real, designed.plan)
        with pytest.raises(InputError, match="needs an operator at a terminal"):
            run_campaign(campaign, "--payload", "gripper")

    def test_a_simulated_arm_without_a_load_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(CellError, match=r"simulation\.payload"):
            carrying(fast_cell(tmp_path))


CONSTANTS = np.array([0.12, 0.12, 0.1, 0.08, 0.05, 0.04])  # N·m/A, motor side
RATIO = np.array([100.0, 100.0, -100.0, 60.0, 60.0, -60.0])


def archive_of_currents(folder: Path, name: str, simulated: Simulated) -> Path:
    """Positions in motor radians and currents in A, without torque constants."""
    columns = {
        "time": {"column": "t"},
        "position": {"columns": "q", "side": "motor"},
        "motor_current": {"columns": "i"},
        "drive": {"gear_ratio": tuple(RATIO)},
    }
    arrays = {
        "q": simulated.position * RATIO,
        "i": simulated.torque / (RATIO * CONSTANTS),
        "t": simulated.time,
    }
    return archive_of(folder / f"{name}.mcap", simulated.urdf, columns, LAW, **arrays)


@pytest.fixture(scope="module")
def currents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gains")
    time = np.arange(0.0, 30.0, 4e-3)
    archive_of_currents(folder, "empty", simulate("ur5_robot.urdf", time, seed=1))
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    archive_of_currents(folder, "full", simulate("ur5_robot.urdf", time, seed=2, load=load))
    return folder


def gains(folder: Path, *arguments: str) -> tuple[int, str]:
    return run(folder, *arguments, command="gains")


def gains_json(folder: Path, *arguments: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(gains(folder, *arguments, "--json")[1])
    return found


def test_the_constants_lie_in_their_intervals(currents: Path) -> None:
    found = gains_json(currents, "empty.mcap", *BOTH)
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


def test_the_output_is_an_entry_of_the_column_map(currents: Path) -> None:
    status, text = gains(currents, "empty.mcap", *BOTH, "--quiet")
    pasted = tomllib.loads(text)["torque_constant"]
    assert (len(pasted) == len(CONSTANTS)) == (status == 0)
    assert "# shoulder_lift_joint ±" in text


def test_a_vertical_axis_in_slow_motion_has_no_constant(tmp_path: Path) -> None:
    """The weight of the payload does not load it."""
    time = np.arange(0.0, 150.0, 2e-2)
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    for seed, (name, body) in enumerate({"empty": None, "full": load}.items()):
        slow = simulate("ur5_robot.urdf", time, seed=seed, pace=0.1, load=body)
        noise = 0.1 * np.random.default_rng(seed).standard_normal(slow.torque.shape)  # N·m
        archive_of_currents(tmp_path, name, replace(slow, torque=slow.torque + noise))
    status, text = gains(tmp_path, "empty.mcap", *BOTH, "-q")
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
        (("empty.mcap", "--mass", "4"), "has no recording with this payload"),
        (("empty.mcap", *BOTH[:4], "--centre", "1,2"), "--centre: '1,2' is not 3 numbers"),
        (("empty.mcap",), r"without a known payload.*--loaded ARCHIVE"),
    ],
)
def test_incomplete_arguments_of_gains_are_refused(
    currents: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        gains(currents, *arguments)


def test_archives_of_a_folder_are_used(currents: Path, tmp_path: Path) -> None:
    """One of the same name as another archive is listed by its path."""
    with pytest.raises(InputError, match="contains no complete archive; give archives"):
        gains(currents, str(tmp_path))
    (tmp_path / "empty.mcap").symlink_to(currents / "empty.mcap")
    loads = gains_json(currents, str(tmp_path), *BOTH)["payload_kg"]
    assert loads == {"empty.mcap": None, "full.mcap": 4.0}
    (tmp_path / "empty.mcap").unlink()
    (tmp_path / "empty.mcap").symlink_to(currents / "full.mcap")
    loads = gains_json(currents, "empty.mcap", "--loaded", str(tmp_path), *BOTH[2:])["payload_kg"]
    assert sorted(loads.values(), key=bool) == [None, 4.0]
