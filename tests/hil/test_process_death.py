"""Whatever dies in mid-motion, the arm stops on its path and what was recorded is readable.

Real processes over the loopback device: a simulated controller, the exchange, the archive process,
and a supervisor that runs a campaign (`live_rig.py`). What is asked is what happens, not how fast:
the controller waits for answers where this machine pauses.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.states import State
from hil.archive import Archive, open_archive
from hil.campaign import Campaign, CampaignPlan, Stop
from hil.cell import Cell
from hil.demo_link import SIMULATE, free_port
from hil.errors import HilError
from hil.progress import Silent
from hil.simulation import simulated_link

PATIENCE = 30.0
"""s for anything that has to happen."""
SPEED = 0.5
"""rad/s of some joint from which on the arm counts as being in mid-motion."""


@dataclass(eq=False)
class Rig:
    """A campaign under way, and every process that has a part in it."""

    campaign: Campaign
    supervisor: subprocess.Popen[str]
    controller: subprocess.Popen[str]
    exchange: int
    archive: int

    @property
    def path(self) -> Path:
        """The archive of the excitation."""
        return self.campaign.folder.archives / "excitation_000_a1.mcap"

    def wait_for_motion(self) -> None:
        """Until the arm moves fast in the excitation, as far as its archive tells."""
        wait(lambda: self.path.exists() and speed(self.path) > SPEED)

    def ended(self) -> dict[str, Any]:
        """Wait for the end of the supervisor; what it said last."""
        said, errors = self.supervisor.communicate(timeout=PATIENCE)
        assert self.supervisor.returncode != 1, errors
        return dict(json.loads(said.strip().splitlines()[-1])) if said.strip() else {}

    def wait_for_processes(self) -> None:
        """Until exchange and archive process are gone."""
        wait(lambda: not running(self.exchange) and not running(self.archive))

    def summary(self) -> dict[str, Any]:
        """End the controller properly; what it says of the session."""
        self.controller.send_signal(signal.SIGTERM)
        said, _ = self.controller.communicate(timeout=PATIENCE)
        return dict(json.loads(said.strip().splitlines()[-1]))

    def ring(self) -> NDArray[np.void]:
        """The last records, from the exchange's memory."""
        records: NDArray[np.void] = np.load(self.campaign.folder.root.parent / "ring.npy")
        return records


def wait(for_what: Any) -> None:
    deadline = time.monotonic() + PATIENCE
    while not for_what():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.05)


