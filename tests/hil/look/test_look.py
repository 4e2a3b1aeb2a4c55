"""What `hil look` says of a log: read as it is, and with one meaning planted. All simulated."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from numpy.typing import NDArray
from typer.testing import CliRunner

from benchmarks.look import measure
from hil.archive import open_archive
from hil.base.errors import ArchiveError, SourceError, UndecidedError
from hil.cli import app
from hil.cli.look import summary
from hil.importers.bag_map import BagMap
from hil.importers.column_map import ColumnMap
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions, import_recording
from hil.look import Look, look_at
from hil.look.before_identification import concluded, undecided
from hil.look.corrected_map import entries_of
from hil.look.messages import row_text
from hil.look.other_arm import Contradictions
from hil.look.physics import channel_rows
from hil.look.readings import (
    ArmChange,
    Basis,
    BeyondRange,
    DoubtfulArm,
    Either,
    Fact,
    GravityOption,
    MapEntries,
    NearestZero,
    NextBest,
    NextStep,
    OtherLengths,
    StillJoints,
    TorqueDelay,
    UnseenZeros,
)
from hil.look.result import Aspect, Row, TiedReading
from hil.look.torque_sample import SETTINGS, prepared
from hil.pipeline.sources import cell_of, source_of
from identification.estimators.delay import DelayEstimate, UndeterminedDelay
from identification.hypotheses.joint_changes import Axes, Change
from identification.hypotheses.scores import Score, compare, score_of
from identification.hypotheses.torque_low_pass import TorqueLowPass
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import prepare
from identification.signals.smoothing import LowPassShape
from tests.hil.importers.bags import STATE, bag, state, states
from tests.hil.importers.moving_log import JOINTS, URDF
from tests.hil.simulated_logs import write_log, write_moving_log
from tests.near import near
from tests.tiers import quick_ones

Floats = NDArray[np.float64]
UPRIGHT = ArmChange(Change("mounting", name="upright"), JOINTS)
MOVED = ArmChange(Change("zero", (0,), 0.5), JOINTS)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "three.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="module")
def table(urdf: Path) -> Mapping[str, Floats]:
    path = write_moving_log(urdf.with_name("moving.csv"), URDF)
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return {"t": values[:, 0], "q": values[:, 1:4], "v": values[:, 4:7], "tau": values[:, 7:]}


def look(urdf: Path, log: Path, table: Mapping[str, Floats], **planted: Floats) -> Look:
    write_log(log, ["t", "q{}", "v{}", "tau{}"], *{**table, **planted}.values())
    return look_at(log, lambda _: Robot.from_urdf(urdf), ImportOptions())


def reading(looked: Look, aspect: str) -> tuple[str, str]:
    row = next(row for row in looked.rows if row.aspect == aspect)
    return row_text(row).reading, row.certainty


def test_a_log_as_it_is(tmp_path: Path, urdf: Path, table: Mapping[str, Floats]) -> None:
    looked = look(urdf, tmp_path / "a.csv", table)
    assert not looked.questions
    assert reading(looked, "signs") == ("as the URDF's axes", "likely")
    assert reading(looked, "angle unit") == ("unit as read", "certain")
    assert reading(looked, "side") == ("joint side, a torque", "certain")
    assert reading(looked, "velocity")[0] == "q1 .. q3: rad" or reading(looked, "motion")
    assert {group.body for group in looked.groups} == set(JOINTS)


def test_coarse_positions_are_not_called_filtered(
    tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
) -> None:
    looked = look(urdf, tmp_path / "a.csv", table, q=np.round(table["q"], 3))
    assert reading(looked, "positions") == ("in steps of 1 mrad", "undetermined")


def negated(table: Mapping[str, Floats]) -> dict[str, Floats]:
    return {"tau": -table["tau"]}


def in_degrees(table: Mapping[str, Floats]) -> dict[str, Floats]:
    return {"q": np.degrees(table["q"]), "v": np.degrees(table["v"])}


def exchanged(table: Mapping[str, Floats]) -> dict[str, Floats]:
    return {"tau": table["tau"][:, [1, 0, 2]]}


def of_motors(table: Mapping[str, Floats]) -> dict[str, Floats]:
    return {"tau": table["tau"] / 100.0}


def to_the_ground(table: Mapping[str, Floats]) -> dict[str, Floats]:
    """The angle of the second joint contains that of the first."""
    matrix = np.eye(3)
    matrix[1, 0] = 1.0
    return {"q": table["q"] @ matrix.T, "v": table["v"] @ matrix.T}


def by_rods(table: Mapping[str, Floats]) -> dict[str, Floats]:
    """Rods drive the second joint from the base: torques belong to the coupled angles."""
    matrix = np.eye(3)
    matrix[1, 0] = 1.0
    return to_the_ground(table) | {"tau": table["tau"] @ np.linalg.inv(matrix)}


def late(table: Mapping[str, Floats]) -> dict[str, Floats]:
    time = table["t"]
    shifted = [np.interp(time - 0.04, time, column) for column in table["tau"].T]
    return {"tau": np.column_stack(shifted)}


@pytest.mark.parametrize(
    ("plant", "aspect", "phrase"),
    [
        (negated, "signs", "torque negated: all joints"),
        pytest.param(
            exchanged,
            "order",
            f"torque columns belong to {JOINTS[1]}, {JOINTS[0]}, {JOINTS[2]}",
            marks=pytest.mark.long,
        ),
        (of_motors, "side", "motor side (before the gears), or a current"),
        pytest.param(late, "delay", "position by 4", marks=pytest.mark.long),
        pytest.param(
            to_the_ground,
            "coupling",
            f"recorded {JOINTS[1]} is {JOINTS[1]} plus {JOINTS[0]}",
            marks=pytest.mark.long,
        ),
        pytest.param(
            by_rods,
            "coupling",
            f"recorded {JOINTS[1]} is {JOINTS[1]} plus {JOINTS[0]}, driven by rods or a belt",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_planted_meaning_is_named(
    tmp_path: Path,
    urdf: Path,
    table: Mapping[str, Floats],
    plant: Callable[[Mapping[str, Floats]], dict[str, Floats]],
    aspect: str,
    phrase: str,
) -> None:
    looked = look(urdf, tmp_path / "a.csv", table, **plant(table))
    assert phrase in reading(looked, aspect)[0]


def test_a_torque_is_compared_with_itself(urdf: Path, tmp_path: Path) -> None:
    """Another order of the torques is no other error."""
    model = RobotModel.from_urdf(urdf.read_text())
    squares = np.random.default_rng(0).uniform(1.0, 2.0, (20, 3)) * [1.0, 100.0, 1e-6]
    torque = np.array([400.0, 900.0, 1e-4])  # the last is too small to decide
    score = Score(squares, torque, np.ones(3), np.ones(3), np.arange(3))
    order = np.array([2, 0, 1])
    other = Score(squares[:, order], torque[order], np.ones(3), np.ones(3), order)
    assert compare(other, score, model).ratio == pytest.approx(1.0)
    halved = replace(other, squares=0.25 * other.squares)
    assert compare(halved, score, model).ratio == pytest.approx(0.5)


@pytest.mark.long
@pytest.mark.parametrize(
    ("arm", "meaning"),
    [
        ("lwr4", "torque 6 negated"),
        ("lwr4", "joints permuted"),
        ("lwr4", "zero of joint 2"),
        ("lwr4", "zero of joint 4"),
        ("lwr4", "position 6 negated"),
        ("gen3", "joints permuted"),
    ],
)
def test_a_meaning_planted_in_a_real_log(shared_data: Path, arm: str, meaning: str) -> None:
    (row,) = measure(shared_data, arm, meaning)
    assert row["right"], row["said"]
    assert not row["wrong"]


def test_a_delay_that_other_parts_do_not_confirm_is_open() -> None:
    delay = DelayEstimate(
        delay=0.03, std=0.003, assumed=0.0, cycle=0.004, interval_factor=2.0,
        reason=UndeterminedDelay.WIDE_INTERVAL, significant=False,
    )  # fmt: skip
    row, _ = channel_rows(delay, None)
    assert row.reading == TorqueDelay(0.03, confirmed=False)
    assert row.certainty is Certainty.UNDETERMINED
    assert row_text(row).reading == "torque perhaps lags position by 30 ms"
    early, _ = channel_rows(replace(delay, delay=-0.03), None)
    assert row_text(early).reading == "torque perhaps leads position by 30 ms"
    unseen, _ = channel_rows(replace(delay, delay=0.005), None)
    assert unseen.reading is Fact.NO_DELAY_SEEN


def test_a_low_pass_that_something_resembles_is_open() -> None:
    filtered = replace(SETTINGS, torque_bandwidth=24.0)
    _, row = channel_rows(None, TorqueLowPass(filtered, confirmed=False))
    assert row.certainty is Certainty.UNDETERMINED
    assert row_text(row).reading == "perhaps: torque low-passed at 24 Hz"
    _, likely = channel_rows(None, TorqueLowPass(filtered, confirmed=True))
    assert likely.certainty is Certainty.LIKELY


@pytest.mark.parametrize(("delay", "is_lag"), [(0.046, True), (0.07, False)])
def test_the_lag_of_a_low_pass_is_no_delay(delay: float, is_lag: bool) -> None:
    found = DelayEstimate(
        delay=delay, std=1e-4, assumed=0.0, cycle=0.002, interval_factor=2.0,
        reason=None, significant=True,
    )  # fmt: skip
    shape = LowPassShape(order=2, causal=True)  # 5 Hz lag by 45 ms
    filtered = replace(SETTINGS, torque_bandwidth=5.0, torque_shape=shape)
    row, _ = channel_rows(found, TorqueLowPass(filtered, confirmed=True))
    assert (row.reading is Fact.DELAY_OF_LOW_PASS) == is_lag
    doubted, _ = channel_rows(found, TorqueLowPass(filtered, confirmed=False))
    assert doubted.reading == TorqueDelay(delay, confirmed=True)


def test_degrees_are_concluded(tmp_path: Path, urdf: Path, table: Mapping[str, Floats]) -> None:
    looked = look(urdf, tmp_path / "a.csv", table, **in_degrees(table))
    says = [reading(looked, "angle unit")[0], reading(looked, "position")[0]]
    assert any("deg" in text for text in says)


def hil(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


class TestCommand:
    def test_a_doubt_ends_with_the_lines_to_choose_from(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        columns = {**table, **of_motors(table)}
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *columns.values())
        result = hil("look", path, "--urdf", urdf)
        assert result.exit_code == 2
        assert "two explanations fit equally well" in result.output
        assert "gear_ratio" in result.output
        assert "torque_constant" in result.output
        assert [*tmp_path.iterdir()] == [path]

    @pytest.mark.long
    def test_every_command_asks_the_side_of_a_log_and_of_its_archive(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        """Unless a map says that it is the torque of the joints: then the verdict judges it."""
        path = tmp_path / "a.csv"
        columns = {**table, **of_motors(table)}
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *columns.values())
        archive = tmp_path / "a.mcap"
        imported = hil("import", "log", path, "--urdf", urdf, "-o", archive)
        assert imported.exit_code == 0
        assert "too small for the joints of this arm; two explanations" in imported.output
        assert "check their unit" not in imported.output  # it asks instead
        of_log = hil("identify", path, "--urdf", urdf).exception
        assert isinstance(of_log, UndecidedError)
        assert of_log.aspect == of_log.field == "side"
        looked = hil("look", archive)
        assert looked.exit_code == 2
        assert "import its log again with one line in the map" in looked.output
        of_archive = hil("identify", archive).exception
        assert isinstance(of_archive, ArchiveError)
        assert of_archive.field == "side"
        assert of_archive.exit_code == of_log.exit_code == 2
        target = archive.with_suffix(".map.toml")
        stated = hil("look", path, "--urdf", urdf, "--map", target, "-v")
        assert stated.exit_code == 0, stated.output
        assert '[torque] side = "motor"; [drive] gear_ratio = ' in stated.output
        assert hil("identify", path, "--urdf", urdf, "--map", target).exit_code == 5

    def test_the_map_it_writes_is_read(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        target = tmp_path / "map.toml"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *{**table, **exchanged(table)}.values())
        result = hil("look", path, "--urdf", urdf, "-o", target, "--json")
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout)["source"] == "a.csv"
        torque = ColumnMap.load(target).torque
        assert torque is not None
        assert torque.columns == ("tau2", "tau1", "tau3")

    def test_without_an_arm_names_clock_and_slopes(
        self, tmp_path: Path, table: Mapping[str, Floats]
    ) -> None:
        path = write_log(tmp_path / "a.csv", ["t", "q{}", "v{}", "tau{}"], *table.values())
        result = hil("look", path)
        assert result.exit_code == 0, (result.output, result.exception)
        assert "position slope" in result.output
        assert "add --urdf ARM.urdf" in result.output

    def test_commands_in_a_file_of_their_own_are_no_joints(
        self, tmp_path: Path, table: Mapping[str, Floats]
    ) -> None:
        folder = tmp_path / "so"
        folder.mkdir()
        names = ["t", "q{}"]
        write_log(folder / "state.csv", names, table["t"], table["q"])
        write_log(folder / "control.csv", names, table["t"], table["q"] + 0.01)
        result = hil("look", folder)
        assert result.exit_code == 0, (result.output, result.exception)
        assert "commanded position  control.csv" in result.output


def import_by(column_map: Path, log: Path, urdf: Path, archive: Path) -> None:
    done = hil("import", "log", log, "--urdf", urdf, "--map", column_map, "-o", archive)
    assert done.exit_code == 0, done.exception


class TestConclusions:
    def test_an_identification_uses_what_is_sure(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *{**table, **exchanged(table)}.values())
        result = hil("identify", path, "--urdf", urdf)
        first, second, third = JOINTS
        order = f"order: torque columns belong to {second}, {first}, {third}, inferred"
        assert order in " ".join(result.output.split())
        text = (tmp_path / "a" / "map.toml").read_text()
        assert 'columns = ["tau2", "tau1", "tau3"]' in text

    def test_rods_that_drive_a_joint_can_be_stated(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        """The lines of docs/logs.md for a parallelogram give joint angles and joint torques."""
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *{**table, **by_rods(table)}.values())
        motor = {"side": "motor"}
        columns = {
            "time": {"column": "t"},
            "position": {"columns": "q{}", **motor},
            "velocity": {"columns": "v{}", **motor},
            "torque": {"columns": "tau{}", **motor},
            "drive": {"gear_ratio": [1.0, 1.0, 1.0], "coupling": [[2, 1, 1.0]]},
        }
        stated = tmp_path / "map.toml"
        stated.write_text(tomlkit.dumps(columns))
        archive = tmp_path / "a.mcap"
        import_by(stated, path, urdf, archive)
        read = open_archive(archive).columns
        assert read["position"] == near(table["q"], abs=1e-7)
        assert read["torque"] == near(table["tau"], abs=1e-4)

    @pytest.mark.long
    def test_the_map_of_a_look_states_rods(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *{**table, **by_rods(table)}.values())
        target, archive = tmp_path / "map.toml", tmp_path / "a.mcap"
        assert hil("look", path, "--urdf", urdf, "-o", target).exit_code == 0
        import_by(target, path, urdf, archive)
        read = open_archive(archive).columns
        assert read["position"] == near(table["q"], abs=1e-7)
        assert read["velocity"] == near(table["v"], abs=1e-7)
        assert read["torque"] == near(table["tau"], abs=1e-4)

    @pytest.mark.long
    def test_a_coupled_angle_is_its_own_in_the_archive(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        """Also by the map that a look writes."""
        path = tmp_path / "a.csv"
        target = tmp_path / "map.toml"
        planted = {**table, **to_the_ground(table)}
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *planted.values())
        result = hil("identify", path, "--urdf", urdf, "--output", tmp_path / "o")
        first, second = JOINTS[:2]
        sentence = f"recorded {second} is {second} plus {first}, inferred"
        assert sentence in " ".join(result.output.split())
        assert hil("look", path, "--urdf", urdf, "-o", target).exit_code == 0
        archive = tmp_path / "a.mcap"
        import_by(target, path, urdf, archive)
        columns = open_archive(archive).columns
        assert columns["position"] == near(table["q"], abs=1e-7)
        assert columns["velocity"] == near(table["v"], abs=1e-7)

    def test_the_lines_that_decide_it_work_when_added(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        """Torques of motors or currents: the map is written without what is open."""
        path = tmp_path / "a.csv"
        target = tmp_path / "map.toml"
        planted = {**table, **of_motors(table)}
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *planted.values())
        looked = hil("look", path, "--urdf", urdf, "-o", target)
        assert looked.exit_code == 2
        assert "map.toml, without what is undetermined: add a line" in looked.output
        line = r'\[torque\] (side = "motor"); \[drive\] (gear_ratio = \[.*?\])'
        side = re.search(line, looked.output)
        assert side is not None
        lines = target.read_text().replace("[torque]\n", f"[torque]\n{side[1]}\n")
        target.write_text(f"{lines}\n[drive]\n{side[2]}\n")
        archive = tmp_path / "a.mcap"
        import_by(target, path, urdf, archive)
        torque = open_archive(archive).columns["torque"]
        assert torque == near(table["tau"], rel=0.2, abs=0.2)

    def test_a_refusal_names_options_and_lines_of_a_map(self) -> None:
        choices = (
            TiedReading("mounting", UPRIGHT, 0.07, GravityOption((0.0, 0.0, -9.81))),
            TiedReading("zero", MOVED, 0.07, MapEntries((("position.offset", [0.0, 3.0]),))),
        )
        contradictions = Contradictions()
        message = str(undecided(Path("my log.csv"), choices, contradictions))
        assert "state --gravity 0 0 -9.81; or write the map with `hil look 'my log.csv'" in message
        assert "-o map.toml`, add [position] offset = [0, 3], and give it with --map" in message

    @pytest.mark.parametrize(
        "mounted",
        [(0.0, 9.81, 0.0), (0.0, 0.0, 0.0)],
    )
    @pytest.mark.long
    def test_another_gravity_is_stated_wrongly(
        self,
        tmp_path: Path,
        urdf: Path,
        table: Mapping[str, Floats],
        mounted: tuple[float, float, float],
    ) -> None:
        """The arm stands; the size of the torque is by its masses under that gravity."""
        path = write_log(tmp_path / "a.csv", ["t", "q{}", "v{}", "tau{}"], *table.values())
        gravity = ("--gravity", *map(str, mounted))
        result = hil("identify", path, "--urdf", urdf, *gravity, "--output", tmp_path / "o")
        assert "mounting: upright, inferred" in result.output
        columns = open_archive(tmp_path / "o" / "a.mcap").columns
        assert columns["torque"] == near(table["tau"], abs=1e-6)

    def test_the_urdf_of_another_arm_is_refused(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        """Torques that follow no masses of the arm: those of another motion."""
        path = tmp_path / "a.csv"
        rng = np.random.default_rng(0)
        noise = np.cumsum(rng.normal(size=table["tau"].shape), axis=0)
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *{**table, "tau": noise}.values())
        result = hil("identify", path, "--urdf", urdf)
        assert isinstance(result.exception, SourceError)
        assert [*tmp_path.iterdir()] == [path]


class TestOtherArm:
    """Two independent findings against the URDF, or a clear one, are a warning; three refuse it."""

    @staticmethod
    def described(path: Path, text: str) -> Path:
        path.write_text(text)
        return path

    def narrow(self, text: str) -> str:
        return text.replace("lower='-3' upper='3'", "lower='-0.05' upper='0.05'")

    def weak(self, text: str) -> str:
        return text.replace("effort='99'", "effort='0.1'")

    @pytest.mark.long
    def test_range_and_torque_contradict_it(
        self, tmp_path: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *table.values())
        other = self.described(tmp_path / "other.urdf", self.weak(self.narrow(URDF)))
        result = hil("identify", path, "--urdf", other)
        assert result.exit_code in (0, 5)
        pattern = r"may describe another arm: \w+ moves \d+° beyond its range; the torque of"
        assert re.search(pattern, " ".join(result.output.split()))

    def test_a_torque_that_no_masses_explain_refuses_it_besides(
        self, tmp_path: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        rng = np.random.default_rng(0)
        noise = 0.3 * table["tau"].std(axis=0) * rng.normal(size=table["tau"].shape)
        write_log(
            path, ["t", "q{}", "v{}", "tau{}"], *{**table, "tau": table["tau"] + noise}.values()
        )
        other = self.described(tmp_path / "other.urdf", self.weak(self.narrow(URDF)))
        result = hil("identify", path, "--urdf", other)
        assert isinstance(result.exception, SourceError)
        assert "was not recorded on the arm of the URDF: " in str(result.exception)
        assert sorted(tmp_path.iterdir()) == [path, other]

    def test_positions_and_torques_of_the_motor_side_do_not(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        """Behind gears of 100: angles 100 times larger, torques 100 times smaller."""
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *table.values())
        assert hil("import", "log", path, "--urdf", urdf).exit_code == 0
        archive = open_archive(tmp_path / "a.mcap")
        cell = cell_of(archive)
        samples = prepare(source_of(archive, cell).recording, cell.model, options=SETTINGS)
        motor = replace(samples.motion, position=100.0 * samples.motion.position)
        before_gears = replace(samples, motion=motor, torque=samples.torque / 100.0)
        score = score_of(cell.model, samples)
        assert not Contradictions.of(cell, cell.model, samples, score, 0.0).found
        (found,) = Contradictions.of(cell, cell.model, before_gears, score, 0.0).found
        assert isinstance(found, BeyondRange)

    @pytest.mark.parametrize(
        ("length", "factor"),
        quick_ones([(0.25, 1.6), (0.4, None)], [(0.25, 1.6), (0.4, None), (0.8, 0.5)]),
    )
    def test_links_of_another_length(
        self, tmp_path: Path, table: Mapping[str, Floats], length: float, factor: float | None
    ) -> None:
        """Masses are free: gravity and the coupling of the joints say how long the links are."""
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *table.values())
        text = URDF.replace("<origin xyz='0 0 0.4'/>", f"<origin xyz='0 0 {length}'/>")
        contradictions = self.contradictions(path, self.described(tmp_path / "x.urdf", text))
        assert contradictions.is_doubtful == (factor is not None)
        lengths = contradictions.lengths
        assert (None if lengths is None else lengths.factor) == pytest.approx(factor, abs=0.05)

    def test_a_look_says_it(self, tmp_path: Path, table: Mapping[str, Floats]) -> None:
        text = URDF.replace("<origin xyz='0 0 0.4'/>", "<origin xyz='0 0 0.25'/>")
        looked = look(self.described(tmp_path / "x.urdf", text), tmp_path / "a.csv", table)
        assert reading(looked, "arm") == ("may not be the arm of the URDF", "undetermined")

    @pytest.mark.long
    def test_an_identification_of_a_bag_says_it(
        self, tmp_path: Path, table: Mapping[str, Floats]
    ) -> None:
        messages = [
            state(10**9 + round(1e9 * t), q.tolist(), velocity=v.tolist(), effort=tau.tolist(),
                  names=JOINTS)
            for t, q, v, tau in zip(*table.values(), strict=True)
        ]  # fmt: skip
        source = bag(tmp_path / "x.db3", {"/joint_states": (STATE, messages)})
        options = ImportOptions()
        for length, warned in ((0.25, True), (0.4, False)):
            text = URDF.replace("<origin xyz='0 0 0.4'/>", f"<origin xyz='0 0 {length}'/>")
            robot = Robot.from_urdf(self.described(tmp_path / "x.urdf", text))
            archive = tmp_path / f"{length}.mcap"
            imported = import_recording(source, archive, lambda _, arm=robot: arm, options)
            again = concluded(imported, source, lambda _, arm=robot: arm, options).recording
            doubts = [each for each in again.concluded if isinstance(each, DoubtfulArm)]
            assert [type(doubt.found[0]) for doubt in doubts] == [OtherLengths] * warned

    def test_a_doubtful_arm_is_said_before_readings_that_fit_alike(self, tmp_path: Path) -> None:
        size = Contradictions(BeyondRange("a", np.radians(75.0), turns=True), is_far=True)
        choices = (TiedReading("zero", MOVED, 0.13, GravityOption((0.0, 0.0, 0.0))),) * 2
        refusal = undecided(tmp_path / "a.csv", choices, size)
        assert refusal.field == "--urdf"
        assert "may not be from the arm of the URDF: a moves 75°" in refusal.problem
        assert "two explanations fit equally well" in refusal.problem

    def test_readings_of_an_axis_that_are_not_so_are_another_arm(self, tmp_path: Path) -> None:
        aspects: tuple[tuple[Aspect, bool], ...] = (("zero", True), ("side", False))
        for aspect, said in aspects:
            choices = (TiedReading(aspect, MOVED, 0.13, GravityOption((0.0, 0.0, 0.0))),) * 2
            remedy = undecided(tmp_path / "a.csv", choices, Contradictions()).remedy
            assert remedy is not None
            assert ("if none of these is the case, give the URDF of this arm" in remedy) == said

    @staticmethod
    def contradictions(log: Path, urdf: Path) -> Contradictions:
        imported = hil("import", "log", log, "--urdf", urdf, "--outside-limits")
        assert imported.exit_code == 0
        archive = open_archive(log.with_suffix(".mcap"))
        cell = cell_of(archive)
        samples = prepare(source_of(archive, cell).recording, cell.model, options=SETTINGS)
        score = score_of(cell.model, samples)
        return Contradictions.of(cell, cell.model, samples, score, score.overall)

    def test_whole_turns_are_not_beyond_a_range(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
    ) -> None:
        path = tmp_path / "a.csv"
        turned = {**table, "q": table["q"] + 2.0 * np.pi * np.array([0.0, 0.0, 1.0])}
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *turned.values())
        assert not self.contradictions(path, urdf).found

    @pytest.mark.parametrize("change", quick_ones(["narrow"], ["narrow", "weak"]))
    @pytest.mark.long
    def test_one_of_them_alone_may_be_a_limit_that_is_wrong(
        self, tmp_path: Path, table: Mapping[str, Floats], change: str
    ) -> None:
        path = tmp_path / "a.csv"
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *table.values())
        other = self.described(tmp_path / "other.urdf", getattr(self, change)(URDF))
        result = hil("identify", path, "--urdf", other)
        assert not isinstance(result.exception, SourceError)
        assert (tmp_path / "a" / "results.json").exists()


def test_a_high_rate_is_averaged() -> None:
    time = np.arange(5000) * 1e-3
    position = np.sin(time[:, None] * [1.0, 1.3, 1.7])
    recording = Recording(time, position, JOINTS, np.cos(position))
    averaged = prepared(recording, RobotModel.from_urdf(URDF))
    assert averaged.motion.n_samples == 1250
    assert averaged.motion.position[600] == pytest.approx(position[2400:2404].mean(axis=0), 1e-4)


def test_payload_is_part_of_what_the_motion_determines(
    tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
) -> None:
    row = next(row for row in look(urdf, tmp_path / "a.csv", table).rows if row.aspect == "payload")
    assert row.certainty is Certainty.LIKELY
    reason = row_text(row).reason
    assert re.fullmatch(r"\d+ of \d+ of its parameters known", reason)


def test_the_map_of_a_bag_says_how_it_was_read(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.db3", {"/joint_states": (STATE, states(300))})
    output = tmp_path / "map.toml"
    result = hil("look", path, "-o", output)
    assert f"wrote {output}" in result.output
    stated = BagMap.load(output)
    assert stated is not None
    assert (stated.topic, stated.outside_limits) == ("/joint_states", False)


def test_a_map_accepts_no_positions_outside_the_limits_by_itself(
    tmp_path: Path, urdf: Path, table: Mapping[str, Floats]
) -> None:
    """Although a look itself reads them."""
    path = tmp_path / "a.csv"
    write_log(path, ["t", "q{}", "v{}", "tau{}"], *table.values())
    output = tmp_path / "map.toml"
    assert hil("look", path, "--urdf", urdf, "-o", output).exit_code == 0
    assert not ColumnMap.load(output).outside_limits


def test_axes_of_changes_become_entries_of_a_map(tmp_path: Path) -> None:
    changes = [Change("torque sign", (1,)), Change("zero", (0,), 0.5)]
    text = '[position]\ncolumns = "q{}"\n[torque]\ncolumns = "tau{}"\n'
    entries = entries_of(Axes.of(changes, 3), text, tmp_path / "a.csv", JOINTS)
    assert entries["torque.scale"] == [1.0, -1.0, 1.0]
    assert entries["position.offset"] == [0.5, 0.0, 0.0]
    assert concluded is not None


class TestTerminal:
    """Two readings that fit alike are asked for where a person can answer."""

    @staticmethod
    def asked(answer: str, *command: object) -> tuple[int, str]:
        """Run `hil` on a pseudo-terminal; return exit status and screen after one answer."""
        leader, follower = pty.openpty()
        with subprocess.Popen(
            [sys.executable, "-m", "hil", *map(str, command)],
            stdin=follower, stdout=follower, stderr=follower,
            env={**os.environ, "TERM": "dumb", "COLUMNS": "200"},
        ) as process:  # fmt: skip
            os.close(follower)
            screen = b""
            while True:
                try:
                    part = os.read(leader, 4096)
                except OSError:  # of Linux, where the other end is closed
                    break
                if not part:
                    break
                screen += part
                if screen.endswith(b"[0]: "):
                    os.write(leader, f"{answer}\n".encode())
            status = process.wait(timeout=60)
        os.close(leader)
        return status, screen.decode()

    @pytest.mark.parametrize(("answer", "status"), quick_ones([], [("0", 2), ("2", 0)]))
    def test_it_asks_which_of_two(
        self, tmp_path: Path, urdf: Path, table: Mapping[str, Floats], answer: str, status: int
    ) -> None:
        path = tmp_path / "a.csv"
        columns = {**table, **of_motors(table)}
        write_log(path, ["t", "q{}", "v{}", "tau{}"], *columns.values())
        code, screen = self.asked(answer, "look", path, "--urdf", urdf)
        assert "two explanations fit equally well" in screen
        assert "side: 1 or 2, or 0 if unknown" in screen
        assert code == status


def rows_of(count: int) -> list[Row]:
    """Return rows whose meaning takes three lines of the table, the last one undetermined."""
    still = StillJoints(tuple(f"joint_{k}" for k in range(9)))
    certain = [Row("motion", still, Certainty.CERTAIN, (Basis.POSITIONS_ALONE,))] * (count - 1)
    return [*certain, Row("order", still, Certainty.UNDETERMINED, (Basis.SMALL_NOISE,))]


def test_long_cells_of_the_table_take_further_lines() -> None:
    lines = summary(rows_of(2))
    assert len(lines) == 1 + 2 * 3
    assert "..." not in " ".join(lines)


def test_a_zero_without_evidence_takes_no_line() -> None:
    """Nor is there anything to do for it; one that lessens the error has both, as has a sign."""

    def shown(row: Row) -> bool:
        lines = summary([*rows_of(1), row])
        assert row.has_step == any(line.startswith(row.aspect) for line in lines)
        return row.has_step

    change = ArmChange(Change("zero", (0,), 0.8), ("j1",))
    zeros, certainty, step = (
        UnseenZeros(("j1",)),
        Certainty.UNDETERMINED,
        NextStep.COMPARE_A_POSTURE,
    )
    step = NextStep.COMPARE_A_POSTURE
    for ratio, is_shown in ((1.0, False), (1.1, False), (0.9, True)):
        evidence = (NearestZero(change, ratio),)
        assert shown(Row("zero", zeros, certainty, evidence, step)) == is_shown
    negated = ArmChange(Change("torque sign", (0,)), ("j1",))
    signs = Either(Fact.SIGNS_OF_URDF, negated)
    assert shown(Row("signs", signs, certainty, (NextBest(negated, 1.0),), NextStep.PUSH_A_JOINT))


def test_uncertain_rows_get_further_lines_first() -> None:
    lines = summary(rows_of(3), most=6)
    assert [line.split()[0] for line in lines[:4]] == ["channel", "motion", "motion", "order"]
    assert len(lines) == 6
    assert ["..." in line for line in lines] == [False, True, True, False, False, False]
