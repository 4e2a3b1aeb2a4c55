"""A real `hil run` over loopback UDP on a disk that hangs: no loss, or a stop with its cause."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from hil.archive import ArchiveOutcome, open_archive
from hil.base.errors import ControllerError
from hil.base.progress import Silent
from hil.campaign import Campaign
from hil.cell import Cell
from hil.control.simulator_process import LOOPBACK, SimulatorProcess
from tests.disk.disks import Disk, processes_disk
from tests.faults import DiskFault, parse_disk_fault
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal
from tests.hil.loopback import loopback_link, on_loopback
from tests.laws.evidence import ArchiveFile, Broken, Evidence
from tests.laws.table import broken

pytestmark = pytest.mark.safety

PATIENCE = 120.0  # s for a process on a loaded computer
RUN = (sys.executable, "-m", "hil", "run")


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disk]:
    with processes_disk(tmp_path_factory.mktemp("disk")) as made:
        yield made


@dataclass(frozen=True)
class Ended:
    """Exit status and output of a run, and the summary of the simulated controller."""

    status: int
    output: str
    arm: dict[str, object]


def made(disk: Disk, name: str, folder: Path) -> Campaign:
    cell = fast_cell(folder, repetitions=1, n_via=7)
    text = on_loopback(cell).text
    campaign = fast_campaign(disk.root / name, Cell.from_texts(text, cell.urdf, cell.path))
    pass_rehearsal(campaign.folder)
    return campaign


def run(campaign: Campaign, disk: Disk, rule: DiskFault | None, after: str) -> Ended:
    """Run a campaign; the rule applies once the file `after` has some content."""
    port = campaign.cell.controller.port
    simulator = SimulatorProcess.start(
        campaign.folder.cell, "--udp", f"{LOOPBACK}:{port}", "--patience", "0.5"
    )
    process = subprocess.Popen(
        [*RUN, str(campaign.folder.root), "--no-identify", "--accept-dry-run", "--quiet"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + PATIENCE
        while rule is not None and process.poll() is None:
            path = campaign.folder.archives / after
            if path.exists() and path.stat().st_size > 30_000:
                disk.do_wrong(rule)
                break
            assert time.monotonic() < deadline
            time.sleep(0.02)
        output = process.communicate(timeout=PATIENCE)[0].decode()
    finally:
        process.kill()
        simulator.finish()
        arm = simulator.end()
    return Ended(process.returncode, output, arm)


def lost(campaign: Campaign) -> list[Broken]:
    """What the laws of archives say: nothing of what was answered is lacking."""
    paths = sorted(campaign.folder.archives.glob("*.mcap"))
    files = tuple(ArchiveFile.of(path) for path in paths)
    return broken(Evidence(period=campaign.cell.period, files=files))


@pytest.mark.slow
@pytest.mark.parametrize("hang", [1.0, 4.0])
def test_hang_of_seconds_loses_nothing(disk: Disk, tmp_path: Path, hang: float) -> None:
    campaign = made(disk, f"hang_{hang:g}", tmp_path)
    rule = parse_disk_fault(f"hang={hang:g}s@write,fsync:*.mcap")
    ended = run(campaign, disk, rule, "dryrun_000_a1.mcap")
    assert "fsync dryrun_000_a1.mcap" in disk.do_wrong()
    assert ended.status == 0, ended.output
    assert "0 rejected" in ended.output
    assert lost(campaign) == []


@pytest.mark.slow
def test_longer_hang_stops_the_arm_and_is_named(disk: Disk, tmp_path: Path) -> None:
    campaign = made(disk, "hang_7", tmp_path)
    rule = parse_disk_fault("hang=7s@write,fsync:*.mcap")
    ended = run(campaign, disk, rule, "dryrun_000_a1.mcap")
    disk.do_wrong()
    assert ended.status == 4
    message = r"dryrun_000_a1\.mcap\) was stopped: .*\(it waited for its disk for [67]\.\d s"
    assert re.search(message, " ".join(ended.output.split())), ended.output
    assert ended.arm["ended"], "open mode was left, and the session ended"
    dry_run = open_archive(campaign.folder.archives / "dryrun_000_a1.mcap")
    assert (dry_run.outcome or ArchiveOutcome()).outcome == "stopped"
    assert lost(campaign) == [], "the ring stored what the disk did not accept"
    again = run(campaign, disk, None, "")
    assert again.status == 0, again.output
    assert lost(campaign) == []


@pytest.mark.slow
def test_link_continues_after_an_archive_that_opened_too_late(
    disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the file would appear after the next run has chosen a free name."""
    campaign = made(disk, "late", tmp_path)
    with loopback_link(campaign.cell) as link:
        with monkeypatch.context() as short:
            short.setattr("hil.control.live_link.OPEN_TIMEOUT", 1.0)
            disk.do_wrong(parse_disk_fault("hang=8s@create:*.mcap"))
            with pytest.raises(ControllerError, match=r"did not open .*move_000_a1\.mcap.*nothing"):
                campaign.run(link, None, Silent(), accept_dry_run=True)
        result = campaign.run(link, None, Silent(), accept_dry_run=True)
        disk.do_wrong()
    assert result.complete
    late = open_archive(campaign.folder.archives / "move_000_a1.mcap")
    assert (late.outcome or ArchiveOutcome()).outcome == "void"
