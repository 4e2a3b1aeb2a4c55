"""Untrusted archives: read, checked, repaired and shown, or refused by name."""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from drivers import InitPacket
from drivers.cycle_records import cycle_dtype
from hil.archive import Archive, ArchiveWriter, ImportedSamples, open_archive, write_samples
from hil.archive.check import check_archive, read_overview
from hil.archive.recording_of_archive import recording_of
from hil.archive.repair import repair
from hil.base.errors import ArchiveError, ArchiveWriteError, InputError
from hil.new import cell_of_urdf, from_archive
from hil.plots.archive_view import view_of
from tests.fuzz.mutate_mcap import mutate_mcap
from tests.fuzz.targets import Target, place_of
from tests.hil.fast_cell import CELL, URDF

JOINTS = ("shoulder", "elbow")
CYCLES = 13


folder = lru_cache(partial(place_of, "archive"))


def run(data: bytes) -> bool:
    """Run all commands on an archive; return whether it can be opened."""
    path = folder() / "excitation_003_a1.mcap"
    path.write_bytes(data)
    try:
        archive = open_archive(path)
    except ArchiveError as error:
        assert error.path == path
        assert error.problem
        check_and_info(path)
        return False
    read_parts(archive)
    check_and_info(path)
    with suppress(InputError):
        view_of(path)  # without drawing, which takes seconds
    repair_and_compare(path, archive)
    new_cell(path, archive)
    return True


def read_parts(archive: Archive) -> None:
    """Check that columns fit one another, and that missing content is reported."""
    for name, column in archive.columns.items():
        assert len(column) == archive.n_samples, name
        assert not (column.size and column.flags.writeable)
    with suppress(ArchiveError):
        archive.cycles()
    for name in archive.attachments:
        try:
            archive.text(name)
        except ArchiveError as error:
            assert error.remedy
    part = open_archive(archive.path, fields=("position",), start=0.0, stop=1e9)
    # A part of a damaged file may be intact.
    assert part.n_samples <= archive.n_samples or archive.damage is not None
    try:
        recording = recording_of(archive)
    except ArchiveError as error:
        assert error.remedy
        return
    assert recording.position.shape == (archive.n_samples, len(archive.joint_names))
    assert len(recording.time) == archive.n_samples
    assert np.isfinite(recording.time).all()
    assert ("missing" in recording.provenance) == (archive.damage is not None)


def check_and_info(path: Path) -> None:
    """`hil archive check` and `info`."""
    with suppress(ArchiveError):
        check_archive(path)
    with suppress(ArchiveError):
        json.dumps(read_overview(path).to_dict())


def repair_and_compare(path: Path, archive: Archive) -> None:
    """`hil archive repair`: its output is intact, and losses are reported."""
    target = path.with_name("repaired.mcap")
    target.unlink(missing_ok=True)
    try:
        made = repair(path, target)
    except (ArchiveError, ArchiveWriteError):
        return
    if made.output is None:
        assert made.intact
        return
    again = open_archive(target)
    assert again.complete, again.damage
    assert again.n_samples == made.samples
    assert again.n_samples >= archive.n_samples or made.losses
    before = archive.columns.get("position")
    if before is not None and not made.losses:
        assert again.columns["position"].tobytes() == before.tobytes()


def new_cell(path: Path, archive: Archive) -> None:
    """`hil new --from-archive`."""
    try:
        values = from_archive(path, archive.joint_names)
    except InputError as error:
        assert error.remedy
        return
    if archive.joint_names == JOINTS:
        cell = replace(cell_of_urdf(_urdf(), {}), values=values)
        cell.text(path.with_name("cell.toml"))


@lru_cache
def _urdf() -> Path:
    path = folder() / "fast.urdf"
    path.write_text(URDF)
    return path


def seeds() -> list[bytes]:
    """Return a recorded archive, an imported, a truncated and a repaired one."""
    rows = np.zeros(CYCLES, cycle_dtype(2))
    cycle = np.arange(CYCLES)
    rows["cycle"], rows["number"] = 5000 + cycle, 10 + cycle
    rows["position"] = np.sin(0.01 * cycle[:, None] + [0.0, 1.0])
    rows["mode"], rows["status"] = 4, 5
    attachments = {
        "robot.urdf": URDF.encode(), "cell.toml": CELL.encode(),
        "drive_train.json": b'{"current_limit": [20.0, 12.0], "following_error": [1.0, 1.0]}',
        "init_packet.bin": InitPacket.build(2, 2, {"gear_ratio": [100.0, -80.0]}).encode(),
    }  # fmt: skip
    place = folder() / "seeds"
    place.mkdir(exist_ok=True)
    names = ("excitation_000_a1", "imported", "truncated", "repaired")
    whole, bare, truncated, repaired = (place / f"{name}.mcap" for name in names)
    with ArchiveWriter(
        whole, joint_names=JOINTS, period=0.01, metadata={"campaign": "c", "simulated": "yes"},
        attachments=attachments, durable=False,
    ) as archive:  # fmt: skip
        archive.event(5000, "Refused", "a text", data={"joint": 1})
        archive.write(rows, rows["target_current"])
        archive.close("completed")
    samples = ImportedSamples(cycle * 2_000_000, position=rows["position"], torque=rows["position"])
    urdf = {"robot.urdf": URDF.encode()}
    write_samples(bare, samples, joint_names=JOINTS, attachments=urdf, metadata={})
    truncated.write_bytes(whole.read_bytes()[: whole.stat().st_size * 3 // 4])
    repair(truncated, repaired)
    made = [path.read_bytes() for path in (whole, bare, truncated, repaired)]
    shutil.rmtree(place)
    return made


TARGET = Target(run, seeds, mutate_mcap, most=24_000, replayed=50)
