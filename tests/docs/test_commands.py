"""Every command in README and docs is typed, or named here with the reason why not.

What is not typed is read by the command line all the same, so that no option is misspelt.
"""

from __future__ import annotations

import re
import shlex
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil import Campaign, Cell
from hil.base.progress import Silent
from hil.campaign import design
from hil.cli import app
from tests.docs.typed import PAGES, ROOT, commands, parse, section
from tests.hil.fast_cell import QUICK
from tests.hil.simulated_logs import write_moving_log

pytestmark = pytest.mark.long

TYPED_ELSEWHERE = {
    "campaign.md": "tests/hil/campaign/test_campaign_day.py",
    "payload.md": "tests/hil/payload/test_payload_command.py",
    **dict.fromkeys(
        (
            "logs.md",
            "i-have-a-comau.md",
            "simulators.md",
        ),
        "tests/docs/test_typed_pages.py",
    ),
}  # Pages whose commands another test types, one after the other

SECTIONS_TYPED_ELSEWHERE = {
    "design.md": "Arms with other controllers",
    "tutorial.md": "The first hour with a simulated arm",
}  # Sections likewise, by tests/docs/test_typed_pages.py

OTHER_PROGRAMS = {
    "sudo": "changes the computer",
    "ip": "network",
    "printf": "changes the computer",
    "echo": "changes the computer",
    "candump": "needs a CAN bus",
    "ssh": "needs another machine",
    "dask": "needs other machines; tests start a scheduler and workers themselves",
    "make": "is how tests are run: its targets are looked up",
    "pip": "network",
    ".": "is the shell's own",
    "cd": "is the shell's own",
    "cp": "is the system's own",
    "python": "is looked up; tests/docs/test_typed_pages.py runs examples",
}  # Programs that are not run, and why

NOT_TYPED = {
    "hil demo --effects": "minutes",
    "hil demo --controller ur": "half a minute; tests/hil/campaign/test_ur_twin.py moves that arm",
    "hil demo --resume": "resumes a stopped one; tests/hil/cli/test_cli.py stops one",
    "hil demo --excitation": "the whole NS 16 campaign: minutes",
    "hil demo --output runs/": "a campaign of the fixture stands in its place",
    "hil design cell.toml --method b -o runs/b": "half a minute; a short one needs other settings",
    "hil doctor cell.toml --duration 14400": "four hours",
    "hil simulate": "waits for a PC; tests/hil/control/test_simulate.py runs it",
    "hil move copy.toml": "needs a controller; tests/hil/control/test_move.py types it",
    "hil record": "waits for a controller; tests/hil/control/test_record_command.py runs it",
    "hil new --controller ur": "needs an arm; tests/hil/new/test_ur_values.py asks a simulated one",
    "hil run runs/weigh": "needs a payload; tests/hil/weighing/test_payload_campaign.py has one",
    "hil torque-constants archives": "needs recordings with a load",
    "hil run campaigns/october --live": "needs a campaign on a real link",
    "hil import rosbag2": "needs a recording; tests/hil/importers/test_rosbag2.py",
    "hil import log log.csv --map columns.toml": "typed in logs.md",
    "hil torque-constants empty.mcap": "typed in logs.md",
    "hil payload bare --loaded gripper": "typed in payload.md",
    "hil payload --model": "typed in payload.md",
    "hil design cell.toml -o runs/precise": "typed in design.md",
    "hil design cell.toml -o runs/next": "typed in design.md",
    "hil rehearse runs/precise": "typed in design.md",
    "hil run runs/precise": "typed in design.md",
    "hil rehearse runs/next": "typed in design.md",
    "hil run runs/next": "typed in design.md",
    "hil identify ur10": "needs a recording; tests/hil/identified/test_one_command.py reads it",
    "hil identify chirp_sweep": "needs recordings; tests/hil/servo/test_servo_command.py",
    "hil identify '~/.cache": "needs a data set; tests/hil/importers/test_lerobot.py writes some",
    "hil export out": "needs recordings; tests/hil/servo/test_servo_command.py exports",
    "hil rollout out": "needs recordings; tests/hil/rollout/test_servo_rollout.py types it",
    "hil batch /data": "needs other people's archives",
    "hil trend logs": "needs logs; tests/hil/fleet/test_trend.py types it",
    "hil batch 'logs/": "needs logs; tests/hil/fleet/test_logs.py types it",
    "hil study --quick": "minutes; tests/hil/study/test_study.py runs a shorter one",
    "hil study --output": "an hour; tests/hil/study/test_study.py runs a short one",
}  # Beginnings of commands that are read and not run, and why

