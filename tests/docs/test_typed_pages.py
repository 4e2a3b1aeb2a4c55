"""Pages that are run from their first block to their last, each with what it needs beside it."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import matplotlib.image
import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from hil import Campaign, Cell
from hil.archive import open_archive
from hil.base.progress import Silent
from hil.campaign import design
from hil.cell.errors import UnknownFieldsError
from hil.cell.toml_edits import with_values
from hil.cli import app
from hil.control.simulator_process import free_port
from hil.results.results import Results
from hil.results.rollout_result import RolloutResult
from identification.model.motion import Motion
from tests.docs.typed import ROOT, commands, section
from tests.hil.payload.load_archives import CENTRE, MASS, archive_of_currents
from tests.hil.simulated_logs import simulate
from tests.motion_table import MotionTable

pytestmark = pytest.mark.long

DESIGN = ROOT / "docs" / "design.md"


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text("utf-8")


def blocks(text: str) -> list[tuple[str, str]]:
    """Language and content of each block, in order."""
    return re.findall(r"```(sh|python|toml)\n(.*?)```", text, re.DOTALL)


def typed(block: str, allowed: tuple[int, ...] = (0,)) -> list[str]:
    """Type the lines of a block but `hil demo`, which the test replaces; their commands."""
    ran = []
    for line in block.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "hil"
        ran.append(arguments[0])
        if arguments[0] != "demo":
            result = CliRunner().invoke(app, arguments)
            assert result.exit_code in allowed, (line, result.output, result.exception)
    return ran


def saved(block: str) -> None:
    """Write a block of TOML to the file that its first line names."""
    Path(block.splitlines()[0].removeprefix("# ")).write_text(block)


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "runs").mkdir()
    for name in ("examples", "sim_fixtures"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestPrecision:
    def test_every_block_runs(self, workplace: Path) -> None:
        """In the order in which a user has what a block needs: the campaign before `--given`."""
        for name in ("cell.toml", "robot.urdf"):
            shutil.copy(ROOT / "examples" / "two_joints" / name, workplace)
        text = section(DESIGN, "Precision to order")
        first, given, campaign, following = (block for _, block in blocks(text))
        assert typed(first) == ["design"]
        assert typed(campaign, (0, 5)) == ["rehearse", "run"]
        assert typed(given) == ["design"]
        assert typed(following, (0, 5)) == ["rehearse", "run"]
        every = sorted(str(path) for path in Path("runs").glob("*/archives/*.mcap"))
        assert typed(f"hil identify {shlex.join(every)} -o all", (0, 5)) == ["identify"]
        record = json.loads((workplace / "runs" / "precise" / "precision.json").read_text())
        assert record["outcome"] in ("met", "out of reach")


class TestLogs:
    TEXT = page("logs.md")
    BALANCER = TEXT.split("## An arm with a balancer")[1].split("\n## ")[0]

    def test_every_block_runs(self, workplace: Path, identified_campaign: Campaign) -> None:
        """After `hil demo`, with recordings with and without a payload."""
        (workplace / "runs" / "source").symlink_to(identified_campaign.folder.root)
        times = np.arange(0.0, 20.0, 8e-3)
        load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
        archive_of_currents(workplace, "empty", simulate("ur5_robot.urdf", times, seed=1))
        archive_of_currents(workplace, "full", simulate("ur5_robot.urdf", times, seed=2, load=load))
        ran = []
        for language, block in blocks(self.TEXT.replace(self.BALANCER, "")):
            if language == "python":
                exec(compile(block, "docs/logs.md", "exec"), {})
            elif language == "toml":
                saved(block)
            else:
                ran += typed(block, (0, 5))
        assert ran == ["demo", "import", "import", "identify", "torque-constants"]
        (run,) = Results.load(workplace / "result" / "results.json").validation
        assert run.archive == "other.mcap"
        assert run.overall_relative_error < 0.1  # of a motion of seconds, with its noise
        assert (workplace / "result" / "report.html").is_file()

    @pytest.mark.slow
    def test_a_known_balancer_predicts_another_motion(self, workplace: Path) -> None:
        """At most 14.0 % of the unseen motion's torque, over all joints and every row."""
        data = ROOT.parent / "shared" / "data" / "kr300"
        if not data.is_dir():
            pytest.skip(f"there is no recording {data}")
        files = {"one.csv": "A.csv", "other.csv": "B.csv"}
        for name in ("one.csv", "other.csv", "map.toml", "robot.urdf"):
            (workplace / name).symlink_to(data / files.get(name, name))
        (cell,) = re.findall(r"```toml\n(.*?)```", self.BALANCER, re.DOTALL)
        Path("heavy.toml").write_text(cell)
        lines = re.findall(r"^hil .*$", self.BALANCER, re.MULTILINE)
        for line in lines:
            identifies = line.startswith("hil identify")
            typed(f"{line} --output found" if identifies else line, (5,) if identifies else (0,))
        (unseen,) = Results.load(workplace / "found" / "results.json").validation
        assert unseen.all_rows_relative_error <= 0.14


