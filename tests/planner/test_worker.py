from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from planner import InvalidSetting, JointLimits, plan, plan_chunk
from planner.errors import PlannerCrashed, PlannerNotStarted, PlanningTimedOut
from planner.worker import (
    WorkerProcess,
    chunks_of,
    close_child,
    in_child,
    map_in_children,
    plan_in_child,
)
from tests.planner.six_axes import SIX_AXES, join, random_points

pytestmark = pytest.mark.long

# Legal states that crash community ruckig 0.19.4: |a| exactly at its limit.
CRASH = {
    "position": -2.8452037956537097,
    "velocity": 0.4654211338651546,
    "acceleration": 9.30842267730309,
    "max_velocity": 2.792526803190927,
    "max_jerk": 93.08422677303089,
}

# A solver that aborts its process for a very slow joint.
ABORTING = """
import os, sys
from importlib.util import module_from_spec, spec_from_file_location
_spec = spec_from_file_location("ruckig", {real!r})
_real = module_from_spec(_spec)
_spec.loader.exec_module(_real)
__version__ = _real.__version__
InputParameter, Trajectory = _real.InputParameter, _real.Trajectory
Synchronization, RuckigError = _real.Synchronization, _real.RuckigError
class Ruckig:
    def __init__(self, n):
        self._real = _real.Ruckig(n)
    def calculate(self, problem, trajectory):
        v, a, j = problem.max_velocity[0], problem.max_acceleration[0], problem.max_jerk[0]
        if v * j / a**2 < 0.1:  # in whatever units
            os.abort()
        return self._real.calculate(problem, trajectory)
"""
CREEP = 1e-3


