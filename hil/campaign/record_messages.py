"""Records of a campaign in words: rehearsal, dry run, warm-up, and the precision it has reached."""

from __future__ import annotations

from collections.abc import Sequence

from hil.base.terminal_text import plural
from identification.text import percentage

from .dry_run_record import DryRunRecord
from .errors import AgainstGravityError, DryRunError
from .folder import CampaignFolder
from .joint_warm_up import WarmUpRecord
from .precision_record import PrecisionRecord, Reached
from .rehearsal_record import Rehearsal


def rehearsal_line(rehearsal: Rehearsal) -> str:
    """Return the result of a rehearsal, without full stop."""
    if rehearsal.passed:
        return (
            f"the rehearsal passed all {len(rehearsal.criteria)} criteria; what it cannot detect is"
            " in rehearsal.json (not_seen)"
        )
    return f"the rehearsal failed: {'; '.join(rehearsal.failures)}"


def contradiction(record: DryRunRecord) -> str:
    """Return what a torque against gravity may mean, the likeliest first."""
    of_payload = (
        "the assumed centre of mass of the payload (--payload-centre) may be wrong; if it is"
        " right, "
        if record.assumed_payload
        else ""
    )
    return (
        f"measured torque opposes the model's gravity: {of_payload}joint_sign, URDF or torque"
        " sign may be wrong"
    )


def gravity_lines(record: DryRunRecord) -> list[str]:
    """Return a line for each joint whose torque opposes the model's gravity."""
    return [f"{joint}: {contradiction(record)}" for joint in record.against_gravity]


def warm_up_line(record: WarmUpRecord) -> str:
    """Return the state of a warm-up that has had a motion."""
    return (
        f"warm-up: friction changes by {percentage(record.changes[-1], 2)} per motion after"
        f" {len(record.motions)} motions (warm below {percentage(record.threshold, 2)}):"
        f" {record.outcome}"
    )


def precision_line(record: PrecisionRecord) -> str:
    """Return the last look at the precision, without full stop."""
    if not record.looks:
        return f"no {record.unit} was measured yet"
    look = record.looks[-1]
    worst = reached_line(look.worst, look.repetitions)
    text = f"precision after {plural(look.repetitions, record.unit)}: {worst}"
    if record.outcome == "met":
        return f"{text}: all requirements are met, no more {record.unit}s"
    if record.outcome == "out of reach" and record.unit == "pair":
        remains = "that exceeds repetitions in [campaign]"
        if look.worst.more is None:
            remains = (
                "what remains is the scale of the torque (weigh a known load with hil "
                "torque-constants, or state torque_uncertainty)"
            )
        return f"{text}: no more pairs; {remains}"
    if record.outcome == "out of reach":
        return (
            f"{text}: no more repetitions; another motion adds what this one lacks "
            "(hil design --given, with the same --precision)"
        )
    return text


def reached_line(reached: Reached, repetitions: int) -> str:
    """Return a requirement after a number of repetitions: "I5yy 7.1 % of 5 %, about 6 more"."""
    wanted = reached.wanted
    text = f"{reached.worst} {wanted.shown(reached.half)} of {wanted.shown(wanted.value)}"
    if reached.ratio <= 1.0:
        return f"{text}, met"
    if repetitions == 1:  # what differs between repetitions is not known
        return text
    if reached.more is None:
        return f"{text}, which more repetitions do not improve enough"
    return f"{text}, about {reached.more} more"


def not_accepted(
    folder: CampaignFolder, record: DryRunRecord, against: Sequence[str] = ()
) -> DryRunError:
    """Return the error of a dry run that is not accepted, or of joints that were not named."""
    if against:
        correct = "correct the cell file and rehearse again"
        if record.assumed_payload:
            correct = "weigh it under another name (--payload) with its --payload-centre"
        return AgainstGravityError(
            folder.root, against, contradiction(record), correct, folder.run_command
        )
    how = f"if the motions looked right, run `{folder.run_command} --accept-dry-run`"
    return DryRunError(folder.root, "was done, but is not accepted", how)
