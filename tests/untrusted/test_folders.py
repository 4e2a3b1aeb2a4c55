"""Untrusted campaign folders: nothing outside is changed, nothing blocks.

Whatever replaces one of its files, the result is a named error, or the file is not needed; links
and pipes are not followed in writing.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import ArchiveHeader, ImportedSamples, open_archive, write_samples
from hil.archive.check import check_archive
from hil.archive.verified_records import MAGIC
from hil.base.errors import ArchiveError, HilError, InputError
from hil.base.files import write_atomically, write_files
from hil.base.safe_input import parse_toml, read_text
from hil.campaign import Campaign, CampaignFolderError
from hil.campaign.dry_run_record import Acceptance, DryRunRecord
from hil.campaign.folder import LOCK, CampaignFolder
from hil.campaign.joint_warm_up import FrictionMeter, WarmUpRecord
from hil.campaign.quality import Executed
from hil.campaign.rehearsal_record import Rehearsal
from hil.campaign.status import execution_log_of
from hil.cell import Cell
from hil.cli import app
from hil.cli.plan import read_via_points
from hil.importers.array_files import READERS, ArrayFile
from hil.importers.bags import bag_files, open_bag
from hil.importers.column_map import Format
from hil.importers.text_table import TextTable
from hil.report.output_files import rewrite_report
from hil.results.results import Results
from hil.results.series import SERIES, load_series
from hil.study.results import StudyResults
from identification import IdentificationError
from identification.excitation import Journal
from planner import PlannerError
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_campaign, fast_cell
from tests.messages import NO_CAMPAIGN_PLAN

pytestmark = pytest.mark.safety


@pytest.fixture(scope="session")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder)).folder.root


@pytest.fixture
def folder(designed: Path, tmp_path: Path) -> Path:
    return shutil.copytree(designed, tmp_path / "campaign")


DEEP = "[" * 100_000 + "]" * 100_000
NAMED = (HilError, IdentificationError, PlannerError)


class WaitsError(BaseException):
    """Not caught by code that converts errors of libraries."""


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fail what blocks, such as on a pipe without writer."""

    def over(*_: object) -> None:
        raise WaitsError

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def put(path: Path, what: str) -> None:
    """Replace a file by something else."""
    path.unlink(missing_ok=True)
    if what == "a pipe":
        os.mkfifo(path)
    elif what == "a device":
        path.symlink_to("/dev/zero")
    elif what == "a folder":
        path.mkdir()
    elif what == "a link to itself":
        path.symlink_to(path)
    elif what == "a link to nothing":
        path.symlink_to(path.with_name("not_there"))
    elif what.endswith("a sparse terabyte"):
        path.write_bytes(MAGIC if what.startswith("an MCAP file and") else b"")
        os.truncate(path, 1 << 40)
    else:
        path.write_text(what)


THINGS = (
    *("a pipe", "a device", "a folder", "a link to itself", "a link to nothing"),
    *("a sparse terabyte", DEEP),
    *("{}", "[]", "null", "1", "NaN", "1e999", "9" * 5000, '{"a":' * 50_000, "a=" + "[" * 50_000),
    "",
)
FILES: dict[str, Callable[[Path], object]] = {
    "manifest.json": lambda root: CampaignFolder(root).manifest(),
    "plan.json": lambda root: Campaign.open(root).status(),
    "cell.toml": lambda root: Campaign.open(root).status(),
    "robot.urdf": lambda root: Campaign.open(root).status(),
    "rehearsal.json": lambda root: Rehearsal.load(CampaignFolder(root)),
    "dry_run.json": lambda root: DryRunRecord.load(CampaignFolder(root)),
    "warmup.json": lambda root: WarmUpRecord.load(
        CampaignFolder(root).warmup, CampaignFolder(root).plan_hash
    ),
    "results.json": lambda root: Results.load(root / "results.json"),
}
STEPS = {"rehearsal.json": "rehearse", "dry_run.json": "dry run", "warmup.json": "warm-up",
         "results.json": "identify"}  # fmt: skip
