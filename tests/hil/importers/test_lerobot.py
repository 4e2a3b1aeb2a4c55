"""Data sets of LeRobot: episodes as recordings, joints and units from the metadata."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from hil.base.errors import InputError, SourceError
from hil.cli import app
from hil.importers.conclusions import EpisodeUnits, UnitsFrom
from hil.importers.imported_robot import Robot
from hil.importers.lerobot import DataSet, is_data_set
from hil.importers.recording_import import ImportOptions, read_episodes, read_recording
from hil.look import look_at
from hil.look.readings import Channels
from hil.pipeline.sources import refuse_duplicates
from tests.hil.importers.lerobot_set import (
    FPS,
    JOINTS,
    LOWER,
    REACH,
    UPPER,
    Array,
    motion,
    write_urdf,
)


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    return write_urdf(tmp_path)


def percent(gripper: Array) -> Array:
    return 100.0 * (gripper - LOWER) / (UPPER - LOWER)


def in_degrees(position: Array) -> Array:
    return np.column_stack([np.degrees(position[:, :2]), percent(position[:, 2])])


def in_range(position: Array, reach: float = REACH) -> Array:
    return np.column_stack([100.0 * position[:, :2] / reach, percent(position[:, 2])])


def written(
    folder: Path,
    episodes: list[tuple[Array, Array]],
    *,
    version: str = "v2.1",
    names: Any = None,
    fixed: bool = False,
) -> Path:
    """Write states and actions of episodes as LeRobot does."""
    stated = [f"{name}.pos" for name in JOINTS] if names is None else names
    feature = {"dtype": "float32", "shape": [3], "names": stated}
    info = {
        "codebase_version": version,
        "total_episodes": len(episodes),
        "fps": FPS,
        "features": {"observation.state": feature, "action": feature},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    tables = []
    numbers = pa.list_(pa.float32(), 3) if fixed else pa.list_(pa.float32())
    for k, (state, action) in enumerate(episodes):
        rows = np.arange(len(state))
        tables.append(
            pa.table(
                {
                    "observation.state": pa.array(state.tolist(), numbers),
                    "action": pa.array(action.tolist(), numbers),
                    "timestamp": pa.array(rows / FPS, pa.float32()),
                    "frame_index": rows,
                    "episode_index": np.full(len(rows), k),
                    "task_index": np.zeros(len(rows), np.int64),
                }
            )
        )
    if version == "v3.0":
        parquet.write_table(pa.concat_tables(tables[:2]), chunk / "file-000.parquet")
        if tables[2:]:
            second = folder / "data" / "chunk-001"
            second.mkdir()
            parquet.write_table(pa.concat_tables(tables[2:]), second / "file-000.parquet")
    else:
        for k, table in enumerate(tables):
            parquet.write_table(table, chunk / f"episode_{k:06d}.parquet")
    return folder


def recordings(
    folder: Path, urdf: Path, **options: Any
) -> list[tuple[str, dict[str, Array], tuple[object, ...]]]:
    """Return names, columns and conclusions of the episodes."""
    robot = Robot.from_urdf(urdf)
    read = read_episodes(
        folder, lambda _: robot, ImportOptions(**options), place_of=lambda path: path
    )
    return [
        (path.stem, dict(recording.archive.columns), recording.concluded)
        for path, recording in read
    ]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_episodes_of_every_version_are_recordings(tmp_path: Path, urdf: Path, version: str) -> None:
    first, second = motion(4.0, 0.0), motion(3.0, 1.0)
    lag = 0.02
    episodes = [(in_degrees(q), in_degrees(q + lag)) for q in (first, second)]
    folder = written(tmp_path / "pick", episodes, version=version)
    assert is_data_set(folder)
    found = recordings(folder, urdf, units="deg")
    assert [name for name, _, _ in found] == ["pick_episode_000000", "pick_episode_000001"]
    for (_, columns, _), position in zip(found, (first, second), strict=True):
        np.testing.assert_allclose(columns["position"], position, atol=1e-5)
        np.testing.assert_allclose(columns["commanded_position"], position + lag, atol=1e-5)
        assert "torque" not in columns
        stamps = columns["stamp"] - columns["stamp"][0]
        np.testing.assert_allclose(1e-9 * stamps, np.arange(len(position)) / FPS, atol=1e-5)


def test_chunks_have_several_files_of_several_episodes(tmp_path: Path, urdf: Path) -> None:
    motions = [motion(duration, phase) for duration, phase in ((4.0, 0.0), (3.0, 1.0), (5.0, 2.0))]
    episodes = [(in_degrees(q), in_degrees(q)) for q in motions]
    folder = written(tmp_path / "pick", episodes, version="v3.0", fixed=True)
    assert len([*folder.rglob("data/**/*.parquet")]) == 2
    found = recordings(folder, urdf, units="deg")
    assert [name[-6:] for name, _, _ in found] == ["000000", "000001", "000002"]
    for (_, columns, _), position in zip(found, motions, strict=True):
        np.testing.assert_allclose(columns["position"], position, atol=1e-5)


def test_a_missing_episode_is_named(tmp_path: Path) -> None:
    episodes = [(in_degrees(q), in_degrees(q)) for q in (motion(4.0, 0.0), motion(3.0, 1.0))]
    folder = written(tmp_path / "pick", episodes)
    table = folder / "data" / "chunk-000" / "episode_000001.parquet"
    table.unlink()
    with pytest.raises(SourceError, match=r"has 1 of 2 episodes .*: no 1") as refused:
        DataSet.read(folder)
    assert refused.value.remedy
    table.with_name("episode_000000.parquet").unlink()
    with pytest.raises(SourceError, match="has 0 of 2 episodes"):
        DataSet.read(folder)


def test_a_look_needs_the_arm(tmp_path: Path) -> None:
    folder = written(tmp_path / "pick", [(in_degrees(motion(4.0, 0.0)),) * 2])
    with pytest.raises(SourceError, match="data set of LeRobot") as refused:
        look_at(folder, None, ImportOptions())
    assert refused.value.remedy == "add --urdf ARM.urdf"


@pytest.mark.parametrize("version", ["v1.6", "v4.0"])
def test_other_versions_are_refused(tmp_path: Path, version: str) -> None:
    data = in_degrees(motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)], version=version)
    with pytest.raises(SourceError, match=f"is of version {version[1:]}") as refused:
        DataSet.read(folder)
    assert refused.value.remedy
    (folder / "meta").rename(folder / "meta_data")  # as of versions 1
    assert is_data_set(folder)
    with pytest.raises(SourceError, match="is of version 1"):
        DataSet.read(folder)


def test_a_calibration_of_another_arm_is_refused(tmp_path: Path, urdf: Path) -> None:
    data = in_range(motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)])
    calibration = tmp_path / "arm.json"
    ends = {"range_min": 2000, "range_max": 2010}
    calibration.write_text(json.dumps(dict.fromkeys(JOINTS, ends)))
    with pytest.raises(SourceError, match=r"calibrates 0\.0153 rad") as refused:
        recordings(folder, urdf, calibration=calibration)
    assert refused.value.remedy


def test_numbers_beyond_100_are_degrees(tmp_path: Path, urdf: Path) -> None:
    position = motion(4.0, 0.0) * np.array([1.2, 1.0, 1.0])
    data = in_degrees(position)
    assert np.abs(data[:, 0]).max() > 101.0
    folder = written(tmp_path / "pick", [(data, data)])
    ((_, columns, concluded),) = recordings(folder, urdf)
    np.testing.assert_allclose(columns["position"], position, atol=1e-5)
    assert EpisodeUnits("deg", UnitsFrom.BEYOND_RANGE) in concluded


def test_a_calibration_gives_the_range_of_each_joint(tmp_path: Path, urdf: Path) -> None:
    reach = 1.6
    position = motion(4.0, 0.0)
    data = in_range(position, reach)
    folder = written(tmp_path / "pick", [(data, data)])
    steps = 4095.0 / (2.0 * np.pi)
    spans = {"pan": 2.0 * reach, "lift": 2.0 * reach, "gripper": UPPER - LOWER}
    calibration = tmp_path / "arm.json"
    calibration.write_text(
        json.dumps(
            {
                name: {"id": k, "range_min": 900.0, "range_max": 900.0 + steps * span}
                for k, (name, span) in enumerate(spans.items())
            }
        )
    )
    ((_, columns, concluded),) = recordings(folder, urdf, calibration=calibration)
    np.testing.assert_allclose(columns["position"], position, atol=1e-5)
    assert EpisodeUnits("range", UnitsFrom.CALIBRATION) in concluded


def test_a_map_states_units_and_range_of_every_episode(tmp_path: Path, urdf: Path) -> None:
    """The map of one episode, as `hil look -o` writes it, reads all of them without options."""
    first, second = motion(4.0, 0.0), motion(3.0, 1.0)
    folder = written(tmp_path / "pick", [(in_degrees(q), in_degrees(q)) for q in (first, second)])
    robot = Robot.from_urdf(urdf)
    stated = read_recording(folder, lambda _: robot, ImportOptions(units="deg"))
    assert stated.text is not None
    (tmp_path / "map.toml").write_text(stated.text)
    found = recordings(folder, urdf, columns=tmp_path / "map.toml")
    for (_, columns, concluded), position in zip(found, (first, second), strict=True):
        np.testing.assert_allclose(columns["position"], position, atol=1e-5)
        assert not concluded


def test_the_range_may_be_that_of_the_urdf(tmp_path: Path, urdf: Path) -> None:
    position = motion(4.0, 0.0)
    folder = written(tmp_path / "pick", [(in_range(position), in_range(position))])
    ((_, columns, _),) = recordings(folder, urdf, units="range")
    np.testing.assert_allclose(columns["position"], position, atol=1e-5)


def test_units_that_may_be_either_are_asked_for(tmp_path: Path, urdf: Path) -> None:
    data = in_degrees(0.5 * motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)])
    with pytest.raises(SourceError, match="degrees, or -100 to 100") as refused:
        recordings(folder, urdf)
    assert "--calibration" in str(refused.value.remedy)


@pytest.mark.parametrize(
    "names",
    [["main_pan", "main_lift", "main_gripper"], {"motors": ["pan", "lift", "gripper"]}],
    ids=["prefix", "motors"],
)
def test_names_of_earlier_versions_are_joints(tmp_path: Path, urdf: Path, names: Any) -> None:
    data = in_degrees(motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)], names=names)
    assert DataSet.read(folder).joints == JOINTS
    ((_, columns, _),) = recordings(folder, urdf, units="deg")
    assert columns["position"].shape[1] == 3


def test_a_calibration_of_other_joints_is_refused(tmp_path: Path, urdf: Path) -> None:
    data = in_range(motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)])
    calibration = tmp_path / "arm.json"
    calibration.write_text('{"other": {"range_min": 1, "range_max": 2}}')
    with pytest.raises(SourceError, match="is not a LeRobot calibration") as refused:
        recordings(folder, urdf, calibration=calibration)
    assert refused.value.remedy


def test_a_data_set_without_joints_is_refused(tmp_path: Path, urdf: Path) -> None:
    data = in_degrees(motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)], names=[0, 1, 2])
    with pytest.raises(SourceError, match="has no numbers for observation"):
        recordings(folder, urdf, units="deg")


def test_episodes_of_one_file_are_no_copies(tmp_path: Path, urdf: Path) -> None:
    episodes = [(in_degrees(q), in_degrees(q)) for q in (motion(3.0, 0.0), motion(5.0, 1.0))]
    folder = written(tmp_path / "pick", episodes, version="v3.0")
    robot = Robot.from_urdf(urdf)
    options = ImportOptions(units="deg")
    read = read_episodes(folder, lambda _: robot, options, place_of=lambda path: path)
    archives = [recording.archive for _, recording in read]
    refuse_duplicates(archives)
    with pytest.raises(InputError, match="was given twice"):
        refuse_duplicates([*archives, archives[0]])


def test_a_look_reads_the_longest_episode(tmp_path: Path, urdf: Path) -> None:
    episodes = [(in_degrees(q), in_degrees(q)) for q in (motion(3.0, 0.0), motion(5.0, 1.0))]
    folder = written(tmp_path / "pick", episodes, version="v3.0")
    done = CliRunner().invoke(app, ["look", str(folder), "--urdf", str(urdf), "--units", "deg"])
    assert "250 samples" in done.output


TURN = 2.0 * np.pi / 4095.0


def calibrated(folder: Path, reach: float) -> Path:
    """Write LeRobot's calibration of the arm."""
    spans = {"pan": 2.0 * reach, "lift": 2.0 * reach, "gripper": UPPER - LOWER}
    path = folder / "arm.json"
    ends = {name: {"range_min": 900.0, "range_max": 900.0 + s / TURN} for name, s in spans.items()}
    path.write_text(json.dumps(ends))
    return path


