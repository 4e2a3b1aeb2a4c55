"""Faults of one part of a recording, planted in logs simulated without code of the project.

No verdict is "well", and the fault is named. Arms, motions and noise are those of
`benchmarks.coverage`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.arms import urdf
from benchmarks.coverage import (
    ARM_TYPES,
    DEFAULTS,
    FITTED_TIME,
    HELD_OUT_TIME,
    Arm,
    Logged,
    drawn_arm,
    drawn_motion,
    logged,
)
from benchmarks.diagnosis import judged
from benchmarks.joint_log import JointLog
from hil.base.progress import Silent
from hil.importers.imported_robot import IMPORTED_LAW, Robot
from hil.pipeline.identification import Identification, identify_archives
from identification.validation.finding import Finding

GAIN = 1.1
FRICTION = 1.3
SEEDS = (1, 2, 3)

pytestmark = [pytest.mark.long, pytest.mark.slow]


def with_gain(log: Logged, joint: int) -> Logged:
    """The torque of one joint is a tenth too large."""
    scale = np.where(np.arange(log.torque.shape[1]) == joint, GAIN, 1.0)
    return log._replace(torque=log.torque * scale)


def with_friction(log: Logged, arm: Arm, seed: int, joint: int | None = None) -> Logged:
    """Friction of the held-out motion is larger by three tenths, of one joint or of all."""
    motion = drawn_motion(
        arm.robot, np.random.default_rng([seed, 2, 1]), HELD_OUT_TIME, DEFAULTS.speed
    )
    velocity = motion.at(log.time)[1]
    more = arm.friction._replace(offset=0.0 * arm.friction.offset)
    added = (FRICTION - 1.0) * more.torque(velocity, 0.0 * velocity)
    if joint is not None:
        added[:, np.arange(added.shape[1]) != joint] = 0.0
    return log._replace(torque=log.torque + added)


def with_rest(log: Logged) -> Logged:
    """The arm rests after the motion, as long as that takes, under the same noise."""
    random = np.random.default_rng(len(log.time))
    noise = np.diff(log.torque, axis=0).std(axis=0) / np.sqrt(2.0)
    standing = random.standard_normal((2, *log.torque.shape))
    return Logged(
        np.append(log.time, log.time + log.time[-1] + log.time[1]),
        np.concatenate((log.position, log.position[-1] + 1e-5 * standing[0])),
        np.concatenate((log.torque, log.torque[-50:].mean(axis=0) + noise * standing[1])),
    )


def identified(
    name: str, seed: int, fault: str, joint: int, folder: Path, *, rests: bool = False
) -> Identification:
    """Plant a fault, import both logs, fit one and predict the other."""
    kind = ARM_TYPES[name]
    arm = drawn_arm(kind, seed)
    robot = Robot.from_urdf(urdf(kind.urdf), friction=IMPORTED_LAW, locked=kind.locked)
    fitted, held_out = (
        logged(arm, seed, part, duration, 0.0, DEFAULTS)
        for part, duration in enumerate((FITTED_TIME, HELD_OUT_TIME))
    )
    if fault == "gain":
        fitted = with_gain(fitted, joint)
    elif fault == "friction of one joint":
        held_out = with_friction(held_out, arm, seed, joint)
    else:
        held_out = with_friction(held_out, arm, seed)
    if rests:
        fitted = with_rest(fitted)
        held_out = with_rest(held_out)
    archives = [
        JointLog(robot, log.time, log.position, None, log.torque, kind.rated_payload).imported(
            folder / f"{part}.mcap"
        )
        for part, log in enumerate((fitted, held_out))
    ]
    return identify_archives(archives[:1], Silent(), predict=archives[1:])


def findings(identification: Identification, *checks: str) -> list[Finding]:
    """Those of some checks that are not good."""
    return [
        finding
        for finding in identification.verdict.findings
        if finding.check in checks and finding.level != "good"
    ]


@pytest.mark.parametrize("name", ARM_TYPES)
@pytest.mark.parametrize("seed", SEEDS)
class TestFaultOfOnePart:
    def test_a_gain_of_one_joint(self, name: str, seed: int, tmp_path: Path) -> None:
        """Of the last joint as well, whose torque is small and mostly friction."""
        n = len(ARM_TYPES[name].rotor)
        joint = (3, 1, n - 1)[seed % 3]
        identification = identified(name, seed, "gain", joint, tmp_path)
        assert not identification.verdict.good
        planted = identification.results.joint_names[joint]
        named = findings(identification, "sameness", "generalisation")
        assert any(f"{planted} " in finding.words for finding in named)

    def test_friction_of_the_held_out_motion(self, name: str, seed: int, tmp_path: Path) -> None:
        identification = identified(name, seed, "friction", 0, tmp_path)
        assert not identification.verdict.good
        (friction,) = findings(identification, "friction")
        assert friction.level == "wrong" and "springs" not in friction.next_step


@pytest.mark.parametrize("seed", [811, 812])
class TestFaultThatIsHardToSee:
    def test_a_gain_of_the_base_axis(self, seed: int, tmp_path: Path) -> None:
        """Without gravity other bodies explain most of it, or no bodies do."""
        identification = identified("panda", seed, "gain", 0, tmp_path)
        assert not identification.verdict.good
        named = findings(identification, "torque constant", "generalisation")
        assert any("panda_joint1 " in finding.words for finding in named)

    @pytest.mark.parametrize("joint", [1, 3])
    def test_friction_of_a_joint_of_much_gravity(
        self, seed: int, joint: int, tmp_path: Path
    ) -> None:
        """A twentieth of its torque."""
        identification = identified("panda", seed, "friction of one joint", joint, tmp_path)
        (friction,) = findings(identification, "friction")
        assert friction.level == "wrong" and f"panda_joint{joint + 1} +" in friction.words


@pytest.mark.parametrize(
    ("fault", "checks"),
    [("gain", ("sameness", "torque constant")), ("friction of one joint", ("friction",))],
    ids=["gain", "friction"],
)
@pytest.mark.parametrize("joint", [0, 4, 6])
def test_rest_hides_no_fault(
    fault: str, checks: tuple[str, ...], joint: int, tmp_path: Path
) -> None:
    """Of the logs, half of the time: a joint is compared while it moves."""
    identification = identified("panda", 2, fault, joint, tmp_path, rests=True)
    assert not identification.verdict.good
    named = findings(identification, *checks)
    assert any(f"panda_joint{joint + 1} " in finding.words for finding in named)


@pytest.mark.parametrize("seed", [0, 2, 7, 20, 53])
def test_several_faults_of_an_arm_are_named_at_once(seed: int, tmp_path: Path) -> None:
    """A joint turned the other way from another zero; with a scale; three zeros and two scales.

    A scale of the joint that carries most; a sign that no step alone lessens the error by.
    """
    outcome = judged(seed, tmp_path)
    assert outcome["whole"], outcome["said"]
    assert not outcome["wrong"]


def test_a_turned_joint_that_a_sign_imitates_is_not_certain(tmp_path: Path) -> None:
    """Joint 2 the other way round, and 3 from another zero: 3 turned by 156 degrees fits alike."""
    assert not judged(52, tmp_path)["wrong"]
