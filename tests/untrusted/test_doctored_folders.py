"""A campaign folder in which somebody changed a value: it is read, or refused by an error of ours.

Read as `hil status`, `hil run` and `hil identify` read it: its status, and how it was run.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.archive import ArchiveName, Samples, open_archive, write_samples
from hil.campaign import Campaign, CampaignFolderError
from hil.campaign.dry_run import Acceptance, DryRun
from hil.campaign.folder import CampaignFolder
from hil.campaign.quality import Played
from hil.campaign.rehearsal import Criterion, Rehearsal
from hil.campaign.status import conduct_of
from hil.campaign.warmup import FrictionMeter, WarmUp
from hil.errors import ArchiveError, HilError, InputError
from identification import IdentificationError
from planner import PlannerError

HUGE, DIGITS = 10**400, "9" * 5000
ENTRY = {"name": "excitation_000_a1.mcap", "outcome": "completed", "sha256": "00", "reason": ""}


def read(folder: Path) -> list[str]:
    """What each way into a folder refuses it with; other errors than ours pass through and fail."""
    refused = []
    for way in (lambda: Campaign.open(folder).status(), lambda: conduct_of(CampaignFolder(folder))):
        try:
            way()
        except (HilError, IdentificationError, PlannerError) as error:
            refused.append(str(error))
    return refused


def doctored(path: Path, *place: str, value: object) -> None:
    """Put another value into a JSON file."""
    content = at = json.loads(path.read_text())
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("archives", [ENTRY | {"name": f"excitation_{DIGITS}_a1.mcap"}]),
        ("archives", [ENTRY | {"name": "a" * 300}]),
        ("archives", [ENTRY | {"name": "a\0b"}]),
        ("archives", [ENTRY | {"name": "\ud800.mcap", "reason": "\ud800"}]),
        ("inputs", [[1, 2]]),
        ("inputs", {"plan.json": 3}),
    ],
)
def test_manifest(place: str, value: object, folder: Path) -> None:
    doctored(folder / "manifest.json", place, value=value)
    read(folder)


def test_an_archive_that_cannot_be_read_is_named_and_not_run_again(folder: Path) -> None:
    doctored(folder / "manifest.json", "archives", value=[ENTRY])
    archives = folder / "archives"
    archives.mkdir(exist_ok=True)
    (archives / ENTRY["name"]).symlink_to("/proc/self/mem")  # a file, and reading it fails
    with pytest.raises(CampaignFolderError, match=f"{ENTRY['name']} cannot be read"):
        CampaignFolder(folder).completed("excitation")
    (archives / ENTRY["name"]).unlink()
    assert CampaignFolder(folder).completed("excitation") == []
    assert CampaignFolder(folder).damaged()


@pytest.mark.parametrize("name", [f"excitation_{DIGITS}_a1.mcap", f"move_000_a{DIGITS}.mcap"])
def test_a_number_without_end_is_none_of_an_archive(name: str) -> None:
    assert ArchiveName.parse(name) is None


@pytest.mark.parametrize("mesh", ["m" * 300 + ".stl", "file:///proc/self/mem", "package://m.stl"])
def test_meshes_that_cannot_be_read_are_missing(mesh: str, folder: Path) -> None:
    urdf = folder / "robot.urdf"
    box = '<box size="0.3 0.08 0.08"/>'
    assert box in urdf.read_text()
    urdf.write_text(urdf.read_text().replace(box, f'<mesh filename="{mesh}"/>'))
    read(folder)
    (folder / "cell.toml").write_text("a = " + "[" * 9999)
    assert read(folder)


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    """Not a recording of a motion that hil made."""
    still = Samples(np.arange(50) * 2_000_000, position=np.zeros((50, 2)), torque=np.ones((50, 2)))
    return write_samples(
        tmp_path / "imported.mcap", still, joint_names=("shoulder", "elbow"), metadata={}
    )


def test_an_imported_archive_in_the_place_of_a_recorded_one(imported: Path, folder: Path) -> None:
    campaign = Campaign.open(folder)
    cell, motion = campaign.cell, campaign.plan.excitation.trajectory
    (folder / "archives").mkdir(exist_ok=True)
    shutil.copy(imported, folder / "archives" / "dryrun_000_a1.mcap")
    names = ["dryrun_000_a1.mcap"]
    for way in (
        lambda: DryRun.of(campaign.folder, cell, names, plan_hash="", simulated=True),
        lambda: Played.of(open_archive(imported)),
        lambda: FrictionMeter(cell, motion).measure(imported),
    ):
        with pytest.raises(ArchiveError, match="is no recording of a motion of hil's own"):
            way()


def test_a_rehearsal_is_read_back_as_it_was(folder: Path) -> None:
    found = Criterion(name="excitation", value=float("inf"), bound=1.0, passed=False, sentence="")
    made = Rehearsal(
        plan_hash="", seed=1, passed=False, criteria=[found], assumed=[], not_seen=[],
        repetitions=2, motion_seconds=4.0, software={}, failed_seeds=(2, 3),
    )  # fmt: skip
    made.save(folder / "rehearsal.json")
    assert Rehearsal.load(CampaignFolder(folder)) == made


def dry_run(folder: Path) -> DryRun:
    return DryRun(
        plan_hash=CampaignFolder(folder).plan_hash, override=0.2, archives=(), duration=10.0,
        simulated=True, joint_names=("a", "b"), current_share=(0.1, 0.2),
        following_error=(0.1, float("nan")), missed=0, late=0, accepted=Acceptance("me", "now"),
    )  # fmt: skip


def test_a_dry_run_is_read_back_as_it_was(folder: Path) -> None:
    made = dry_run(folder)
    made.save(folder / "dry_run.json")
    found = DryRun.load(CampaignFolder(folder))
    assert found is not None
    assert repr(found) == repr(made)  # NaN is like no other


def warm_up(folder: Path) -> WarmUp:
    return (
        WarmUp(CampaignFolder(folder).plan_hash, ("a", "b"), 0.01, moved_at=1e9)
        .with_motion("one.mcap", [1.0, float("nan")], 1, 9)
        .cooled()
        .with_motion("two.mcap", [1.0, 2.0], 1, 9)
    )


def test_a_warm_up_is_read_back_as_it_was(folder: Path) -> None:
    made = warm_up(folder)
    made.save(folder / "warmup.json")
    assert WarmUp.load(folder / "warmup.json", made.plan_hash) == made


BROKEN: dict[str, list[tuple[tuple[str, ...], object]]] = {
    "dry_run.json": [
        (("override",), "x"), (("archives",), 3), (("current_share",), [0.1]),
        (("current_share",), ["x", 1]), (("missed",), "x"), (("against_gravity",), 3),
        (("against_gravity",), [3]), (("joint_names",), 3), (("accepted",), []),
        (("accepted",), {"by": "\ud800", "at": "x"}), (("simulated",), 1),
        (("format_version",), [2]),
    ],
    "warmup.json": [
        (("outcome",), 3), (("outcome",), "\ud800"), (("outcome",), "hot"), (("threshold",), "x"),
        (("motions",), [{"archive": "w", "friction": ["x", 1]}]),
        (("motions",), [{"archive": "w", "friction": [1.0]}]),
        (("moved_at",), "now"), (("earlier",), 3),
    ],
    "plan.json": [
        (("excitation", "seed"), float("inf")), (("excitation", "fly"), HUGE),
        (("excitation", "speed"), [HUGE, 1]), (("excitation", "speed"), ["0.1", "0.2"]),
        (("excitation", "via_points"), []), (("excitation", "via_points"), 5.0),
        (("excitation", "criteria", "log10_det"), "x"), (("excitation", "trajectory"), []),
        (("excitation", "trajectory", "knots"), [[0, HUGE], [0, 1]]),
        (("excitation", "rejected"), {"a": []}), (("excitation",), []),
        (("validation",), 3), (("validation",), {"a": 1}), (("moves",), 3),
    ],
}  # fmt: skip
HUGE_NUMBERS = [
    ("dry_run.json", "missed", HUGE),
    ("dry_run.json", "duration", HUGE),
    ("warmup.json", "motions", [{"archive": "w", "friction": [HUGE, 1]}] * 3),
    ("warmup.json", "moved_at", HUGE),
    ("warmup.json", "threshold", HUGE),
]
LOADED: dict[str, Callable[[Path], object]] = {
    "dry_run.json": lambda folder: DryRun.load(CampaignFolder(folder)),
    "warmup.json": lambda folder: WarmUp.load(
        folder / "warmup.json", CampaignFolder(folder).plan_hash
    ),
    "plan.json": lambda folder: Campaign.open(folder).status(),
}


@pytest.fixture
def done(folder: Path) -> Path:
    """The folder with a dry run and a warm-up."""
    dry_run(folder).save(folder / "dry_run.json")
    warm_up(folder).save(folder / "warmup.json")
    return folder


@pytest.mark.parametrize(
    ("file", "place", "value"), [(f, *case) for f, cases in BROKEN.items() for case in cases]
)
def test_a_changed_value_is_refused_by_its_file(
    file: str, place: tuple[str, ...], value: object, done: Path
) -> None:
    if file == "plan.json":
        (done / "manifest.json").unlink(missing_ok=True)
    doctored(done / file, *place, value=value)
    said = "is not a campaign plan" if file == "plan.json" else f"{file} is damaged"
    with pytest.raises(InputError, match=re.escape(said)) as refused:
        LOADED[file](done)
    if file != "plan.json":
        assert isinstance(refused.value, CampaignFolderError)
    if file == "dry_run.json":
        assert not conduct_of(CampaignFolder(done)).steps[1].done
    read(done)


@pytest.mark.parametrize(("file", "key", "value"), HUGE_NUMBERS)
def test_numbers_beyond_all_others(file: str, key: str, value: object, done: Path) -> None:
    doctored(done / file, key, value=value)
    read(done)
