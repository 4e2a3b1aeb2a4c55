"""Logs whose torque or zeros are other than stated: named rightly, or called good by nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import InputError, SourceError
from hil.base.progress import Silent
from hil.cli import app
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions, RobotOf, import_recording
from hil.look import look_at
from hil.look.readings import Changes, Fact
from hil.look.result import Row
from hil.payload.payload_run import find_payload
from hil.pipeline.identification import identify_archives
from identification.validation.finding_messages import (
    NO_BODIES,
    OTHER_TIMES,
    RATE_OF_TORQUE,
    TORQUE_AND_MOTION,
)
from tests.hil.diagnosis_cases import CASES, URDF, identified, needs_the_cases, rigid_error
from tests.near import near

pytestmark = [pytest.mark.slow, needs_the_cases]

THREE = CASES / "09-several-zeros" / "three.csv"
ZEROS = {1: 0.35, 2: -0.2, 4: 0.15}  # rad, by joint
SUBTRACTED = CASES / "06-torque-already-compensated" / "residual_97.csv"


def robot_of(_: object) -> Robot:
    return Robot.from_urdf(URDF)


def archived(log: Path, folder: Path, robot: RobotOf = robot_of) -> Path:
    """Import a log as it is recorded, without asking what its torque says."""
    archive = folder / f"{log.stem}.mcap"
    import_recording(log, archive, robot, ImportOptions())
    return archive


def test_several_zeros_are_found_at_once() -> None:
    (row,) = [row for row in look_at(THREE, robot_of, ImportOptions()).rows if row.aspect == "zero"]
    assert row.certainty is Certainty.CERTAIN
    assert isinstance(row.reading, Changes)
    found = {each.change.joints[0]: each.change.size for each in row.reading.changes}
    assert found == pytest.approx(ZEROS, abs=np.radians(2.0))


def test_an_identification_corrects_them() -> None:
    arm = identified(THREE)
    assert arm.verdict.good
    assert rigid_error(arm) < 0.02


def test_an_archive_is_asked_the_same_as_its_log(tmp_path: Path) -> None:
    found = identify_archives([archived(THREE, tmp_path)], Silent())
    assert not found.verdict.good
    diagnosis = found.validation.evidence.diagnosis
    assert diagnosis is not None
    sizes = {step.change.joints[0]: step.change.size for step in diagnosis.zeros}
    assert sizes == pytest.approx(ZEROS, abs=np.radians(2.0))


def test_torque_without_bodies_is_named_by_a_look() -> None:
    look = look_at(SUBTRACTED, robot_of, ImportOptions())
    assert Fact.NO_BODIES in [row.reading for row in look.rows]
    assert not look.questions
    certain = {row.aspect for row in look.rows if row.certainty is Certainty.CERTAIN}
    assert not certain & {"order", "signs", "zero", "gravity", "mounting", "side"}


def test_torque_without_bodies_is_refused_or_called_wrong(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="model of the arm was subtracted"):
        identified(SUBTRACTED)
    verdict = identify_archives([archived(SUBTRACTED, tmp_path)], Silent()).verdict
    assert not verdict.good
    assert next(each.check for each in verdict.findings if each.level == "wrong") == NO_BODIES


def test_no_load_is_weighed_without_gravity(tmp_path: Path) -> None:
    folder = CASES / "06-torque-already-compensated"
    bare, loaded = (archived(folder / f"{name}.csv", tmp_path) for name in ("bare_g", "full_g"))
    with pytest.raises(InputError, match="gravity was removed from the torque"):
        find_payload([bare], [loaded], Silent())


def test_a_load_without_gravity_is_weighed_by_inertia(tmp_path: Path) -> None:
    """3.0 kg, of which the flange bears the weight."""
    folder = CASES / "06-torque-already-compensated"
    archives = [tmp_path / f"{name}.mcap" for name in ("bare_g", "full_g")]
    for archive in archives:
        log = folder / f"{archive.stem}.csv"
        line = ["import", "log", str(log), "--urdf", str(URDF), "-o", str(archive)]
        assert CliRunner().invoke(app, line).exit_code == 0
    found = find_payload(archives[:1], archives[1:], Silent())
    low, high = found.estimate.intervals[0]
    assert low < 3.0 < high
    assert high - low < 0.5
    assert found.wrist_torque[0] == near(9.81 * 3.0 * 0.092, rel=0.1)


def test_a_batch_is_told_the_same_of_a_log_and_of_its_archive(tmp_path: Path) -> None:
    archive = archived(SUBTRACTED, tmp_path)
    for words in ((archive,), (SUBTRACTED, "--urdf", URDF)):
        result = CliRunner().invoke(app, ["batch", *map(str, words)])
        shown = " ".join(f"{result.output} {result.exception or ''}".split())
        assert "a model of the arm was subtracted from it" in shown


@pytest.mark.parametrize(
    ("log", "aspect"),
    [
        (THREE, "zero"),
        (SUBTRACTED, "bodies"),
        (CASES / "06-torque-already-compensated" / "bare_g.csv", "gravity"),
    ],
    ids=["zeros", "no bodies", "no gravity"],
)
def test_a_look_at_an_archive_is_that_of_its_log(log: Path, aspect: str, tmp_path: Path) -> None:
    """An archive has its robot in it: none need be given."""
    readings = [
        [row.reading for row in look.rows if row.aspect == aspect and is_certain(row)]
        for look in (
            look_at(log, robot_of, ImportOptions()),
            look_at(archived(log, tmp_path), None, ImportOptions()),
        )
    ]
    of_log, of_archive = readings
    assert len(of_log) == 1
    assert str(of_archive) == str(of_log)


def is_certain(row: Row) -> bool:
    return row.certainty is Certainty.CERTAIN


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda torque: np.where(np.arange(6) == 1, 3.0, torque), "of j2 is 3 throughout"),
        (np.abs, "no torque is ever negative, although 6 joints move"),
    ],
    ids=["one value", "no sign"],
)
def test_a_torque_that_was_not_measured_is_refused(
    damage: Callable[[Any], Any], sentence: str, tmp_path: Path
) -> None:
    """By what it is, not as that of another arm."""
    log = CASES / "11-urdf-units" / "log.csv"
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    table[:, 7:] = damage(table[:, 7:])
    damaged = tmp_path / "log.csv"
    header = log.read_text().split("\n", 1)[0]
    np.savetxt(damaged, table, delimiter=",", header=header, comments="", fmt="%.10g")
    with pytest.raises(SourceError, match=sentence):
        identified(damaged)


PLAIN = CASES / "11-urdf-units" / "log.csv"


def damaged_log(folder: Path, damage: Callable[[Any], Any]) -> Path:
    """The log of an arm as described, with its table changed."""
    path = folder / "damaged.csv"
    header = PLAIN.read_text().split("\n", 1)[0]
    table = damage(np.loadtxt(PLAIN, delimiter=",", skiprows=1))
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.10g")
    return path


def twice_as_long(table: Any) -> Any:
    return np.column_stack([2.0 * table[:, :1], table[:, 1:]])


def drifting(table: Any) -> Any:
    drifts = table.copy()
    drifts[:, 2] += np.linspace(0.0, 0.2, len(table))
    return drifts


def its_rate(table: Any) -> Any:
    rate = np.gradient(table[:, 7:], table[:, 0], axis=0)
    return np.column_stack([table[:, :7], rate])


def of_another_run(table: Any) -> Any:
    return np.column_stack([table[:, :7], np.roll(table[:, 7:], 400, axis=0)])


@pytest.mark.parametrize(
    ("damage", "check", "refusal"),
    [
        (twice_as_long, OTHER_TIMES, ""),
        (drifting, "zeros", ""),
        (its_rate, RATE_OF_TORQUE, "is a torque rate"),
        (of_another_run, TORQUE_AND_MOTION, "from another run than the positions"),
    ],
    ids=["times", "drift", "rate", "another run"],
)
def test_a_log_and_its_archive_are_told_the_same(
    damage: Callable[[Any], Any], check: str, refusal: str, tmp_path: Path
) -> None:
    """The verdict names it first, of a log and of an archive of it."""
    log = damaged_log(tmp_path, damage)
    verdicts = [identify_archives([archived(log, tmp_path)], Silent()).verdict]
    if refusal:
        with pytest.raises(SourceError, match=refusal):
            identified(log)
    else:
        verdicts.append(identified(log).verdict)
    for verdict in verdicts:
        assert not verdict.good
        assert next(each.check for each in verdict.findings if each.level == "wrong") == check
