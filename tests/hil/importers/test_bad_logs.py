"""Bad input typed with a URDF: one sentence, what was found, what to do, nothing written."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.base.errors import HilError
from hil.cli import app
from tests.hil.importers.moving_log import URDF
from tests.hil.simulated_logs import write_log, write_moving_log

Floats = NDArray[np.float64]
Table = Mapping[str, Floats]
NAMES = ["t", "q{}", "v{}", "tau{}"]


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "three.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="module")
def table(urdf: Path) -> Table:
    path = write_moving_log(urdf.with_name("moving.csv"), URDF)
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return {"t": values[:, 0], "q": values[:, 1:4], "v": values[:, 4:7], "tau": values[:, 7:]}


def csv(path: Path, table: Table, **changed: Floats) -> Path:
    return write_log(path, NAMES, *{**table, **changed}.values())


def without_torque(path: Path, table: Table) -> Path:
    return write_log(path, NAMES[:3], table["t"], table["q"], table["v"])


def of_two_joints(path: Path, table: Table) -> Path:
    return csv(path, {name: values[..., :2] for name, values in table.items()}, t=table["t"])


def with_constant_torque(path: Path, table: Table) -> Path:
    return csv(path, table, tau=np.full_like(table["tau"], 1.5))


def at_rest(path: Path, table: Table) -> Path:
    return csv(path, table, q=np.full_like(table["q"], 0.5), v=np.zeros_like(table["v"]))


def first_rows(count: int) -> Callable[[Path, Table], Path]:
    return lambda path, table: csv(path, {name: part[:count] for name, part in table.items()})


def empty(path: Path, _: Table) -> Path:
    path.write_text("")
    return path


def header_alone(path: Path, _: Table) -> Path:
    path.write_text("t,q1,q2,q3,tau1,tau2,tau3\n")
    return path


def with_text(path: Path, table: Table) -> Path:
    lines = csv(path, table).read_text().splitlines()
    path.write_text("\n".join([*lines[:300], "paused by operator", *lines[300:]]) + "\n")
    return path


def with_one_name_twice(path: Path, table: Table) -> Path:
    text = csv(path, table).read_text()
    path.write_text(text.replace("tau2", "tau1", 1))
    return path


def with_a_name_too_many(path: Path, table: Table) -> Path:
    text = csv(path, table).read_text()
    path.write_text(text.replace("tau3", "tau3,note", 1))
    return path


def with_commas_between_commas(path: Path, table: Table) -> Path:
    names, *rows = csv(path, table).read_text().splitlines()
    path.write_text("\n".join([names, *(row.replace(".", ",") for row in rows)]) + "\n")
    return path


def with_zeros_of_a_lost_block(path: Path, table: Table) -> Path:
    text = csv(path, table).read_bytes()
    path.write_bytes(text[:20_000] + bytes(4096) + text[24_096:])
    return path


def from_last_to_first(path: Path, table: Table) -> Path:
    return csv(path, {name: values[::-1] for name, values in table.items()})


def with_a_word(path: Path, table: Table) -> Path:
    lines = csv(path, table).read_text().splitlines()
    cells = lines[300].split(",")
    lines[300] = ",".join([*cells[:2], "stopped", *cells[3:]])
    path.write_text("\n".join(lines) + "\n")
    return path


def with_two_clocks(path: Path, table: Table) -> Path:
    return write_log(path, ["stamp", *NAMES], 0.25 + 1.001 * table["t"], *table.values())


def of_another_motion(path: Path, table: Table) -> Path:
    """Torques that no masses of this arm make, as with the URDF of another arm."""
    steps = np.random.default_rng(0).normal(size=table["tau"].shape)
    return csv(path, table, tau=np.cumsum(steps, axis=0))


def a_urdf(path: Path, _: Table) -> Path:
    path = path.with_name("arm.urdf")
    path.write_text(URDF)
    return path


def xml(path: Path, _: Table) -> Path:
    path.write_text("<?xml version='1.0'?>\n<log><row t='0'/></log>\n")
    return path


def starts_with(mark: bytes) -> Callable[[Path, Table], Path]:
    def write(path: Path, _: Table) -> Path:
        path.write_bytes(mark + bytes(range(256)))
        return path

    return write


def a_hollow_mat(path: Path, _: Table) -> Path:
    path = path.with_suffix(".mat")
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    path.write_bytes(head.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n" + bytes(2000))
    return path


# What is typed, what was found, and what to do.
CASES: list[tuple[Callable[[Path, Table], Path], str, str]] = [
    (without_torque, "no channel is named as torque", "record it"),
    (of_two_joints, "2 channels are named as position (q1 .. q2), and the URDF has 3", "--locked"),
    (with_constant_torque, "the torque of each joint is constant (1.5, 1.5, 1.5)", "--columns"),
    (at_rest, "no joint moves: every position is constant", "--columns"),
    (empty, "has no row of numbers", "record again"),
    (header_alone, "has no row of numbers", "record again"),
    (first_rows(1), "has 1 sample in 0 s", "record a motion of all joints, of 10 s or more"),
    (first_rows(99), "has 99 samples in 0.", "record a motion of all joints, of 10 s or more"),
    (with_text, "line 301 has nothing in column q1", "--drop-missing"),
    (with_a_word, "line 301 has 'stopped' in column q2", "--drop-missing"),
    (with_one_name_twice, "2 columns have the name 'tau1'", "from 0 in the map: 7 or 8"),
    (with_a_name_too_many, "has 11 names", "name every column in the header"),
    (with_commas_between_commas, "above rows of", "semicolons between the columns"),
    (with_zeros_of_a_lost_block, "\\x00' ... in column", "correct it"),
    (from_last_to_first, "older than the previous one", "in the order of their times"),
    (with_two_clocks, "stamp and t are all named as time", "--columns 'time=t'"),
    (of_another_motion, "its torque does not follow the arm of the URDF", "give the URDF of this"),
    (a_urdf, "is a robot description (URDF), not a recording", "LOG --urdf arm.urdf"),
    (xml, "is XML, not a table of numbers", "give a table of numbers"),
    (starts_with(b"PK\x03\x04"), "is a zip file", "unzip log.csv"),
    (starts_with(b"\xd0\xcf\x11\xe0"), "cannot be read as a spreadsheet", "as CSV"),
    (starts_with(b"\x1f\x8b\x08"), "cut off or damaged", "zcat log.csv > part.csv"),
    (starts_with(b"ARROW1\0\0"), "is Feather", "pandas.read_feather"),
    (starts_with(b"\x80\x05\x95"), "is a pickle of Python", "pandas.read_pickle"),
    (starts_with(b"\x89HDF\r\n\x1a\n"), "is HDF5", "numpy.savez"),
    (a_hollow_mat, "its data are lost", "copy it again"),
]


def typed(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


# What a command accepts: an import any motion; a look shows what the torque follows.
ACCEPTED = {
    "look": "its torque",
    "import log": "its torque|the torque|no joint moves|has 1 sample|has 99 samples",
}
TYPED = [
    pytest.param(
        command,
        *case,
        id=f"{command}-{case[0].__name__}",
        marks=[pytest.mark.long] if (command, case[0]) == ("identify", of_another_motion) else [],
    )
    for case in CASES
    for command in ("identify", "look", "import log")
    if command not in ACCEPTED or not re.match(ACCEPTED[command], case[1])
]


@pytest.mark.parametrize(("command", "write", "problem", "remedy"), TYPED)
def test_it_is_refused_in_one_sentence(
    tmp_path: Path,
    urdf: Path,
    table: Table,
    command: str,
    write: Callable[[Path, Table], Path],
    problem: str,
    remedy: str,
) -> None:
    source = write(tmp_path / "log.csv", table)
    result = typed(*command.split(), source, "--urdf", urdf)
    assert isinstance(result.exception, HilError), result.output
    message = str(result.exception)
    assert message.startswith(str(source))
    assert problem in message
    assert remedy in message
    assert "\n" not in message
    assert "/hil-" not in message  # no temporary file, which nobody finds
    assert result.exception.exit_code == (5 if write is of_another_motion else 2)  # it was read
    assert [*tmp_path.iterdir()] == [source]


def test_a_header_that_ends_in_a_comma_is_read(tmp_path: Path, urdf: Path, table: Table) -> None:
    source = csv(tmp_path / "log.csv", table)
    source.write_text(source.read_text().replace("\n", ",\n", 1))
    result = typed("import", "log", source, "--urdf", urdf, "-o", tmp_path / "log.mcap")
    assert result.exit_code == 0, result.exception


@pytest.mark.parametrize("write", [with_text, with_a_word])
def test_rows_with_text_are_left_out(
    tmp_path: Path, urdf: Path, table: Table, write: Callable[[Path, Table], Path]
) -> None:
    source = write(tmp_path / "log.csv", table)
    refused = str(typed("import", "log", source, "--urdf", urdf).exception)
    (option,) = re.findall(r"--drop-\w+", refused)
    result = typed("import", "log", source, "--urdf", urdf, option)
    assert result.exit_code == 0, result.exception
    assert 'missing = "drop"' in (tmp_path / "log.map.toml").read_text()
    again = ("--map", tmp_path / "log.map.toml", "--force")
    assert typed("import", "log", source, "--urdf", urdf, *again).exit_code == 0


def test_two_clocks_are_chosen_from(tmp_path: Path, urdf: Path, table: Table) -> None:
    source = with_two_clocks(tmp_path / "log.csv", table)
    refused = str(typed("import", "log", source, "--urdf", urdf).exception)
    for option in re.findall(r"--columns '[^']*'", refused):
        result = typed("import", "log", source, "--urdf", urdf, *shlex.split(option), "--force")
        assert result.exit_code == 0, result.exception


@pytest.mark.long
@pytest.mark.parametrize("joint", [0, 2])
def test_a_torque_of_zero_throughout_ends_in_a_verdict(
    tmp_path: Path, urdf: Path, table: Table, joint: int
) -> None:
    """As of the fingers of a bag, or of a sensor that was not read."""
    torque = table["tau"].copy()
    torque[:, joint] = 0.0
    path = csv(tmp_path / "a.csv", table, tau=torque)
    arguments = ["identify", str(path), "--urdf", str(urdf), "-o", str(tmp_path / "out"), "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exception is None or isinstance(result.exception, (HilError, SystemExit))
    assert result.exit_code != 0
