"""A disk that fails (EIO, EDQUOT, ENOSPC) at a random operation of a campaign.

Complete archives stay complete, the error names file and remedy, and the same command completes
once the disk works.
"""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from drivers.transports.simulated import SimulatedTransport
from hil.base.errors import ArchiveError, HilError, NotAnArchiveError, OutputError
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan
from hil.cell import Cell
from hil.cli import app
from hil.control.simulated_cell import controller_settings, simulated_controller
from hil.control.virtual_link import VirtualLink
from tests.disk.disks import Disk, planted_disk
from tests.faults import CREATE, REFUSALS, RENAME, SYNC, WRITE, DiskFault, parse_disk_fault
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal
from tests.laws.errors import OF_DISKS
from tests.laws.evidence import ArchiveFile, Evidence, Rest, entries_of
from tests.laws.manifests import Entry
from tests.laws.table import Scenario, broken, judged

pytestmark = pytest.mark.safety

DONE = {
    "*": {CREATE: 15, WRITE: 130, SYNC: 130, RENAME: 8},
    "*.mcap": {CREATE: 7, WRITE: 130, SYNC: 130},
    "manifest.json*": {CREATE: 6, WRITE: 6, SYNC: 6, RENAME: 6},
}  # Least number of operations of a run, by pattern of file names
Designed = tuple[Cell, CampaignPlan]


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disk]:
    with planted_disk(tmp_path_factory.mktemp("disk")) as made:
        yield made


@pytest.fixture(autouse=True)
def reset_disk(disk: Disk) -> Iterator[None]:
    yield
    disk.do_wrong()


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Designed:
    folder = tmp_path_factory.mktemp("designed")
    made = fast_campaign(folder / "campaign", fast_cell(folder, repetitions=2))
    return made.cell, made.plan


def rehearsed(disk: Disk, name: str, designed: Designed) -> Campaign:
    campaign = Campaign.create(disk.root / name, *designed)
    pass_rehearsal(campaign.folder)
    return campaign


def random_rule(rng: random.Random) -> DiskFault:
    """A refusal somewhere in a run: of one operation, or of all from there on."""
    names = rng.choice(sorted(DONE))
    operation = rng.choice(sorted(DONE[names]))
    return DiskFault(
        (operation,),
        names,
        after=rng.randrange(DONE[names][operation]),
        times=rng.choice((0, 0, 1)),
        error=rng.choice(sorted(REFUSALS)),
    )


def entered(campaign: Campaign) -> tuple[Entry, ...]:
    return entries_of(campaign.folder.root)


def files_of(campaign: Campaign) -> tuple[tuple[ArchiveFile, ...], tuple[str, ...]]:
    """Return the archives, and what is wrong with files that cannot be opened.

    A file may be truncated anywhere, if it is not entered before its header.
    """
    in_manifest = {entry.name for entry in entered(campaign)}
    files: list[ArchiveFile] = []
    problems: list[str] = []
    for path in campaign.folder.archives.glob("*.mcap"):
        try:
            files.append(ArchiveFile.of(path, excused=True))
        except NotAnArchiveError:
            if path.name in in_manifest:
                problems.append(f"{path.name} is entered and no archive")
        except ArchiveError as error:
            problems.append(f"{path.name}: {error}")
    return tuple(files), tuple(problems)


def evidence_of(campaign: Campaign, before: tuple[Entry, ...], **parts: Any) -> Evidence:
    files, unreadable = files_of(campaign)
    return Evidence(
        period=campaign.cell.period,
        files=files,
        unreadable=unreadable,
        folder=campaign.folder.root,
        manifests=(before, entered(campaign)),
        **parts,
    )