def running(pid: int) -> bool:
    """Whether a process lives (a zombie does not)."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    return False


def speed(path: Path) -> float:
    """Joint speed commanded last in an archive that is being written, rad/s."""
    with suppress(HilError):
        velocity = open_archive(path).columns.get("commanded_velocity", np.zeros((0, 1)))
        moving = velocity[~np.isnan(velocity).any(axis=1)]
        return float(np.abs(moving[-1]).max()) if len(moving) else 0.0
    return 0.0


@pytest.fixture
def rig(tmp_path: Path, cell: Cell, plan: CampaignPlan) -> Iterator[Rig]:
    """A campaign of one excitation and one validation run, started."""
    local = cell.with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1")
    one = CampaignPlan(plan.excitation, plan.validation[:1])
    short = local.with_campaign(repetitions=1, validation_runs=1)
    campaign = Campaign.create(tmp_path / "campaign", short, one)
    # Approach, standstill, excitation; then the controller ends the session.
    port, environment = free_port(), os.environ | {"OMP_NUM_THREADS": "1"}
    with (
        subprocess.Popen(
            [*SIMULATE, str(campaign.folder.cell), "--udp", f"127.0.0.1:{port}", "--json",
             "--patience", "2", "--intervals", "3"],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        ) as controller,
        subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("live_rig.py")),
             str(campaign.folder.root), str(port)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
            start_new_session=True,
        ) as supervisor,
    ):  # fmt: skip
        assert supervisor.stdout is not None
        pids = json.loads(supervisor.stdout.readline())
        try:
            yield Rig(campaign, supervisor, controller, **pids)
        finally:
            for pid in (supervisor.pid, controller.pid, *pids.values()):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


def on_the_path(campaign: Campaign, commanded: NDArray[np.float64]) -> bool:
    """Whether every set-point lies on the planned excitation, rounding of the start apart."""
    trajectory = campaign.plan.excitation.trajectory
    step = 1e-4  # s
    samples = np.arange(0.0, trajectory.duration, step)
    path, velocity, _ = trajectory.sample(samples)
    between = 0.5 * step * np.abs(velocity).max()
    offset = commanded[0] - path[0]
    assert np.abs(offset).max() < 1e-5
    return all(
        np.abs(path + offset - position).max(axis=1).min() <= between + 1e-9
        for position in commanded[::50]
    )


def require_stopped_on_path(campaign: Campaign, records: Any) -> None:
    """The arm was moving, left the plan's time but not its path, and came to rest before its end.

    `records` are columns by name: of an archive, or of the ring.
    """
    sent = ~np.isnan(records["commanded_position"]).any(axis=1)
    commanded = np.asarray(records["commanded_position"])[sent]
    velocity = np.asarray(records["commanded_velocity"])[sent]
    assert np.abs(velocity).max() > SPEED
    assert np.all(velocity[-1] == 0.0)
    assert on_the_path(campaign, commanded)
    trajectory = campaign.plan.excitation.trajectory
    end = trajectory.sample(np.array([trajectory.duration]))[0][0]
    assert np.abs(commanded[-1] - end).max() > 1e-3, "it was stopped, not finished"
    assert np.abs(records["velocity"][-1]).max() < 0.01
    state = np.asarray(records["state"])
    last_open = np.flatnonzero(np.isin(state, (State.OPEN, State.EXITING)))[-1]
    assert state[last_open] == State.EXITING
    assert state[last_open + 1] == State.CLOSED


def excitation_in(ring: NDArray[np.void]) -> NDArray[np.void]:
    """Records of the last interval in open mode, and what followed."""
    last = ring["interval"].max()
    first = int(np.argmax(ring["interval"] == last))
    records: NDArray[np.void] = ring[first:]
    return records


def require_resumed(campaign: Campaign) -> None:
    """The rest of the campaign runs (in virtual time), and the excitation is done again."""
    again = Campaign.open(campaign.folder.root)
    link = simulated_link(again.cell, instead_of_hardware=True)
    again.run(
        link,
        Stop(),
        Silent(),
        provenance={"simulated": "yes"},
        durable=False,
        unrehearsed=True,
    )
    done = [path.name for kind in ("excitation", "validation") for path in
            again.folder.completed(kind)]  # fmt: skip
    assert done == ["excitation_000_a2.mcap", "validation_000_a1.mcap"]


def outcome_of(archive: Archive) -> tuple[str, str]:
    assert archive.outcome is not None
    return archive.outcome.entries["outcome"], archive.outcome.entries["reason"]


@pytest.mark.slow
def test_a_killed_supervisor_leaves_a_stopped_arm_and_a_whole_archive(rig: Rig) -> None:
    rig.wait_for_motion()
    rig.supervisor.kill()
    rig.wait_for_processes()
    archive = open_archive(rig.path)
    assert archive.complete
    outcome, reason = outcome_of(archive)
    assert outcome == "stopped"
    assert "supervisor" in reason
    require_stopped_on_path(rig.campaign, archive.columns)
    assert rig.summary()["rejected"] == 0
    require_resumed(rig.campaign)


@pytest.mark.slow
def test_a_hung_up_terminal_takes_the_supervisor_and_nothing_else(rig: Rig) -> None:
    rig.wait_for_motion()
    os.killpg(rig.supervisor.pid, signal.SIGHUP)
    rig.wait_for_processes()
    archive = open_archive(rig.path)
    assert archive.complete
    assert outcome_of(archive)[0] == "stopped"
    require_stopped_on_path(rig.campaign, archive.columns)


def test_ctrl_c_in_the_terminal_stops_the_arm_on_its_path(rig: Rig) -> None:
    rig.wait_for_motion()
    os.killpg(rig.supervisor.pid, signal.SIGINT)
    said = rig.ended()
    assert said["error"] == "MotionFailedError"
    assert rig.supervisor.returncode == 4
    rig.wait_for_processes()
    archive = open_archive(rig.path)
    assert archive.complete
    assert outcome_of(archive)[0] == "stopped"
    require_stopped_on_path(rig.campaign, archive.columns)


@pytest.mark.slow
def test_a_killed_archive_process_stops_the_arm_and_costs_its_last_chunk(rig: Rig) -> None:
    rig.wait_for_motion()
    os.kill(rig.archive, signal.SIGKILL)
    said = rig.ended()
    assert said["error"] == "ControllerFault"
    assert "the archive process ended" in said["text"]
    rig.wait_for_processes()
    archive = open_archive(rig.path)
    assert not archive.complete
    ring = excitation_in(rig.ring())
    require_stopped_on_path(rig.campaign, ring)
    # What is in the file is what the link saw, cycle for cycle, up to its last chunk.
    assert speed(rig.path) > SPEED
    cycle = archive.columns["cycle"]
    seen = ring["cycle"]
    both = (max(seen[0], cycle[0]) <= seen) & (seen <= cycle[-1])
    assert both.any()
    assert np.array_equal(seen[both], cycle[cycle >= seen[both][0]])
    require_resumed(rig.campaign)


def test_an_archive_process_that_hangs_stops_the_arm_and_is_ended(rig: Rig) -> None:
    rig.wait_for_motion()
    os.kill(rig.archive, signal.SIGSTOP)
    said = rig.ended()
    assert said["error"] == "ControllerFault"
    assert "gave no sign of life for 5 s and was ended; the arm was brought to rest" in said["text"]
    assert rig.path.name in said["text"]
    rig.wait_for_processes()
    require_stopped_on_path(rig.campaign, excitation_in(rig.ring()))


def test_a_full_disk_stops_the_arm_and_what_was_flushed_is_whole(rig: Rig) -> None:
    rig.wait_for_motion()
    size = rig.path.stat().st_size
    resource.prlimit(rig.archive, resource.RLIMIT_FSIZE, (size + 1000, size + 1000))
    said = rig.ended()
    assert said["error"] == "ArchiveWriteError"
    assert "cannot be written further" in said["text"]
    assert rig.supervisor.returncode == 2
    rig.wait_for_processes()
    archive = open_archive(rig.path)
    assert not archive.complete
    assert archive.n_samples > 0
    require_stopped_on_path(rig.campaign, excitation_in(rig.ring()))


@pytest.mark.slow
def test_a_killed_exchange_is_named_and_what_it_left_behind_is_archived(rig: Rig) -> None:
    rig.wait_for_motion()
    os.kill(rig.exchange, signal.SIGKILL)
    said = rig.ended()
    assert said["error"] == "ControllerFault"
    assert "exchange process ended" in said["text"]
    rig.wait_for_processes()
    archive = open_archive(rig.path)
    assert archive.complete
    assert outcome_of(archive) == ("lost", "the exchange process ended")
    assert archive.columns["cycle"][-1] == rig.ring()["cycle"][-1]
    # The controller is alone: unanswered, it ends open mode by its own watch.
    summary = rig.summary()
    assert summary["missed"] > 0
