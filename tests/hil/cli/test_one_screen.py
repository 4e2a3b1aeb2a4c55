"""Every command prints one screen by default, of recordings good and bad."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from benchmarks.fleet import Fault, Fleet, FleetPlan, write_fleet
from benchmarks.fleet import urdf as fleet_urdf
from hil.base.errors import HilError
from hil.base.one_screen import SCREEN_COLUMNS, SCREEN_LINES, Paragraph, brief, one_screen, wrapped
from hil.cell import Cell
from hil.cli import app
from identification.errors import IdentificationError
from planner.errors import PlannerError
from tests.hil.batch_work import NOTHING_OPEN
from tests.hil.fast_cell import QUICK_GRADIENT, fast_cell, mirrored
from tests.hil.payload.load_archives import CENTRE, LAW, MASS, archive_of_currents
from tests.hil.simulated_logs import archive_of, simulate, urdf_path, write_log

Floats = NDArray[np.float64]
_SENTENCE = 8  # words of what is no figure, name or title


def require_one_screen(text: str) -> None:
    """At most 24 lines of 100 columns, and nothing twice."""
    lines = text.rstrip("\n").split("\n")
    assert len(lines) <= SCREEN_LINES, text
    assert max(map(len, lines)) <= SCREEN_COLUMNS, max(lines, key=len)
    clauses = [clause.strip() for clause in re.split(r"[;:.]\s", " ".join(text.split()))]
    told = Counter(clause for clause in clauses if len(clause.split()) >= _SENTENCE)
    assert not [clause for clause, times in told.items() if times > 1], text


class TestText:
    def test_long_text_takes_the_room_that_is_left(self) -> None:
        long = "word " * 60
        shown = one_screen([Paragraph(long, "found  "), *["row"] * 22])
        assert len(shown) == SCREEN_LINES
        assert shown[0].startswith("found  word") and shown[1].startswith("       word")
        assert shown[1].endswith(" ...")

    @pytest.mark.parametrize(
        ("start", "last"),
        [
            ("word " * 12 + "It follows the arm. Then ", "It follows the arm."),
            ("word " * 12 + "wrong sign of joint 3; ", "wrong sign of joint 3 ..."),
            ("It stops. Then ", "word ..."),
        ],
    )
    def test_text_is_cut_after_a_sentence_or_a_clause(self, start: str, last: str) -> None:
        """Half a sentence says little, unless most of the line would stay empty."""
        (shown,) = one_screen([Paragraph(start + "word " * 60)], lines=1)
        assert shown.endswith(last)

    def test_a_command_to_copy_is_never_cut(self) -> None:
        command = Paragraph("word " * 30 + "end", complete=True)
        shown = one_screen([Paragraph("first " * 60), *["row"] * 20, command])
        assert len(shown) == SCREEN_LINES and shown[-1].endswith("word end")

    @pytest.mark.parametrize("lead", ["  ", "weigh the load: ", "record without it, then "])
    def test_a_command_is_broken_as_a_shell_continues_it(self, lead: str) -> None:
        """What is copied from the screen is what was meant."""
        command = f"hil torque-constants {' '.join(f'march/{k}.mcap' for k in range(20))} --mass 4"
        for shown in (brief([lead + command]), wrapped(lead + command).split("\n")):
            require_one_screen("\n".join(shown))
            copied = "\n".join(shown)
            copied = copied[copied.index("hil torque-constants") :]
            assert shlex.split(copied.replace("\\\n", "")) == command.split()

    def test_prose_about_a_command_has_no_marks(self) -> None:
        prose = f"give them to hil torque-constants (as {'many ' * 40} files); or measure"
        assert "\\" not in "".join(brief([prose])) + wrapped(prose)

    def test_empty_lines_go_before_text_is_cut(self) -> None:
        parts = [Paragraph("word " * 60), "", *["row"] * 21, ""]
        shown = one_screen(parts)
        assert len(shown) == SCREEN_LINES and "" not in shown

    def test_long_lines_are_broken_between_words_and_long_words_stay(self) -> None:
        path = "/" + "x" * 120
        broken = wrapped(f"short\n{'word ' * 30}\n{path} is whole").split("\n")
        assert broken[0] == "short" and path in broken
        assert max(len(line) for line in broken if line != path) <= SCREEN_COLUMNS

    def test_of_too_many_lines_the_ends_stay(self) -> None:
        shown = brief([f"line {k}" for k in range(40)], last=2)
        assert len(shown) == SCREEN_LINES
        assert shown[0] == "line 0" and shown[-2:] == ["line 38", "line 39"]
        assert "17 more lines: -v" in shown
        require_one_screen("\n".join(brief([f"{k} " * 200 for k in range(50)])))


@pytest.fixture(scope="module")
def arm() -> Mapping[str, Floats]:
    """A motion of a UR5 of six seconds."""
    motion = simulate("ur5_robot.urdf", np.arange(0.0, 8.0, 0.02))
    return {"t": motion.time, "q": motion.position, "v": motion.velocity, "tau": motion.torque}


Table = Mapping[str, Floats]
Change = Callable[[Table, np.random.Generator], Table]


def scaled(name: str, factor: Floats | float) -> Change:
    return lambda table, rng: {**table, name: table[name] * factor}


def noisy(size: float) -> Change:
    def change(table: Table, rng: np.random.Generator) -> Table:
        torque = table["tau"]
        noise = size * torque.std(axis=0) * rng.standard_normal(torque.shape)
        return {**table, "tau": torque + noise}

    return change


def rows(part: slice | NDArray[np.intp]) -> Change:
    return lambda table, rng: {name: column[part] for name, column in table.items()}


def permuted(name: str, order: list[int]) -> Change:
    return lambda table, rng: {**table, name: table[name][:, order]}


def jumping(table: Table, rng: np.random.Generator) -> Table:
    position = table["q"].copy()
    position[200:, 1] += 0.5
    return {**table, "q": position}


def uneven(table: Table, rng: np.random.Generator) -> Table:
    return {**table, "t": table["t"] + 0.004 * rng.random(len(table["t"]))}


WRIST = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
LOGS: Mapping[str, Change] = {
    "right": rows(slice(None)),
    "noisy": noisy(0.2),
    "drowned in noise": noisy(3.0),
    "all torques negated": scaled("tau", -1.0),
    "one torque negated": scaled("tau", WRIST),
    "one axis negated": scaled("q", WRIST),
    "milli": scaled("tau", 1e-3),
    "of motors": scaled("tau", 0.01),
    "wrong constant": scaled("tau", 1.0 + 0.5 * (WRIST < 0.0)),
    "degrees": scaled("q", 180.0 / np.pi),
    "torques exchanged": permuted("tau", [1, 0, 2, 3, 4, 5]),
    "positions exchanged": permuted("q", [0, 1, 2, 4, 3, 5]),
    "two seconds": rows(slice(0, 100)),
    "half a second": rows(slice(0, 25)),
    "slow rate": rows(slice(None, None, 5)),
    "with gaps": rows(np.r_[0:150, 190:300, 320:400]),
    "jump": jumping,
    "uneven": uneven,
    "no torque": lambda table, rng: {**table, "tau": 0.0 * table["tau"]},
    "no motion": lambda table, rng: {**table, "q": 0.0 * table["q"], "v": 0.0 * table["v"]},
}


@pytest.mark.long
@pytest.mark.parametrize("name", LOGS)
@pytest.mark.parametrize("command", ["look", "identify"])
def test_a_log_fills_one_screen(
    command: str, name: str, arm: Mapping[str, Floats], tmp_path: Path
) -> None:
    log = written(tmp_path, name, arm)
    require_one_screen(printed(command, log, "--urdf", urdf_path("ur5_robot.urdf")))


def written(folder: Path, name: str, arm: Mapping[str, Floats]) -> Path:
    """Write one of the `LOGS`."""
    table = LOGS[name](arm, np.random.default_rng(1))
    return write_log(folder / "log.csv", ["t", "q{}", "v{}", "tau{}"], *table.values())


def printed(*words: object) -> str:
    """What a command prints, or the text of its refusal."""
    result = CliRunner().invoke(app, [*map(str, words)])
    if isinstance(result.exception, HilError | IdentificationError | PlannerError):
        return "\n".join(textwrap.wrap(str(result.exception), SCREEN_COLUMNS))
    assert isinstance(result.exception, SystemExit | None), result.exception
    return result.stdout or result.output


IDENTIFIED = ("right", "drowned in noise", "one torque negated", "with gaps")


@pytest.mark.long
@pytest.mark.parametrize("name", IDENTIFIED)
def test_what_follows_an_identification_fills_one_screen(
    name: str, arm: Mapping[str, Floats], tmp_path: Path
) -> None:
    """Of good models and bad ones."""
    folder = tmp_path / "result"
    urdf = urdf_path("ur5_robot.urdf")
    printed("identify", written(tmp_path, name, arm), "--urdf", urdf, "-o", folder)
    archive = folder / "log.mcap"
    for words in (
        ("rollout", folder, "--samples", "3"),
        ("export", folder, "--to", "mjcf", "-o", tmp_path / "arm.xml"),
        ("report", folder),
        ("batch", folder, "-o", tmp_path / "batch"),
        ("compare", folder, folder),
        ("payload", archive, "--loaded", archive),
    ):
        require_one_screen(printed(*words))


@pytest.mark.long
def test_a_campaign_fills_one_screen(tmp_path: Path) -> None:
    """Design, rehearsal, run and what is left of it."""
    cell = fast_cell(tmp_path).path
    folder = tmp_path / "run"
    settings = tmp_path / "search.toml"
    settings.write_text(QUICK_GRADIENT)
    for words in (
        ("design", cell, "-o", folder, "--settings", settings),
        ("rehearse", folder),
        ("run", folder, "--accept-dry-run"),
        ("status", folder),
        ("identify", folder),
        ("doctor", cell),
    ):
        require_one_screen(printed(*words))


WRONG_CELLS: Mapping[str, Callable[[Cell], Cell]] = {
    "a joint mirrored": lambda cell: mirrored(cell, "[-1, -1]"),
    "a motor without current": lambda cell: _changed(cell, "current_limit", "[20.0, 0.4]"),
    "not rehearsed": lambda cell: cell,
}


def _changed(cell: Cell, field: str, value: str) -> Cell:
    text = re.sub(rf"^{field} = .*$", f"{field} = {value}", cell.text, flags=re.MULTILINE)
    return Cell.from_texts(text, cell.urdf, cell.path)


@pytest.mark.long
@pytest.mark.parametrize("name", WRONG_CELLS)
def test_a_campaign_that_fails_fills_one_screen(name: str, tmp_path: Path) -> None:
    """At whatever step it is refused."""
    cell = WRONG_CELLS[name](fast_cell(tmp_path))
    cell.path.write_text(cell.text)
    folder = tmp_path / "run"
    settings = tmp_path / "search.toml"
    settings.write_text(QUICK_GRADIENT)
    rehearsal = () if name == "not rehearsed" else (("rehearse", folder),)
    for words in (
        ("design", cell.path, "-o", folder, "--settings", settings),
        *rehearsal,
        ("run", folder, "--dry-run"),
        ("run", folder, "--accept-dry-run", "--no-identify"),
        ("status", folder),
    ):
        require_one_screen(printed(*words))


@pytest.fixture(scope="module")
def weighed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Torques and currents with a load of 4 kg and without, on a wall, and in slow motion."""
    folder = tmp_path_factory.mktemp("weighed")
    load = pin.Inertia(MASS, CENTRE, np.zeros((3, 3)))
    fast, slow = np.arange(0.0, 12.0, 8e-3), np.arange(0.0, 60.0, 2e-2)
    for seed, (name, body) in enumerate({"empty": None, "full": load}.items()):
        made = simulate("ur5_robot.urdf", fast, seed=seed, load=body)
        arrays = {"t": made.time, "q": made.position, "tau": made.torque}
        archive_of(folder / f"{name}.mcap", made.urdf, law=LAW, **arrays)
        archive_of_currents(folder, f"current_{name}", made)
        made = simulate("ur5_robot.urdf", slow, seed=seed, load=body, pace=0.03)
        archive_of_currents(folder, f"slow_{name}", made)
    made = simulate("ur5_robot.urdf", fast, seed=3, gravity=(0.0, -9.81, 0.0))
    arrays = {"t": made.time, "q": made.position, "tau": made.torque}
    archive_of(folder / "wall.mcap", made.urdf, law=LAW, **arrays)
    return folder