@pytest.fixture
def aborting_solver(tmp_path, monkeypatch):
    import ruckig

    (tmp_path / "ruckig.py").write_text(ABORTING.format(real=ruckig.__file__), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    close_child()  # one that was started before would have the real solver
    yield
    close_child()


def same(motion, other) -> bool:
    return all(
        np.array_equal(a, b)
        for a, b in zip(
            motion.knots + motion.coefficients, other.knots + other.coefficients, strict=True
        )
    )


def gone(pid: int, within: float) -> bool:
    end = time.monotonic() + within
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state[0] == "Z":  # ended, but not reaped in this container
            return True
        time.sleep(0.02)
    return False


def test_states_that_crash_the_solver_are_not_passed_to_it():
    limits = JointLimits(
        [-3.0], [3.0], [CRASH["max_velocity"]], [CRASH["acceleration"]], [CRASH["max_jerk"]]
    )
    p = CRASH["position"]
    v = CRASH["velocity"]
    a = CRASH["acceleration"]
    assert join(np.array([[p, -v, a]]), np.array([[p, v, a]]), limits, 0.1) is None


def test_plans_of_a_child_are_the_same_and_read_only():
    points = random_points(3)
    motion = plan_in_child(points, SIX_AXES, fly=0.25)
    assert same(motion, plan(points, SIX_AXES, fly=0.25))
    assert not motion.knots[0].flags.writeable
    assert not motion.coefficients[0].flags.writeable


def test_errors_have_attributes_and_traceback_of_the_child():
    with pytest.raises(InvalidSetting, match="fly = 2") as caught:
        plan_in_child(random_points(3), SIX_AXES, fly=2.0)
    assert (caught.value.name, caught.value.value) == ("fly", 2.0)
    with pytest.raises(ZeroDivisionError) as unexpected:
        in_child(divmod, 1, 0)
    assert "in the planning process" in unexpected.value.__notes__[0]


@contextmanager
def workers(count):
    """Worker processes, ended afterwards."""
    with ExitStack() as stack:
        yield [stack.enter_context(WorkerProcess()) for _ in range(count)]


def together(children, points, limits, speed=None):
    """Motions through points, planned by workers in chunks as in a search."""
    shares = np.ones((len(points), limits.n_joints)) if speed is None else speed

    def arguments(chunk):
        return [points[index] for index in chunk], shares[list(chunk)], limits, 0.5

    return map_in_children(children, plan_chunk, chunks_of(len(points), 32), arguments)


def test_a_solver_that_aborts_ends_the_child_only(aborting_solver):
    points = random_points(5)
    with WorkerProcess() as child:
        before = child.call(os.getpid)
        assert child.call(os.getpid) == before == child.pid
        for _ in range(2):
            with pytest.raises(PlannerCrashed, match="signal 6") as caught:
                child.call(plan, points, SIX_AXES, speed=CREEP)
            assert caught.value.status == -signal.SIGABRT
        assert child.call(os.getpid) != before
        assert same(child.call(plan, points, SIX_AXES), plan(points, SIX_AXES))
    assert gone(before, 5.0)
    with pytest.raises(PlannerCrashed):
        plan_in_child(points, SIX_AXES, speed=CREEP)
    assert same(plan_in_child(points, SIX_AXES), plan(points, SIX_AXES))


def test_a_process_that_cannot_start_has_its_own_error(tmp_path, monkeypatch):
    (tmp_path / "ruckig.py").write_text("raise SystemExit(3)", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    with workers(2) as children, pytest.raises(PlannerNotStarted, match="status 3"):
        together(children, [random_points(0)] * 3, SIX_AXES)
    with WorkerProcess() as child:
        with pytest.raises(PlannerNotStarted, match="status 3"):
            child.call(abs, -1)
        (tmp_path / "ruckig.py").unlink()
        assert child.call(abs, -1) == 1


def test_a_call_that_takes_too_long_is_ended():
    with WorkerProcess(timeout=2.0) as child:
        pid = child.call(os.getpid)
        with pytest.raises(PlanningTimedOut, match="2 s"):
            child.call(time.sleep, 60.0)
        assert gone(pid, 5.0)
        assert child.call(abs, -1) == 1


@pytest.mark.parametrize("task", ["", "child.begin(time.sleep, 60.0)"], ids=["idle", "busy"])
def test_a_child_ends_with_its_parent(task):
    script = f"""
import os, signal, time
from planner.worker import WorkerProcess
child = WorkerProcess(timeout=3600.0)
print(child.call(os.getpid), flush=True)
{task}
time.sleep(0.2)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert gone(int(done.stdout), 2.0), done.stderr


def test_a_forked_process_plans_in_a_child_of_its_own():
    """Else it could receive the motions of its parent, and run them."""
    script = """
import os
from planner.worker import in_child
ours = in_child(os.getpid)
if os.fork() == 0:
    os._exit(7 if in_child(os.getpid) not in (ours, os.getpid()) else 1)
assert os.waitstatus_to_exitcode(os.wait()[1]) == 7
assert in_child(os.getpid) == ours, "the parent keeps its child"
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_crash_costs_a_search_one_individual(aborting_solver):
    points = np.array([random_points(seed) for seed in range(80)])
    speed = np.ones((80, 6))
    deadly = [0, 41, 79]
    speed[deadly, 0] = CREEP
    with workers(2) as children:
        planned = together(children, points, SIX_AXES, speed)
        assert [
            i for i, motion in enumerate(planned) if isinstance(motion, PlannerCrashed)
        ] == deadly
        for index in sorted({*range(80)} - {*deadly}):
            (alone,) = plan_chunk(points[[index]], speed[[index]], SIX_AXES, 0.5)
            assert same(planned[index], alone)
        again = together(children, points[:40], SIX_AXES)
        assert not any(isinstance(motion, Exception) for motion in again)


def test_ctrl_c_ends_a_search_and_its_workers():
    script = """
import numpy as np
from planner.worker import WorkerProcess, map_in_children
with WorkerProcess() as one, WorkerProcess() as other:
    print(*(child.call(__import__("os").getpid) for child in (one, other)), flush=True)
    map_in_children([one, other], np.negative, [[k] for k in range(10**7)], lambda k: (k,))
"""
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as search:
        pids = [int(pid) for pid in search.stdout.readline().split()]
        time.sleep(0.3)
        os.killpg(search.pid, signal.SIGINT)
        _, errors = search.communicate(timeout=10.0)
    assert search.returncode == -signal.SIGINT
    assert errors.count("Traceback") == 1
    assert errors.rstrip().endswith("KeyboardInterrupt")
    assert len(pids) == 2
    assert all(gone(pid, 5.0) for pid in pids)


@pytest.fixture
def importable(monkeypatch):
    """Make the functions of these tests importable in a child."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


def killed_so_often(indices, folder, often):
    """Negate; end the process some times at item 5, as if from outside."""
    for index in indices:
        count = len(list(Path(folder).iterdir()))
        if index == 5 and count < often:
            (Path(folder) / str(count)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return [-index for index in indices]


@pytest.mark.parametrize(("size", "often"), [(1, 1), (4, 2), (1, 99)])
def test_an_item_killed_from_outside_is_tried_again(size, often, tmp_path, importable):
    """Alone and within a chunk; an item that ends every process is an error."""
    finished = []
    with WorkerProcess() as child:
        results = map_in_children(
            [child],
            killed_so_often,
            chunks_of(9, size),
            lambda chunk: (list(chunk), str(tmp_path), often),
            done=finished.append,
        )
    assert sum(finished) == 9
    if often == 99:
        assert isinstance(results.pop(5), PlannerCrashed)
        assert len(list(tmp_path.iterdir())) == 2
    assert results == [-index for index in range(9) if often < 99 or index != 5]


def test_a_child_killed_while_it_starts_is_started_again():
    """So are those ended by an exception of the function."""
    with workers(2) as children:
        os.kill(children[0].pid, signal.SIGKILL)
        results = map_in_children(children, list, chunks_of(9, 3), lambda chunk: (chunk,))
        assert results == list(range(9))
        with pytest.raises(ZeroDivisionError):
            map_in_children(children, operator.truediv, chunks_of(3, 2), lambda _: (1, 0))
        assert map_in_children(children, list, chunks_of(2, 1), lambda chunk: (chunk,)) == [0, 1]
