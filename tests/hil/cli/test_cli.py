"""Commands as typed: output, exit status and help."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import hil as hil_package
from hil.archive import ImportedSamples, open_archive, write_samples
from hil.base.errors import InputError
from hil.base.progress import reporter
from hil.campaign import Campaign
from hil.cli import COMMANDS, app, main
from hil.results.results import Results
from sim_fixtures.ns16 import CELL_PATH, URDF_PATH

pytestmark = pytest.mark.long


def hil(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hil", *map(str, arguments)]
    environment = os.environ | {"COLUMNS": "200", "NO_COLOR": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=300, check=False
    )


def test_help_lists_every_command() -> None:
    done = hil("--help")
    assert done.returncode == 0
    assert "hil demo" in done.stdout
    for command in COMMANDS:
        assert f" {command} " in done.stdout
        asked = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"})
        assert asked.exit_code == 0
        assert len(COMMANDS.purpose(command)) > 10


def leaves(command: Any) -> Iterator[Any]:
    """Commands without commands below them."""
    below = getattr(command, "commands", None)
    yield from (
        [leaf for subcommand in below.values() for leaf in leaves(subcommand)]
        if below
        else [command]
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_each_option_is_explained(command: str) -> None:
    """By its help text or in the docstring of the command."""
    for leaf in leaves(COMMANDS[command]):
        assert all(option.help for option in leaf.params), leaf.name
        assert not [
            parameter
            for parameter in leaf.params
            if getattr(parameter, "is_flag", False) and parameter.metavar
        ]
        assert "Options:" not in leaf.help
        entries = re.findall(r"^        (\w+): ", leaf.callback.__doc__, re.MULTILINE)
        assert {*entries} <= {option.name for option in leaf.params}


def test_the_package_documents_its_names() -> None:
    assert hil_package.__doc__ is not None
    assert hil_package.__version__ == version("hil")
    for name in hil_package.__all__:
        assert f"`{name}`" in hil_package.__doc__
        assert getattr(hil_package, name).__doc__


@pytest.mark.parametrize(("completed", "absent"), [("", "pydantic"), ("hil re", "numpy")])
def test_help_and_completion_import_no_numerics(completed: str, absent: str) -> None:
    look = "import atexit, sys; atexit.register(lambda: print('loaded', *sys.modules)); "
    look += "from hil.cli import app; app(['--help'], prog_name='hil')"
    shell = {"_HIL_COMPLETE": "complete_bash" if completed else "", "COMP_WORDS": completed}
    environment = {**os.environ, **shell, "COMP_CWORD": "1"}
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, env=environment)
    shown, _, modules = done.stdout.decode().partition("loaded ")
    assert ("rehearse" in shown, "design" in shown) == (True, not completed)
    loaded = set(modules.split())
    ours = {name for name in loaded if name.split(".")[0] == "hil"}
    base = {"errors", "exit_status", "first_use", "interrupt", "progress_lines", "terminal_text"}
    base = {f"hil.base.{part}" for part in (*base, "version")}
    cli = {"hil", "hil.base", "hil.cli", "hil.cli.suggestions", *base}
    assert ours == cli
    assert not {"numpy", "scipy", "pinocchio", absent, "drivers", "planner"} & loaded


def test_the_version_names_package_and_numerical_libraries() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.stdout.startswith(f"hil {version('hil')} (numpy {np.__version__}, ")


@pytest.mark.parametrize("command", ["status", "run"])
def test_a_command_imports_only_what_it_uses(command: str) -> None:
    look = f"import sys; from hil.cli import COMMANDS; COMMANDS['{command}']; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert f"hil.cli.{command}" in loaded
    assert not {"hil.cli.design", "matplotlib", "cvxpy", "pymoo"} & loaded
    parts = ("interpolate", "linalg", "optimize", "signal", "sparse", "spatial", "special", "stats")
    assert not {f"scipy.{part}" for part in parts} & loaded


@pytest.mark.slow
def test_status_takes_at_most_0_8_s_of_processor(campaign: Campaign) -> None:
    """The minimum of several runs, as other programs slow it down."""
    spent = []
    for _ in range(8):
        before = sum(os.times()[2:4])  # of children
        assert hil("status", campaign.folder.root).returncode == 0
        spent.append(sum(os.times()[2:4]) - before)
    assert min(spent) <= 0.8


def test_the_demo_writes_results_and_begins_with_the_verdict(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "demo"
    done = hil("demo", "--output", folder, "--repetitions", 2, "--validation", 1)
    assert done.returncode == 0, done.stderr
    results = Results.load(folder / "results.json")
    assert " ".join(done.stdout.split()).startswith(results.verdict.line)
    assert results.verdict.line.startswith("Good for feed-forward (")
    assert len(list((folder / "archives").glob("excitation_*.mcap"))) == 2
    assert (folder / "report.html").read_text("utf-8").startswith("<!")

    again = hil("demo", "--output", folder)
    assert again.returncode == 2
    assert "--force" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["identify", "nothing.mcap"], "nothing.mcap"),
        (["identify", str(CELL_PATH)], "cell.toml"),
        (
            ["import", "rosbag2", "x.db3", "-o", "y.mcap"],
            "--urdf arm.urdf, --cell cell.toml, or --dh table.csv",
        ),
        (["import", "rosbag2", "x.db3", "-o", "y.mcap", "--urdf", str(URDF_PATH)], "x.db3"),
        (
            ["import", "log", "x", "-o", "y", "--map", "m.toml", "--urdf", str(URDF_PATH)],
            "m.toml",
        ),
        (["identify", "x.mcap", "--torque-bandwidth", "wide"], "not a bandwidth"),
        (["identify", "x.mcap", "--output", str(CELL_PATH)], "cannot be created"),
        (["identify", "x.mcap", "--delay", "nan"], "--delay"),
        (["demo", "--output", str(CELL_PATH)], "is not a folder"),
    ],
)
def test_bad_input_gets_one_sentence_and_status_2(
    tmp_path: Path,
    arguments: list[str],
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Any other exception would propagate."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["hil", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert sentence in capsys.readouterr().err.replace("\n", "")


@pytest.mark.slow
def test_a_stopped_demo_is_resumed(campaign: Campaign, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(campaign.folder.root, folder)
    (folder / "archives" / "validation_001_a1.mcap").unlink()
    done = hil("demo", "--output", folder, "--resume")
    assert done.returncode == 0, done.stderr
    # Attempt numbers are not reused.
    assert (folder / "archives" / "validation_001_a2.mcap").exists()
    assert (folder / "report.html").exists()


@pytest.mark.parametrize("option", ["--repetitions", "--validation", "--seed"])
def test_a_resumed_demo_ignores_no_option(campaign: Campaign, tmp_path: Path, option: str) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(campaign.folder.root, folder)
    arguments = ["demo", "--output", str(folder), "--resume", option, "77"]
    refused = CliRunner().invoke(app, arguments)
    assert f"was begun with {option} " in str(refused.exception)
    assert f"omit {option} with --resume" in str(refused.exception)


def test_force_removes_only_a_campaign(campaign: Campaign, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    link = tmp_path / "link"
    shutil.copytree(campaign.folder.root, folder)
    (folder / "my_notes.txt").write_text("mine")
    link.symlink_to(folder)
    for place, message in ((folder, "my_notes.txt"), (link, "is not a folder")):
        refused = CliRunner().invoke(app, ["demo", "--output", str(place), "--force"])
        assert isinstance(refused.exception, InputError)
        assert message in str(refused.exception)
    assert (folder / "my_notes.txt").exists()


@pytest.mark.slow
def test_an_archive_that_went_missing_is_named(campaign: Campaign, tmp_path: Path) -> None:
    folder = shutil.copytree(campaign.folder.root, tmp_path / "copy")
    (folder / "archives" / "excitation_001_a1.mcap").unlink()
    assert "excitation_001_a1.mcap is missing" in hil("identify", folder, "--quiet").stderr


def test_ctrl_c_stops_on_the_path_with_complete_archives(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    command = [sys.executable, "-m", "hil", "demo", "--output", str(folder)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        deadline = time.monotonic() + 120.0
        while not (folder / "archives" / "excitation_000_a1.mcap").exists():
            assert time.monotonic() < deadline
            assert run.poll() is None
            time.sleep(0.05)
        time.sleep(0.3)
        run.send_signal(signal.SIGINT)
        _, output = run.communicate(timeout=60)
    assert run.returncode == 130, output
    assert "stopped" in output
    assert "--resume" in output
    last = sorted((folder / "archives").iterdir(), key=lambda path: path.stat().st_mtime)[-1]
    archive = open_archive(last)
    assert archive.complete
    assert archive.outcome.entries["outcome"] == "stopped"


@pytest.mark.parametrize("package", ["hil", "hil.campaign", "hil.testing", "identification"])
def test_tab_completion_lists_names_that_are_not_loaded_yet(package: str) -> None:
    look = f"import {package} as package; print(set(package.__all__) - set(dir(package)))"
    shown = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert shown.stdout == "set()\n"


class TestMistypedPaths:
    """A path that is not there is answered with the one beside it that is most like it."""

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "run").mkdir()
        for name in ("first.mcap", "second.mcap"):
            write_samples(
                tmp_path / "run" / name,
                ImportedSamples(np.arange(3) * 10**7, np.zeros((3, 1)), torque=np.zeros((3, 1))),
                joint_names=("a",),
                metadata={"clock_origin_ns": str(1_700_000_000 * 10**9), "importer": "log"},
            )
        return tmp_path / "run"

    @pytest.mark.parametrize("command", ["identify", "plot", "archive check", "archive info"])
    @pytest.mark.parametrize("typed", ["run/frist.mcap", "runn/first.mcap"])
    def test_nearest_name(self, folder: Path, command: str, typed: str) -> None:
        done = hil(*command.split(), folder.parent / typed)
        assert done.returncode == 2
        assert f"there is {folder / 'first.mcap'}" in done.stderr

    @pytest.mark.parametrize(
        "command",
        ["status", "report", "rehearse", "run", "batch", "compare tests", "demo --excitation"],
    )
    def test_nearest_folder(self, folder: Path, command: str) -> None:
        done = hil(*command.split(), f"{folder}n")
        assert done.returncode == 2
        assert f"; there is {folder}\n" in done.stderr

    def test_a_file_is_meant_by_a_name_with_a_suffix(self, folder: Path) -> None:
        """Not the folder of the results, which has the name of the log."""
        (folder / "first").mkdir()
        done = hil("identify", folder / "first.bag")
        assert f"there is {folder / 'first.mcap'}" in done.stderr

    def test_nothing_alike(self, tmp_path: Path) -> None:
        done = hil("archive", "check", tmp_path / "x.mcap")
        assert "check whether it was moved or removed" in done.stderr
        done = hil("archive", "check", tmp_path / "absent" / "x.mcap")
        assert f"there is no folder {tmp_path / 'absent'}" in done.stderr

    def test_other_inputs(self, folder: Path) -> None:
        (folder / "arm.urdf").write_text("<robot name='a'/>")
        done = hil("new", "--urdf", folder / "amr.urdf", "-o", folder / "c.toml")
        assert f"there is {folder / 'arm.urdf'}" in done.stderr

    def test_folders_are_accepted(self, folder: Path) -> None:
        done = hil("archive", "check", folder)
        assert [line.partition(":")[0] for line in done.stdout.splitlines()] == [
            str(folder / "first.mcap"),
            str(folder / "second.mcap"),
        ]
        done = hil("plot", folder, "-o", folder / "a.png")
        assert (folder / "a.png").exists()
        assert f"{folder / 'first.mcap'} is the first of 2 archives" in done.stdout

    def test_folder_without_an_archive(self, tmp_path: Path) -> None:
        done = hil("archive", "info", tmp_path)
        assert done.returncode == 2
        assert "has no archive (*.mcap) in it" in done.stderr

    def test_info_has_the_date_on_top_and_units(self, folder: Path) -> None:
        lines = hil("archive", "info", "-v", folder / "first.mcap").stdout.splitlines()
        assert lines[1].split() == ["recorded", "2023-11-14T22:13:20+00:00"]
        shown = {line.split()[0]: line.split()[-1] for line in lines[1:] if len(line.split()) > 1}
        assert shown["duration"] == "s"
        assert shown["size"] == "bytes"
        assert shown["clock_origin_ns"] == "ns"
        assert shown["outcome.samples"] == "samples"


def test_a_required_choice_has_an_example_of_each(tmp_path: Path) -> None:
    done = hil("plan", tmp_path / "cell.toml")
    assert "--random 6" in done.stderr
    assert "--via FILE" in done.stderr


def test_piped_output_has_messages_and_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    piped = reporter()
    with piped.task("smoothing", 2) as task:
        task.advance(1, "half")
        piped.say("one recording is short")
        task.advance(1, "all")
    assert capsys.readouterr().out == "one recording is short\n"
