"""The pytest plugin in another project: its page's example, and what it costs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hil.cell import Cell
from hil.testing import SessionError, UdpController, shortened
from sim_fixtures.ns16 import CELL_PATH

pytestmark = pytest.mark.long

DOCUMENT = Path(__file__).parents[3] / "docs" / "simulate.md"


def pytest_in(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """pytest as in another project: no configuration or conftest of ours."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTEST_ADDOPTS"}
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--strict-markers", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip


def written(folder: Path) -> list[str]:
    """The script and the test of the page, as files named there."""
    text = DOCUMENT.read_text("utf-8")
    named = re.findall(r"`(\w+\.py)`:?[^`]*?\n\n```python\n(.*?)```", text, re.DOTALL)
    for name, code in named:
        (folder / name).write_text(code)
    return [name for name, _ in named]


@pytest.mark.slow  # a whole run of pytest with real sockets in it
def test_the_example_of_the_page_runs_as_it_stands(tmp_path: Path) -> None:
    """And, in the same run, a test that reads what an identification leaves."""
    assert written(tmp_path) == ["to_home.py", "test_to_home.py", "test_bad_repetition.py"]
    (tmp_path / "test_results.py").write_text(
        "import json\n"
        "def test_results(identified_campaign, short_campaign):\n"
        "    folder = identified_campaign.folder\n"
        "    assert json.loads(folder.results.read_text())\n"
        "    assert folder.report.read_bytes().lower().startswith(b'<!doctype html>')\n"
        "    assert not short_campaign.folder.results.exists()\n"
    )
    done = pytest_in(tmp_path, "-W", "error", "-v")
    assert done.returncode == 0, done.stdout
    assert "6 passed" in done.stdout


def test_pytest_starts_without_anything_heavy(tmp_path: Path) -> None:
    (tmp_path / "test_light.py").write_text(
        "import sys\n"
        "def test_light():\n"
        "    assert 'hil.testing.plugin' in sys.modules\n"
        "    heavy = {'numpy', 'scipy', 'pinocchio', 'pydantic', 'hil.cell'} & set(sys.modules)\n"
        "    assert not heavy\n"
    )
    done = pytest_in(tmp_path)
    assert done.returncode == 0, done.stdout


def test_another_arm_a_wrong_script_and_a_fault_that_is_none(tmp_path: Path) -> None:
    """One run: the conftest's own arm takes the place of the NS 16, and what is wrong fails."""
    written(tmp_path)
    script = tmp_path / "to_home.py"
    script.write_text(script.read_text().replace("cell.home, speed", "cell.initial, speed"))
    (tmp_path / "conftest.py").write_text(
        "import pytest\n"
        "from hil import Cell\n"
        "from hil.testing import shortened\n"
        "from sim_fixtures.ns16 import CELL_PATH\n"
        "@pytest.fixture(scope='session')\n"
        "def simulated_cell():\n"
        "    cell = shortened(Cell.load(CELL_PATH))\n"
        "    text = cell.text.replace('initial_deg = [10.0', 'initial_deg = [33.0')\n"
        "    return Cell.from_texts(text, cell.urdf, cell.path)\n"
    )
    (tmp_path / "test_mine.py").write_text(
        "import numpy as np\n"
        "import pytest\n"
        "from hil.campaign import Stop\n"
        "def test_arm(simulated_link, simulated_cell):\n"
        "    where = np.degrees(simulated_cell.controller_angles(simulated_link.connect(Stop())))\n"
        "    assert abs(where[0] - 33.0) < 0.01\n"
        "@pytest.mark.controller_faults('earthquake@1')\n"
        "def test_typo(simulated_link):\n"
        "    pass\n"
    )
    done = pytest_in(tmp_path, "-v", "-k", "comes_home or arm or typo")
    assert "test_mine.py::test_arm PASSED" in done.stdout, done.stdout
    assert "test_the_arm_comes_home FAILED" in done.stdout
    assert "test_mine.py::test_typo ERROR" in done.stdout
    assert "'earthquake' is none of lose" in done.stdout


def test_a_project_without_it_pays_for_a_few_small_modules() -> None:
    """Its own are those of the names of errors; all others are Python's."""
    code = (
        "import sys, pytest; before = set(sys.modules); import hil.testing.plugin;"
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    ours = {name for name in modules if name.partition(".")[0] == "hil"}
    assert ours == {
        "hil",
        "hil.base",
        "hil.base.errors",
        "hil.base.exit_status",
        "hil.base.first_use",
        "hil.base.terminal_text",
        "hil.testing",
        "hil.testing.plugin",
    }
    assert {name.partition(".")[0] for name in modules - ours} <= sys.stdlib_module_names


@pytest.mark.parametrize("options", [("--intervals", "1"), ("--duration", "4")])
def test_a_program_that_stays_until_504_ends(tmp_path: Path, options: tuple[str, ...]) -> None:
    cell = shortened(Cell.load(CELL_PATH))
    program = Path(__file__).parents[1] / "foreign_pc.py"
    with UdpController.started(cell, tmp_path, options=options) as controller:
        command = [sys.executable, str(program), "--port", str(controller.port)]
        done = subprocess.run(
            [*command, "--exit-after", "100"], capture_output=True, text=True, timeout=60.0
        )
        assert done.returncode == 0, done.stderr
        assert "504" in done.stdout
        assert controller.finish()["phase"] == "ended"


def test_a_program_that_never_replied_is_named(tmp_path: Path) -> None:
    cell = shortened(Cell.load(CELL_PATH))
    with UdpController.started(cell, tmp_path) as controller:
        with pytest.raises(SessionError, match="no reply came") as error:
            controller.finish()
        assert str(controller.port) in str(error.value)
