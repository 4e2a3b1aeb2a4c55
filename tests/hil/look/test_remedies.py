"""Remedies printed for recordings of public reports, typed: the result is the right one."""

from __future__ import annotations

import re
import shlex
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.errors import HilError
from hil.cli import app
from tests.near import near

pytestmark = pytest.mark.slow
RATE = 250.0  # Hz, of the controller whose cycles were counted
FACTOR = re.compile(
    r"(masses|lengths of joints|centres of mass|inertias)[^(]*(?:\(origin[^)]*\)[^(]*)?"
    r"\(multiply by ([\de.-]+)\)"
)
"""Quantities of a description with their factors to SI units."""


@pytest.fixture
def cases(shared_data: Path) -> Path:
    folder = shared_data.parent / "cases" / "diagnosis"
    if not folder.is_dir():
        pytest.skip("the cases (../shared/cases/diagnosis) are not beside this checkout")
    return folder


def typed(*words: object) -> tuple[int, str]:
    """Exit status and what is printed; a refusal is printed as well."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    refused = isinstance(result.exception, HilError)
    assert refused or result.exit_code in (0, 2, 5), (words, result.exception)
    code = result.exception.exit_code if refused else result.exit_code
    return code, " ".join(f"{result.output} {result.exception or ''}".split())


def columns(archive: Path) -> Any:
    return open_archive(archive).columns


LOGS = (
    "02-cycle-counter-as-time/time_counter.csv", "03-plotjuggler-async/async.csv",
    "04-commanded-as-measured/open_loop.csv", "06-torque-already-compensated/bare_g.csv",
    "06-torque-already-compensated/residual_97.csv", "09-several-zeros/three.csv",
    "10-rows/bursts.csv", "10-rows/frozen.csv", "12-motion-kinds/payload_late.csv",
    "12-motion-kinds/single.csv", "13-containers/xcdr2.mcap",
    "14-torque-encodings/present_load.csv",
)  # fmt: skip


@pytest.mark.parametrize("name", LOGS)
def test_a_look_ends_in_sentences(cases: Path, name: str) -> None:
    code, shown = typed("look", cases / name, "--urdf", cases / "arm.urdf")
    assert code in (0, 2)
    assert "Traceback" not in shown


def test_the_rate_in_place_of_counted_cycles(cases: Path, tmp_path: Path) -> None:
    log = cases / "02-cycle-counter-as-time" / "time_counter.csv"
    output = tmp_path / "out.mcap"
    line = ("import", "log", log, "--urdf", cases / "arm.urdf", "--force", "-o", output)
    code, refused = typed(*line)
    assert code == 2
    (option,) = re.findall(r"--sample-rate HZ", refused)
    assert typed(*line, *shlex.split(option.replace("HZ", str(RATE))))[0] == 0
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    read = columns(output)
    assert np.median(np.diff(read["stamp"])) == near(1e9 / RATE)
    assert read["position"] == near(table[:, 1:7], rel=1e-12)


def test_the_rate_in_place_of_a_map_with_milliseconds(cases: Path, tmp_path: Path) -> None:
    """The step that the verdict prints, in the map that was given: the model is good then."""
    folder = cases / "02-cycle-counter-as-time"
    line = ("identify", folder / "time_counter.csv", "--urdf", cases / "arm.urdf")
    code, shown = typed(*line, "--map", folder / "ms.toml", "-o", tmp_path / "wrong")
    assert code == 5
    assert "state the rate of the controller: sample_rate = HZ and no [time]" in shown
    entries = tmp_path / "map.toml"
    stated = (folder / "ms.toml").read_text()
    without_time = re.sub(r"\[time\][^\[]*", "", stated)
    entries.write_text(f"sample_rate = {RATE}\n{without_time}")
    code, shown = typed(*line, "--map", entries, "-o", tmp_path / "right")
    assert code == 0
    assert "Good for feed-forward" in shown


def inertials(path: Path) -> dict[str, list[float]]:
    """Numbers of a URDF by element, in its order."""
    numbers: dict[str, list[float]] = {}
    for element in ElementTree.parse(path).iter():
        for key in ("value", "xyz", "ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
            if element.tag in ("mass", "inertia", "origin") and key in element.attrib:
                found = map(float, element.attrib[key].split())
                numbers.setdefault(f"{element.tag} {key}", []).extend(found)
    return numbers


@pytest.mark.parametrize("name", ["gram.urdf", "mm.urdf"])
def test_a_description_times_its_factors_is_that_of_the_arm(
    cases: Path, tmp_path: Path, name: str
) -> None:
    folder = cases / "11-urdf-units"
    code, refused = typed("look", folder / "log.csv", "--urdf", folder / name)
    assert code == 2
    factors = {what: float(factor) for what, factor in FACTOR.findall(refused)}
    assert factors
    tree = ElementTree.parse(folder / name)
    for inertial in tree.iter("inertial"):
        scale(inertial.find("mass"), factors.get("masses", 1.0))
        scale(inertial.find("inertia"), factors.get("inertias", 1.0))
        scale(inertial.find("origin"), factors.get("centres of mass", 1.0))
    for joint in tree.iter("joint"):
        scale(joint.find("origin"), factors.get("lengths of joints", 1.0))
    urdf = tmp_path / "arm.urdf"
    tree.write(urdf)
    found = inertials(urdf)
    for key, expected in inertials(cases / "arm.urdf").items():
        assert found[key] == pytest.approx(expected, rel=1e-9, abs=1e-12), key
    code, shown = typed("look", folder / "log.csv", "--urdf", urdf)
    assert code == 0
    assert "two explanations fit equally well" not in shown


def scale(element: ElementTree.Element | None, factor: float) -> None:
    for key in ("value", "xyz", "ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
        if element is not None and key in element.attrib:
            values = [float(word) * factor for word in element.attrib[key].split()]
            element.set(key, " ".join(map(repr, values)))


def test_two_topics_in_one_table_need_no_remedy(cases: Path, tmp_path: Path) -> None:
    """Positions at 250 Hz and torques at 100 Hz: the latter's stamps, the former interpolated."""
    log = cases / "03-plotjuggler-async" / "async.csv"
    output = tmp_path / "out.mcap"
    code, shown = typed("import", "log", log, "--urdf", cases / "arm.urdf", "-o", output)
    assert code == 0
    assert "--drop-missing" not in shown
    table = np.genfromtxt(log, delimiter=",", skip_header=1)
    torques = table[np.isfinite(table[:, 7:]).all(axis=1)]
    read = columns(output)
    found = np.searchsorted(torques[:, 0], read["stamp"] * 1e-9 - 1e-6)
    assert len(read["stamp"]) > 0.98 * len(torques)
    assert read["torque"] == near(torques[np.clip(found, 0, len(torques) - 1), 7:])