SHORTER = {
    "design": ("--settings", "quick.toml"),
    "doctor": ("--duration", "1"),
    "move": ("--yes",),
}  # Added so that a command takes seconds and asks no question

NOT_GOOD_EITHER = ("doctor", "identify", "run")
"""May end with 5: this computer need not be fit, a campaign of seconds no good one."""


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with a cell of two joints and the files that pages name."""
    for name in ("sim_fixtures", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    for name in ("cell.toml", "robot.urdf"):
        shutil.copy(ROOT / "examples" / "two_joints" / name, tmp_path)
    (tmp_path / "arm.urdf").symlink_to(ROOT / "examples" / "two_joints" / "robot.urdf")
    (tmp_path / "quick.toml").write_text(QUICK)
    (tmp_path / "points.csv").write_text("0, 20\n30, -10\n-20, 40\n0, 20\n")
    urdf = (tmp_path / "robot.urdf").read_text()
    for seed, name in enumerate(("log.csv", "other.csv")):
        write_moving_log(tmp_path / name, urdf, seed=seed)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put_demo(workplace: Path, campaign: Campaign) -> None:
    """Leave what `hil demo` leaves, and what pages take from there."""
    shutil.copytree(campaign.folder.root, workplace / "runs" / "demo")
    for name in ("tutorial", "simulators", "source"):  # pages have one each: none fails for another
        (workplace / "runs" / name).symlink_to("demo")
    (workplace / "archives").symlink_to(workplace / "runs" / "demo" / "archives")
    for name, archive in zip("ab", campaign.folder.completed("excitation"), strict=False):
        shutil.copy(archive, workplace / f"{name}.mcap")


@pytest.fixture(scope="module")
def two_campaigns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two small campaigns of the arm of two joints, march and june."""
    folder = tmp_path_factory.mktemp("two")
    cell = Cell.load(ROOT / "examples" / "two_joints" / "cell.toml")
    cell = cell.with_campaign(repetitions=2, validation_runs=1)
    plan = design(cell, Silent())
    for seed, name in enumerate(("march", "june"), 1):
        seeded_cell = cell.with_campaign(simulation_seed=seed)
        Campaign.create(folder / name, seeded_cell, plan).run(unrehearsed=True, durable=False)
    return folder


def put_two(workplace: Path, folder: Path, *names: str) -> None:
    """Leave both campaigns under the names that a page gives them."""
    for name, campaign in zip(names, sorted(folder.iterdir(), reverse=True), strict=False):
        shutil.copytree(campaign, workplace / "runs" / name)


def test_no_page_makes_a_demo_in_the_folder_of_another() -> None:
    """`hil demo` refuses a folder that is not empty, and `make demo` has filled one."""
    folders = ["runs/demo"]
    for page in sorted((ROOT / "docs").glob("*.md")):
        made = re.findall(r"^hil demo --output (\S+)(?!.*--force)", page.read_text(), re.M)
        folders += made
    assert len(folders) == len({*folders}), folders
    assert len(folders) > 2


def reason_not_to(command: list[str]) -> str | None:
    if command[0] != "hil":
        return OTHER_PROGRAMS[command[0]]
    line = shlex.join(command)
    return next((why for begin, why in NOT_TYPED.items() if line.startswith(begin)), None)