CARRIED = "--mass 4 --centre 0,0.09,0.12"
WEIGHINGS = (
    "payload empty.mcap --loaded full.mcap",
    "payload empty.mcap --loaded full.mcap --check mass=4.5 --check cx=0.2",
    "payload full.mcap --loaded empty.mcap",
    "payload wall.mcap --loaded full.mcap",
    "payload --model empty.mcap full.mcap",
    f"torque-constants current_empty.mcap --loaded current_full.mcap {CARRIED}",
    "torque-constants current_empty.mcap --loaded current_full.mcap --mass 4",
    f"torque-constants slow_empty.mcap --loaded slow_full.mcap {CARRIED}",
    f"torque-constants empty.mcap --loaded full.mcap {CARRIED}",
    "torque-constants current_empty.mcap",
)


@pytest.mark.long
@pytest.mark.parametrize("line", WEIGHINGS)
def test_a_load_fills_one_screen(line: str, weighed: Path) -> None:
    words = [weighed / word if word.endswith(".mcap") else word for word in line.split()]
    require_one_screen(printed(*words))


@pytest.mark.long
@pytest.mark.parametrize("faults", [0, 5])
def test_a_fleet_fills_one_screen(faults: int, tmp_path: Path) -> None:
    """Ten robots, of which none or five wear."""
    worn = tuple(Fault(robot, "wear", robot % 3, 0.5, 0.1) for robot in range(faults))
    plan = FleetPlan(robots=10, months=4, duration=6.0, day=0.005, faults=worn)
    write_fleet(tmp_path / "logs", Fleet(plan))
    naming = ("--robot", "{robot}/{date}.csv", "--urdf", fleet_urdf(), *NOTHING_OPEN[:-2])
    for words in (
        ("trend", tmp_path / "logs", *naming, "--limit", "friction+60%"),
        ("batch", tmp_path / "logs", *naming, "-o", tmp_path / "tables"),
    ):
        require_one_screen(printed(*words))


COMMANDS = "identify look design rehearse run batch payload rollout compare doctor demo"


@pytest.mark.parametrize("command", COMMANDS.split())
def test_a_command_prints_everything_if_asked(command: str) -> None:
    assert "--verbose" in CliRunner().invoke(app, [command, "--help"]).output