STATED = """
[time]
column = "{}"
[position]
columns = "{}"
{zeros}
[torque]
columns = "{}"
"""
"""A whole column map, which is taken as it is: the verdict alone says what it has wrong."""


def stated_map(folder: Path, *columns: str, zeros: str = "") -> Path:
    """Write the map of a log whose time, positions and torques are these columns."""
    text = STATED.format(*columns, zeros=zeros)
    path = folder / f"map{len(zeros)}.toml"
    path.write_text(text)
    return path


def test_zeros_that_a_verdict_prints_make_the_model_good(cases: Path, tmp_path: Path) -> None:
    log = cases / "09-several-zeros" / "three.csv"
    line = ("identify", log, "--urdf", cases / "arm.urdf")
    stated = stated_map(tmp_path, "t", "q{}", "tau{}")
    code, shown = typed(*line, "--map", stated, "-o", tmp_path / "wrong", "-v")
    assert code == 5
    (offset,) = set(re.findall(r"\[position\] (offset = \[[^]]*\])", shown))
    corrected = stated_map(tmp_path, "t", "q{}", "tau{}", zeros=offset)
    code, shown = typed(*line, "--map", corrected, "-o", tmp_path / "right")
    assert code == 0
    assert "Good for feed-forward" in shown


def test_gravity_that_a_verdict_prints_makes_the_model_good(cases: Path, tmp_path: Path) -> None:
    log = cases / "06-torque-already-compensated" / "bare_g.csv"
    stated = stated_map(tmp_path, "timestamp", "actual_q_{}", "actual_torque_{}")
    line = ("identify", log, "--urdf", cases / "arm.urdf", "--map", stated)
    code, shown = typed(*line, "-o", tmp_path / "wrong", "-v")
    assert code == 5
    (option,) = set(re.findall(r"`(--gravity 0 0 0)` with a log", shown))
    code, shown = typed(*line, *shlex.split(option), "-o", tmp_path / "right")
    assert code == 0
    assert "Good for feed-forward" in shown


