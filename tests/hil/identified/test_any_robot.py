"""Robots and logs that nothing was written for: read from configuration alone, then identified."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt, sosfiltfilt
from typer.testing import CliRunner

from hil.base.errors import ArchiveError
from hil.base.exit_status import ExitStatus
from hil.base.progress import Silent
from hil.cli import app
from hil.importers.column_map import ColumnMap, Quantity, TimeColumn
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.importers.recording_content import Use
from hil.pipeline.notes import PositionNoise, UnevenClock
from hil.pipeline.options import FIXED, Options
from hil.pipeline.prepared import Prepared, prepare_sources, stated_settings
from hil.pipeline.sources import gather_sources
from hil.results.results import FittedResult, Results
from identification import Estimate, FrictionLaw, estimate, prediction_error
from identification.factor.factor import Factor
from identification.validation.finding import TestedOn
from tests.hil.simulated_logs import (
    POSITION_NOISE,
    TORQUE_NOISE,
    Simulated,
    planted,
    simulate,
    urdf_path,
)
from tests.near import near

pytestmark = pytest.mark.long

Array = NDArray[np.float64]
LAW = FrictionLaw(third=None, offset=True, standstill=0.02)
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
PANDA = "panda.urdf"
UR5 = "ur5_robot.urdf"
EPOCH_MS = 1_700_000_000_000


NOTHING_CHOSEN = replace(FIXED, delay=None)
"""Nothing chosen automatically: least squares."""


@dataclass(frozen=True, eq=False)
class Found:
    """An identification from an archive."""

    prepared: Prepared
    fit: Estimate
    held_out_error: float


def identify(
    folder: Path,
    simulated: Simulated,
    log: str,
    columns: str,
    locked: tuple[str, ...] = (),
    options: Options = NOTHING_CHOSEN,
) -> Found:
    """The way of `hil import log` and `hil identify`, up to the estimate."""
    (folder / "map.toml").write_text(columns)
    archive = import_log(
        folder / log,
        folder / "log.mcap",
        robot=Robot.from_urdf(simulated.urdf, friction=LAW, locked=dict.fromkeys(locked, 0.0)),
        columns=ColumnMap.load(folder / "map.toml"),
    )
    prepared = prepare_sources(gather_sources([archive], 0.7), options, Silent())
    model = prepared.sources.cell.model
    fit = estimate(model, Factor.of(model, prepared.fitted[0]))
    (error,) = prediction_error(model, fit.values, prepared.held_out)
    return Found(prepared, fit, error.overall)


def assert_found(identified: Found, simulated: Simulated) -> None:
    """What was planted is found, and what was held out predicted down to the noise."""
    model = identified.prepared.sources.cell.model
    truth = planted(model, simulated)
    # Smoothing leaves a bias below a percent; chance goes beyond 5 std once in two million.
    far = np.abs(identified.fit.values - truth) > 5.0 * identified.fit.std + 0.01 * np.abs(truth)
    assert not far.any(), np.array(model.parameter_names)[far]
    rms = np.sqrt((simulated.clean**2).mean(axis=0) @ np.ones(model.n_joints))
    noise = TORQUE_NOISE * np.sqrt(np.sum(simulated.clean.var(axis=0)))
    assert identified.held_out_error < 1.5 * noise / rms


def write(path: Path, header: str, table: Array, form: Callable[[float], str] = repr) -> None:
    lines = [header] if header else []
    lines += [",".join(form(float(cell)) for cell in row) for row in table]
    path.write_text("\n".join(lines) + "\n")


def test_seven_axes_in_degrees_at_an_uneven_100_hz(tmp_path: Path) -> None:
    """Time in ms of a wall clock, a column of a gripper, stamps repeated, a second lost."""
    rng = np.random.default_rng(2)
    time = np.cumsum(0.01 * rng.uniform(0.6, 1.4, 4000))
    time = time[(time < 11.0) | (time > 12.0)]
    simulated = simulate(PANDA, time, locked=FINGERS)
    order = [6, 2, 0, 1, 3, 4, 5]
    degrees = np.degrees(simulated.position)[:, order]
    torque = simulated.torque[:, order]
    stamp = EPOCH_MS + np.round(time * 1e3, 3)
    table = np.column_stack([degrees, np.full(len(time), 0.04), torque, np.zeros(len(time)), stamp])
    table = np.insert(table, 500, table[499], axis=0)  # a line written twice
    names = [f"panda_joint{joint + 1}" for joint in order]
    header = ",".join([*(f"q{k}" for k in range(1, 9)), *(f"u{k}" for k in range(1, 9)), "stamp"])
    write(tmp_path / "log.csv", header, table)
    columns = f"""
        joints = {[*names, "gripper"]!r}
        [time]
        column = "stamp"
        unit = "ms"
        [position]
        columns = "q{{}}"
        unit = "deg"
        [torque]
        columns = "u{{}}"
        """
    identified = identify(tmp_path, simulated, "log.csv", columns, FINGERS)
    assert_found(identified, simulated)
    clock, *_ = [each.base for each in identified.prepared.notes if isinstance(each, UnevenClock)]
    assert not clock.uniform
    assert clock.gaps - clock.pauses == 1


def test_currents_without_torque_constants_are_refused(tmp_path: Path) -> None:
    simulated = simulate(UR5, np.arange(0.0, 5.0, 4e-3))
    np.savez(tmp_path / "log.npz", q=simulated.position, i=simulated.torque)
    columns = 'sample_rate = 250.0\n[position]\ncolumns = "q"\n[motor_current]\ncolumns = "i"\n'
    with pytest.raises(ArchiveError, match=r"no torques; give drive\.torque_constant"):
        identify(tmp_path, simulated, "log.npz", columns)


def test_a_standstill_gives_the_noise(tmp_path: Path) -> None:
    """Three files of one robot: to be fitted, to be predicted, at rest (positions alone)."""
    time = np.arange(0.0, 12.0, 4e-3)
    robot = Robot.from_urdf(simulate(UR5, time[:2]).urdf, friction=LAW)
    uses: dict[str, Use] = {"a": "excitation", "b": "validation", "c": "standstill"}
    paths = []
    for seed, (name, use) in enumerate(uses.items()):
        simulated = simulate(UR5, time, seed=seed)
        arrays = {"q": simulated.position, "tau": simulated.torque}
        position = {"columns": "q"}
        quantities = {"position": position, "torque": {"columns": "tau"}}
        if use == "standstill":
            noise = POSITION_NOISE * np.random.default_rng(9).standard_normal(
                simulated.position.shape
            )
            arrays = {"q": simulated.position[0] + noise}
            quantities = {"position": position}
        np.savez(tmp_path / f"{name}.npz", **arrays)
        paths.append(
            import_log(
                tmp_path / f"{name}.npz",
                tmp_path / f"{name}.mcap",
                robot=robot,
                columns=ColumnMap.model_validate({"sample_rate": 250.0, **quantities}),
                use=use,
            )
        )
    sources = gather_sources(paths, 0.7)
    assert [source.name for source in sources.training] == ["a.mcap"]
    assert [source.name for source in sources.held_out] == ["b.mcap"]
    assert sources.tested_on is TestedOn.UNSEEN
    assert sources.noise_variance == pytest.approx(np.full(6, POSITION_NOISE**2), rel=0.2)
    prepared = prepare_sources(sources, Options(torque_bandwidth=None), Silent())
    assert PositionNoise(at_standstill=True) in prepared.notes

    unread = gather_sources(paths[:1], 0.7, predict=paths[1:2])
    assert [source.name for source in unread.held_out] == ["b.mcap"]


ROOT = Path(__file__).resolve().parents[3]
DATA = ROOT.parent / "shared" / "data"
TEXT = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
SECTION = TEXT.split("## Two published recordings")[1].split("\n## ")[0]
COMMANDS = re.findall(r"^\$ hil (.*)$", SECTION, re.MULTILINE)


def fitted_by(commands: list[str], output: Path) -> FittedResult:
    """Run an import and an identification, and read the errors of the fit."""
    for command in commands:
        arguments = shlex.split(command)
        status = 0
        if arguments[0] == "identify":
            arguments = [*arguments, "--output", str(output)]
            status = ExitStatus.NEGATIVE_RESULT
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == status, (command, result.output, result.exception)
    return Results.load(output / "results.json").fitted


@pytest.mark.slow
def test_the_commands_of_the_page_fit_two_published_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """UR10: every row of all joints; TX40, with its coupling and without: torque through 40 Hz."""
    assert [command.split()[0] for command in COMMANDS] == ["import", "identify"] * 3
    if not (DATA / "tx40").is_dir() or not (DATA / "ur10_unisa").is_dir():
        pytest.skip(f"there are no recordings below {DATA}")
    files = [*(DATA / "tx40").iterdir(), *(DATA / "ur10_unisa").iterdir()]
    for file in [*files, urdf_path("ur10_robot.urdf")]:
        (tmp_path / file.name).symlink_to(file)
    (block,) = re.findall(r"```toml\n(.*?)```", SECTION, re.DOTALL)
    (tmp_path / "tx40.toml").write_text(block)
    monkeypatch.chdir(tmp_path)
    assert fitted_by(COMMANDS[:2], tmp_path / "ur10").all_rows_relative_error <= 0.0515
    coupled = fitted_by(COMMANDS[2:4], tmp_path / "coupled").smoothed_overall_relative_error
    alone = fitted_by(COMMANDS[4:6], tmp_path / "alone").smoothed_overall_relative_error
    assert coupled <= 0.109
    assert coupled < alone <= 0.143


RATE = 125.0  # Hz
BANDWIDTH = 4.0  # Hz
OPTIONS = replace(FIXED, delay=None, torque_bandwidth="auto")
COLUMNS = ColumnMap(
    time=TimeColumn(column="time"),
    position=Quantity(columns="position", joints_along="columns"),
    torque=Quantity(columns="torque", joints_along="columns"),
)


def prepared(
    folder: Path, order: int | None, *, causal: bool = False, options: Options = OPTIONS
) -> Prepared:
    """A log of a UR5, its torque through a Butterworth low-pass."""
    log = simulate("ur5_robot.urdf", np.arange(0.0, 24.0, 1.0 / RATE), pace=2.0)
    torque = log.torque
    if order is not None:
        sections = butter(order, BANDWIDTH, fs=RATE, output="sos")
        torque = (sosfilt if causal else sosfiltfilt)(sections, torque, axis=0)
    np.savez(folder / "log.npz", time=log.time, position=log.position, torque=torque)
    robot = Robot.from_urdf(
        log.urdf, friction=FrictionLaw(third=None, offset=True, standstill=0.02)
    )
    archive = import_log(folder / "log.npz", folder / "log.mcap", robot=robot, columns=COLUMNS)
    return prepare_sources(gather_sources([archive], 0.7), options, Silent())


def held_out_error(prepared_data: Prepared) -> float:
    model = prepared_data.sources.cell.model
    values = estimate(model, Factor.of(model, prepared_data.fitted[0])).values
    (error,) = prediction_error(model, values, prepared_data.held_out, all_rows=True)
    return error.overall


@pytest.fixture(scope="module")
def unfiltered(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    return prepared(tmp_path_factory.mktemp("unfiltered"), None)


class TestFilteredTorque:
    def test_none_is_claimed_without_one(self, unfiltered: Prepared) -> None:
        assert unfiltered.settings.preprocessing.torque_bandwidth is None

    @pytest.mark.parametrize(("order", "causal"), [(1, False), (4, False), (1, True), (2, True)])
    def test_is_found(self, tmp_path: Path, order: int, causal: bool, unfiltered: Prepared) -> None:
        """The lag of a causal low-pass, some 10 ms, is not identified as a delay."""
        filtered = prepared(tmp_path, order, causal=causal)
        preprocessing = filtered.settings.preprocessing
        assert preprocessing.torque_bandwidth == near(BANDWIDTH, rel=0.2)
        assert held_out_error(filtered) < 1.3 * held_out_error(unfiltered)
        if causal:
            assert preprocessing.torque_shape.causal
            assert preprocessing.torque_delay == 0.0
            assert filtered.delays is None


def test_fixed_options_decide_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("choose_settings", "estimate_delay", "possible_low_passes"):
        monkeypatch.setattr(f"hil.pipeline.prepared.{name}", pytest.fail)
    prepared_data = prepared(tmp_path, 2, causal=True, options=FIXED)
    assert prepared_data.settings == stated_settings(prepared_data.sources.cell, FIXED)
