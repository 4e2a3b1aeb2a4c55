"""A folder with a file for each quantity, and quantities with time stamps of their own."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from hil.base.errors import SourceError
from hil.importers.conclusions import OneTimeBase
from hil.importers.imported_robot import Robot
from hil.importers.log_files import is_folder_of_logs
from hil.importers.recording_import import (
    ImportedRecording,
    ImportOptions,
    is_archive,
    read_recording,
)
from tests.hil.importers.moving_log import JOINTS, POSITION, RATE, SLOPE, TIME, TORQUE, URDF, Floats

DEFAULT = ImportOptions()
AT_RATE = ImportOptions(sample_rate=RATE)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "run"
    path.mkdir()
    return path


def columns(imported: ImportedRecording, name: str) -> Floats:
    return np.asarray(imported.archive.columns[name], np.float64)


def read(folder: Path, robot: Robot, options: ImportOptions = DEFAULT) -> ImportedRecording:
    assert not is_archive(folder)
    return read_recording(folder, lambda _: robot, options)


def texts(folder: Path, arrays: Mapping[str, Floats]) -> None:
    for name, array in arrays.items():
        np.savetxt(folder / name, array, fmt="%.9g")


def without_times(folder: Path) -> None:
    texts(folder, {"q.txt": POSITION, "dq.txt": SLOPE, "tau.txt": TORQUE})


def of_numpy(folder: Path) -> None:
    np.save(folder / "q.npy", POSITION)
    np.save(folder / "dq.npy", SLOPE.T)
    np.save(folder / "torque.npy", TORQUE)


def of_words(folder: Path) -> None:
    texts(folder, {"joint_positions.csv": POSITION, "joint_velocities.csv": SLOPE})
    texts(folder, {"measured_torques.csv": TORQUE})


def with_notes(folder: Path) -> None:
    without_times(folder)
    (folder / "notes.txt").write_text("recorded on Monday\n")


@pytest.mark.parametrize("write", [without_times, of_numpy, of_words, with_notes])
def test_files_without_times_need_a_rate(
    folder: Path, robot: Robot, write: Callable[[Path], None]
) -> None:
    write(folder)
    with pytest.raises(SourceError) as caught:
        read(folder, robot)
    assert caught.value.remedy == "state --sample-rate HZ"
    imported = read(folder, robot, AT_RATE)
    for name, values in (("position", POSITION), ("velocity", SLOPE), ("torque", TORQUE)):
        np.testing.assert_allclose(columns(imported, name), values, atol=1e-7)
    assert imported.map_text is not None
    path = folder.parent / "map.toml"
    path.write_text(imported.map_text)
    again = read(folder, robot, ImportOptions(columns=path))
    np.testing.assert_array_equal(columns(again, "torque"), columns(imported, "torque"))


def test_times_in_a_file_of_their_own(folder: Path, robot: Robot) -> None:
    without_times(folder)
    texts(folder, {"t.txt": TIME})
    stamp = columns(read(folder, robot), "stamp")
    np.testing.assert_allclose(1e-9 * (stamp - stamp[0]), TIME, atol=1e-8)


def test_times_in_the_first_column_of_each_file(folder: Path, robot: Robot) -> None:
    for name, values in (("q.txt", POSITION), ("tau.txt", TORQUE)):
        texts(folder, {name: np.column_stack([TIME, values])})
    imported = read(folder, robot)
    np.testing.assert_allclose(columns(imported, "torque"), TORQUE, atol=1e-7)
    assert not any(isinstance(each, OneTimeBase) for each in imported.examined.found)


def test_a_file_for_each_joint(folder: Path, robot: Robot) -> None:
    for joint in range(3):
        texts(folder, {f"q_{joint + 1}.txt": POSITION[:, joint]})
        texts(folder, {f"tau_{joint + 1}.txt": TORQUE[:, joint]})
    np.testing.assert_allclose(columns(read(folder, robot, AT_RATE), "torque"), TORQUE, atol=1e-7)


def test_files_with_headers_and_their_own_clocks(folder: Path, robot: Robot) -> None:
    """Two topics at 250 and 100 Hz: torques stay, positions are interpolated to their times."""
    late = np.arange(0.0007, TIME[-1], 0.01)
    torque = np.column_stack([20.0 * np.cos(2.0 * late + k) for k in range(3)])
    for name, prefix, time, values in (
        ("state.csv", "q", TIME, POSITION),
        ("sensor.csv", "tau", late, torque),
    ):
        header = ",".join(["time", *(f"{prefix}{k}" for k in (1, 2, 3))])
        rows = np.column_stack([time, values])
        np.savetxt(folder / name, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    imported = read(folder, robot)
    expected = np.column_stack([0.9 * np.sin(2.0 * late + k) for k in range(3)])
    inside = late <= TIME[-1]
    np.testing.assert_allclose(columns(imported, "torque"), torque[inside], atol=1e-7)
    np.testing.assert_allclose(columns(imported, "position"), expected[inside], atol=1e-7)
    (base,) = (each for each in imported.examined.found if isinstance(each, OneTimeBase))
    assert base.base == "torque"
    assert base.counts == {"position": len(TIME), "torque": len(late)}


def test_commands_of_a_file_that_is_named_so(folder: Path, robot: Robot) -> None:
    header = "timestamp,positions"
    lists = [
        f'{1e6 * t:.6f},"[{a}, {b}, {c}]"'
        for t, (a, b, c) in zip(TIME, POSITION.tolist(), strict=True)
    ]
    (folder / "control.csv").write_text("\n".join([header, *lists]) + "\n")
    (folder / "state.csv").write_text("\n".join([header, *lists]) + "\n")
    imported = read(folder, robot)
    assert "commanded_position" in imported.archive.columns


def test_several_files_of_one_quantity_are_to_be_chosen_from(folder: Path, robot: Robot) -> None:
    for part in ("train", "test"):
        texts(folder, {f"q_{part}.txt": POSITION, f"tau_{part}.txt": TORQUE})
    chosen: dict[str, str] = {}
    for _ in range(2):
        with pytest.raises(SourceError) as caught:
            read(folder, robot, ImportOptions(chosen=chosen, sample_rate=RATE))
        options = re.findall(r"--columns '(\w+)=([^']+)'", caught.value.remedy)
        chosen.update([next(each for each in options if "train" in each[1])])
    imported = read(folder, robot, ImportOptions(chosen=chosen, sample_rate=RATE))
    np.testing.assert_allclose(columns(imported, "torque"), TORQUE, atol=1e-7)


def test_files_that_name_no_quantity_are_listed(folder: Path, robot: Robot) -> None:
    texts(folder, {"a.txt": POSITION, "b.txt": TORQUE})
    with pytest.raises(SourceError, match="they are a") as caught:
        read(folder, robot, AT_RATE)
    assert re.findall(r"(\w+)=FILE", caught.value.remedy) == ["position", "torque"]
    chosen = {"position": "a.txt", "torque": "b.txt"}
    imported = read(folder, robot, ImportOptions(chosen=chosen, sample_rate=RATE))
    np.testing.assert_allclose(columns(imported, "torque"), TORQUE, atol=1e-7)


def test_quantities_that_were_not_recorded_together(folder: Path, robot: Robot) -> None:
    for name, values, start in (("q.txt", POSITION, 0.0), ("tau.txt", TORQUE, 100.0)):
        texts(folder, {name: np.column_stack([TIME + start, values])})
    with pytest.raises(SourceError, match="not recorded at the same time") as caught:
        read(folder, robot)
    assert caught.value.field == "time"


def test_a_folder_of_archives_or_a_bag_is_none_of_logs(folder: Path) -> None:
    texts(folder, {"q.txt": POSITION})
    assert is_folder_of_logs(folder)
    (folder / "manifest.json").write_text("{}")
    assert not is_folder_of_logs(folder)


def interleaved(path: Path) -> Path:
    """Write two topics into one table, each in rows of its own, as PlotJuggler does."""
    late = np.arange(0.0007, TIME[-1], 0.01)
    lines = [
        (t, [f"{v:.9g}" for v in row] + [""] * 3) for t, row in zip(TIME, POSITION, strict=True)
    ]
    lines += [(t, [""] * 3 + [f"{20.0 * np.cos(2.0 * t + k):.9g}" for k in range(3)]) for t in late]
    lines.sort(key=lambda line: line[0])
    header = [
        "__time",
        *(f"/js/{j}/position" for j in JOINTS),
        *(f"/ft/{j}/effort" for j in JOINTS),
    ]
    body = [",".join([f"{t:.6f}", *cells]) for t, cells in lines]
    path.write_text("\n".join([",".join(header), *body]) + "\n")
    return path


@pytest.mark.parametrize("drop", [False, True])
def test_topics_in_rows_of_their_own_are_interpolated(
    tmp_path: Path, robot: Robot, drop: bool
) -> None:
    log = interleaved(tmp_path / "plotjuggler.csv")
    imported = read_recording(log, lambda _: robot, ImportOptions(drop_missing=drop))
    stamp = 1e-9 * columns(imported, "stamp") + 0.0
    clock = stamp - stamp[0] + 0.0007
    expected = np.column_stack([20.0 * np.cos(2.0 * clock + k) for k in range(3)])
    np.testing.assert_allclose(columns(imported, "torque"), expected, atol=1e-5)
    expected = np.column_stack([0.9 * np.sin(2.0 * clock + k) for k in range(3)])
    np.testing.assert_allclose(columns(imported, "position"), expected, atol=1e-5)
    assert imported.map_text is not None
    assert 'missing = "interpolate"' in imported.map_text


def test_a_gap_of_one_topic_takes_no_invented_values(tmp_path: Path, robot: Robot) -> None:
    log = interleaved(tmp_path / "plotjuggler.csv")
    lines = log.read_text().splitlines()

    def is_lost(line: str) -> bool:
        return line.endswith(",,,") and 0.5 < float(line.split(",")[0]) < 0.9

    kept = [
        lines[0],
        *(line for line in lines[1:] if not is_lost(line)),
    ]
    log.write_text("\n".join(kept) + "\n")
    imported = read_recording(log, lambda _: robot, ImportOptions())
    stamp = columns(imported, "stamp")
    assert 0.35 < 1e-9 * np.diff(stamp).max() < 0.45
    (base,) = (each for each in imported.examined.found if isinstance(each, OneTimeBase))
    assert 30 <= base.left_out <= 45