def log_of(motion: str, path: str) -> None:
    """What an arm of the URDF, with friction, logs of a designed motion: twice, with noise."""
    cell = Cell.load("cell.toml")
    trajectory = MotionTable.of(Path("runs/motion", motion).read_text())
    once = np.arange(0.0, trajectory.duration + 0.5, 2e-3)
    times = np.arange(2 * len(once)) * 2e-3
    states = Motion(once, *trajectory.sample(once))
    states = Motion.joined((states, states))
    q = states.position
    n = len(cell.joint_names)
    values = cell.parameter_values(
        rotor_inertia=np.full(n, 0.3), coulomb=np.full(n, 5.0), viscous=np.full(n, 3.0),
        third=np.zeros(n),
    )  # fmt: skip
    noise = np.random.default_rng(len(motion)).standard_normal((2, *q.shape))
    torque = cell.model.torque(values, states) + 0.2 * noise[0]
    table = np.column_stack([times, q + 1e-5 * noise[1], torque])
    np.savetxt(path, table, delimiter=",", header="t,q1,q2,tau1,tau2", comments="")


def test_other_robots_from_a_urdf_to_a_good_model(workplace: Path) -> None:
    for language, block in blocks(section(DESIGN, "Arms with other controllers")):
        if language == "toml":
            saved(block)
            log_of("excitation.csv", "log.csv")
            log_of("validation_000.csv", "other.csv")
        else:
            typed(block)
    assert Results.load(Path("result/results.json")).verdict.good
    assert "<robot" in Path("result/arm.urdf").read_text()


def test_simulators_run_what_was_exported(workplace: Path) -> None:
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    cell = Cell.load(ROOT / "examples" / "two_joints" / "cell.toml")
    cell = cell.with_campaign(repetitions=2, validation_runs=1)
    demo = Campaign.create(workplace / "runs" / "simulators", cell, design(cell, Silent()))
    demo.run(unrehearsed=True, durable=False)
    ran = []
    for language, block in blocks(page("simulators.md")):
        assert language == "sh"
        ran += typed(block)
    assert ran == ["demo", "identify", "export", "rollout", *["export"] * 3]
    rollout = RolloutResult.load(Path("runs/simulators/rollout.json"))
    assert rollout.ratio is not None
    assert rollout.ratio[2] <= 0.5  # at 0.5 s
    assert matplotlib.image.imread("runs/simulators/rollout.png").std() > 0.0
    assert len([*Path("runs/simulators/identified_ensemble").iterdir()]) == 20
    archives = {path.name for path in Path("runs/simulators/archives").iterdir()}
    copies = {path.name for path in Path("runs/simulators/annotated").iterdir()}
    assert copies < archives
    loader = re.findall(r"^```text\n(import .*?)^```", page("simulators.md"), re.M | re.S)[0]
    assert len(loader.splitlines()) == 3
    typed("hil export runs/simulators --to pinocchio")
    names: dict[str, object] = {}
    exec(loader, names)
    assert (names["model"].armature > 0.0).all()  # type: ignore[attr-defined]


def masked(text: str) -> str:
    """A text in one line without its numbers, whose width and size vary from day to day."""
    return " ".join(re.sub(r"[\d.]+(e[-+]?\d+)?", "#", text).split())


@pytest.mark.slow
def test_simulators_print_what_the_page_shows(workplace: Path) -> None:
    """The five commands as they stand, on the arm of the page; numbers are not compared."""
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    text = page("simulators.md")
    (_, block), *_ = blocks(text)
    printed = ""
    for line in block.splitlines():
        assert line.startswith("hil ")
        done = subprocess.run(
            [sys.executable, "-m", *shlex.split(line)], capture_output=True, text=True
        )
        assert done.returncode == 0, (line, done.stdout, done.stderr)
        printed += done.stdout
    shown = re.findall(r"^((?:parameters: |written: 20|\d+ windows; ).*?)```", text, re.M | re.S)
    assert len(shown) == 3
    for block in shown:
        assert masked(block) in masked(printed)
    assert "The identified arm is better than the nominal one" in printed