"""Steps whose files are independent of the others."""


def replaced(path: Path) -> Iterator[str]:
    """Replace a file by each of `THINGS`, for some seconds; remove the last one."""
    for thing in THINGS:
        put(path, thing)
        with within(20.0):
            yield thing
        shutil.rmtree(path) if thing == "a folder" else path.unlink()


@pytest.mark.parametrize("name", FILES)
def test_replaced_file_is_named(name: str, folder: Path) -> None:
    original = (folder / name).read_bytes() if (folder / name).exists() else None
    for thing in replaced(folder / name):
        with pytest.raises(NAMED, match=re.escape(name)) as refused:
            FILES[name](folder)
        assert "\n" not in str(refused.value), thing
    if original is not None:
        (folder / name).write_bytes(original)
        FILES[name](folder)


@pytest.mark.parametrize("name", STEPS)
def test_status_names_the_file_of_a_step(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.campaign.status.drift_wanted", lambda cell: 0.1)
    for thing in replaced(folder / name):
        steps = {step.name: step for step in Campaign.open(folder).status().steps}
        assert steps[STEPS[name]].state != "done", thing
        assert name in steps[STEPS[name]].sentence, thing


@pytest.mark.parametrize("thing", ["a folder", "a link to itself", "a link to nothing"])
def test_unreadable_manifest_is_not_a_missing_one(thing: str, folder: Path) -> None:
    """Otherwise an edited plan would be accepted as the original."""
    put(folder / "manifest.json", thing)
    campaign = Campaign.open(folder)
    for step in (campaign.status, campaign.folder.accept_changes):
        with pytest.raises(CampaignFolderError, match=r"manifest\.json cannot be read"):
            step()


@pytest.mark.parametrize("name", ["../elsewhere_000_a1.mcap", "../../excitation_000_a1.mcap",
                                  "/tmp/excitation_000_a1.mcap", "", "..", "a/b.mcap"])  # fmt: skip
def test_manifest_names_files_of_its_folder_only(name: str, folder: Path) -> None:
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    content["archives"] = [{"name": name, "outcome": "completed", "sha256": "0"}]
    path.write_text(json.dumps(content))
    with pytest.raises(CampaignFolderError, match="is not the name of a file in archives/"):
        Campaign.open(folder).folder.manifest()


@pytest.mark.parametrize("suffix", ["", ".tmp"])
@pytest.mark.parametrize("thing", ["a link", "a pipe"])
def test_writing_follows_no_link_and_waits_for_no_pipe(
    suffix: str, thing: str, folder: Path
) -> None:
    """Neither at the file nor at its temporary file."""
    other_file = folder.parent / "profile"
    target = folder / "manifest.json"
    other_file.write_text("mine")
    in_the_way = folder / f"{target.name}{suffix}"
    in_the_way.unlink(missing_ok=True)
    in_the_way.symlink_to(other_file) if thing == "a link" else os.mkfifo(in_the_way)
    with within(20.0):
        write_atomically(target, "new")
        write_files(folder, {"results.json": "new"})
    assert other_file.read_text() == "mine"
    assert target.is_file() and not target.is_symlink()
    assert target.read_text() == "new"


def test_link_is_no_lock(folder: Path) -> None:
    campaign = Campaign.open(folder)
    missing_target = folder.parent / "not_made"
    (folder / LOCK).unlink(missing_ok=True)
    (folder / LOCK).symlink_to(missing_target)
    with pytest.raises(CampaignFolderError, match=f"{LOCK} cannot be written"), \
            campaign.folder.locked():  # fmt: skip
        pass
    assert not missing_target.exists()


RECORDINGS: dict[str, Callable[[Path], object]] = {
    "log.csv": lambda path: TextTable.read(path, Format()),
    **{f"log{suffix}": ArrayFile for suffix in READERS},
    "bag.db3": bag_files,
    "bag.mcap": lambda path: open_bag(path).__enter__(),
    "via.csv": lambda path: read_via_points(path, Cell.load(CELL_PATH)),
    "results.json": StudyResults.load,
    "excitation_000_a1.mcap": open_archive,
    "excitation_001_a1.mcap": check_archive,
}


@pytest.mark.parametrize(
    "thing",
    [
        *("a pipe", "a device", "a link to nothing", "a sparse terabyte"),
        "an MCAP file and a sparse terabyte",
    ],
)
@pytest.mark.parametrize("name", RECORDINGS)
def test_recording_or_plan_must_be_a_file(name: str, thing: str, tmp_path: Path) -> None:
    if thing.endswith("a sparse terabyte") and name == "bag.db3":
        pytest.skip("rows are read one by one")
    put(tmp_path / name, thing)
    with within(20.0), pytest.raises(HilError, match=re.escape(name)) as refused:
        RECORDINGS[name](tmp_path / name)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("named", ["/dev/zero", "pipe", ".", "/etc/shadow\0", "missing.urdf"])
def test_invalid_path_of_a_description_is_refused(named: str, tmp_path: Path) -> None:
    """A path may leave the folder; it is only read."""
    cell = fast_cell(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    shown = named.replace("\0", "\\u0000")
    cell.path.write_text(cell.text.replace('urdf = "fast.urdf"', f'urdf = "{shown}"'))
    with within(20.0), pytest.raises(InputError, match=r"cell\.urdf"):
        Cell.load(cell.path)


def series(members: dict[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return content.getvalue()


def claiming(shape: tuple[int, ...]) -> bytes:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    return head.getvalue()


def member(values: object) -> bytes:
    content = io.BytesIO()
    np.save(content, np.array(values))
    return content.getvalue()


COLUMNS = {
    "excitation": ("time", "position", "velocity", "fitted"),
    "example": ("time", "measured", "predicted", "used"),
    "friction": ("torque", "speed"),
    "law": ("torque", "speed"),
}
MEMBERS = {
    f"{part}_{name}.npy": member(np.zeros(3 if name == "time" else (3, 2)))
    for part, names in COLUMNS.items()
    for name in names
} | {"example_archive.npy": member("one.mcap")}


def test_series_of_a_report_are_read_as_written(folder: Path) -> None:
    (folder / SERIES).write_bytes(series(MEMBERS))
    assert load_series(folder, 2).example_archive == "one.mcap"
    with pytest.raises(InputError, match="2 columns, not 3"):
        load_series(folder, 3)


class Opens:
    """Creates a file when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self._trace,)


def test_series_of_a_report_are_numbers_of_limited_size(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace = folder.parent / "unpickled"
    pickled = io.BytesIO()
    np.save(pickled, np.array([Opens(trace)], dtype=object), allow_pickle=True)
    bombs = (
        b"",
        series({"time.npy": pickled.getvalue()}),
        series({"time.npy": claiming((1 << 40,))}),
        series({f"{i}.npy": bytes(1 << 18) for i in range(17)}),  # much out of little
        *(
            series(MEMBERS | {"example_time.npy": data})
            for data in (member([1.0]), member(["a", "b", "c"]), member([0.0, 1e308, -1e308]),
                         claiming((10**30,)), b"\x93NUMPY\x01\x00\x04\x00((((")
        ),
    )  # fmt: skip
    loaded = SimpleNamespace(joint_names=["a", "b"])
    monkeypatch.setattr(Results, "load", lambda _: loaded)
    monkeypatch.setattr("hil.results.series._MAX_BYTES", 1 << 22)
    for data in bombs:
        (folder / SERIES).write_bytes(data)
        with pytest.raises(InputError, match="does not contain the series of a report"):
            rewrite_report(folder)
    assert not trace.exists()


def test_text_is_read_with_any_line_ends(tmp_path: Path) -> None:
    (tmp_path / "it").write_bytes("a = 1\r\nb = 'ä'\r".encode())
    assert parse_toml(read_text(tmp_path / "it")) == {"a": 1, "b": "ä"}


NAMES = {
    "a\x1b]0;title\x07\x1b[31mb": r"a\x1b]0;title\x07\x1b[31mb",
    "a\nerror: all is well": r"a\nerror: all is well",
    "a\udcffb": r"a\udcffb",
    "[link=http://x]a[/link]": "[link=http://x]a[/link]",
}


@pytest.mark.parametrize("name", NAMES)
def test_name_does_not_control_the_terminal(
    name: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hil.cli import main

    monkeypatch.setattr("sys.argv", ["hil", "status", name])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    printed = capfd.readouterr().err
    assert printed.startswith(f"error: {NAMES[name].split('/')[0]}")
    assert printed.rstrip("\n").isprintable()
    monkeypatch.setattr("sys.argv", ["hil", "status", name, "--json"])
    with pytest.raises(SystemExit):
        main()
    assert NAMES[name].split("/")[0] in json.loads(capfd.readouterr().out)["error"]


def test_markup_in_the_name_of_a_campaign_is_shown(folder: Path, tmp_path: Path) -> None:
    renamed = folder.rename(tmp_path / "[bold]c\x1b[31m[]")
    shown = CliRunner().invoke(app, ["status", str(renamed)])
    assert shown.exit_code == 0, shown.output
    assert "\x1b" not in shown.output
    assert "[bold]c" in shown.output


HUGE = 10**400
DIGITS = "9" * 5000
ENTRY = {"name": "excitation_000_a1.mcap", "outcome": "completed", "sha256": "00", "reason": ""}


def read(folder: Path) -> list[str]:
    """Return the named errors of all readers of a folder; others are raised."""
    refused = []
    for read_it in (
        lambda: Campaign.open(folder).status(),
        lambda: execution_log_of(CampaignFolder(folder)),
    ):
        try:
            read_it()
        except NAMED as error:
            refused.append(str(error))
    return refused


def doctored(path: Path, *place: str, value: object) -> None:
    content = at = json.loads(path.read_text())
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    path.write_text(json.dumps(content))


def test_unreadable_archive_is_named_and_not_repeated(folder: Path) -> None:
    doctored(folder / "manifest.json", "archives", value=[ENTRY])
    archives = folder / "archives"
    archives.mkdir(exist_ok=True)
    (archives / ENTRY["name"]).symlink_to("/proc/self/mem")  # a file that cannot be read
    with pytest.raises(CampaignFolderError, match=f"{ENTRY['name']} cannot be read"):
        CampaignFolder(folder).completed("excitation")
    (archives / ENTRY["name"]).unlink()
    assert CampaignFolder(folder).completed("excitation") == []
    assert CampaignFolder(folder).damaged()


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
    """An imported recording."""
    still = ImportedSamples(
        np.arange(50) * 2_000_000, position=np.zeros((50, 2)), torque=np.ones((50, 2))
    )
    return write_samples(
        tmp_path / "imported.mcap", still, joint_names=("shoulder", "elbow"), metadata={}
    )


def test_imported_archive_instead_of_a_recorded_one(imported: Path, folder: Path) -> None:
    campaign = Campaign.open(folder)
    cell = campaign.cell
    motion = campaign.plan.excitation.trajectory
    (folder / "archives").mkdir(exist_ok=True)
    shutil.copy(imported, folder / "archives" / "dryrun_000_a1.mcap")
    names = ["dryrun_000_a1.mcap"]
    for use in (
        lambda: DryRunRecord.of(campaign, names, plan_hash="", simulated=True),
        lambda: Executed.of(open_archive(imported)),
        lambda: FrictionMeter(cell, motion).measure(imported),
    ):
        with pytest.raises(ArchiveError, match="is not a recording by hil"):
            use()


def dry_run(folder: Path) -> DryRunRecord:
    return DryRunRecord(
        plan_hash=CampaignFolder(folder).plan_hash, override=0.2, archives=(), duration=10.0,
        simulated=True, joint_names=("a", "b"), current_share=(0.1, 0.2),
        following_error=(0.1, float("nan")), missed=0, late=0, accepted=Acceptance("me", "now"),
    )  # fmt: skip


def warm_up(folder: Path) -> WarmUpRecord:
    return (
        WarmUpRecord(CampaignFolder(folder).plan_hash, ("a", "b"), 0.01, moved_at=1e9)
        .with_motion("one.mcap", [1.0, float("nan")], 1, 9)
        .cooled()
        .with_motion("two.mcap", [1.0, 2.0], 1, 9)
    )


BROKEN: list[tuple[str, tuple[str, ...], object]] = [
    ("dry_run.json", ("current_share",), [0.1]),
    ("dry_run.json", ("against_gravity",), [3]),
    ("dry_run.json", ("accepted",), {"by": "\ud800", "at": "x"}),
    ("warmup.json", ("outcome",), "\ud800"),
    ("warmup.json", ("motions",), [{"archive": "w", "friction": [1.0]}]),
    ("plan.json", ("excitation", "seed"), float("inf")),
    ("plan.json", ("excitation", "fly"), HUGE),
    ("plan.json", ("excitation", "via_points"), 5.0),
    ("plan.json", ("excitation", "trajectory", "knots"), [[0, HUGE], [0, 1]]),
    ("plan.json", ("validation",), {"a": 1}),
]
READ_OR_REFUSED: list[tuple[str, tuple[str, ...], object]] = [
    *(
        ("manifest.json", ("archives",), [ENTRY | entry])
        for entry in ({"name": f"excitation_{DIGITS}_a1.mcap"}, {"name": "a" * 300},
                      {"name": "a\0b"}, {"name": "\ud800.mcap", "reason": "\ud800"})
    ),
    ("manifest.json", ("inputs",), [[1, 2]]),
    ("dry_run.json", ("missed",), HUGE),
    ("warmup.json", ("moved_at",), HUGE),
]  # fmt: skip


@pytest.mark.parametrize(("file", "place", "value"), [*BROKEN, *READ_OR_REFUSED])
def test_changed_value_is_refused_or_read(
    file: str, place: tuple[str, ...], value: object, folder: Path
) -> None:
    """Those of `BROKEN` are refused; no reader ends with another error."""
    dry_run(folder).save(folder / "dry_run.json")
    warm_up(folder).save(folder / "warmup.json")
    doctored(folder / file, *place, value=value)
    if (file, place, value) in BROKEN:
        if file == "plan.json":
            (folder / "manifest.json").unlink(missing_ok=True)
        message = NO_CAMPAIGN_PLAN if file == "plan.json" else f"{file} cannot be read"
        with pytest.raises(InputError, match=re.escape(message)):
            FILES[file](folder)
        if file == "dry_run.json":
            assert not execution_log_of(CampaignFolder(folder)).steps[1].done
    read(folder)


HEADER = {"kind": "move", "joint_names": '["a"]', "attachments": "[]"}


@pytest.mark.parametrize("value", [10**400, True, float("nan"), float("inf"), "1", None])
def test_invalid_true_parameters_are_left_out(value: object) -> None:
    def planted(of_x: object) -> object:
        return ArchiveHeader.of({**HEADER, "planted": json.dumps({"x": of_x})}).planted

    assert planted(-1.5) == {"x": -1.5}
    assert planted(value) == {}


def test_journal_of_forged_frames_is_read_in_linear_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = io.BytesIO()
    Journal(file, {})
    frame = 12 + len(b"\x93NUMPY")
    count = 2_000
    for k in range(count):  # each claims all that follows
        length = frame * (count - k) - 12
        file.write(length.to_bytes(8, "little") + bytes(4) + b"\x93NUMPY")
    summed = []
    crc32 = zlib.crc32

    def crc32_with_count(data: bytes) -> int:
        summed.append(len(data))
        return crc32(data)

    monkeypatch.setattr(zlib, "crc32", crc32_with_count)
    Journal(file, {})
    assert sum(summed) < 8 * len(file.getvalue())
