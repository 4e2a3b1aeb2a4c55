"""Remedies for logs as controllers, PLCs and spreadsheets write them, applied: each has its effect.

What a look and an identification advise is taken as values; what no test here applies fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pinocchio as pin
import pytest

from hil.base.errors import SourceError
from hil.base.progress import Silent
from hil.identified.identified_arm import IdentifiedArm, arm_from
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions, import_recording
from hil.look import look_at
from hil.look.readings import ClockReading, Decider, MapKey, NextStep
from hil.look.result import Look, Row
from hil.payload.payload_run import find_payload
from hil.pipeline.identification import Identification
from identification.validation.finding import Finding, RemedyKey, Thresholds
from identification.validation.finding_messages import Naming, worded
from identification.validation.findings.table import find
from tests.hil.simulated_logs import simulate, write_log
from tests.near import near

CASES = Path(__file__).parents[4] / "shared" / "cases" / "logs"
LOGS = (
    "header_repeated_in_the_middle.csv", "iso_time.csv", "latin1_header.csv", "msvc_nan.csv",
    "plain.csv", "quoted.csv", "thousands.csv", "uint32_us_wrap.csv", "units_row.csv",
    "unwrapped.csv", "utf16.csv", "wrapped.csv",
)  # fmt: skip
LOST = "mat73.mat"
ENCODER = 2.0 * np.pi / 2**17  # rad, of a usual one
LOAD = 2.0  # kg
NAMES = ("t", "q{}", "tau{}")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CASES.is_dir(), reason="the logs (../shared/cases/logs) are not here"),
]


def test_every_log_is_walked() -> None:
    files = {path.name for path in CASES.iterdir()} - {"README.md"}
    assert {name for name in files if not name.endswith((".toml", ".urdf"))} == {*LOGS, LOST}


def urdf_of(log: Path) -> Path:
    return CASES / ("wrapped_arm.urdf" if "wrapped" in log.name else "arm.urdf")


@dataclass(frozen=True)
class Read:
    """A log, the options it is read by, and its samples in SI units."""

    log: Path
    options: ImportOptions
    folder: Path
    time: Any
    position: Any
    torque: Any

    @classmethod
    def of(cls, log: Path, options: ImportOptions, folder: Path) -> Read:
        robot = Robot.from_urdf(urdf_of(log))
        archive = import_recording(log, folder / "read.mcap", lambda _: robot, options).archive
        time = (archive.columns["stamp"] - archive.columns["stamp"][0]) * 1e-9
        return cls(log, options, folder, time, *map(archive.columns.get, ("position", "torque")))

    def look(self, log: Path | None = None, **options: Any) -> Look:
        robot = Robot.from_urdf(urdf_of(self.log))
        by = ImportOptions(**options) if options or log else self.options
        return look_at(log or self.log, lambda _: robot, by)

    def identified(self, *logs: Path) -> IdentifiedArm:
        return arm_from([*logs], urdf_of(self.log), None, (), self.options, None, None)

    def written(self, name: str, position: Any, torque: Any) -> Path:
        return write_log(self.folder / f"{name}.csv", NAMES, self.time, position, torque)


@pytest.fixture(params=LOGS)
def read(request: pytest.FixtureRequest, tmp_path: Path) -> Read:
    """A log, read as it is or by the option that its refusal advises."""
    log = CASES / request.param
    try:
        return Read.of(log, ImportOptions(), tmp_path)
    except SourceError as error:
        assert error.remedy.startswith("correct it, or leave such rows out: --drop-missing, ")
        return Read.of(log, ImportOptions(drop_missing=True), tmp_path)


def row_of(look: Look, aspect: str) -> Row:
    (row,) = [row for row in look.rows if row.aspect == aspect]
    return row


def raw_encoder_positions(read: Read) -> None:
    counts = np.rint(read.position / ENCODER) * ENCODER
    noise = np.random.default_rng(0).normal(0.0, ENCODER, counts.shape)
    look = read.look(read.written("raw", counts + np.rint(noise / ENCODER) * ENCODER, read.torque))
    assert not row_of(look, "positions").has_step


def zeros_of_a_posture(read: Read) -> None:
    """The posture is that of the URDF: no zero is left to be compared."""
    text = read.look().map_text
    assert text is not None
    zeros = f"[position]\noffset = {[0.0] * read.position.shape[1]}\n"
    path = read.folder / "map.toml"
    path.write_text(text.replace("[position]\n", zeros), encoding="utf-8")
    assert not row_of(read.look(columns=path), "zero").has_step


def unit_of_time(read: Read) -> None:
    look = read.look()
    clock = row_of(look, "time").reading
    assert look.map_text is not None
    assert isinstance(clock, ClockReading)
    path = read.folder / "map.toml"
    unit = f'[time]\nunit = "{clock.unit}"\n'
    path.write_text(look.map_text.replace("[time]\n", unit), encoding="utf-8")
    assert not row_of(read.look(columns=path), "time").has_step


def configuration(model: pin.Model, angles: Any) -> Any:
    """The angles as pinocchio takes them, which has cosine and sine of joints without limits."""
    parts = [
        (np.cos(angle), np.sin(angle)) if joint.nq == 2 else (angle,)
        for joint, angle in zip(model.joints[1:], angles, strict=True)
    ]
    return np.concatenate(parts)


def payload_by_two_recordings(read: Read) -> None:
    urdf = str(urdf_of(read.log))
    bare, loaded = (pin.buildModelFromUrdf(urdf) for _ in range(2))
    load = pin.Inertia(LOAD, np.array([0.0, 0.0, 0.1]), 0.01 * np.eye(3))
    loaded.appendBodyToJoint(loaded.njoints - 1, load, pin.SE3.Identity())
    angles = np.unwrap(read.position, axis=0)
    velocity, acceleration = (
        np.gradient(angles, read.time, axis=0),
        np.gradient(np.gradient(angles, read.time, axis=0), read.time, axis=0),
    )
    position = [configuration(bare, each) for each in angles]
    states = list(zip(position, velocity, acceleration, strict=True))
    added = [
        pin.rnea(loaded, loaded.createData(), *state) - pin.rnea(bare, bare.createData(), *state)
        for state in states
    ]
    full = read.written("full", read.position, read.torque + np.array(added))
    robot = Robot.from_urdf(urdf_of(read.log))
    archive = read.folder / "full.mcap"
    import_recording(full, archive, lambda _: robot, ImportOptions())
    found = find_payload([read.folder / "read.mcap"], [archive], Silent())
    low, high = found.estimate.intervals[0]
    assert low < LOAD < high
    assert high - low < 0.2 * LOAD


LOOK_EFFECTS: dict[Decider, Callable[[Read], None]] = {
    MapKey("time.unit"): unit_of_time,
    NextStep.ASK_FOR_POSITIONS: raw_encoder_positions,
    NextStep.COMPARE_A_POSTURE: zeros_of_a_posture,
    NextStep.RECORD_PAYLOAD: payload_by_two_recordings,
}


def test_what_a_look_advises_has_its_effect(read: Read) -> None:
    advised = {row.decider for row in read.look().rows if row.decider is not None}
    assert advised
    for decider in advised:
        LOOK_EFFECTS[decider](read)


def findings_of(arm: IdentifiedArm) -> tuple[Finding, ...]:
    assert isinstance(arm.identification, Identification)
    return tuple(find(arm.identification.validation.evidence, Thresholds()))


def advised_by(arm: IdentifiedArm) -> dict[RemedyKey, Finding]:
    """What the next steps of a verdict are, with the finding of each."""
    naming = Naming(tuple(arm.results.joint_names))
    return {
        finding.remedy: finding
        for finding in findings_of(arm)
        if finding.remedy and worded(finding, naming).next_step in arm.verdict.next_steps
    }


def same_motion_again(read: Read, finding: Finding) -> None:
    logs = []
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0.0, 2e-3, read.torque.shape)
        torque = read.torque + noise * read.torque.std(axis=0)
        logs.append(read.written(f"run{seed}", read.position, torque))
    assert finding.key not in [each.key for each in findings_of(read.identified(*logs))]


def motion_of_all_joints(read: Read, finding: Finding) -> None:
    simulated = simulate(urdf_of(read.log), np.arange(0.0, 16.0, 0.004), pace=2.0)
    columns = (simulated.time, simulated.position, simulated.torque)
    log = write_log(read.folder / "exciting.csv", NAMES, *columns)
    assert finding.key not in [each.key for each in findings_of(read.identified(log))]


VERDICT_EFFECTS: dict[RemedyKey, Callable[[Read, Finding], None]] = {
    "repeat the motion": same_motion_again,
    "design a motion": motion_of_all_joints,
}


def test_what_a_verdict_advises_has_its_effect(read: Read) -> None:
    arm = read.identified(read.log)
    assert arm.verdict.good
    for remedy, finding in advised_by(arm).items():
        VERDICT_EFFECTS[remedy](read, finding)


def test_a_file_whose_data_are_lost_is_saved_again(tmp_path: Path) -> None:
    """Saved again it has the samples of the plain log."""
    with pytest.raises(SourceError, match="its data are lost") as refused:
        Read.of(CASES / LOST, ImportOptions(), tmp_path)
    assert refused.value.remedy == "copy it again, or save it again in MATLAB"
    plain = Read.of(CASES / "plain.csv", ImportOptions(), tmp_path)
    saved = tmp_path / LOST
    samples = {"t": plain.time, "q": plain.position, "tau": plain.torque}
    with h5py.File(saved, "w", userblock_size=512) as file:
        for name, values in samples.items():
            file[name] = np.atleast_2d(values.T)
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    saved.write_bytes(header + saved.read_bytes()[len(header) :])
    (tmp_path / "read.mcap").unlink()
    again = Read.of(saved, ImportOptions(), tmp_path)
    assert again.position == near(plain.position, abs=1e-12)
    assert again.torque == near(plain.torque, abs=1e-12)
