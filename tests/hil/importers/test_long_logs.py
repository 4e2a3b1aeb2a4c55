"""Logs that are too long to be read whole, and logs with pauses."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.archive import open_archive
from hil.base.errors import SourceError
from hil.importers.column_map import Format
from hil.importers.conclusions import Excerpt
from hil.importers.excerpt import (
    MAX_EXCERPT_SECONDS,
    STRETCH_ROWS,
    activity,
    chosen_stretches,
    excerpt_of,
)
from hil.importers.imported_robot import Robot
from hil.importers.log_files import LogFiles
from hil.importers.messages import sentence
from hil.importers.recording_import import ImportedRecording, ImportOptions, read_recording
from hil.importers.text_table import TextTable
from hil.pipeline.sources import cell_of, source_of
from identification.signals.recording import PAUSE_SECONDS, Recording, cut_at_pauses
from tests.hil.importers.moving_log import JOINTS, URDF

RATE = 250.0  # Hz
ROWS = 8 * STRETCH_ROWS
LONGEST = 3 * STRETCH_ROWS


def moving(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and torques (m, 3) of an arm that moves all the time."""
    phase = 2.0 * np.pi * time[:, None] * np.array([0.11, 0.17, 0.23])
    position = 0.4 * np.sin(phase)
    return position, 5.0 * np.cos(phase) + 1e-3 * np.sin(997.0 * time[:, None])


def written(path: Path, time: np.ndarray | None, *columns: np.ndarray) -> Path:
    """A log with a header of its time, if any, and of position and torque of three joints."""
    names = [f"{quantity}{joint}" for quantity in ("q", "tau") for joint in (1, 2, 3)]
    parts = [*columns] if time is None else [time, *columns]
    header = ",".join(names if time is None else ["time", *names])
    np.savetxt(path, np.column_stack(parts), "%.7f", ",", header=header, comments="")
    return path


def read(path: Path, robot: Robot, longest: int | None, **options: float) -> ImportedRecording:
    reading = ImportOptions(outside_limits=True, **options)  # type: ignore[arg-type]
    return read_recording(path, lambda _: robot, reading, files=LogFiles(longest=longest))


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path)


def test_rows_of_a_long_log_are_those_of_the_file(robot: Robot, tmp_path: Path) -> None:
    time = np.arange(ROWS) / RATE
    path = written(tmp_path / "log.csv", time, *moving(time))
    imported = read(path, robot, LONGEST)
    whole = read(path, robot, None)
    columns = imported.archive.columns
    assert 2 * STRETCH_ROWS < len(columns["stamp"]) <= LONGEST
    rows = np.searchsorted(whole.archive.columns["stamp"], columns["stamp"])
    for name in ("stamp", "position", "torque"):
        assert np.array_equal(columns[name], whole.archive.columns[name][rows])
    (said,) = [each for each in imported.examined.found if isinstance(each, Excerpt)]
    assert (said.count, said.stretches) == (len(rows) + 1, 3)  # the header is a line as well
    assert said.total == ROWS + 1
    assert f"used {said.count} of {said.total} rows" in sentence(said)
    assert not any("pause" in sentence(each) for each in imported.examined.found)
    assert not any(isinstance(each, Excerpt) for each in whole.examined.found)


def test_without_a_time_rows_that_are_not_read_take_their_time(
    robot: Robot, tmp_path: Path
) -> None:
    time = np.arange(ROWS) / RATE
    path = written(tmp_path / "log.csv", None, *moving(time))
    stamp = read(path, robot, LONGEST, sample_rate=RATE).archive.columns["stamp"]
    position = read(path, robot, LONGEST, sample_rate=RATE).archive.columns["position"]
    assert np.allclose(position, moving(1e-9 * stamp)[0], atol=1e-6)
    assert 1e-9 * stamp[-1] > 2.0 * LONGEST / RATE


def test_a_column_that_counts_rows_is_known_in_a_long_log(robot: Robot, tmp_path: Path) -> None:
    time = np.arange(ROWS) / RATE
    path = written(tmp_path / "log.csv", np.arange(ROWS, dtype=float), *moving(time))
    with pytest.raises(SourceError, match="counts the rows from 0"):
        read(path, robot, LONGEST)


def test_a_cell_without_a_number_is_named_by_its_line(tmp_path: Path) -> None:
    time = np.arange(ROWS) / RATE
    path = written(tmp_path / "log.csv", time, *moving(time))
    table = TextTable.read(path, Format(), LONGEST)
    line = table.numbered[-5]
    lines = path.read_text().splitlines()
    assert table.lines[-5] == lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(",", ",x", 1)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SourceError, match=f"line {line} has 'x"):
        TextTable.read(path, Format(), LONGEST).numbers(["q1"], "position")


