"""What holds of every child process, whichever of the two ways of starting one was used."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.child_process import ChildProcess
from planner.worker import WorkerProcess

pytestmark = pytest.mark.safety

LIMIT = 60.0  # s for a new interpreter on a busy computer
PATIENCE = "import sys; print('ready', flush=True); sys.stdin.read(); import time; time.sleep(600)"


def by_drivers() -> tuple[int, Callable[[], None]]:
    """A program of the drivers that runs."""
    child = ChildProcess(("-c", PATIENCE))
    while "ready" not in child.output:
        assert child.wait(0.02) is None

    def end() -> None:
        child.kill(LIMIT)
        child.close()

    return child.pid, end


def by_planner() -> tuple[int, Callable[[], None]]:
    """A worker of the planner that has answered."""
    worker = WorkerProcess(timeout=LIMIT)
    pid = worker.call(os.getpid)
    return pid, worker.close


@pytest.fixture(params=[by_drivers, by_planner])
def child(request: pytest.FixtureRequest) -> Iterator[Path]:
    """Its folder in /proc."""
    pid, end = request.param()
    yield Path(f"/proc/{pid}")
    end()
    assert not Path(f"/proc/{pid}").exists()


def test_ctrl_c_and_the_end_of_the_terminal_do_not_reach_it(child: Path) -> None:
    assert os.getsid(int(child.name)) == int(child.name)


def test_it_has_no_input(child: Path) -> None:
    assert (child / "fd" / "0").readlink() == Path("/dev/null")


def test_it_imports_from_the_folders_of_its_parent(child: Path) -> None:
    environment = dict(
        entry.split("=", 1) for entry in (child / "environ").read_text().split("\0") if "=" in entry
    )
    folders = [path or str(Path.cwd()) for path in sys.path]
    assert environment["PYTHONPATH"].split(os.pathsep) == folders


def test_it_inherits_no_descriptor_that_was_not_given(tmp_path: Path) -> None:
    file = tmp_path / "open"
    with file.open("w") as parent:
        os.set_inheritable(parent.fileno(), True)
        for start in (by_drivers, by_planner):
            pid, end = start()
            links = {fd.readlink() for fd in Path(f"/proc/{pid}/fd").iterdir()}
            end()
            assert file not in links


def test_nothing_of_the_main_module_is_imported_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import os\n"
        "from drivers.child_process import ChildProcess\n"
        "from planner.worker import WorkerProcess\n"
        "print('main', flush=True)\n"
        "child = ChildProcess(('-c', 'print(1)'))\n"
        "assert child.wait(60.0) == 0, child.errors\n"
        "assert child.output == '1\\n'\n"
        "with WorkerProcess(timeout=60.0) as worker:\n"
        "    assert worker.call(os.getpid) != os.getpid()\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=4 * LIMIT
    )
    assert (done.returncode, done.stdout) == (0, "main\n"), done.stderr