@pytest.mark.parametrize(
    ("unit", "recorded", "with_calibration"),
    [
        ("deg", in_degrees, False),
        ("deg", in_degrees, True),
        ("range", in_range, True),
        ("rad", lambda position: position, False),
    ],
)
def test_steps_of_the_encoders_say_the_unit(
    tmp_path: Path, urdf: Path, unit: Any, recorded: Any, with_calibration: bool
) -> None:
    """Small motion, which would fit each of them."""
    position = TURN * np.round(0.3 * motion(4.0, 0.0) / TURN)
    folder = written(tmp_path / "pick", [(recorded(position), recorded(position))])
    calibration = calibrated(tmp_path, REACH) if with_calibration else None
    ((_, columns, concluded),) = recordings(folder, urdf, calibration=calibration)
    assert EpisodeUnits(unit, UnitsFrom.ENCODER) in concluded
    np.testing.assert_allclose(columns["position"][:, :2], position[:, :2], atol=1e-3)


def test_a_calibration_does_not_say_the_unit(tmp_path: Path, urdf: Path) -> None:
    """LeRobot writes degrees or the range, with one calibration."""
    data = in_degrees(0.5 * motion(4.0, 0.0))
    folder = written(tmp_path / "pick", [(data, data)])
    with pytest.raises(SourceError, match="degrees, or -100 to 100"):
        recordings(folder, urdf, calibration=calibrated(tmp_path, REACH))


def test_radians_are_stated(tmp_path: Path, urdf: Path) -> None:
    position = 0.5 * motion(4.0, 0.0)
    folder = written(tmp_path / "pick", [(position, position)])
    with pytest.raises(SourceError, match="in radians"):
        recordings(folder, urdf)
    ((_, columns, _),) = recordings(folder, urdf, units="rad")
    np.testing.assert_allclose(columns["position"], position, atol=1e-5)


def test_a_look_names_the_units_and_why(tmp_path: Path, urdf: Path) -> None:
    position = TURN * np.round(0.3 * motion(4.0, 0.0) / TURN)
    folder = written(tmp_path / "pick", [(in_degrees(position), in_degrees(position))])
    robot = Robot.from_urdf(urdf)
    rows = {row.aspect: row for row in look_at(folder, lambda _: robot, ImportOptions()).rows}
    assert rows["position"].reading == Channels("observation.state", "deg")
    assert rows["position"].evidence == (EpisodeUnits("deg", UnitsFrom.ENCODER),)
