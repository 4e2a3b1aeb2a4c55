"""A log and its archive are asked the same by every command that takes recordings.

The log is of a simulated arm of six joints, with one fault each. Its archive is that of an import
as recorded (by a column map, of which nothing is doubted), or of one that concludes the map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from hil.base.errors import HilError
from tests.hil.cli.remedies import typed
from tests.hil.simulated_logs import simulate, urdf_path, write_log

pytestmark = pytest.mark.slow

URDF = urdf_path("ur5_robot.urdf")
TIME = np.arange(0.0, 14.0, 0.008)
LOAD = 3.0  # kg
CONSTANT = 8.0  # N·m/A, gears included
LEAD = 6  # samples by which commands are ahead
LOGS = ("look", "identify", "batch", "trend")
"""Commands that take logs as well as archives."""


@dataclass(frozen=True)
class Fault:
    """How a log differs from its description, and what every command says of it.

    Attributes:
        damage: changes time, positions and torques.
        look, sentence: what a look says of it, and what the others do.
        is_refused: whether no parameter follows from it, so that a batch leaves it out.
        columns: of the log.
    """

    damage: Callable[[Any, Any, Any], tuple[Any, ...]]
    look: str
    sentence: str
    is_refused: bool = False
    columns: tuple[str, ...] = ("t", "q{}", "tau{}")


def without_gravity(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    model = pin.buildModelFromUrdf(str(URDF))
    data = model.createData()
    weight = [pin.computeGeneralizedGravity(model, data, each).copy() for each in position]
    return time, position, torque - np.array(weight)


def exchanged(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    return time, position, torque[:, [0, 2, 1, 3, 4, 5]]


def negated(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    return time, position, torque * [1.0, -1.0, 1.0, 1.0, 1.0, 1.0]


def other_zeros(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    return time, position - [0.0, 0.35, -0.25, 0.0, 0.0, 0.0], torque


def only_friction(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    velocity = np.gradient(position, time, axis=0)
    return time, position, 3.0 * np.sign(velocity) + 1.0 * velocity


def jittered(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    random = np.random.default_rng(0)
    return np.sort(time + random.uniform(0.0, 0.007, len(time))), position, torque


def commands(time: Any, position: Any, torque: Any) -> tuple[Any, ...]:
    ahead = position[LEAD:]
    return time[:-LEAD], ahead, ahead, torque[:-LEAD]


AXES = ("t", "q{}", "tau{}")
NOTHING = "almost no rigid-body"
FAULTS = {
    "gravity": Fault(without_gravity, "torque without gravity", "gravity was removed", True),
    "order": Fault(exchanged, "torque columns belong to", "interchanged"),
    "sign": Fault(negated, "torque negated", "probably has the wrong sign"),
    "zeros": Fault(other_zeros, "zero shifted by", "differ from the URDF"),
    "bodies": Fault(only_friction, NOTHING, NOTHING, True),
    "stamps": Fault(jittered, "stamps vary by", "the time stamps vary by"),
    "commands": Fault(
        commands, "commanded", "the commands bit for bit",
        columns=("t", "measured_position_{}", "commanded_position_{}", "measured_torque_{}"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Recorded:
    """A log with a fault, as it is recorded, and without one, each with its archive."""

    fault: Fault
    log: Path
    archive: Path
    plain: Path
    reading: tuple[str, ...]


def log_map(folder: Path, names: tuple[str, ...]) -> Path:
    tables = [("time", "column"), ("position", "columns"), ("torque", "columns")]
    if len(names) == 4:
        tables.insert(2, ("commanded_position", "columns"))
    lines = [
        f'[{table}]\n{key} = "{name}"\n' for (table, key), name in zip(tables, names, strict=True)
    ]
    path = folder / "map.toml"
    path.write_text("".join(lines))
    return path


@pytest.fixture(scope="module", params=FAULTS)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    fault = FAULTS[request.param]
    simulated = simulate(URDF, TIME, seed=3, pace=1.5)
    signals = (simulated.time, simulated.position, simulated.torque)
    folders = [tmp_path_factory.mktemp(name) for name in ("fault", "archive", "plain")]
    log = write_log(folders[0] / "log.csv", fault.columns, *fault.damage(*signals))
    reading = ("--urdf", str(URDF), "--map", str(log_map(folders[0], fault.columns)))
    archive = folders[1] / "log.mcap"
    assert typed("import", "log", log, *reading, "-o", archive).exit_code == 0
    plain_log = write_log(folders[2] / "plain.csv", AXES, *signals)
    plain = folders[2] / "plain.mcap"
    line = (
        "import",
        "log",
        plain_log,
        "--urdf",
        URDF,
        "--map",
        log_map(folders[2], AXES),
        "-o",
        plain,
    )
    assert typed(*line).exit_code == 0
    plain_log.unlink()
    return Recorded(fault, log, archive, plain, reading)


def shown(*words: object) -> tuple[int, str]:
    """Exit status and all that is printed."""
    result = typed(*words)
    is_refused = isinstance(result.exception, HilError)
    assert is_refused or result.exit_code in (0, 5), (words, result.exception)
    code = (
        result.exception.exit_code if isinstance(result.exception, HilError) else result.exit_code
    )
    return code, " ".join(f"{result.output} {result.exception or ''}".split())


def words_of(command: str, place: Path, folder: Path) -> list[object]:
    return [command, place, "-v", *(["-o", folder / place.stem] if command == "identify" else [])]


@pytest.mark.parametrize("command", LOGS)
def test_both_are_told_the_same(recorded: Recorded, command: str, tmp_path: Path) -> None:
    fault = recorded.fault
    of_log = shown(*words_of(command, recorded.log, tmp_path / "log"), *recorded.reading)
    of_archive = shown(*words_of(command, recorded.archive, tmp_path / "archive"))
    said = fault.look if command == "look" else fault.sentence
    assert said in of_log[1]
    assert said in of_archive[1]
    assert of_log[0] == of_archive[0]


@pytest.mark.parametrize("command", LOGS)
def test_what_an_import_concludes_every_command_concludes(
    recorded: Recorded, command: str, tmp_path: Path
) -> None:
    """Without a map: what is certain is corrected, in the log and in its archive."""
    arm = ("--urdf", URDF)
    archive = tmp_path / "import" / "log.mcap"
    archive.parent.mkdir()
    imported = shown("import", "log", recorded.log, *arm, "-o", archive)
    assert imported[0] == 0
    of_log = shown(*words_of(command, recorded.log, tmp_path / "log"), *arm)
    of_archive = shown(*words_of(command, archive, tmp_path / "archive"))
    assert of_log[0] == of_archive[0]


@pytest.mark.parametrize("command", [*LOGS, "import log"])
def test_a_stated_unit_that_is_not_known_is_refused_by_name(tmp_path: Path, command: str) -> None:
    simulated = simulate(URDF, TIME, seed=3, pace=1.5)
    names = ("t", "q{}", "tau{} [lbf.furlong]")
    signals = (simulated.time, simulated.position, simulated.torque)
    log = write_log(tmp_path / "log.csv", names, *signals)
    code, text = shown(*command.split(), log, "--urdf", URDF)
    assert code == 2
    assert "lbf.furlong, a unit that is not known" in text
    assert not [*tmp_path.glob("*.mcap")]


@pytest.mark.parametrize("are_other", [False, True])
def test_torque_constants_name_other_zeros(tmp_path: Path, are_other: bool) -> None:
    """Of archives with currents, some with a known payload: two constants then stay open."""
    load = pin.Inertia(LOAD, np.zeros(3), np.zeros((3, 3)))
    names = ("t", "q{}", "current{} [A]")
    archives = []
    for name, carried in (("bare", None), ("full", load)):
        simulated = simulate(URDF, TIME, seed=3, pace=1.5, load=carried)
        signals = (simulated.time, simulated.position, simulated.torque / CONSTANT)
        if are_other:
            signals = other_zeros(*signals)
        log = write_log(tmp_path / f"{name}.csv", names, *signals)
        archives.append(tmp_path / f"{name}.mcap")
        assert shown("import", "log", log, "--urdf", URDF, "-o", archives[-1])[0] == 0
    bare, full = archives
    _, text = shown("torque-constants", bare, "--loaded", full, "--mass", LOAD)
    assert ("not determined" in text) is are_other
    assert (FAULTS["zeros"].sentence in text) is are_other


class TestCommandsOfArchives:
    def test_a_payload_is_not_set(self, recorded: Recorded) -> None:
        code, text = shown("payload", recorded.archive, "--loaded", recorded.plain)
        assert code != 0
        if recorded.fault is not FAULTS["stamps"]:  # which are corrected
            assert recorded.fault.sentence in text

    def test_a_comparison_names_it(self, recorded: Recorded) -> None:
        code, text = shown("compare", recorded.archive.parent, recorded.plain.parent, "-v")
        assert recorded.fault.sentence in text
        assert (code != 0) == recorded.fault.is_refused