@pytest.mark.long
def test_a_compressed_log_is_read_in_stretches(tmp_path: Path) -> None:
    time = np.arange(ROWS) / RATE
    path = written(tmp_path / "log.csv", time, *moving(time))
    plain = TextTable.read(path, Format(), LONGEST)
    packed = tmp_path / "log.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert TextTable.read(packed, Format(), LONGEST).lines == plain.lines
    assert len(plain.lines) < LONGEST


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encodings_and_decimal_commas_of_long_logs(encoding: str, tmp_path: Path) -> None:
    time = np.arange(4 * STRETCH_ROWS) / RATE
    plain = written(tmp_path / "plain.csv", time, *moving(time)).read_text()
    text = plain.replace(",", ";").replace(".", ",").replace("q1", "Position1 (°)", 1)
    path = tmp_path / "log.csv"
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    table = TextTable.read(path, Format(), 2 * STRETCH_ROWS)
    assert table.names[1] == "Position1 (°)"
    assert len(table.lines) == 2 * STRETCH_ROWS - 1
    values = table.numbers(["time", 1], "position")
    assert np.allclose(values[:, 1], moving(values[:, 0])[0][:, 0], atol=1e-6)


def test_stretches_in_which_the_arm_stands_are_left_out() -> None:
    stamp = np.arange(20 * STRETCH_ROWS) * 4_000_000
    position, _ = moving(1e-9 * stamp)
    still = np.arange(len(stamp)) // STRETCH_ROWS % 5 > 0
    position[still] = 0.1
    chosen = excerpt_of(stamp, position, 6 * STRETCH_ROWS)
    assert chosen is not None
    assert chosen.stretches == 4
    assert not still[chosen.rows].any()


def test_what_is_read_is_spread_at_uneven_distances() -> None:
    """A program that repeats would be seen at the same places again and again."""
    chosen = chosen_stretches(np.ones(1000), 20)
    assert len(chosen) == 20
    assert np.array_equal(chosen // 50, np.arange(20))  # one of each twentieth
    assert len(set(np.diff(chosen).tolist())) > 2


def test_a_stretch_without_numbers_may_contain_motion() -> None:
    rows = np.random.default_rng(1).standard_normal((100, 2))
    probes = [rows, np.full((100, 2), np.nan), np.zeros((100, 2))]
    moved = activity(probes)
    assert np.isnan(moved[1])
    assert chosen_stretches(moved, 3).tolist() == [0, 1]


def test_rows_are_limited_and_so_is_time() -> None:
    """Rows and blocks of time both take memory."""
    rows = 400_000
    position, _ = moving(np.arange(rows) / RATE)
    assert excerpt_of(np.arange(rows) * 1_000_000, position, rows) is None
    slow = excerpt_of(np.arange(rows) * 4_000_000, position, rows)
    assert slow is not None
    assert 0.9 * MAX_EXCERPT_SECONDS < len(slow.rows) / RATE <= MAX_EXCERPT_SECONDS


class TestPauses:
    def test_a_recording_is_cut_at_a_pause_of_twenty_minutes(
        self, robot: Robot, tmp_path: Path
    ) -> None:
        time = np.arange(6000) / RATE
        position, torque = moving(time)
        time[2500:] += 1200.0
        path = written(tmp_path / "log.csv", time, position, torque)
        imported = read(path, robot, None)
        said = [sentence(each) for each in imported.examined.found]
        assert any("cut at a pause of 20 min" in line for line in said)
        archive = imported.archive
        recording = source_of(archive, cell_of(archive)).recording
        assert [part.stop for part in recording.segments()] == [2500, 6000]
        assert np.ptp(recording.time) == pytest.approx(6000 / RATE + 1.0, abs=0.1)
        assert np.array_equal(recording.position, archive.columns["position"])

    def test_shorter_ones_stay_as_they_are(self) -> None:
        time = np.arange(200) * 0.01
        time[100:] += PAUSE_SECONDS - 1.0
        recording = Recording(time, np.zeros((200, 3)), JOINTS)
        assert cut_at_pauses(recording) is recording

    def test_gaps_that_were_reported_stay(self) -> None:
        time = np.arange(300) * 0.01
        time[200:] += 3600.0
        gaps = np.arange(300) == 100
        recording = Recording(time, np.zeros((300, 3)), JOINTS, gap_before=gaps)
        cut = cut_at_pauses(replace(recording))
        assert [part.start for part in cut.segments()] == [0, 100, 200]
        assert cut.time[-1] == pytest.approx(2.99 + 1.0 - 0.01)


def test_hil_import_reads_every_row(robot: Robot, tmp_path: Path) -> None:
    time = np.arange(2 * STRETCH_ROWS) / RATE
    path = written(tmp_path / "log.csv", time, *moving(time))
    read(path, robot, None).write(tmp_path / "log.mcap")
    assert open_archive(tmp_path / "log.mcap").n_samples == 2 * STRETCH_ROWS
