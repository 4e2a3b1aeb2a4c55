"""Rows and clock of logs with a known fault: named, and harmless where that is safe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from hil.archive import open_archive
from hil.base.errors import SourceError
from hil.identified.identified_arm import arm_from
from hil.importers.conclusions import ClockRestarted, CopiedCommands, RowCounter
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions, read_recording
from hil.look import look_at
from hil.look.readings import Fact, RowsReading
from identification.signals.row_faults import RowFaultKind
from tests.hil.diagnosis_cases import CASES, URDF, identified, needs_the_cases, rigid_error

pytestmark = [pytest.mark.slow, needs_the_cases]


def rows_of(log: str) -> np.ndarray[Any, Any]:
    return np.genfromtxt(CASES / log, delimiter=",", skip_header=1)


def written(path: Path, time: Any, values: Any) -> Path:
    names = ["t", *(f"q{k}" for k in range(1, 7)), *(f"tau{k}" for k in range(1, 7))]
    table = np.column_stack([time, values])
    np.savetxt(path, table, fmt="%.8g", delimiter=",", header=",".join(names), comments="")
    return path


def clean() -> np.ndarray[Any, Any]:
    """Positions and torques at 250 Hz: rows of the log whose stamps alone are wrong."""
    return rows_of("10-rows/bursts.csv")[:, 1:]


def bursts(_: Path) -> Path:
    return CASES / "10-rows" / "bursts.csv"


def frozen(_: Path) -> Path:
    return CASES / "10-rows" / "frozen.csv"


def jittered(folder: Path) -> Path:
    values = clean()
    late = np.random.default_rng(0).uniform(0.0, 0.016, len(values))
    return written(folder / "jitter.csv", np.sort(np.arange(len(values)) / 250 + late), values)


def repeated_and_lost(folder: Path) -> Path:
    random = np.random.default_rng(0)
    values = clean()
    time = np.arange(len(values)) / 250 + random.uniform(0.0, 0.0024, len(values))
    again = np.flatnonzero(random.random(len(values)) < 0.05)[1:]
    values[again] = values[again - 1]
    kept = random.random(len(values)) > 0.02
    return written(folder / "rows.csv", time[kept], values[kept])


def written_twice(folder: Path) -> Path:
    values = clean()
    values = np.vstack([values[:2000], values[1700:]])
    return written(folder / "twice.csv", np.arange(len(values)) / 250, values)


def two_motions(folder: Path) -> Path:
    values = clean()
    values = np.vstack([values[1700:], values[:1700]])
    return written(folder / "two.csv", np.arange(len(values)) / 250, values)


def restarted_clock(folder: Path) -> Path:
    values = clean()
    time = np.arange(len(values)) / 250
    values = np.vstack([values[1700:], values[:1700]])
    return written(folder / "restart.csv", np.append(time[:1800], time[:1700]), values)


def two_topics(_: Path) -> Path:
    return CASES / "03-plotjuggler-async" / "async.csv"


FAULTS: Final[dict[Any, Sequence[RowFaultKind]]] = {
    bursts: (),
    frozen: (RowFaultKind.FROZEN,),
    jittered: (),
    repeated_and_lost: (),
    written_twice: (RowFaultKind.WRITTEN_TWICE,),
    two_motions: (RowFaultKind.JUMP,),
    restarted_clock: (),
    two_topics: (),
}


@pytest.mark.parametrize("write", FAULTS)
def test_the_arm_is_found_all_the_same(write: Any, tmp_path: Path) -> None:
    arm = identified(write(tmp_path))
    assert arm.verdict.good
    assert rigid_error(arm) < 0.003
    sources = arm.identification.prepared.sources.training
    assert [fault.kind for fault in sources[0].faults] == list(FAULTS[write])
    checks = [finding.check for finding in arm.results.judgement.findings]
    assert ("rows" in checks) == bool(FAULTS[write])


def test_held_out_stamps_are_judged_as_those_that_are_fitted(tmp_path: Path) -> None:
    """A second file with jitter is predicted at even times, too."""
    values = clean()
    random = np.random.default_rng(1)
    time = np.arange(len(values)) / 250 + random.uniform(0.0, 0.0036, len(values))
    fitted = written(tmp_path / "fitted.csv", time[:2200], values[:2200])
    other = written(tmp_path / "other.csv", time[2200:], values[2200:])
    arm = arm_from(fitted, URDF, None, other, None, None, None)
    assert arm.verdict.good
    sources = arm.identification.prepared.sources
    for source in (*sources.training, *sources.held_out):
        assert source.times is not None
        assert source.times.even
    assert arm.results.validation[0].all_rows_relative_error < 0.01


def test_look_names_the_rows() -> None:
    looked = look_at(frozen(CASES), lambda _: Robot.from_urdf(URDF), ImportOptions())
    (row,) = (each for each in looked.rows if each.aspect == "rows")
    assert isinstance(row.reading, RowsReading)
    assert [fault.kind for fault in row.reading.faults] == [RowFaultKind.FROZEN]
    assert not looked.questions


def test_an_archive_is_asked_the_same_as_its_log(tmp_path: Path) -> None:
    imported = read_recording(frozen(CASES), lambda _: Robot.from_urdf(URDF), ImportOptions())
    imported.write(tmp_path / "frozen.mcap")
    arm = arm_from(tmp_path / "frozen.mcap", None, None, (), None, None, None)
    assert "rows" in [finding.check for finding in arm.results.judgement.findings]
    assert arm.verdict.good


class TestCommandsAsPositions:
    LOG: Final = CASES / "04-commanded-as-measured" / "open_loop.csv"

    def test_they_are_named_and_their_lag_is_no_delay_of_the_torque(self) -> None:
        arm = identified(self.LOG)
        assert not arm.verdict.good
        causes = {
            finding.check for finding in arm.results.judgement.findings if finding.level == "wrong"
        }
        assert "positions" in causes
        assert "delay" not in causes

    def test_look_is_certain_of_them(self) -> None:
        looked = look_at(self.LOG, lambda _: Robot.from_urdf(URDF), ImportOptions())
        (row,) = (each for each in looked.rows if each.aspect == "positions")
        assert row.reading is Fact.COMMANDED
        assert any(isinstance(each, CopiedCommands) for each in row.evidence)

    def test_another_column_of_positions_is_named(self, tmp_path: Path) -> None:
        lines = self.LOG.read_text().splitlines()
        names = [f"joint_position_{k}" for k in range(6)]
        table = [",".join([lines[0], *names])]
        for line in lines[1:]:
            cells = line.split(",")
            table.append(",".join([line, *(f"{float(c) + 0.001:.6f}" for c in cells[1:7])]))
        log = tmp_path / "log.csv"
        log.write_text("\n".join(table) + "\n")
        chosen = {"position": "measured_joint_position_{}"}
        options = ImportOptions(chosen=chosen)
        imported = read_recording(log, lambda _: Robot.from_urdf(URDF), options)
        (copied,) = (e for e in imported.examined.found if isinstance(e, CopiedCommands))
        assert copied.measured == ("joint_position_{}",)
        options = ImportOptions(chosen={"position": copied.measured[0]})
        imported = read_recording(log, lambda _: Robot.from_urdf(URDF), options)
        assert not [e for e in imported.examined.found if isinstance(e, CopiedCommands)]


class TestCyclesAsTime:
    FOLDER: Final = CASES / "02-cycle-counter-as-time"

    def test_a_column_that_counts_rows_is_no_time(self) -> None:
        with pytest.raises(SourceError, match="counts the rows") as caught:
            identified(self.FOLDER / "time_counter.csv")
        assert "--sample-rate" in caught.value.remedy
        arm = identified(self.FOLDER / "time_counter.csv", sample_rate=250.0)
        assert arm.verdict.good
        assert rigid_error(arm) < 0.003

    def test_a_map_that_reads_it_in_ms_is_a_cause(self, tmp_path: Path) -> None:
        options = ImportOptions(columns=self.FOLDER / "ms.toml")
        log = self.FOLDER / "time_counter.csv"
        imported = read_recording(log, lambda _: Robot.from_urdf(URDF), options)
        assert any(isinstance(each, RowCounter) for each in imported.examined.found)
        arm = identified(log, columns=self.FOLDER / "ms.toml")
        assert not arm.verdict.good
        assert "time" in [finding.check for finding in arm.results.judgement.findings]


def test_a_clock_that_begins_again_is_two_motions(tmp_path: Path) -> None:
    log = restarted_clock(tmp_path)
    imported = read_recording(log, lambda _: Robot.from_urdf(URDF), ImportOptions())
    assert any(isinstance(each, ClockRestarted) for each in imported.examined.found)
    imported.write(tmp_path / "log.mcap")
    stamp = open_archive(tmp_path / "log.mcap").columns["stamp"]
    assert np.count_nonzero(np.diff(stamp) > 5e8) == 1
