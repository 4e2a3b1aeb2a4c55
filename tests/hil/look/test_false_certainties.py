"""Logs of which nothing certain follows: rounded stamps, a torque of zeros, rows at 5 Hz."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from benchmarks.board import cut, import_all
from benchmarks.conditions import filtered, written
from benchmarks.joint_log import JointLog
from benchmarks.published import Published
from hil.base.errors import SourceError
from hil.identified.identified_arm import arm_from
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.plausibility import are_degrees
from hil.importers.recording_import import ImportOptions, read_recording
from hil.importers.stamps import concluded_unit
from hil.look import look_at
from hil.look.before_identification import concluded
from hil.look.readings import ErrorExplained, ReadAsGiven, RowsReading, ZeroTorques
from hil.look.result import Look
from identification.hypotheses.hypothesis import Hypothesis
from tests.hil.simulated_logs import (
    Simulated,
    simulate,
    urdf_path,
    write_log,
    write_moving_log,
)
from tests.tiers import quick_ones

URDF = urdf_path("ur5_robot.urdf")
RECORDED = Path(__file__).resolve().parents[4] / "shared" / "data"
TIME = np.arange(0.0, 12.0, 0.008)


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    return simulate(URDF, TIME, seed=2, pace=1.5)


def log_of(folder: Path, simulated: Simulated, **changed: Any) -> Path:
    columns = {"time": simulated.time, "torque": simulated.torque} | changed
    path = folder / "log.csv"
    names = ["t", "q{}", "tau{}"]
    return write_log(path, names, columns["time"], simulated.position, columns["torque"])


def look(log: Path) -> Look:
    robot = Robot.from_urdf(URDF)
    return look_at(log, lambda _: robot, ImportOptions())


@pytest.mark.long
def test_no_delay_is_certain_by_rounded_stamps(tmp_path: Path, simulated: Simulated) -> None:
    """To 0.1 s: the times are even steps at an estimated rate."""
    found = look(log_of(tmp_path, simulated, time=np.round(TIME, 1)))
    (row,) = [row for row in found.rows if row.aspect == "delay"]
    assert row.certainty is not Certainty.CERTAIN


@pytest.mark.long
def test_no_row_is_displaced_by_late_stamps_alone(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    time = np.arange(0.0, 14.0, 0.008)
    simulated = simulate(URDF, time, seed=3, pace=1.5)
    late = np.sort(time + random.uniform(0.0, 0.007, len(time)))
    found = look(log_of(tmp_path, simulated, time=late))
    (rows,) = [row.reading for row in found.rows if isinstance(row.reading, RowsReading)]
    assert rows.times is not None
    assert rows.times.even
    assert rows.faults == ()


@pytest.mark.long
def test_shares_of_a_range_are_no_certain_degrees(tmp_path: Path, simulated: Simulated) -> None:
    """Each joint has its own range in them, as a servo normalises it: no unit explains them."""
    low, high = simulated.position.min(axis=0) - 0.05, simulated.position.max(axis=0) + 0.07
    position = (simulated.position - low) / (high - low) * 200.0 - 100.0
    log = write_log(
        tmp_path / "log.csv", ["t", "q{}", "tau{}"], simulated.time, position, simulated.torque
    )
    (row,) = [row for row in look(log).rows if row.aspect == "position"]
    assert row.certainty is not Certainty.CERTAIN


def planar_arm(axis: str, count: int) -> str:
    """Description of an arm whose axes are parallel."""
    links = ['<link name="link0"/>']
    for joint in range(1, count + 1):
        mass = 3.0 / joint
        links.append(
            f'''<link name="link{joint}"><inertial><origin xyz="0.15 0 0"/><mass value="{mass}"/>
            <inertia ixx="0.002" iyy="{0.02 * mass}" izz="{0.02 * mass}" ixy="0" ixz="0" iyz="0"/>
            </inertial></link><joint name="joint{joint}" type="revolute">
            <parent link="link{joint - 1}"/><child link="link{joint}"/>
            <origin xyz="{0.3 * (joint > 1)} 0 0"/><axis xyz="{axis}"/>
            <limit lower="-2.9" upper="2.9" effort="200" velocity="20"/></joint>'''
        )
    return f'<robot name="planar">{"".join(links)}</robot>'


UPRIGHT_AXIS, LEVEL_AXIS = "0 0 1", "0 1 0"


@pytest.mark.parametrize(
    ("axis", "count", "in_degrees"),
    quick_ones(
        [(LEVEL_AXIS, 2, False)],
        [
            (axis, count, in_degrees)
            for axis in (LEVEL_AXIS, UPRIGHT_AXIS)
            for count in (2, 3)
            for in_degrees in (False, True)
            if in_degrees <= (axis == LEVEL_AXIS)
        ],
    ),
)
def test_a_planar_arm_may_show_the_unit_of_its_positions(
    tmp_path: Path, axis: str, count: int, in_degrees: bool
) -> None:
    """Gravity shows it of axes that are level; numbers from -100 to 100 are no degrees."""
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(planar_arm(axis, count))
    log = write_moving_log(tmp_path / "log.csv", urdf.read_text(), duration=16.0)
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    time, position, torque = table[:, 0], table[:, 1 : count + 1], table[:, -count:]
    low, high = position.min(axis=0) - 0.05, position.max(axis=0) + 0.2
    numbers = (position - low) / (high - low) * 200.0 - 100.0
    numbers = np.degrees(position) if in_degrees else numbers
    write_log(log, ["t", "q{}", "tau{}"], time, numbers, torque)
    found = look_at(log, lambda _: Robot.from_urdf(urdf), ImportOptions())
    certain = {row.aspect for row in found.rows if row.certainty is Certainty.CERTAIN}
    assert ("position" in certain) == in_degrees
    assert ("angle unit" in certain) == in_degrees
    if not in_degrees:
        assert not certain & {"zero", "scale"}


@pytest.mark.parametrize("wrapped_at", ["zero", "the middle of the motion"])
def test_angles_within_a_turn_are_radians(
    tmp_path: Path, simulated: Simulated, wrapped_at: str
) -> None:
    """They leave the limits of the URDF, but for a turn."""
    whole = simulated.position
    at = 0.0 if wrapped_at == "zero" else 0.5 * (whole.min(axis=0) + whole.max(axis=0))
    position = (whole - at) % (2.0 * np.pi) + at
    limits = (np.abs(whole).max() + 0.1) * np.array([-1.0, 1.0])
    assert np.abs(position).max() > 3.0 * limits[1] or wrapped_at == "zero"
    urdf = tmp_path / "limited.urdf"
    narrow = re.sub(
        r'lower="[^"]*" upper="[^"]*"', 'lower="{:.4f}" upper="{:.4f}"'.format(*limits),
        URDF.read_text(),
    )  # fmt: skip
    urdf.write_text(narrow)
    names = Robot.from_urdf(urdf).joint_names
    converted = np.radians(position)
    assert not are_degrees(position, converted, names, urdf.read_text())
    within_a_turn = simulated.position % (2.0 * np.pi)
    assert are_degrees(np.degrees(within_a_turn), within_a_turn, names, urdf.read_text())


class TestTorqueOfZeros:
    """Of one joint that moves: it is named, and counts as no error of the others."""

    @pytest.fixture
    def log(self, tmp_path: Path, simulated: Simulated) -> Path:
        torque = simulated.torque.copy()
        torque[:, 1] = 0.0
        return log_of(tmp_path, simulated, torque=torque)

    @pytest.mark.long
    def test_a_look_names_it(self, log: Path, simulated: Simulated) -> None:
        found = look(log)
        assert ZeroTorques((simulated.joint_names[1],)) in [row.reading for row in found.rows]
        assert found.error is not None
        assert found.error < 0.05

    @pytest.mark.long
    def test_a_verdict_says_no_more_of_it(self, log: Path) -> None:
        arm = arm_from(log, URDF, None, (), None, None, None)
        assert not arm.verdict.good
        wrong = [each for each in arm.verdict.findings if each.level == "wrong"]
        (cause,) = [each for each in wrong if each.role == "cause"]
        assert (cause.key, cause.joints) == ("no torque", (1,))
        assert arm.results.judgement.all_joints is not None
        assert arm.results.judgement.all_joints.relative < 0.05


@pytest.mark.parametrize(
    ("step", "count", "unit"),
    [(0.2, 70, "s"), (0.2, 10_000, "ms"), (4.0, 20, "ms"), (0.004, 500, "s"), (4000.0, 500, "us")],
)
def test_a_unit_of_time_gives_a_second_of_motion(step: float, count: int, unit: str) -> None:
    """5 Hz for 14 s, or 5 kHz in ms for 2 s; of a few rows the rate decides."""
    assert concluded_unit([round(1e9 * step * row) for row in range(count)]) == unit


def test_a_slow_log_is_refused_by_its_rate(tmp_path: Path, simulated: Simulated) -> None:
    rows = slice(None, None, 25)
    path = tmp_path / "log.csv"
    signals = [each[rows] for each in (simulated.time, simulated.position, simulated.torque)]
    log = write_log(path, ["t", "q{}", "tau{}"], *signals)
    with pytest.raises(SourceError, match="has 5 samples per second"):
        look(log)


@pytest.mark.long
@pytest.mark.parametrize("inertia", [0.0, 50.0])
def test_a_low_pass_explains_a_torque_better_than_another_arm(
    tmp_path: Path, simulated: Simulated, inertia: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 2 Hz: a third of the torque is gone, and no sign, zero or scale is certain.

    Nor are signs of all joints searched, which would take most of the time, whatever the inertia of
    a rotor [kg·m²].
    """
    for searched in ("best_signs", "signs_by_joint_fit"):
        monkeypatch.setattr(Hypothesis, searched, lambda _: pytest.fail("signs are searched"))
    velocity = np.gradient(simulated.position, TIME, axis=0)
    torque = simulated.torque.copy()
    torque[:, 1] += inertia * np.gradient(velocity[:, 1], TIME)
    sections = butter(2, 2.0, fs=125.0, output="sos")
    torque = sosfilt(sections, torque, axis=0)
    found = look(log_of(tmp_path, simulated, torque=torque))
    (row,) = [row for row in found.rows if row.aspect == "as read"]
    (explained,) = [each for each in row.evidence if isinstance(each, ErrorExplained)]
    assert explained.error < 0.05
    assert explained.how.low_pass == pytest.approx(2.0, rel=0.1)
    assert not [row for row in found.rows if row.is_changed and row.certainty is Certainty.CERTAIN]