class TestFirstHour:
    PAGE = ROOT / "docs" / "tutorial.md"
    TEXT = section(PAGE, "The first hour with a simulated arm")
    STEPS = commands(PAGE, TEXT)

    def edit(self, path: Path, **instead: int) -> None:
        """What the page asks to write into `[controller]` and `[campaign]` of the copy."""
        (block,) = re.findall(r"```toml\n(.*?)```", self.TEXT, re.DOTALL)
        link = tomllib.loads(block) | instead
        values = {f"controller.{key}": value for key, value in link.items()}
        counts = re.findall(r"`(repetitions|validation_runs) = (\d+)`", self.TEXT)
        values |= {f"campaign.{key}": int(count) for key, count in counts}
        path.write_text(with_values(path.read_text("utf-8"), values))

    def hil(self, arguments: list[str]) -> subprocess.Popen[str]:
        assert arguments[0] == "hil"
        return subprocess.Popen(
            [sys.executable, "-m", *arguments], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip

    @pytest.mark.slow
    def test_the_commands_run_in_their_order(self, workplace: Path) -> None:
        """Against a simulated controller, which waits for this computer."""
        simulate, *steps = self.STEPS
        assert [step[1] for step in steps] == [
            "new", "sim_fixtures/ns16/cell.toml", "doctor", "record", "plot", "move", "plot",
            "move", "design", "rehearse", "run", "run",
        ]  # fmt: skip
        port = str(free_port())
        for step in steps:
            if step[0] == "cp":
                for name in step[1:-1]:
                    shutil.copy(name, step[-1])
                self.edit(Path("cell.toml"), port=int(port))
                continue
            controller = None
            if step[1] in {"new", "record", "move", "run"}:
                controller = self.hil([part.replace("2001", port) for part in simulate])
            done = self.hil([part.replace("2001", port) for part in step])
            printed, _ = done.communicate(timeout=900 if step[1] == "run" else 180)
            if controller is not None:
                controller.terminate()
                controller.communicate(timeout=60)
                time.sleep(0.1)
            # doctor --quick is provisional: 5, whatever this computer can do.
            assert done.returncode == (5 if step[1] == "doctor" else 0), (step, printed)
            if step[1] == "new":
                with pytest.raises(UnknownFieldsError) as unknown:
                    Cell.load("new.toml")
                assert len(unknown.value.fields) == 12
                assert "twelve other fields" in self.TEXT
        moves = [open_archive(path) for path in sorted(Path("moves").glob("*.mcap"))]
        assert [(move.kind, move.complete) for move in moves] == [("move", True)] * 2
        assert open_archive("archives/standstill_000_a1.mcap").complete
        assert Path("standstill.png").exists() and Path("first_move.png").exists()
        assert Path("runs/small/report.html").exists()


ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
SLOW = ("01", "03", "04", "06", "08")
LAST_LINE = {
    "01": "report.html",
    "02": "completed",
    "03": "planted",
    "04": "The model",
    "05": "largest distance from the planned path",
    "06": "N·m",
    "07": "packets",
    "08": "30 recordings of 5 robots",
}  # Something that stands in what it prints


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.slow] if path.name[:2] in SLOW else [])
        for path in EXAMPLES
    ],
    ids=lambda path: path.stem,
)
def test_it_runs(path: Path, tmp_path: Path) -> None:
    # In a copy: pictures are for people to look at, and differ in nothing but time stamps.
    for name in ("sim_fixtures", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    folder = tmp_path / "examples"
    folder.mkdir()
    (folder / "two_joints").symlink_to(ROOT / "examples" / "two_joints")
    script = folder / path.name
    script.write_text(path.read_text("utf-8"))
    quick = ["--quick"] if "--quick" in script.read_text("utf-8") else []
    done = subprocess.run(
        [sys.executable, str(script), *quick],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert LAST_LINE[path.name[:2]] in done.stdout
    assert (tmp_path / "runs" / "examples" / f"{path.stem}.png").stat().st_size > 5_000
    assert sorted(entry.name for entry in folder.iterdir()) == sorted([path.name, "two_joints"])
