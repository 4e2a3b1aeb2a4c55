"""Commands on a full disk: each reports it, and works once there is room.

The disk is a file system in memory, which only root may mount.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from drivers.transports.simulated import SimulatedTransport
from hil.campaign import Campaign
from hil.campaign.link import Link
from hil.cell import Cell
from hil.cli import app
from hil.errors import HilError, OutputError
from hil.progress import Silent
from hil.simulation import controller_settings, simulated_controller
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal

SIZE = 64  # MiB of the disk


@dataclass(frozen=True)
class Disk:
    root: Path  # where it is mounted

    @property
    def ballast(self) -> Path:
        return self.root / "ballast"

    def fill(self, left: int) -> None:
        self.empty()
        free = os.statvfs(self.root)
        room = free.f_bavail * free.f_frsize - 1024 * left
        with self.ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, room))

    def empty(self) -> None:
        self.ballast.unlink(missing_ok=True)


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disk]:
    root = tmp_path_factory.mktemp("disk")
    mount = shutil.which("mount")
    if mount is None or os.geteuid() != 0:
        pytest.skip("only root may mount a small file system")
    done = subprocess.run(
        [mount, "-t", "tmpfs", "-o", f"size={SIZE}m", "tmpfs", str(root)],
        capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    try:
        yield Disk(root)
    finally:
        subprocess.run(["umount", "--lazy", str(root)], check=True)


@pytest.fixture(scope="module")
def campaign(disk: Disk, tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    cell = fast_cell(tmp_path_factory.mktemp("cell"), repetitions=3)
    made = fast_campaign(disk.root / "campaign", cell)
    pass_rehearsal(made.folder)
    return made


def hil(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def require_error(result: Result, disk: Disk, *places: str) -> None:
    """Check the error: cause, exit status, and a path below one of these places on the disk."""
    error = result.exception
    if isinstance(error, SystemExit):  # printed by a command for several files
        errors = [line for line in result.output.splitlines() if line.startswith("error: ")]
        text = errors[0].removeprefix("error: ") if errors else result.output
        assert error.code in (1, 2), text
    else:
        assert isinstance(error, HilError), f"{error!r}\n{result.output}"
        assert error.exit_code in (1, 2)
        text = str(error)
    assert "No space left on device" in text, text
    blamed = Path(text.partition(": ")[0]).resolve()
    assert any(blamed.is_relative_to(disk.root.resolve() / place) for place in places), text


def sums(campaign: Campaign) -> dict[str, str]:
    """Digests of the complete archives in the manifest."""
    folder = campaign.folder.archives
    return {
        entry.name: hashlib.sha256((folder / entry.name).read_bytes()).hexdigest()
        for entry in campaign.folder.manifest()
        if (folder / entry.name).exists() and entry.outcome == "completed"
    }


@pytest.mark.parametrize("left", [0, 400])
def test_run_on_a_full_disk_leaves_complete_archives(
    disk: Disk, campaign: Campaign, left: int
) -> None:
    """Each of these fillings lets the run come further than the one before."""
    before = sums(campaign)
    disk.fill(left)
    result = hil("run", campaign.folder.root, "--accept-dry-run", "--no-identify", "--quiet")
    disk.empty()
    require_error(result, disk, "campaign")
    after = sums(campaign)
    assert before.items() <= after.items()
    for path in campaign.folder.archives.glob("*.mcap"):
        checked = hil("archive", "check", path)
        assert checked.exit_code == 0 or path.name not in after


def test_run_completes_once_there_is_room(disk: Disk, campaign: Campaign) -> None:
    disk.empty()
    before = sums(campaign)
    result = hil("run", campaign.folder.root, "--accept-dry-run", "--no-identify", "--quiet")
    assert result.exit_code == 0, result.output
    assert before.items() <= sums(campaign).items()
    assert len(campaign.folder.completed("excitation")) == 3


SHORT = {"population": 8, "generations": 1}
"""Settings of the shortest search."""
STAGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "design":
        ("design cell/cell.toml --settings short.toml -o designed --workers 1", ("designed",)),
    "compare":
        ("compare campaign second -o pages/compare.html", ("pages", "campaign", "second")),
    "rehearse": ("rehearse campaign --again", ("campaign",)),
    "identify": ("identify campaign --quiet", ("campaign",)),
    "report": ("report campaign", ("campaign",)),
    "reidentify": ("reidentify campaign --output batch --quiet", ("batch", "campaign")),
    "plot": ("plot campaign/archives/excitation_000_a1.mcap --output plot.png", ("plot.png",)),
    "repair": ("archive repair excitation_000_a1.mcap", ("excitation_000_a1_repaired.mcap",)),
    "new": ("new --urdf campaign/robot.urdf --output new.toml --force", ("new.toml",)),
}  # fmt: skip
"""Commands that write, and where."""


@pytest.fixture(scope="module")
def prepared(disk: Disk, campaign: Campaign) -> Campaign:
    """Complete the campaign; add a second one, a cell file, and settings of a short search."""
    disk.empty()
    campaign.run(accept_dry_run=True)
    campaign.identify()
    (disk.root / "cell").mkdir()
    cell = fast_cell(disk.root / "cell", repetitions=3)
    text = cell.text.replace("seed = 3", "seed = 4")
    other = Cell.from_texts(text, cell.urdf, cell.path)
    Campaign.create(disk.root / "second", other, campaign.plan).run(unrehearsed=True)
    settings = hil("design", "--show-settings", "b").output
    for key, value in SHORT.items():
        settings, count = re.subn(rf"(?m)^{key} = \d+", f"{key} = {value}", settings)
        assert count == 1, settings
    (disk.root / "short.toml").write_text(settings)
    return campaign


def as_before(disk: Disk, campaign: Campaign) -> None:
    """Make room, write a truncated archive, and remove what the commands make."""
    disk.empty()
    truncated = disk.root / "excitation_000_a1.mcap"
    truncated.write_bytes((campaign.folder.archives / truncated.name).read_bytes()[:100_000])
    (disk.root / "excitation_000_a1_repaired.mcap").unlink(missing_ok=True)
    for made in ("designed", "pages", "batch"):
        shutil.rmtree(disk.root / made, ignore_errors=True)


@pytest.mark.slow
@pytest.mark.parametrize("left", [0, 8])
@pytest.mark.parametrize("stage", sorted(STAGES))
def test_commands_report_a_full_disk_and_work_afterwards(
    disk: Disk, prepared: Campaign, stage: str, left: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = prepared
    monkeypatch.chdir(disk.root)
    as_before(disk, campaign)
    before = sums(campaign)
    disk.fill(left)
    command, written = STAGES[stage]
    full = hil(*command.split())
    disk.empty()
    assert sums(campaign) == before
    if full.exit_code or full.exception:
        require_error(full, disk, *written)
    else:
        assert left, "nothing can be written where nothing is left"
    begun = (disk.root / "designed" / "search.journal").exists()
    if begun:  # the error names the option that resumes the search
        assert "--resume" in f"{full.exception} {full.output}"
    again = hil(*command.split(), *(["--resume"] if begun else []))
    expected = {"repair": 3}.get(stage, 0)  # the end of the archive is lost
    assert again.exit_code == expected, f"{again.exception!r} {again.output}"


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["run", *sorted(STAGES)])
def test_commands_report_a_read_only_folder(
    disk: Disk, prepared: Campaign, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(disk.root)
    as_before(disk, prepared)
    victim = prepared.folder.completed("excitation")[-1]
    victim.rename(victim.with_suffix(".away"))  # so that there is something to run
    command = "run campaign --no-identify" if stage == "run" else STAGES[stage][0]
    subprocess.run(["mount", "-o", "remount,ro", str(disk.root)], check=True)
    try:
        refused = hil(*command.split())
    finally:
        subprocess.run(["mount", "-o", "remount,rw", str(disk.root)], check=True)
        victim.with_suffix(".away").rename(victim)
    error = refused.exception
    text = str(error) if isinstance(error, HilError) else refused.output
    assert "Read-only file system" in text or "cannot be written to" in text, f"{error!r} {text}"
    assert isinstance(error, HilError | SystemExit), f"{error!r}"
    assert refused.exit_code or error, "a command that leaves nothing has failed"


def test_campaign_that_cannot_be_created_leaves_nothing(disk: Disk, campaign: Campaign) -> None:
    disk.fill(4)
    with pytest.raises(OutputError, match=r"No space left on device.*make room"):
        Campaign.create(disk.root / "other", campaign.cell, campaign.plan)
    disk.empty()
    Campaign.create(disk.root / "other", campaign.cell, campaign.plan)


# The folder, or a part of it, is removed while the campaign runs


@pytest.fixture
def small(tmp_path: Path) -> Campaign:
    return fast_campaign(tmp_path / "campaign", fast_cell(tmp_path, repetitions=1))


def remove_at(
    monkeypatch: pytest.MonkeyPatch, campaign: Campaign, archive: str, parts: Sequence[str]
) -> None:
    """Remove parts of the folder when an archive has been written to five times."""
    true, count = os.write, 0

    def write(descriptor: int, data: Any) -> int:
        nonlocal count
        name = Path(f"/proc/self/fd/{descriptor}").readlink().name
        count += name == archive
        if count == 5 and name == archive:
            for part in parts:
                shutil.rmtree(campaign.folder.root / part, ignore_errors=True)
        return true(descriptor, data)

    monkeypatch.setattr(os, "write", write)


@pytest.mark.parametrize("parts", [("archives",), ("",)], ids=["the archives", "all of it"])
def test_removed_folder_is_reported_with_the_arm_at_rest(
    small: Campaign, parts: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = small.folder.root
    controller = simulated_controller(small.cell, settings=controller_settings(small.cell))
    link = Link.over(SimulatedTransport(controller), small.cell, finish=controller.finish)
    remove_at(monkeypatch, small, "excitation_000_a1.mcap", parts)
    with pytest.raises(HilError) as raised:
        small.run(link, None, Silent(), accept_dry_run=True, durable=True)
    monkeypatch.undo()
    assert raised.value.exit_code in (1, 2)
    assert str(root) in str(raised.value)
    assert "check whether it was moved or removed" in str(raised.value)
    assert np.abs(controller.plant.velocity).max() < 1e-3
