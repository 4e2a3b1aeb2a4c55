from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.errors import ShapeError
from identification.signals.recording import Recording, RecordingError

NAMES = ("shoulder", "elbow", "wrist")


def a_recording(samples: int = 200, *, commanded: bool = True) -> Recording:
    time = np.arange(samples) * 1e-3
    phase = 8.0 * time[:, None] + np.arange(3)
    command = 0.5 * np.sin(phase)
    return Recording(
        time=time,
        position=0.5 * np.sin(phase - 0.01),
        joint_names=NAMES,
        torque=np.cos(phase),
        commanded_position=command if commanded else None,
    )


def test_a_sound_recording_passes_unchanged() -> None:
    recording = a_recording()
    assert recording.checked(NAMES) is recording


@given(
    channel=st.sampled_from(["position", "torque"]),
    sample=st.integers(0, 199),
    joint=st.integers(0, 2),
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_a_number_that_is_none_is_refused_with_channel_joint_and_sample(
    channel: str, sample: int, joint: int, value: float
) -> None:
    recording = a_recording()
    spoilt = getattr(recording, channel).copy()
    spoilt[sample, joint] = value
    with pytest.raises(RecordingError, match=f"{channel} of joint {NAMES[joint]}") as refused:
        replace(recording, **{channel: spoilt}).checked()
    assert (refused.value.check, refused.value.joint, refused.value.sample) == (
        "finite",
        NAMES[joint],
        sample,
    )


def test_time_that_is_not_a_number_is_refused() -> None:
    time = a_recording().time.copy()
    time[7] = np.nan
    with pytest.raises(RecordingError, match="sample 7"):
        replace(a_recording(), time=time).checked()


def test_a_cycle_without_a_set_point_is_no_fault() -> None:
    recording = a_recording()
    assert recording.commanded_position is not None
    command = recording.commanded_position.copy()
    command[20:30] = np.nan
    replace(recording, commanded_position=command).checked()


@pytest.mark.parametrize(("step", "word"), [(0.0, "repeats"), (-5e-3, "falls back")])
def test_a_repeated_or_falling_clock_is_refused_at_its_sample(step: float, word: str) -> None:
    time = a_recording().time.copy()
    time[50:] += time[49] + step - time[50]
    with pytest.raises(RecordingError, match=word) as refused:
        replace(a_recording(), time=time).checked()
    assert (refused.value.check, refused.value.sample) == ("clock", 50)


def test_a_joint_that_does_not_follow_its_command_is_stuck() -> None:
    recording = a_recording()
    position = recording.position.copy()
    position[:, 1] = position[0, 1]
    with pytest.raises(RecordingError, match="elbow is stuck") as refused:
        replace(recording, position=position).checked()
    assert (refused.value.check, refused.value.joint) == ("stuck", "elbow")


def test_a_reading_that_freezes_half_way_is_stuck_from_there_on() -> None:
    recording = a_recording()
    position = recording.position.copy()
    position[120:, 2] = position[120, 2]
    with pytest.raises(RecordingError, match="wrist is stuck") as refused:
        replace(recording, position=position).checked()
    assert refused.value.sample == 120


def test_a_joint_commanded_to_stand_still_may_stand_still() -> None:
    recording = a_recording()
    position, command = recording.position.copy(), recording.commanded_position
    assert command is not None
    command = command.copy()
    position[:, 1] = command[:, 1] = 0.3
    replace(recording, position=position, commanded_position=command).checked()


def test_without_a_command_a_dead_reading_beside_moving_joints_is_stuck_unless_declared() -> None:
    recording = a_recording(commanded=False)
    position = recording.position.copy()
    position[:, 0] = 0.3
    with pytest.raises(RecordingError, match=r"shoulder is stuck.*declare it as held"):
        replace(recording, position=position).checked()
    replace(recording, position=position, held_joints=("shoulder",)).checked()


def test_at_standstill_no_joint_is_stuck() -> None:
    recording = a_recording(commanded=False)
    replace(recording, position=np.full_like(recording.position, 0.3)).checked()


def test_quantised_readings_of_a_slow_joint_are_not_stuck() -> None:
    recording = a_recording()
    resolution = 1e-3
    slow = 0.01 * recording.time[:, None] + np.zeros(3)
    replace(
        recording,
        position=np.round(slow / resolution) * resolution,
        commanded_position=slow,
    ).checked()


@pytest.mark.parametrize(
    ("expected", "named"),
    [
        (("elbow", "shoulder", "wrist"), "shoulder"),
        (("shoulder", "elbow", "hand"), "hand"),
        (("shoulder", "elbow"), "wrist"),
    ],
)
def test_joints_that_are_not_the_models_are_refused_by_name(
    expected: tuple[str, ...], named: str
) -> None:
    with pytest.raises(RecordingError) as refused:
        a_recording().checked(expected)
    assert (refused.value.check, refused.value.joint) == ("joints", named)


@pytest.mark.parametrize(("leap", "refused"), [(599.0, False), (601.0, True), (2e9, True)])
def test_a_clock_that_leaps_is_refused_at_its_sample(leap: float, refused: bool) -> None:
    good = a_recording()
    time = good.time.copy()
    time[50:] += leap
    leaping = replace(good, time=time)
    if not refused:
        assert leaping.checked() is leaping
        return
    with pytest.raises(RecordingError, match=r"leaps by .* at sample 50; .* cut the recording"):
        leaping.checked()


def test_reported_gaps_and_jumps_of_the_clock_split_a_recording() -> None:
    recording = a_recording()
    gap = np.zeros(200, dtype=bool)
    gap[30] = True
    time = recording.time.copy()
    time[100:] += 0.5
    assert replace(recording, time=time, gap_before=gap).segments() == [
        slice(0, 30),
        slice(30, 100),
        slice(100, 200),
    ]


def test_a_jittering_clock_is_not_a_gap() -> None:
    jitter = np.random.default_rng(1).uniform(-4e-4, 4e-4, 200)
    recording = a_recording()
    assert replace(recording, time=recording.time + jitter).segments() == [slice(0, 200)]


def test_arrays_that_do_not_fit_each_other_are_refused() -> None:
    recording = a_recording()
    assert recording.torque is not None
    with pytest.raises(ShapeError, match="torque"):
        replace(recording, torque=recording.torque[:-1])
    with pytest.raises(ShapeError, match="gap_before"):
        replace(recording, gap_before=np.zeros(3, dtype=bool))


def test_a_motion_starts_where_the_command_begins_to_move() -> None:
    recording = a_recording()
    assert recording.commanded_position is not None
    command = recording.commanded_position.copy()
    command[:40] = command[40]
    assert replace(recording, commanded_position=command).motion_start == recording.time[41]
    command[:10] = np.nan
    assert replace(recording, commanded_position=command).motion_start == recording.time[41]


def test_without_a_command_a_motion_starts_with_the_recording() -> None:
    assert a_recording(commanded=False).motion_start == 0.0