def test_the_entries_of_a_load_with_its_sign_in_a_bit(cases: Path, tmp_path: Path) -> None:
    """The refusals lead from a log without a torque to one in newton metres."""
    log = cases / "14-torque-encodings" / "present_load.csv"
    line = ("identify", log, "--urdf", cases / "arm.urdf", "-o", tmp_path / "found")
    code, refused = typed(*line)
    assert code == 2
    (option,) = re.findall(r"state (--columns '[^']*')", refused)
    code, refused = typed(*line, *shlex.split(option))
    assert code == 2
    (entries,) = re.findall(r"\[torque\] (columns = .*), the N.m of each joint", refused)
    rated = "[60.0, 180.0, 90.0, 12.0, 12.0, 6.0]"
    torque = entries.replace("[...]", rated).replace(", ", "\n", 3).replace("\nrated", "\nrated")
    path = tmp_path / "map.toml"
    path.write_text(
        '[time]\ncolumn = "timestamp"\n[position]\ncolumns = "j{}_present_position"\n'
        f"[torque]\n{torque}\n"
    )
    code, shown = typed(*line, "--map", path)
    assert code == 0, shown


def test_a_load_that_begins_in_the_unseen_part_has_its_time(cases: Path, tmp_path: Path) -> None:
    """2.0 kg from 13.6 s on, of which the unseen part begins at 11.2 s."""
    log = cases / "12-motion-kinds" / "payload_late.csv"
    code, shown = typed("identify", log, "--urdf", cases / "arm.urdf", "-o", tmp_path / "found")
    assert code == 5
    ((start, mass, half),) = re.findall(
        r"in unseen motion from ([\d.]+) s on the arm carried ([\d.]+) ± ([\d.]+) kg more", shown
    )
    assert float(start) == pytest.approx(13.6 - 11.2, abs=0.3)
    assert float(mass) == pytest.approx(2.0, abs=max(0.02, float(half)))


def test_a_log_of_one_joint_after_the_other_has_no_absurd_figure(
    cases: Path, tmp_path: Path
) -> None:
    """No joint that the fitted part did not move has a change of friction, of gain or a load."""
    log = cases / "12-motion-kinds" / "single.csv"
    line = ("identify", log, "--urdf", cases / "arm.urdf", "-o", tmp_path / "found", "-v")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        code, shown = typed(*line)
    assert code == 5
    assert max(float(share) for share in re.findall(r"([\d.]+) ?%", shown)) < 200.0
    assert "the arm carried" not in shown
    assert "friction on" not in shown


def test_damaged_samples_of_torque_are_left_out_and_counted(cases: Path, tmp_path: Path) -> None:
    """Five of 1 750, in the fitted and the unseen part: the model is as good as without them."""
    log = cases / "11-urdf-units" / "log.csv"
    header = log.read_text().split("\n", 1)[0]
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    column = header.split(",").index("tau2")
    rows = np.array([300, 301, 620, 900, 1500])
    table[rows, column] += np.array([3.0, 3.0, -4.0, 3.0, -3.0]) * np.ptp(table[:, column])
    damaged = tmp_path / "damaged.csv"
    np.savetxt(damaged, table, delimiter=",", header=header, comments="", fmt="%.10g")
    line = ("identify", damaged, "--urdf", cases / "arm.urdf", "-o", tmp_path / "found", "-v")
    code, shown = typed(*line)
    assert code == 0
    (count,) = re.findall(r"excluded from fit and error: j2 (\d) of \d+ samples", shown)
    assert count == "4"
    assert "isolated outliers" not in shown


def rows_of_bursts(cases: Path) -> Any:
    """Positions, then torques, at 250 Hz: rows of the log whose stamps alone are wrong."""
    return np.loadtxt(cases / "10-rows" / "bursts.csv", delimiter=",", skiprows=1)[:, 1:]


def written(path: Path, **columns: Any) -> Path:
    """Write a log with a column for each quantity, or one for each joint of it."""
    names = [
        name.format(joint)
        for name, values in columns.items()
        for joint in range(1 if values.ndim == 1 else values.shape[1])
    ]
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="", fmt="%.10g")
    return path


def test_the_measured_positions_in_place_of_the_commands(cases: Path, tmp_path: Path) -> None:
    """Commands 40 ms ahead of the arm, written as its measured positions as well."""
    rows = rows_of_bursts(cases)
    lead = 10
    quantities = {
        "t": np.arange(len(rows) - lead) / RATE,
        "measured_joint_position_{}": rows[lead:, :6],
        "commanded_joint_position_{}": rows[lead:, :6],
        "encoder_{}": rows[:-lead, :6],
        "measured_torque_{}": rows[:-lead, 6:],
    }
    log = written(tmp_path / "log.csv", **quantities)
    line = ("identify", log, "--urdf", cases / "arm.urdf")
    code, shown = typed(*line, "-o", tmp_path / "wrong")
    assert code == 5
    (option,) = set(re.findall(r"\((--columns 'position=NAME\{\}')\)", shown))
    option = option.replace("NAME{}", "encoder_{}")
    code, shown = typed(*line, *shlex.split(option), "-o", tmp_path / "right")
    assert code == 0
    assert "Good for feed-forward" in shown


