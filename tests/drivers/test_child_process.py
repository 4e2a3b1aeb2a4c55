"""A child process: what it inherits, its error output, and how its end is seen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.child_process import ChildProcess

pytestmark = pytest.mark.safety

LIMIT = 60.0  # s for a new interpreter on a busy computer


@pytest.fixture
def started() -> Iterator[list[ChildProcess]]:
    children: list[ChildProcess] = []
    yield children
    for child in children:
        child.kill()
        child.close()


def run(children: list[ChildProcess], code: str, *arguments: str, **how: object) -> ChildProcess:
    child = ChildProcess(("-c", code, *arguments), **how)  # type: ignore[arg-type]
    children.append(child)
    return child


def test_error_output_is_kept_and_names_the_end(started: list[ChildProcess]) -> None:
    failing = run(started, "import sys; print('first', file=sys.stderr); raise ValueError('bad')")
    assert failing.wait(LIMIT) == 1
    assert not failing.alive
    failing.close()
    failing.close()
    assert failing.errors.startswith("first\n")
    assert failing.last_error == "ValueError: bad"
    silent = run(started, "raise SystemExit(3)")
    assert silent.wait(LIMIT) == 3
    assert silent.last_error == "exit status 3"


def test_its_output_is_read_while_it_runs_and_after(started: list[ChildProcess]) -> None:
    code = "import time; print('port 7', flush=True); time.sleep(600)"
    child = run(started, code)
    while "\n" not in child.output:
        assert child.wait(0.05) is None
    assert (child.output, child.errors, child.alive) == ("port 7\n", "", True)
    child.kill()
    child.close()
    assert child.output == "port 7\n"


def test_a_signal_ends_it(started: list[ChildProcess]) -> None:
    sleeping = run(started, "import time; time.sleep(600)")
    assert (sleeping.alive, sleeping.status, sleeping.wait(0.0)) == (True, None, None)
    sleeping.terminate()
    assert sleeping.wait(LIMIT) == -signal.SIGTERM
    sleeping.terminate()  # it has ended


def test_it_has_its_descriptors_and_a_session_of_its_own(
    started: list[ChildProcess],
) -> None:
    ours, theirs = os.pipe()
    code = "import os, sys; os.write(int(sys.argv[1]), str(os.getsid(0)).encode())"
    child = run(started, code, str(theirs), descriptors=[theirs])
    os.close(theirs)
    assert int(os.read(ours, 20)) == child.pid != os.getsid(0)
    os.close(ours)


def test_it_imports_from_the_same_folders_not_the_main_module(tmp_path: Path) -> None:
    """A program that starts one at its top level does not start programs without end."""
    (tmp_path / "beside.py").write_text("raise SystemExit(7)\n")
    program = tmp_path / "program.py"
    program.write_text(
        "from drivers.child_process import ChildProcess\n"
        f"print(ChildProcess(('-c', 'import beside')).wait({LIMIT}))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path or "." for path in sys.path)}
    done = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout == "7\n"


def test_one_that_is_refused_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    before = set(Path("/proc/self/fd").iterdir())
    with pytest.raises(BlockingIOError, match="no more processes"):
        ChildProcess(("-c", ""))
    assert set(Path("/proc/self/fd").iterdir()) == before
