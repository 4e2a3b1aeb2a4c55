"""Cycle records of frames: cycles are counted by the controller's time stamps alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.c4g_packets import DRIVE_ON
from drivers.cycle_records import ARM_STATE
from drivers.drive_train import DriveTrain
from drivers.states import State
from drivers.ur.cycles import CycleCounter
from drivers.ur.reader import OutputFrames
from drivers.ur.rtde import RtdeError

PERIOD = 0.002
LAYOUT = np.dtype(
    [
        ("timestamp", "f8"),
        *((name, "f8", (6,)) for name in (
            "target_q", "target_qd", "target_qdd", "target_current", "target_moment",
            "actual_q", "actual_qd", "actual_current", "joint_temperatures",
        )),
        ("joint_mode", "i4", (6,)),
        ("robot_mode", "i4"), ("safety_mode", "i4"), ("runtime_state", "u4"),
        ("robot_status_bits", "u4"), ("speed_scaling", "f8"),
    ]
)  # fmt: skip


def drives(sign: float = 1.0, offset: float = 0.0) -> DriveTrain:
    ones = np.ones(6)
    return DriveTrain(
        gear_ratio=101.0 * ones, calibration=0.0 * ones, joint_sign=sign * ones,
        joint_offset=offset * ones, torque_constant=0.1 * ones, current_limit=10.0 * ones,
    )  # fmt: skip


def frames_at(stamps: list[float], **columns: object) -> OutputFrames:
    values = np.zeros(len(stamps), LAYOUT)
    values["timestamp"] = stamps
    for name, column in columns.items():
        values[name] = column
    return OutputFrames(values, np.arange(len(stamps), dtype=float), ())


@given(
    st.sets(st.integers(0, 2000), min_size=1, max_size=60).map(sorted),
    st.floats(0.0, 1e6),
    st.lists(st.integers(0, 60), max_size=6).map(sorted),
)
def test_missing_frames_are_gaps_and_never_a_shift(
    cycles: list[int], begin: float, cuts: list[int]
) -> None:
    """However the frames are divided into calls."""
    counter = CycleCounter(drives(), PERIOD)
    stamps = [begin + PERIOD * cycle for cycle in cycles]
    parts = [
        counter.records(frames_at(stamps[start:stop]))
        for start, stop in zip([0, *cuts], [*cuts, len(stamps)], strict=True)
    ]
    records = np.concatenate(parts)
    np.testing.assert_array_equal(records["cycle"], np.array(cycles) - cycles[0])
    assert records["gap"].sum() == cycles[-1] - cycles[0] + 1 - len(cycles)


@pytest.mark.parametrize(
    ("later", "fault"),
    [
        *((later, "started again") for later in (0.0, -0.002, -50.0)),
        (0.003, r"not 2 ms apart: correct controller\.cycle_ms"),
    ],
)
@pytest.mark.parametrize("together", [True, False])
def test_frames_before_a_fault_of_time_are_recorded(
    later: float, fault: str, together: bool
) -> None:
    """Whether it comes with them or later."""
    counter = CycleCounter(drives(), PERIOD)
    sound, wrong = [100.0, 100.002], [100.002 + later, 100.002 + later + 0.002]
    frames = frames_at(sound + wrong) if together else frames_at(sound)
    assert counter.records(frames)["cycle"].tolist() == [0, 1]
    for _ in range(2):
        with pytest.raises(RtdeError, match=fault):
            counter.records(frames_at(wrong))


def test_angles_and_torques_are_those_of_the_urdf() -> None:
    angle = np.array([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    names = ("actual_q", "target_q", "actual_qd", "target_moment", "actual_current")
    frames = frames_at([1.0], target_current=2.0 * angle, **dict.fromkeys(names, angle))
    train = drives(sign=-1.0, offset=0.3)
    records = CycleCounter(train, PERIOD).records(frames)
    np.testing.assert_allclose(records["position"], -(angle - 0.3))
    np.testing.assert_allclose(records["velocity"], -angle)
    np.testing.assert_allclose(records[ARM_STATE]["target_moment"], -angle)
    # The current is that of the motor; its torque has the joint's sign.
    np.testing.assert_allclose(records["target_current"], angle)
    np.testing.assert_allclose(records["model_current"], 2.0 * angle)
    np.testing.assert_allclose(train.joint_torque(records["target_current"]), -10.1 * angle)
    assert np.isnan(records["commanded_position"]).all()


def test_modes_say_when_the_drives_are_on() -> None:
    counter = CycleCounter(drives(), PERIOD)
    records = counter.records(frames_at([1.0, 1.002, 1.004], robot_mode=[3, 5, 7]))
    assert records["state"].tolist() == [State.DRIVE_OFF, State.DRIVING_ON, State.CLOSED]
    assert records["status"].tolist() == [0, 0, DRIVE_ON]


def test_what_a_version_does_not_send_is_unknown() -> None:
    states = CycleCounter(drives(), PERIOD).records(frames_at([1.0]))[ARM_STATE]
    assert states["safety_status"][0] == -1
    for name in ("payload_mass", "payload_inertia", "current_as_torque", "speed_fraction"):
        assert np.isnan(states[name]).all(), name


def test_the_inertia_of_a_payload_is_in_our_order() -> None:
    layout = np.dtype([*LAYOUT.descr, ("payload_inertia", "f8", (6,))])
    values = np.zeros(1, layout)
    values["payload_inertia"] = [[1.0, 2.0, 3.0, 0.12, 0.13, 0.23]]  # xx, yy, zz, xy, xz, yz
    records = CycleCounter(drives(), PERIOD).records(OutputFrames(values, np.zeros(1), ()))
    states = records[ARM_STATE]
    assert states["payload_inertia"][0].tolist() == [1.0, 0.12, 0.13, 2.0, 0.23, 3.0]
