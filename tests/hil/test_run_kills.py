"""A real `hil run`, killed at random moments, and finished by the next ones."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import numpy as np
import pytest

from hil.archive import ArchiveName, open_archive
from hil.campaign import Campaign
from hil.cell import Cell
from hil.demo_link import LOOPBACK, SimulatorProcess, free_port
from hil.identify import identify_campaign
from hil.progress import Silent
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal

PATIENCE = 120.0
"""s for a process to get on, on a machine that does other things as well."""
RUN = (sys.executable, "-m", "hil", "run")


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder))


def started(root: Path, *options: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*RUN, str(root), "--no-identify", "--json", *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def kill_after(process: subprocess.Popen[bytes], root: Path, new: int, delay: float) -> bool:
    """SIGKILL `delay` s after `new` more archives were begun; False if it ended before."""
    before = len(list((root / "archives").iterdir()))
    deadline = time.monotonic() + PATIENCE
    while len(list((root / "archives").iterdir())) < before + new:
        if process.poll() is not None:
            process.communicate()
            return False
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(delay)
    killed = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return killed


@contextmanager
def simulator(cell: Path, port: int) -> Iterator[None]:
    """A controller over loopback UDP for the PC's side at `port`."""
    far = f"{LOOPBACK}:{port}"
    process = SimulatorProcess.start(cell, "--udp", far, "--patience", "0.5")
    try:
        yield
    finally:
        process.finish()
        process.end()


def wait_until_free(port: int) -> None:
    """Until the exchange process that was left alone has ended."""
    deadline = time.monotonic() + PATIENCE
    while True:
        with socket(AF_INET, SOCK_DGRAM) as probe:
            try:
                probe.bind((LOOPBACK, port))
                return
            except OSError:
                assert time.monotonic() < deadline
        time.sleep(0.1)


def finished(root: Path, *options: str) -> dict[str, object]:
    process = started(root, *options)
    out, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors.decode()
    told: dict[str, object] = json.loads(out)
    return told


def require_whole(campaign: Campaign, undisturbed: Campaign) -> None:
    """Each interval is there once, as planned, and what is found in all of them is the same."""
    for kind in ("dryrun", "standstill", "excitation", "validation"):
        there = [ArchiveName.parse(path) for path in campaign.folder.completed(kind)]
        wanted = [ArchiveName.parse(path) for path in undisturbed.folder.completed(kind)]
        assert [one.index for one in there if one] == [one.index for one in wanted if one]
        entered = Counter(
            (name.kind, name.index)
            for entry in campaign.folder.manifest()
            if entry.outcome == "completed" and (name := ArchiveName.parse(entry.name))
            if name.kind == kind
        )
        assert set(entered.values()) == {1}, "nothing whole was done again"
        for path in campaign.folder.completed(kind):
            assert open_archive(path).complete
    found = [identify_campaign(one.folder.root, Silent()) for one in (campaign, undisturbed)]
    assert all(one.verdict.good for one in found)
    one, other = (result.estimate.pooled for result in found)
    apart = np.abs(one.values - other.values) / np.hypot(one.std, other.std)
    assert np.max(apart) < 4.0


@pytest.mark.slow  # tests.process_death kills a supervisor in as many ways in each run of the tests
@pytest.mark.parametrize("times", [2, 5])
def test_a_campaign_that_is_killed_is_finished_and_finds_the_same(
    tmp_path: Path, designed: Campaign, times: int
) -> None:
    chance = random.Random(20140901)
    cell = fast_cell(tmp_path, repetitions=times + 1)
    undisturbed = Campaign.create(tmp_path / "undisturbed", cell, designed.plan)
    campaign = Campaign.create(tmp_path / "killed", cell, designed.plan)
    for one in (undisturbed, campaign):
        pass_rehearsal(one.folder)
    undisturbed.run(accept_dry_run=True, durable=False)

    kills = 0
    root = campaign.folder.root
    for new in (1, 2, 2, 2, 2, 2):
        process = started(root, "--accept-dry-run")
        kills += kill_after(process, root, new, chance.uniform(0.0, 0.15))
        if kills == times:
            break
    assert kills == times
    last = Campaign.open(root).run(accept_dry_run=True, durable=False)
    assert last.complete
    assert last.repetitions == (times + 1, times + 1)
    require_whole(Campaign.open(root), undisturbed)


@pytest.mark.slow
def test_over_real_sockets_a_killed_supervisor_leaves_an_arm_at_rest_and_a_campaign_to_finish(
    tmp_path: Path, designed: Campaign
) -> None:
    """Exchange and archive process outlive it, stop the arm and complete the file."""
    port = free_port()
    cell = fast_cell(tmp_path)
    text = cell.with_link(transport="udp", host=LOOPBACK, bind=LOOPBACK, port=port).text
    campaign = Campaign.create(
        tmp_path / "killed", Cell.from_texts(text, cell.urdf, cell.path), designed.plan
    )
    undisturbed = Campaign.create(tmp_path / "undisturbed", cell, designed.plan)
    for one in (undisturbed, campaign):
        pass_rehearsal(one.folder)
    undisturbed.run(accept_dry_run=True, durable=False)
    root, chance = campaign.folder.root, random.Random(7)
    kills = 0
    for new in (2, 4, 3):
        with simulator(campaign.folder.cell, port):
            process = started(root, "--accept-dry-run")
            kills += kill_after(process, root, new, chance.uniform(0.0, 0.8))
            wait_until_free(port)
    assert kills == 3
    with simulator(campaign.folder.cell, port):
        last = finished(root, "--accept-dry-run")
    assert last["complete"]
    require_whole(Campaign.open(root), undisturbed)