@pytest.mark.long
def test_a_heavy_rotor_is_no_scale_of_the_torque(tmp_path: Path, simulated: Simulated) -> None:
    """Of 100 kg·m² on a joint that moves some 10: its torque is as stated, and so are its zeros."""
    velocity = np.gradient(simulated.position, TIME, axis=0)
    torque = simulated.torque.copy()
    torque[:, 1] += 100.0 * np.gradient(velocity[:, 1], TIME)
    found = look(log_of(tmp_path, simulated, torque=torque))
    assert not [row for row in found.rows if row.is_changed]
    (row,) = [row for row in found.rows if row.aspect == "as read"]
    (explained,) = [each for each in row.evidence if isinstance(each, ErrorExplained)]
    assert explained.how.heavy_rotors
    assert found.error == pytest.approx(explained.error)
    assert found.error < 0.05


@pytest.mark.long
def test_a_log_that_nothing_explains_better_is_read_as_given(tmp_path: Path) -> None:
    """A low-pass leaves 15 % of the torque; a zero, a sign and an order explain 1 % of that."""
    if not (RECORDED / "kr300").is_dir():
        pytest.skip("the recordings are not here")
    published = Published.named("kr300")
    archives = import_all(published, RECORDED / "kr300", tmp_path)
    logs = {name: JointLog.read(path, published.rated_payload) for name, path in archives.items()}
    (split,) = [split for split in published.splits if str(split) == "B to A"]
    fitted = cut(split, {name: filtered(log) for name, log in logs.items()}).fitted
    source = written(fitted, tmp_path / "fitted.npz")
    imported = read_recording(source, lambda _: fitted.robot, ImportOptions())
    found = concluded(imported, source, lambda _: fitted.robot, ImportOptions())
    assert found.recording.map_text == imported.map_text
    (given,) = [each for each in found.recording.concluded if isinstance(each, ReadAsGiven)]
    assert given.error > 0.15
    assert len(given.no_better.changes) == 3
