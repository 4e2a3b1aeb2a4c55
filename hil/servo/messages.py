"""Words about the result of an arm without torque: the only place that makes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from hil.base.one_screen import COLUMNS, Paragraph, Part, columns
from hil.results.servo_result import ServoPrediction, ServoResults, ServoValue, ServoVerdict

_GOOD: Final = 0.5
"""Share of the command's own error, up to which a simulated motion is of use: a quarter of what the
servo does otherwise than commanded is then left in the square."""
_SHOWN: Final = {
    "kp": "kp",
    "kd": "kd",
    "armature": "armat.",
    "viscous": "viscous",
    "coulomb": "coulomb",
    "static": "static",
    "load": "load",
    "limit": "limit",
    "acceleration": "accel.",
    "dead_band": "dead band",
}
"""Parameters of the table of joints, as its heads call them; the last ones if there is room."""
_MOST_ROWS: Final = 8  # of the table of joints
_MOST: Final = 3  # recordings, warnings and next steps on a screen


def unit_of(results: ServoResults) -> str:
    """Return the unit of position errors of all joints together."""
    units = {"mrad" if unit == "rad" else "mm" for unit in results.joint_units}
    return " or ".join(sorted(units))


def verdict_of(results: ServoResults) -> ServoVerdict:
    """Return whether the model predicts positions much better than the command itself."""
    unit = unit_of(results)
    warnings: list[str] = []
    steps: list[str] = []
    if results.in_sample or not results.validation:
        line = "No motion was held out: whether the model predicts another motion is not known."
        steps.append("predict another recording: --predict RECORDING")
        return ServoVerdict(good=False, line=line, warnings=warnings, next_steps=steps)
    worst = max(
        results.validation,
        key=lambda each: each.position_error_mrad / max(each.command_error_mrad, 1e-9),
    )
    share = worst.position_error_mrad / max(worst.command_error_mrad, 1e-9)
    good = share <= _GOOD
    figures = ", ".join(
        f"{each.archive} {each.position_error_mrad:.3g}" for each in results.validation
    )
    line = (
        f"The servo model {'predicts' if good else 'does not predict'} {results.tested_on} from its"
        f" commands: {figures} {unit} (command itself {worst.command_error_mrad:.3g})."
    )
    for each in results.validation:
        pairs = zip(
            results.joint_names, each.joint_errors_mrad, each.command_joint_errors_mrad, strict=True
        )
        poor = [joint for joint, own, command in pairs if own > max(command, 1.0)]
        pushed = max(each.pushed, key=lambda push: abs(push.change_mrad), default=None)
        if pushed is not None:
            joints = ", ".join(push.joint for push in each.pushed)
            warnings.append(
                f"{each.archive}: something touched the arm: {joints} moved while the command"
                f" rested and the model stood, {pushed.joint} by {pushed.change_mrad:.0f} {unit} at"
                f" {pushed.time:.0f} s"
            )
        elif poor:
            warnings.append(
                f"{each.archive}: {', '.join(poor)} predicted worse than by the command itself"
            )
    if not good:
        steps.append("look at the report: a joint that touched something cannot be predicted")
        steps.append("fit slow and fast motions over the range that is used")
    scale = [value.joint for value in results.servo if value.name == "kp" and not value.determined]
    if scale:
        warnings.append(
            f"the torque scale of {', '.join(scale)} is not determined: gravity and inertia of the"
            " bodies hardly show in its position; gains and friction hold together only"
        )
    return ServoVerdict(good=good, line=line, warnings=warnings, next_steps=steps)


def screen(results: ServoResults, read: Sequence[Part] = ()) -> list[Part]:
    """Return the parts of one screen: verdict, recordings, errors, parameters, warnings."""
    verdict = results.verdict
    parts: list[Part] = [Paragraph(verdict.line), *read, ""]
    parts += columns(_errors(results, results.validation[:_MOST]))
    parts += ["", *columns(_parameters(results, [*results.joint_names][:_MOST_ROWS])), ""]
    parts.append(
        f"delay of commands {1e3 * results.delay:.0f} ms; ? = not determined by the motion"
    )
    parts += [Paragraph(text, "doubtful  ", 2) for text in verdict.warnings[:_MOST]]
    parts += [Paragraph(text, "next      ", 2) for text in verdict.next_steps[:_MOST]]
    return parts


def whole(results: ServoResults) -> list[str]:
    """Return everything: errors by joint, each parameter with its interval, choices and notes."""
    lines = [results.verdict.line, "", *columns(_errors(results, results.validation)), ""]
    if by_joint := _errors_by_joint(results):
        lines += [*columns(by_joint), ""]
    rows = [("joint", "parameter", "value", "95 % interval", "unit", "")]
    rows += [
        (
            value.joint,
            value.name,
            f"{value.value:.4g}",
            f"{value.lower:.3g} to {value.upper:.3g}",
            value.unit,
            "" if value.determined else "not determined",
        )
        for value in results.servo
        if value.present
    ]
    lines += [*columns(rows, left=2), ""]
    lines.append(f"delay of commands: {1e3 * results.delay:.3g} ms")
    lines += [
        f"{choice.joint}: {' and '.join(choice.terms)} left out, other windows are predicted better"
        for choice in results.term_choices
        if not choice.present
    ]
    lines += [f"doubtful: {warning}" for warning in results.verdict.warnings]
    lines += [f"note: {note}" for note in results.notes]
    return [*lines, *(f"next: {step}" for step in results.verdict.next_steps)]


def _errors(results: ServoResults, shown: Sequence[ServoPrediction]) -> list[list[str]]:
    """Return the rows of the errors of predicted motions."""
    if not shown:
        return [["no motion was held out"]]
    other = [] if results.compared is None else [results.compared]
    unit = f"rms [{unit_of(results)}]"
    rows = [[unit, "all", "MuJoCo's terms", "command", *other]]
    for each, simple in zip(shown, results.simulators["mujoco"].validation, strict=False):
        overall = [each.position_error_mrad, simple.position_error_mrad, each.command_error_mrad]
        if other:
            overall.append(each.compared_error_mrad or 0.0)
        rows.append([each.archive, *(f"{number:.3g}" for number in overall)])
    return rows


def _errors_by_joint(results: ServoResults) -> list[list[str]]:
    """Return the rows of the errors of each joint in predicted motions."""
    rows = [
        [each.archive, *(f"{number:.3g}" for number in each.joint_errors_mrad)]
        for each in results.validation
    ]
    return [["by joint", *results.joint_names], *rows] if rows else []


def _joint_errors(results: ServoResults) -> dict[str, str]:
    """Return the error of each joint over all predicted motions, as text; empty without any."""
    errors = np.array([each.joint_errors_mrad for each in results.validation])
    if not len(errors):
        return {}
    overall = np.sqrt(np.mean(errors**2, axis=0))
    return {name: f"{error:.2g}" for name, error in zip(results.joint_names, overall, strict=True)}


def _parameters(results: ServoResults, joints: Sequence[str]) -> list[list[str]]:
    """Return the rows of the parameters that the model has, one for each joint."""
    by_joint = {
        joint: {value.name: value for value in results.servo if value.joint == joint}
        for joint in joints
    }
    names = [name for name in _SHOWN if any(row[name].present for row in by_joint.values())]
    errors = _joint_errors(results)
    rows = [
        ["joint", *(["error"] if errors else []), *(_SHOWN[name] for name in names)],
        *(
            [joint, *([errors[joint]] if errors else []), *(_cell(values[name]) for name in names)]
            for joint, values in by_joint.items()
        ),
    ]
    while max(map(len, columns(rows))) > COLUMNS:
        rows = [row[:-1] for row in rows]
    return rows


def _cell(value: ServoValue) -> str:
    if not value.present:
        return "-"
    return f"{value.value:.2g}{'' if value.determined else '?'}"
