"""A unit that a log states is converted, or refused by its name: never read as another one."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.errors import HilError
from hil.cli import app
from hil.importers.stated_units import stated_unit, without_unit
from hil.importers.unit_products import product_of
from hil.importers.units import factor_of, unit_of
from tests.hil.importers.moving_log import POSITION, SLOPE, TIME, TORQUE, URDF
from tests.near import near
from tests.tiers import quick_ones

Floats = NDArray[np.float64]
# By their definitions: 1 kgf = 9.80665 N, 1 lbf = 0.45359237 kgf, 1 ozf = 1/16 lbf, 1 in = 25.4 mm.
KGF = 9.80665
LBF = 0.45359237 * KGF
INCH = 0.0254
TORQUES = {
    "kgf cm": KGF / 100.0, "kgf.cm": KGF / 100.0, "kgf·m": KGF, "kg cm": KGF / 100.0,
    "kgcm": KGF / 100.0, "kp m": KGF, "gf-cm": 1e-5 * KGF, "ozf in": LBF / 16.0 * INCH,
    "oz-in": LBF / 16.0 * INCH, "ozin": LBF / 16.0 * INCH, "in-lb": LBF * INCH,
    "lbf ft": LBF * 12.0 * INCH, "ft·lbf": LBF * 12.0 * INCH, "lb-ft": LBF * 12.0 * INCH,
    "N cm": 0.01, "Ncm": 0.01, "N*mm": 1e-3, "Nmm": 1e-3, "mN m": 1e-3, "mN·m": 1e-3,
    "kN m": 1e3, "dyn cm": 1e-7, "mN.cm": 1e-5, "Nm": 1.0, "N": 1.0,
}  # fmt: skip
ANGLES = {
    "gon": math.pi / 200.0, "°": math.pi / 180.0, "arcmin": math.pi / 10800.0,
    "arcsec": math.pi / 648000.0, "mdeg": math.pi / 180e3, "rev": 2.0 * math.pi,
    "turns": 2.0 * math.pi, "mrad": 1e-3, "cm": 0.01, "in": INCH,
}  # fmt: skip
SPEEDS = {
    "gon/s": math.pi / 200.0, "deg/min": math.pi / 10800.0, "rev/min": math.pi / 30.0,
    "rad s^-1": 1.0, "rad·s⁻¹": 1.0, "mrad/s": 1e-3, "turns per s": 2.0 * math.pi, "mm/s": 1e-3,
}  # fmt: skip
CURRENTS = {"A": 1.0, "mA": 1e-3, "kA": 1e3}
OF_KINDS = {
    "torque": TORQUES, "position": ANGLES, "velocity": SPEEDS, "motor_current": CURRENTS,
}  # fmt: skip
KNOWN = [
    pytest.param(kind, unit, factor, id=f"{kind} {unit}")
    for kind, units in OF_KINDS.items()
    for unit, factor in units.items()
]
UNKNOWN = ("furlong", "stone mile", "cal", "Nm/s", "tau", "kgf cm s", "kg", "lb", "1/s^2")


@pytest.mark.parametrize(("kind", "unit", "factor"), KNOWN)
def test_a_known_unit_has_its_factor(kind: str, unit: str, factor: float) -> None:
    known = unit_of(unit, kind)
    assert known is not None
    assert factor_of(known, kind) == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize("unit", UNKNOWN)
def test_another_text_is_no_torque(unit: str) -> None:
    assert unit_of(unit, "torque") is None


def test_a_product_of_units_is_of_one_quantity() -> None:
    assert product_of("kgf cm") is not None
    assert unit_of("kgf cm", "position") is None
    assert unit_of("gon", "torque") is None
    assert product_of("") is None
    assert product_of("m" * 100) is None


@pytest.mark.parametrize(
    ("name", "bare", "unit"),
    [
        ("q1 [gon]", "q1", "gon"),
        ("M1 (kgf cm)", "M1", "kgf cm"),
        ("tau1 [furlong]", "tau1", "furlong"),
        ("q1_deg", "q1", "deg"),
        ("q1_ticks", "q1", "ticks"),
        ("q[1]", "q[1]", None),
        ("q1 (actual)", "q1 (actual)", None),
        ("torque (axis 1)", "torque (axis 1)", None),
        ("time (UTC)", "time (UTC)", None),
        ("tau1 []", "tau1 []", None),
        ("tau1 (-)", "tau1 (-)", None),
    ],
)
def test_brackets_hold_a_unit_or_a_name(name: str, bare: str, unit: str | None) -> None:
    assert without_unit(name) == (bare, unit)


@pytest.mark.parametrize("text", ["", "-", "n/a", "measured", "J1", "axis 2", "left arm"])
def test_what_is_no_unit(text: str) -> None:
    assert stated_unit(text) is None


class Log:
    """A log with units in its names, imported by the command."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "log.csv"
        self.urdf = folder / "three.urdf"
        self.urdf.write_text(URDF)

    def write(self, **units: tuple[str, float]) -> None:
        """Write it, of each quantity in a unit of this factor; without one in rad and N.m."""
        columns: list[tuple[str, Floats]] = []
        for name, values in (("q", POSITION), ("v", SLOPE), ("tau", TORQUE)):
            unit, factor = units.get(name, ("", 1.0))
            if name == "v" and not unit:
                continue
            end = f" [{unit}]" if unit else ""
            columns += [
                (f"{name}{k}{end}", column / factor) for k, column in enumerate(values.T, 1)
            ]
        rows = np.column_stack([TIME, *(column for _, column in columns)])
        lines = [",".join(["t", *(name for name, _ in columns)])]
        lines += [",".join(map(repr, row)) for row in rows.tolist()]
        self.path.write_text("\n".join(lines) + "\n")

    def refused(self, *options: object) -> str:
        """The refusal of an import, else ""."""
        output = self.path.with_name("out.mcap")
        line = ["import", "log", self.path, "--urdf", self.urdf, "--force", "-o", output, *options]
        result = CliRunner().invoke(app, [*map(str, line)])
        assert result.exit_code == 0 or isinstance(result.exception, HilError), result
        return "" if result.exit_code == 0 else str(result.exception)

    def check(self) -> None:
        columns = open_archive(self.path.with_name("out.mcap")).columns
        assert columns["position"] == near(POSITION, abs=1e-9)
        assert columns["torque"] == near(TORQUE, rel=1e-9)
        if "velocity" in columns:
            assert columns["velocity"] == near(SLOPE, rel=1e-9, abs=1e-9)


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return Log(tmp_path)


