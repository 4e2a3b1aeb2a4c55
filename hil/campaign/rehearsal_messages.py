"""Results, assumptions and blind spots of a rehearsal, in words."""

from __future__ import annotations

import shlex
from typing import Final, assert_never

from drivers.open_mode import MAX_TARGET_JUMP
from hil.cell import Cell
from hil.control.simulated_cell import NOISE_SHARE, RESOLUTION_SHARE
from identification.excitation.collision_messages import unchecked_text
from identification.text import percentage

from .oscillation import Oscillation
from .rehearsal_criteria import (
    MAX_ERROR_RATIO,
    MAX_SPEED_SHARE,
    CurrentShare,
    FailedMotion,
    Judged,
    ParameterErrors,
    SpeedShare,
    Undetermined,
    UndeterminedCriterion,
    UnseenError,
    WorstMotion,
    judgement_of,
)
from .rehearsal_record import EFFECTS, RehearsalCriterion
from .twin import (
    Assumption,
    CurrentNoise,
    DefaultEffects,
    NoLostPackets,
    ZeroNominal,
)
from .undetected import CopiedDrives, CopiedFigures, UncheckedPairs, Undetected

_CORRECT: Final = (
    "correct the cause, by [limits] or [drive_train] of the cell file, or the tables of the "
    "simulated arm ([nominal], [controller], [simulation])"
)


def criterion_record(judged: Judged, cell: Cell) -> RehearsalCriterion:
    """Return a criterion as it is recorded: its figures, and them in a sentence."""
    judgement = judgement_of(judged)
    remedy = "" if judgement.passed else _remedy(judged, cell)
    facts = _facts(judged, cell)
    return RehearsalCriterion(
        name=judgement.name,
        value=judgement.value,
        bound=judgement.bound,
        passed=judgement.passed,
        sentence=f"{facts}: {remedy}" if remedy else facts,
    )


def assumption_words(assumption: Assumption) -> str:
    """Return an assumption about the simulated arm."""
    match assumption:
        case CurrentNoise(noise, resolution):
            return (
                f"the current has a noise of {noise:.3g} A rms and a resolution of "
                f"{resolution:.3g} A ({percentage(NOISE_SHARE, 1)} and "
                f"{percentage(RESOLUTION_SHARE, 1)} of the weakest motor's limit)"
            )
        case DefaultEffects(torque_ripple, friction_drift, delay):
            return (
                "effects that the model leaves out have default sizes: torque ripple of "
                f"{percentage(torque_ripple)} of the Coulomb torque, friction that falls by "
                f"{percentage(friction_drift)}, springs in the main axes, {1e3 * delay:g} ms of"
                " delay"
            )
        case ZeroNominal(fields):
            return f"[nominal] has only zeros for {', '.join(fields)}, and so has the simulated arm"
        case NoLostPackets(joint, turns, allowed, cycle_ms):
            return (
                f"no packet is lost: at full speed the motor of {joint} turns by {turns:.2g}"
                f" revolutions in a cycle of {cycle_ms} ms; the guard allows {allowed:.2g}"
                f" ({percentage(MAX_TARGET_JUMP)} of following_error in [drive_train]), so that a"
                " packet lost at that speed ends the motion on the real arm; a shorter cycle or a"
                " lower velocity_deg in [limits] avoids this"
            )
        case never:
            assert_never(never)


def undetected_words(undetected: Undetected) -> str:
    """Return what a rehearsal cannot detect, and why."""
    match undetected:
        case CopiedFigures.SCALES:
            return (
                "torque constants and current limits: the simulated motors take them from the cell"
                " file"
            )
        case CopiedFigures.SHAPES:
            return (
                "floor, walls and shapes: they are checked, but as the cell file and the URDF state"
                " them"
            )
        case UncheckedPairs(exceptions):
            return unchecked_text(exceptions) or ""
        case CopiedDrives(fields):
            return (
                f"{', '.join(fields)} of [drive_train]: the simulated arm takes them from there, "
                "so that errors in them are not detected; the controller's init packet (gears, "
                "coupling) and the dry run (signs) detect them, or a table "
                "[simulation.drive_train] now"
            )
        case never:
            assert_never(never)


