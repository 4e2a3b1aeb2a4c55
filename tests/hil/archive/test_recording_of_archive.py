"""Conversion of archives to recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cycle_records import cycle_dtype
from hil.archive import ArchiveWriter, ImportedSamples, open_archive, write_samples
from hil.archive.recording_of_archive import open_recording, recording_of
from hil.base.errors import ArchiveError

JOINTS = ("a", "b")
NAME = "excitation_002_a1.mcap"


def records(count: int = 400, first: int = 777_000_000) -> NDArray[np.void]:
    rows = np.zeros(count, cycle_dtype(2))
    rows["cycle"] = first + np.arange(count)
    phase = 0.01 * np.arange(count)[:, None] + np.array([0.0, 1.0])
    rows["position"] = np.sin(phase)
    rows["commanded_position"] = np.sin(phase + 0.001)
    rows["commanded_position"][:1] = np.nan
    rows["target_current"] = np.cos(phase)
    return rows


def archive(path: Path, rows: NDArray[np.void], *, torque: bool = True, lost: int = 0) -> Path:
    """Write an archive of these cycles; the reply to cycle `lost` was not accepted."""
    metadata = {"campaign": "c9", "simulated": "yes", "seed": "4"}
    with ArchiveWriter(
        path, joint_names=JOINTS, period=0.002, metadata=metadata, durable=False
    ) as writer:
        writer.write(rows, 50.0 * rows["target_current"] if torque else None)
        if lost:
            writer.event(lost, "AnswersLost", "1 reply was not accepted", data={"count": 1})
        writer.close("completed", reason="")
    return path


def test_recording_has_columns_and_provenance(tmp_path: Path) -> None:
    """Time is counted in cycles, not in arrivals."""
    rows = records()
    rows["arrival"] = 1e9 + np.random.default_rng(0).normal(size=len(rows))
    path = archive(tmp_path / NAME, rows)
    recording = open_recording(path)
    assert recording.checked(JOINTS) is recording
    np.testing.assert_array_equal(recording.position, rows["position"])
    np.testing.assert_array_equal(recording.torque, 50.0 * rows["target_current"])
    np.testing.assert_array_equal(recording.motor_current, rows["target_current"])
    np.testing.assert_array_equal(recording.commanded_position, rows["commanded_position"])
    np.testing.assert_array_equal(recording.time, np.arange(400) * 0.002)
    np.testing.assert_array_equal(recording_of(open_archive(path)).time, recording.time)
    expected = {"archive": NAME, "kind": "excitation", "index": "2", "campaign": "c9",
                "seed": "4", "outcome": "completed"}  # fmt: skip
    assert expected.items() <= recording.provenance.items()
    assert "missing" not in recording.provenance


def test_lost_packets_and_replies_not_accepted_are_gaps(tmp_path: Path) -> None:
    rows = records()
    rows["gap"][120] = 2
    unaccepted = int(rows["cycle"][150])
    rows = np.delete(rows, [118, 119, 300, 301])  # the second hole was never reported
    recording = open_recording(archive(tmp_path / NAME, rows, lost=unaccepted))
    assert np.flatnonzero(recording.gap_before).tolist() == [118, 148, 298]
    parts = [(segment.start, segment.stop) for segment in recording.segments()]
    assert parts == [(0, 118), (118, 148), (148, 298), (298, 396)]
    assert recording.time[118] == pytest.approx(0.240)


def test_truncated_archive_gives_its_intact_part(tmp_path: Path) -> None:
    path = archive(tmp_path / NAME, records())
    path.write_bytes(path.read_bytes()[:-9000])
    recording = open_recording(path)
    count = recording.n_samples
    assert 0 < count < 400
    assert count % 50 == 0  # 100 ms of 2 ms cycles
    assert np.array_equal(recording.position, records()["position"][:count])
    assert f"{count} samples" in recording.provenance["missing"]
    assert "outcome" not in recording.provenance


def test_restarted_cycles_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time between two sessions is unknown: only the first is read."""
    monkeypatch.setattr(ArchiveWriter, "_check_growth", lambda *_: None)  # as earlier versions
    rows = np.concatenate([records(100), records(100, first=0)])
    recording = open_recording(archive(tmp_path / NAME, rows))
    assert recording.n_samples == 100
    assert "cycles that do not follow the previous ones" in recording.provenance["missing"]


def test_imported_stamps_are_converted_to_seconds(tmp_path: Path) -> None:
    stamp = np.array([0, 8_000_001, 15_999_999], np.int64) + 1_700_000_000 * 10**9
    samples = ImportedSamples(stamp, np.arange(6.0).reshape(3, 2))
    path = write_samples(tmp_path / "x.mcap", samples, joint_names=JOINTS, metadata={})
    recording = open_recording(path)
    assert recording.time.tolist() == pytest.approx([0.0, 8.000001e-3, 15.999999e-3], abs=1e-15)
    assert recording.gap_before is None


def test_part_of_the_time_equals_that_part_of_the_recording(tmp_path: Path) -> None:
    path = archive(tmp_path / NAME, records(first=1000))
    full = open_recording(path)
    part = open_recording(path, start=2.1, stop=2.3)  # s; the first cycle is at 2 s
    assert np.array_equal(part.position, full.position[50:150])
    assert np.array_equal(part.torque, full.torque[50:150])
    assert part.time == pytest.approx(0.002 * np.arange(100))
    assert part.provenance["part"] == "2.1 to 2.3 [s]"
    assert np.array_equal(open_recording(path, start=2.7).position, full.position[350:])
    assert np.array_equal(open_recording(path, stop=2.01).position, full.position[:5])
    with pytest.raises(ArchiveError, match="has no sample; record it again"):
        open_recording(path, start=90.0)


def test_unknown_or_unwanted_channels_are_none(tmp_path: Path) -> None:
    path = archive(tmp_path / NAME, records())
    recording = open_recording(path, channels=["torque"])
    assert recording.torque is not None
    assert recording.motor_current is recording.commanded_position is None
    assert open_recording(path, channels=[]).torque is None
    bare = archive(tmp_path / "move_000_a1.mcap", records(), torque=False)
    assert open_recording(bare).torque is None