def refused_run(disk: Disk, campaign: Campaign, rule: DiskFault) -> list[str]:
    """Run on a disk that fails, then on one that works; return the failed operations."""
    root = campaign.folder.root
    struck: list[str] = []

    def refused() -> Evidence:
        before = entered(campaign)
        disk.do_wrong(rule)
        raised = None
        try:
            Campaign.open(root).run(None, None, Silent(), accept_dry_run=True, durable=True)
        except HilError as error:
            raised = error
        struck.extend(disk.do_wrong())
        return evidence_of(campaign, before, disk=(tuple(struck), raised))

    def works() -> Evidence:
        before = entered(campaign)
        result = Campaign.open(root).run(None, None, Silent(), accept_dry_run=True)
        assert result.complete
        counts = (1, campaign.cell.campaign.repetitions, len(campaign.plan.validation))
        motions = {("excitation", k): campaign.plan.excitation.trajectory for k in range(counts[1])}
        motions |= {("validation", k): v.trajectory for k, v in enumerate(campaign.plan.validation)}
        return evidence_of(campaign, before, counts=counts, motions=motions)

    assert judged(Scenario(root.name, (str(rule),), refused)) == []
    assert judged(Scenario(f"{root.name}, resumed", (), works)) == []
    return struck


def rounds(disk: Disk, designed: Designed, seeds: range) -> int:
    count = 0
    for seed in seeds:
        campaign = rehearsed(disk, f"round_{seed}", designed)
        rule = random_rule(random.Random(f"refused/{seed}"))
        try:
            count += bool(refused_run(disk, campaign, rule))
        except Exception as error:
            error.add_note(f"seed {seed}: {rule}")
            raise
        finally:
            disk.do_wrong()
    return count


def test_the_line_of_a_disk_fault_says_all_of_it() -> None:
    for seed in range(200):
        fault = random_rule(random.Random(seed))
        assert parse_disk_fault(str(fault)) == fault
    assert parse_disk_fault("hang=7s@write,fsync:*.mcap").hang == pytest.approx(7.0)


@pytest.mark.parametrize("line", ["EIO", "EIO@sit:*", "ESRCH@write:*", "hang@write:*", "EIO@write"])
def test_an_unreadable_disk_fault_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match="lines are"):
        parse_disk_fault(line)


def test_failing_disk_costs_one_motion_only(disk: Disk, designed: Designed) -> None:
    assert rounds(disk, designed, range(2)) >= 1


@pytest.mark.parametrize("operation", [CREATE, WRITE])
def test_manifest_that_cannot_be_written_is_reported(
    disk: Disk, designed: Designed, operation: str
) -> None:
    campaign = rehearsed(disk, f"manifest_{operation}", designed)
    rule = parse_disk_fault(f"EIO@{operation}+2x1:manifest.json*")
    assert refused_run(disk, campaign, rule) == [f"{operation} manifest.json.tmp"]


def test_campaign_without_manifest_is_removed(disk: Disk, designed: Designed) -> None:
    """Without a manifest it would look like one whose cell file was edited."""
    root = disk.root / "half"
    disk.do_wrong(parse_disk_fault("EDQUOT@rename:manifest.json"))
    with pytest.raises(OutputError, match=r"manifest\.json.*quota exceeded.*make room"):
        Campaign.create(root, *designed)
    assert disk.do_wrong()
    assert list(root.iterdir()) == []
    assert Campaign.create(root, *designed).folder.sealed


@pytest.mark.slow
def test_rehearsal_passes_after_a_disk_error(disk: Disk, designed: Designed) -> None:
    for number, (operation, after) in enumerate(((WRITE, 40), (RENAME, 12), (SYNC, 8))):
        campaign = Campaign.create(disk.root / f"rehearsed_{number}", *designed)
        disk.do_wrong(parse_disk_fault(f"EIO@{operation}+{after}:*"))
        with pytest.raises(HilError) as raised:
            campaign.rehearse()
        refused = (tuple(disk.do_wrong()), raised.value)
        assert refused[0]
        assert broken(Evidence(folder=campaign.folder.root, disk=refused)) == []
        assert Campaign.open(campaign.folder.root).rehearse().passed


@pytest.mark.slow
def test_many_failures_cost_one_motion_only(disk: Disk, designed: Designed) -> None:
    assert rounds(disk, designed, range(100, 140)) > 20


STAGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "design":
        ("design cell/cell.toml --settings short.toml -o designed --workers 1", ("designed",)),
    "compare":
        ("compare campaign second -o pages/compare.html", ("pages", "campaign", "second")),
    "rehearse": ("rehearse campaign --again", ("campaign",)),
    "identify": ("identify campaign --quiet", ("campaign",)),
    "report": ("report campaign", ("campaign",)),
    "batch": ("batch campaign --output batch --quiet", ("batch", "campaign")),
    "plot": ("plot campaign/archives/excitation_000_a1.mcap --output plot.png", ("plot.png",)),
    "repair": ("archive repair excitation_000_a1.mcap", ("excitation_000_a1_repaired.mcap",)),
    "new": ("new --urdf campaign/robot.urdf --output new.toml --force", ("new.toml",)),
}  # fmt: skip
"""Commands that write, and where."""
SHORT = {"population": 8, "generations": 1}  # settings of the shortest search


def hil(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in arguments])


@pytest.fixture(scope="module")
def prepared(disk: Disk, designed: Designed) -> Campaign:
    """Complete a campaign; add a second one, a cell file, and settings of a short search."""
    campaign = rehearsed(disk, "campaign", designed)
    campaign.run(accept_dry_run=True)
    campaign.identify()
    (disk.root / "cell").mkdir()
    cell = fast_cell(disk.root / "cell", repetitions=2)
    other = Cell.from_texts(cell.text.replace("seed = 3", "seed = 4"), cell.urdf, cell.path)
    Campaign.create(disk.root / "second", other, campaign.plan).run(unrehearsed=True)
    settings = hil("design", "--show-settings", "b").output
    for key, value in SHORT.items():
        settings, count = re.subn(rf"(?m)^{key} = \d+", f"{key} = {value}", settings)
        assert count == 1, settings
    (disk.root / "short.toml").write_text(settings)
    return campaign


@pytest.mark.slow
class TestCommands:
    """Commands report a full or read-only disk, and work once it accepts their files."""

    @pytest.mark.parametrize("error", ["ENOSPC", "EROFS"])
    @pytest.mark.parametrize("stage", sorted(STAGES))
    def test_refusal_is_reported(
        self,
        disk: Disk,
        prepared: Campaign,
        stage: str,
        error: str,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.chdir(disk.root)
        truncated = disk.root / "excitation_000_a1.mcap"
        whole = (prepared.folder.archives / truncated.name).read_bytes()
        truncated.write_bytes(whole[: len(whole) // 2])
        (disk.root / "excitation_000_a1_repaired.mcap").unlink(missing_ok=True)
        for made in ("designed", "pages", "batch"):
            shutil.rmtree(disk.root / made, ignore_errors=True)
        before = entered(prepared)
        command, written = STAGES[stage]
        disk.do_wrong(parse_disk_fault(f"{error}@all:*"))
        refused = hil(*command.split())
        assert disk.do_wrong()
        assert entered(prepared) == before
        text = str(refused.exception)
        if isinstance(refused.exception, SystemExit):  # printed by a command for several files
            text = refused.output.partition("error: ")[2]
        assert any(cause in text for cause in OF_DISKS), f"{text} {refused.output}"
        blamed = Path(text.partition(": ")[0]).resolve()
        assert any(blamed.is_relative_to(disk.root.resolve() / place) for place in written), text
        again = hil(*command.split())
        expected = {"repair": 3}.get(stage, 0)  # the end of the archive is lost
        assert again.exit_code == expected, f"{again.exception!r} {again.output}"


@pytest.fixture
def small(tmp_path: Path) -> Campaign:
    return fast_campaign(tmp_path / "campaign", fast_cell(tmp_path, repetitions=1))


def remove_at(
    monkeypatch: pytest.MonkeyPatch, campaign: Campaign, archive: str, parts: Sequence[str]
) -> None:
    """Remove parts of the folder when an archive has been written to five times."""
    true = os.write
    count = 0

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
    link = VirtualLink.over(SimulatedTransport(controller), small.cell, finish=controller.finish)
    remove_at(monkeypatch, small, "excitation_000_a1.mcap", parts)
    with pytest.raises(HilError) as raised:
        small.run(link, None, Silent(), accept_dry_run=True, durable=True)
    monkeypatch.undo()
    assert raised.value.exit_code in (1, 2)
    assert str(root) in str(raised.value)
    assert "check whether it was moved or removed" in str(raised.value)
    rest = Rest("at the end", controller.plant.velocity, 1e-3)
    assert broken(Evidence(rests=(rest,))) == []
