"""Remedies printed for recordings of public reports, typed: the result is the right one."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.errors import HilError
from hil.cli import app

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
    assert np.median(np.diff(read["stamp"])) == pytest.approx(1e9 / RATE)
    assert read["position"] == pytest.approx(table[:, 1:7], rel=1e-12)


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
    assert "two readings fit alike" not in shown


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
    assert read["torque"] == pytest.approx(torques[np.clip(found, 0, len(torques) - 1), 7:])