@pytest.mark.parametrize("name", ["bursts", "frozen"])
def test_rows_as_a_verdict_wants_them_have_no_finding(
    cases: Path, tmp_path: Path, name: str
) -> None:
    """The controller's time with each sample; a log without the second in which nothing moves."""
    line = ("--urdf", cases / "arm.urdf", "-v")
    steps = {
        "bursts": "log the controller's time with each sample",
        "frozen": "find out why the logger stopped",
    }
    code, shown = typed("identify", cases / "10-rows" / f"{name}.csv", *line, "-o", tmp_path / "a")
    assert code == 0
    assert steps[name] in shown
    rows = rows_of_bursts(cases)
    time = np.arange(len(rows)) / RATE
    log = written(tmp_path / "log.csv", **{"t": time, "q{}": rows[:, :6], "tau{}": rows[:, 6:]})
    code, shown = typed("identify", log, *line, "-o", tmp_path / "b")
    assert code == 0
    assert steps[name] not in shown
    assert "time stamps vary by" not in shown and "the log repeats one row" not in shown


def test_bodies_without_inertias_are_no_obstacle(cases: Path, tmp_path: Path) -> None:
    """What a description lacks comes from the motion: nothing is to be mended."""
    tree = ElementTree.parse(cases / "arm.urdf")
    for inertia in tree.iter("inertia"):
        scale(inertia, 0.0)
    urdf = tmp_path / "zero.urdf"
    tree.write(urdf)
    log = cases / "11-urdf-units" / "log.csv"
    code, shown = typed("identify", log, "--urdf", urdf, "-o", tmp_path / "found")
    assert code == 0
    assert "Good for feed-forward" in shown


def test_an_import_that_reads_again_keeps_its_options(cases: Path, tmp_path: Path) -> None:
    """Zeros are found, and the log is read with them: joints held, and not coupled, as stated."""
    log = cases / "09-several-zeros" / "three.csv"
    archive = tmp_path / "out.mcap"
    line = ("import", "log", log, "--urdf", cases / "arm.urdf", "-o", archive)
    code, shown = typed(*line, "--held", "j6", "--uncoupled")
    assert code == 0
    assert "zero" in shown
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    moved = columns(archive)["position"][0] - table[0, 1:7]
    assert np.degrees(moved) == pytest.approx([0.0, 20.1, -11.5, 0.0, 8.6, 0.0], abs=1.0)
    assert open_archive(archive).header.held_joints == ("j6",)


def test_gear_ratios_that_differ_by_joint(cases: Path, tmp_path: Path) -> None:
    """Forces of MuJoCo's actuators: the line that a look prints, with the maker's ratios."""
    gears = np.array([50.0, -80.0, 50.0, 30.0, 30.0, 20.0])
    rows = np.loadtxt(cases / "11-urdf-units" / "log.csv", delimiter=",", skiprows=1)
    quantities = {"time": rows[:, 0], "qpos_{}": rows[:, 1:7], "actuator_force_{}": rows[:, 7:]}
    quantities["actuator_force_{}"] = rows[:, 7:] / gears
    log = written(tmp_path / "log.csv", **quantities)
    line = (log, "--urdf", cases / "arm.urdf", "--columns", "torque=actuator_force_{}")
    entries = tmp_path / "map.toml"
    code, shown = typed("look", *line, "-v", "-o", entries)
    assert code == 2
    (found,) = re.findall(r'\[torque\] side = "motor"; \[drive\] gear_ratio = \[([^]]*)\]', shown)
    masses = 1.08  # of the description over those of the arm
    assert [*map(float, found.split(","))] == pytest.approx((masses * gears).tolist(), rel=0.1)
    text = entries.read_text().replace("[torque]\n", '[torque]\nside = "motor"\n')
    entries.write_text(f"{text}\n[drive]\ngear_ratio = {gears.tolist()}\n")
    code, shown = typed("identify", *line[:3], "--map", entries, "-o", tmp_path / "found")
    assert code == 0
    assert "Good for feed-forward" in shown
