"""Play between encoder and link, by steps of the position where the load reverses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.signals.play import ToAndFro, steps_to_and_fro
from identification.signals.recording import Recording
from tests.identification.three_axes import NAMES, Floats

TIME = np.arange(0.0, 20.0, 0.004)
PLAY = 0.0035  # rad
KNEE = 1


def motion() -> tuple[Floats, Floats]:
    """Positions with the noise of an encoder, and loads of the gears with other reversals."""
    rng = np.random.default_rng(2)
    rate = np.array([1.1, 1.7, 2.3])
    position = 0.8 * np.sin(rate * TIME[:, None])
    load = 20.0 * np.cos(rate * TIME[:, None] + np.array([0.3, 1.2, 2.0]))
    return position + rng.normal(0.0, 2e-5, position.shape), load


def found_in(position: Floats) -> list[ToAndFro]:
    recording = Recording(time=TIME, position=position, torque=position, joint_names=NAMES)
    middle = len(TIME) // 2  # the second half is predicted
    return list(
        steps_to_and_fro([recording.between(0, middle), recording.between(middle, len(TIME))])
    )


def follows(found: ToAndFro, load: Floats) -> bool:
    middle = len(TIME) // 2
    return found.follows([TIME[:middle], TIME[middle:]], [load[:middle], load[middle:]])


def test_play_is_of_the_joint_whose_load_reverses() -> None:
    position, load = motion()
    position[:, KNEE] += 0.5 * PLAY * np.sign(load[:, KNEE])
    (found,) = found_in(position)
    assert found.joint == KNEE
    assert found.size == pytest.approx(PLAY, rel=0.1)
    assert follows(found, load[:, KNEE])
    assert not follows(found, load[:, 0])


def rounded(position: Floats, load: Floats) -> Floats:
    return np.round(position / PLAY) * PLAY


def slipping(position: Floats, load: Floats) -> Floats:
    """At reversals of the load, always on."""
    steps = np.abs(np.diff(np.sign(load[:, [KNEE]]), axis=0, prepend=np.sign(load[:1, [KNEE]])))
    return position + 0.5 * PLAY * np.cumsum(steps, axis=0) * np.eye(3)[KNEE]


def of_any_size(position: Floats, load: Floats) -> Floats:
    rng = np.random.default_rng(4)
    side = np.sign(load[:, KNEE])
    part = np.cumsum(np.abs(np.diff(side, prepend=side[:1]))).astype(int) // 2
    size = rng.uniform(0.1, 3.0, part.max() + 1)[part]
    return position + 0.5 * PLAY * (side * size)[:, None] * np.eye(3)[KNEE]


@pytest.mark.parametrize("change", [lambda position, _: position, rounded, slipping, of_any_size])
def test_other_steps_are_no_play(change) -> None:
    assert not found_in(change(*motion()))


def test_play_is_found_whatever_the_rate() -> None:
    """At 500 Hz; at 40 Hz a step cannot be distinguished from the motion."""
    position, load = motion()
    position[:, KNEE] += 0.5 * PLAY * np.sign(load[:, KNEE])
    recording = Recording(time=TIME / 2.0, position=position, torque=position, joint_names=NAMES)
    (found,) = steps_to_and_fro([recording])
    assert found.joint == KNEE
    slow = replace(recording, time=6.0 * TIME)
    assert not list(steps_to_and_fro([slow]))
