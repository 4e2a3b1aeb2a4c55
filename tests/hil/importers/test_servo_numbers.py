"""Numbers of servos and drives: ticks, loads with a bit for the sign, parts of a rated torque."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.archive import Archive, open_archive
from hil.base.errors import HilError
from hil.cli import app
from hil.importers.servo_numbers import are_per_mille, encoder_of, sign_bit_of, signed
from tests.hil.importers.moving_log import POSITION, TIME, TORQUE, URDF
from tests.near import near

Floats = NDArray[np.float64]
RATED = np.array([30.0, 25.0, 40.0])
PARTS = np.rint(1000.0 * TORQUE / RATED)


def magnitude(values: Floats, bit: int = 10) -> Floats:
    return np.abs(values) + (values < 0.0) * float(1 << bit)


def ticks(count: int, middle: int, turn: float = 2.0 * np.pi) -> Floats:
    return np.rint(middle + POSITION * count / turn)


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return path


def write(folder: Path, torque: tuple[str, Floats], position: Floats = POSITION) -> Path:
    name, values = torque
    names = ["t", *(f"q{k}" for k in (1, 2, 3)), *(name.format(k) for k in (1, 2, 3))]
    rows = np.column_stack([TIME, position, values]).tolist()
    path = folder / "log.csv"
    path.write_text(
        "\n".join([",".join(names), *(",".join(map(repr, row)) for row in rows)]) + "\n"
    )
    return path


def refusal(source: Path, urdf: Path, *options: object) -> str:
    """The refusal of an import, else ""."""
    output = source.with_name("out.mcap")
    line = ["import", "log", source, "--urdf", urdf, "--force", "-o", output, *options]
    result = CliRunner().invoke(app, [*map(str, line)])
    assert result.exit_code == 0 or isinstance(result.exception, HilError), result
    return "" if result.exit_code == 0 else str(result.exception)


def read(source: Path) -> Archive:
    return open_archive(source.with_name("out.mcap"))


def stated(refused: str, source: Path) -> Path:
    """The map that a refusal prints, with the rated torques of the drives."""
    (entries,) = re.findall(r"in a map \(--map\): \[torque\] (.*), rated = \[\.\.\.\]", refused)
    path = source.with_name("map.toml")
    lines = [re.sub(r", (?=\w+ =)", "\n", entries), f"rated = {RATED.tolist()}"]
    path.write_text("\n".join(["[torque]", *lines]) + "\n")
    return path


class TestLoads:
    def test_a_sign_in_a_bit_is_named_and_can_be_stated(self, tmp_path: Path, urdf: Path) -> None:
        source = write(tmp_path, ("present_load_{}", magnitude(PARTS)))
        (option,) = re.findall(r"--columns '(torque=[^']*)'", refusal(source, urdf))
        refused = refusal(source, urdf, "--columns", option)
        assert "is a magnitude with the sign in bit 10" in refused
        assert refusal(source, urdf, "--map", stated(refused, source)) == ""
        assert read(source).columns["torque"] == near(TORQUE, abs=0.5 * RATED.max() / 1000)

    @pytest.mark.parametrize("bit", [10, 15])
    def test_it_is_the_bit_without_which_the_numbers_jump(self, bit: int) -> None:
        values = magnitude(PARTS, bit)
        assert sign_bit_of(values) == bit
        assert np.array_equal(signed(values, bit), PARTS)

    @pytest.mark.parametrize(
        "values",
        [PARTS, TORQUE, np.abs(PARTS), ticks(4096, 2048), magnitude(PARTS) + 0.5, 0.0 * PARTS],
        ids=["signed", "torque", "no sign", "ticks", "fractions", "zero"],
    )
    def test_others_have_none(self, values: Floats) -> None:
        assert sign_bit_of(values) is None


class TestObjectsOfDrives:
    @pytest.mark.parametrize(
        "name", ["torque_actual_value_{}", "tau{}_6077h", "6077h_{}", "0x6077_{}", "axis{}_6077h"]
    )
    def test_per_mille_is_named_and_can_be_stated(
        self, tmp_path: Path, urdf: Path, name: str
    ) -> None:
        source = write(tmp_path, (name, PARTS))
        refused = refusal(source, urdf)
        assert "6077h: per mille of a rated value" in refused
        assert refusal(source, urdf, "--map", stated(refused, source)) == ""
        assert read(source).columns["torque"] == near(TORQUE, abs=0.5 * RATED.max() / 1000)

    def test_torques_in_newton_metres_are_none(self, tmp_path: Path, urdf: Path) -> None:
        source = write(tmp_path, ("torque_actual_value_{}", TORQUE))
        assert refusal(source, urdf) == ""
        assert read(source).columns["torque"] == near(TORQUE, rel=1e-12)

    def test_names_decide(self) -> None:
        assert are_per_mille(["tau{}_6077h"], PARTS)
        assert not are_per_mille(["tau{}"], PARTS)
        assert not are_per_mille([], PARTS)


class TestTicks:
    @pytest.mark.parametrize(
        ("count", "middle", "turn"),
        [(4096, 2048, 2.0 * np.pi), (16384, 8192, 2.0 * np.pi), (1024, 512, np.radians(300.0))],
    )
    def test_about_the_middle_of_an_encoder_are_angles(
        self, tmp_path: Path, urdf: Path, count: int, middle: int, turn: float
    ) -> None:
        source = write(tmp_path, ("tau{}", TORQUE), ticks(count, middle, turn))
        assert refusal(source, urdf) == ""
        archive = read(source)
        assert archive.columns["position"] == near(POSITION, abs=0.51 * turn / count)
        (line,) = (line for line in archive.header.findings.lines if "ticks" in line)
        assert f"encoder ticks ({count} per turn, zero at {middle})" in line

    def test_the_map_states_another_zero(self, tmp_path: Path, urdf: Path) -> None:
        source = write(tmp_path, ("tau{}", TORQUE), ticks(4096, 1000))
        entries = tmp_path / "map.toml"
        scale = 2.0 * np.pi / 4096
        entries.write_text(f'[position]\nunit = "rad"\noffset = -1000\nscale = {scale!r}\n')
        assert refusal(source, urdf, "--map", entries) == ""
        assert read(source).columns["position"] == near(POSITION, abs=0.51 * scale)

    @pytest.mark.parametrize(
        "values",
        [POSITION, np.degrees(POSITION), np.rint(100.0 * POSITION), ticks(4096, 0), 0.0 * POSITION],
        ids=["radians", "degrees", "signed", "about zero", "zero"],
    )
    def test_other_numbers_are_none(self, values: Floats) -> None:
        assert encoder_of(values) is None

    def test_whole_degrees_are_degrees(self, tmp_path: Path, urdf: Path) -> None:
        source = write(tmp_path, ("tau{}", TORQUE), np.rint(np.degrees(POSITION)))
        assert refusal(source, urdf) == ""
        assert read(source).columns["position"] == near(POSITION, abs=np.radians(0.51))


def test_the_load_of_a_public_report(shared_data: Path, tmp_path: Path) -> None:
    cases = shared_data.parent / "cases" / "diagnosis"
    if not cases.is_dir():
        pytest.skip("the cases (../shared/cases/diagnosis) are not beside this checkout")
    source = tmp_path / "load.csv"
    source.write_bytes((cases / "14-torque-encodings" / "present_load.csv").read_bytes())
    (option,) = re.findall(r"--columns '(torque=[^']*)'", refusal(source, cases / "arm.urdf"))
    refused = refusal(source, cases / "arm.urdf", "--columns", option)
    entries = stated(refused, source)
    rated = [60.0, 180.0, 90.0, 12.0, 12.0, 6.0]
    entries.write_text(entries.read_text().replace(str(RATED.tolist()), str(rated)))
    assert refusal(source, cases / "arm.urdf", "--map", entries) == ""
    table = np.loadtxt(cases / "11-urdf-units" / "log.csv", delimiter=",", skiprows=1)
    torque = read(source).columns["torque"]
    error = np.abs(torque - table[: len(torque), 7:]) / rated
    is_measured = np.abs(torque) < 1.0229 * np.array(rated)  # more does not fit below the bit
    assert is_measured.mean() > 0.9
    assert error[is_measured].max() < 0.51e-3


def test_a_factor_after_the_name_scales_the_numbers(tmp_path: Path, urdf: Path) -> None:
    source = write(tmp_path, ("load{}", np.rint(340.0 * TORQUE)))
    assert not refusal(source, urdf, "--columns", "torque=load{}*0.0029411765")
    torque = read(source).columns["torque"]
    np.testing.assert_allclose(torque, TORQUE, atol=0.51 / 340.0)


def test_a_factor_alone_is_no_name(tmp_path: Path, urdf: Path) -> None:
    source = write(tmp_path, ("load{}", TORQUE))
    assert "torque" in refusal(source, urdf, "--columns", "torque=*2")