def type_page(page: Path) -> list[str]:
    """Type what can be typed of a page; the commands that were."""
    typed = []
    text = page.read_text(encoding="utf-8")
    if page.name in SECTIONS_TYPED_ELSEWHERE:
        text = text.replace(section(page, SECTIONS_TYPED_ELSEWHERE[page.name]), "")
    for command in commands(page, text):
        if reason_not_to(command) is not None:
            continue
        extra = () if "--quick" in command else SHORTER.get(command[1], ())
        result = CliRunner().invoke(app, [*command[1:], *extra], env={"COLUMNS": "120"})
        allowed = (0, 5) if command[1] in NOT_GOOD_EITHER else (0,)
        assert result.exit_code in allowed, (command, result.output, result.exception)
        typed.append(" ".join(command))
    return typed


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_command_line_understands_every_command(page: Path) -> None:
    for command in commands(page):
        if command[0] == "hil":
            parse(command[1:])
        elif command[0] == "make":
            assert f"\n{command[1]}:" in (ROOT / "Makefile").read_text()
        elif command[:2] == ["python", "-m"]:
            module = Path(*command[2].split("."))
            assert any((ROOT / f).exists() for f in (module, module.with_suffix(".py"))) or (
                command[2] == "cantools"
            ), command
        elif command[0] == "python" and command[1].startswith("examples/"):
            assert (ROOT / command[1]).exists()


def test_no_exception_is_left_over() -> None:
    written = [command for page in PAGES for command in commands(page)]
    lines = [shlex.join(command) for command in written]
    assert not [b for b in NOT_TYPED if not any(line.startswith(b) for line in lines)]
    assert OTHER_PROGRAMS.keys() >= {command[0] for command in written} - {"hil"}


FAST = ("connect.md", "i-have-a-log.md", "motion.md", "README.md")
AFTER_A_DEMO = ("commands.md", "tutorial.md")
AFTER_TWO = {
    "commands.md": ("march", "june"),
    "batch.md": ("march", "june"),
    "design.md": ("demo",),
}  # Pages that name campaigns of one arm, and how
SLOW = ("batch.md", "commands.md", "design.md", "tutorial.md")


@pytest.mark.parametrize(
    "name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def test_a_page_is_typed_from_its_first_command_to_its_last(
    workplace: Path, name: str, request: pytest.FixtureRequest
) -> None:
    if name in AFTER_A_DEMO:
        put_demo(workplace, request.getfixturevalue("identified_campaign"))
    if name in AFTER_TWO:
        put_two(workplace, request.getfixturevalue("two_campaigns"), *AFTER_TWO[name])
    page = next(page for page in PAGES if page.name == name)
    assert type_page(page)


def test_every_page_with_something_to_type_is_typed() -> None:
    to_type = {
        page.name
        for page in PAGES
        if any(reason_not_to(command) is None for command in commands(page))
    }
    assert to_type <= {*FAST, *SLOW, *TYPED_ELSEWHERE}


def python_of_the_readme() -> list[str]:
    """The blocks: from a log, and a campaign."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_ten_lines_of_the_readme_identify_a_log(
    workplace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In less than ten seconds, loading all libraries apart; the log is simulated."""
    code = python_of_the_readme()[0]
    assert len([line for line in code.splitlines() if line]) <= 10
    names: dict[str, Any] = {}
    begin = time.process_time()
    exec(compile(code, "README.md", "exec"), names)
    assert time.process_time() - begin < 10.0
    assert capsys.readouterr().out.startswith("Good for ")
    assert np.abs(names["holding"]).max() > 0.0
    assert (workplace / "result" / "report.html").exists()
    assert (workplace / "torques.png").stat().st_size > 5_000


@pytest.mark.slow
def test_the_campaign_of_the_readme_runs(
    workplace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As it stands, and again in the folder that it left: nothing moves a second time."""
    _, code = python_of_the_readme()
    names: dict[str, Any] = {}
    (workplace / "examples").mkdir(exist_ok=True)
    if not (workplace / "examples" / "two_joints").exists():
        (workplace / "examples" / "two_joints").symlink_to(ROOT / "examples" / "two_joints")
    counts = []
    for _ in range(2):
        exec(compile(code, "README.md", "exec"), names)
        counts.append(len(list((workplace / "runs" / "python" / "archives").iterdir())))
    assert counts[0] == counts[1]
    assert "The model" in capsys.readouterr().out.splitlines()[-1]
    assert names["recording"].n_samples > 0