@pytest.mark.parametrize(
    "unit", quick_ones(["kgf cm", "lbf ft"], ["kgf cm", "ozf in", "N cm", "mN m", "lbf ft"])
)
def test_torques_are_converted(log: Log, unit: str) -> None:
    log.write(tau=(unit, TORQUES[unit]))
    assert log.refused() == ""
    log.check()


@pytest.mark.parametrize(("angle", "speed"), [("gon", "gon/s"), ("mdeg", "deg/min")])
def test_angles_and_speeds_are_converted(log: Log, angle: str, speed: str) -> None:
    log.write(q=(angle, ANGLES[angle]), v=(speed, SPEEDS[speed]))
    assert log.refused() == ""
    log.check()


def test_units_below_the_names_are_converted(log: Log) -> None:
    log.write(q=("x", ANGLES["gon"]), tau=("x", TORQUES["kgf cm"]))
    head, _, rows = log.path.read_text().partition("\n")
    below = ",".join(["s", *["gon"] * 3, *["kgf cm"] * 3])
    log.path.write_text(f"{head.replace(' [x]', '')}\n{below}\n{rows}")
    assert log.refused() == ""
    log.check()


@pytest.mark.parametrize(
    ("kind", "name", "unit", "factor"),
    [("torque", "tau", "stone mile", 2.0), ("position", "q", "furlong", 0.5)],
)
def test_an_unknown_unit_is_named_and_can_be_stated(
    log: Log, kind: str, name: str, unit: str, factor: float
) -> None:
    """Also for channels that are chosen, and with a map that names them alone."""
    log.write(**{name: (unit, factor)})
    chosen = ("--columns", f"{kind}={name}{{}}")
    entries = log.path.with_name("map.toml")
    entries.write_text(f'[{kind}]\ncolumns = "{name}{{}}"\n')
    for options in ((), chosen, ("--map", entries)):
        refused = log.refused(*options)
        assert f"stated in {unit}, a unit that is not known" in refused
    (remedy,) = re.findall(r'(\[\w+\]) (unit = "[^"]+"), scale = FACTOR', refused)
    entries.write_text("\n".join([*remedy, f"scale = {factor}"]))
    assert log.refused("--map", entries) == ""
    log.check()


def test_a_unit_of_another_quantity_is_refused(log: Log) -> None:
    log.write(tau=("rad", 1.0))
    assert "rad is not a unit of it; choose: --columns 'position=tau{}'" in log.refused()
    refused = log.refused("--columns", "torque=tau{}")
    assert "stated in rad, which is not a unit of torque" in refused


def test_a_unit_of_a_map_goes_before_that_of_the_file(log: Log) -> None:
    log.write(q=("furlong", ANGLES["gon"]))
    entries = log.path.with_name("map.toml")
    entries.write_text('[position]\nunit = "gon"\n')
    assert log.refused("--map", entries) == ""
    log.check()


def test_per_mille_needs_what_is_a_thousand(log: Log) -> None:
    log.write(tau=("‰", 0.05))
    refused = log.refused()
    assert "is in per mille of a rated value" in refused
    assert "add to [torque]: rated = [...]" in refused
    entries = log.path.with_name("map.toml")
    entries.write_text("[torque]\nrated = [50.0, 50.0, 50.0]\n")
    assert log.refused("--map", entries) == ""
    log.check()