def oscillation_words(oscillation: Oscillation, joint_names: tuple[str, ...]) -> str:
    """Return a growing oscillation in a clause."""
    return (
        f"{joint_names[oscillation.joint]} oscillates at {oscillation.frequency:.0f} Hz, with an"
        f" amplitude that grows {oscillation.growth:.0f} times in {oscillation.seconds:.1f} s"
    )


def _facts(judged: Judged, cell: Cell) -> str:
    """Return what was found and what is allowed."""
    names = cell.joint_names
    match judged:
        case CurrentShare(run, share, bound, worst):
            return (
                f"{run}: the largest current is {percentage(share)} of its limit (motor of "
                f"{_joint(worst, cell)}, {worst.archive.name}), at most {percentage(bound)} is"
                " allowed"
            )
        case FailedMotion(run, failure):
            return f"{run}: {failure}"
        case SpeedShare(run, share) if share <= MAX_SPEED_SHARE:
            return (
                f"{run}: every motion was completed, at up to {percentage(share)} of a speed limit"
            )
        case SpeedShare(run, share, worst):
            return (
                f"{run}: {_joint(worst, cell)} moved at {percentage(share)} of its speed limit "
                f"({worst.archive.name}), at most {percentage(MAX_SPEED_SHARE)} is allowed"
            )
        case UndeterminedCriterion(name, _, problem):
            return f"{name}: cannot be determined: the identification failed ({problem})"
        case Undetermined(undetermined):
            return (
                f"parameters not determined by the excitation: {', '.join(undetermined) or 'none'}"
            )
        case ParameterErrors(count, deviation, parameter, bound):
            return (
                f"the errors of {count} parameters are at most {deviation:.3g} standard deviations"
                f" ({parameter}), {bound:.3g} are allowed"
            )
        case UnseenError(ratio, joint):
            return (
                f"on unseen motion the torque error is {ratio:.2f} times what noise leaves "
                f"({names[joint]}), at most {MAX_ERROR_RATIO:g} is allowed"
            )
        case never:
            assert_never(never)


def _remedy(judged: Judged, cell: Cell) -> str:
    """Return what to do about a criterion that is not met; "" if its facts say it."""
    match judged:
        case CurrentShare(run, _, _, worst):
            redesign = "lower acceleration_deg in [limits] of the cell file, and design again"
            return _motion_remedy(run, worst, cell, redesign)
        case FailedMotion(run, _, last):
            return "" if last is None else _motion_remedy(run, last, cell, _CORRECT)
        case SpeedShare(run, _, worst):
            redesign = "lower velocity_deg in [limits] of the cell file, and design again"
            return _motion_remedy(run, worst, cell, redesign)
        case UndeterminedCriterion():
            return ""
        case Undetermined():
            return "design a motion that moves every joint"
        case ParameterErrors():
            return (
                "drive train or model in the cell file do not match the arm, or, just above the "
                "limit, by chance: `--again --seed 2` shows which"
            )
        case UnseenError():
            return "design a better excitation (`hil design`)"
        case never:
            assert_never(never)


def _motion_remedy(run: str, worst: WorstMotion, cell: Cell, remedy: str) -> str:
    """Return what to do about a motion, and the command that plots it.

    An oscillation that grows has another cause than the motion: `remedy` does not apply to it.
    """
    joint = worst.joint
    if worst.oscillation is not None:
        joint = worst.oscillation.joint
        causes = "current_delay_cycles in [controller]"
        if run == EFFECTS:
            causes = "delay and elasticity in [simulation]"
        remedy = (
            f"{oscillation_words(worst.oscillation, cell.joint_names)}: the control of the "
            "simulated arm is unstable, the motion is not at fault; correct "
            f"{causes} or rotor_inertia in [nominal] of the cell file"
        )
    command = ["hil", "plot", str(worst.archive)]
    if joint is not None:
        command += ["--joint", cell.joint_names[joint]]
    return f"{remedy}; see `{shlex.join(command)}`"


def _joint(worst: WorstMotion, cell: Cell) -> str:
    return "" if worst.joint is None else cell.joint_names[worst.joint]
