"""Words about the result of an arm without torque: the only place that makes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from hil.base.one_screen import MAX_JOINT_ROWS, SCREEN_COLUMNS, Paragraph, Part, columns
from hil.results.servo_result import (
    ServoContact,
    ServoPrediction,
    ServoResults,
    ServoValue,
    ServoVerdict,
)
from identification.arrays import root_mean_square
from identification.text import interval_text

_MAX_GOOD_ERROR_SHARE: Final = 0.5
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
_MISSED: Final = 0.3
"""Share of the motion, from which on a tenth of its square is missed."""
_MOSTLY: Final = 0.5  # of a motion, from which on it is judged without what something held
_MAX_LINES: Final = 3  # recordings, warnings and next steps on a screen


def verdict_of(results: ServoResults) -> ServoVerdict:
    """Return whether the model predicts positions much better than the command itself."""
    unit = results.error_unit
    warnings: list[str] = []
    steps: list[str] = []
    if results.in_sample or not results.validation:
        line = "No motion was held out: whether the model predicts another motion is not known."
        steps.append("predict another recording: --predict RECORDING")
        return ServoVerdict(good=False, line=line, warnings=warnings, next_steps=steps)
    worst = max(results.validation, key=_share)
    share = _share(worst)
    missed = [each.archive for each in results.validation if _is_missed(each)]
    good = share <= _MAX_GOOD_ERROR_SHARE and not missed
    figures = ", ".join(_figure(each) for each in results.validation)
    line = (
        f"The servo model {'predicts' if good else 'does not predict'} {results.tested_on} from its"
        f" commands: position error of {figures} {unit} RMS ({_judged(worst)[1]:.3g} {unit} if the"
        " arm followed its commands exactly)."
    )
    if results.stuck:
        warnings.append(
            f"{', '.join(results.stuck)} never moved in the fitted motions, although commanded "
            f"to: nothing is known about these servos, and errors over all joints exclude them"
        )
    warnings += _touched_in_fit(results)
    for each in results.validation:
        own, commands = each.joint_errors_mrad, each.command_joint_errors_mrad
        pairs = zip(results.joint_names, own, commands, strict=True)
        poor = [
            joint
            for joint, error, command in pairs
            if error > max(command, 1.0) and joint not in results.stuck
        ]
        if each.contacts or each.pushed:
            warnings.append(_touched(each, unit))
        elif poor:
            warnings.append(
                f"in {each.archive}, {', '.join(poor)} predicted worse than by the command itself"
            )
    if missed:
        warnings.append(
            f"more than a tenth of the variance of the motion of {', '.join(missed)} is not"
            " predicted: commands may be late by more than 0.2 s, or belong to other joints"
        )
    if not good:
        steps.append("look at the report: a joint that touched something cannot be predicted")
        steps.append("fit slow and fast motions over the range that is used")
    scale = [
        value.joint
        for value in results.servo
        if value.name == "kp" and not value.determined and value.joint not in results.stuck
    ]
    if scale:
        warnings.append(
            f"the torque scale of {', '.join(scale)} is not determined: gravity and inertia of the"
            " bodies have little effect on the positions, or parts of the motion disagree; gains"
            " and friction are valid only together"
        )
    return ServoVerdict(good=good, line=line, warnings=warnings, next_steps=steps)


def _judged(prediction: ServoPrediction) -> tuple[float, float]:
    """Return the errors of the model and of the command by which a motion is judged.

    Without what something held, if that is not most of the motion: no model of the arm predicts it.
    """
    free = prediction.free
    if free is not None and free.share >= _MOSTLY:
        return free.position_error_mrad, free.command_error_mrad
    return prediction.position_error_mrad, prediction.command_error_mrad


def _is_missed(prediction: ServoPrediction) -> bool:
    """Return whether much of the motion itself is missed, not only of what friction changes."""
    own, _ = _judged(prediction)
    motion = prediction.motion_mrad
    return motion is not None and own > _MISSED * motion and _share(prediction) > _MISSED**2


def _share(prediction: ServoPrediction) -> float:
    """Return the ratio of the model's error to the command's."""
    own, command = _judged(prediction)
    return own / max(command, 1e-9)


def _figure(prediction: ServoPrediction) -> str:
    """Return the name of a motion and its error, with and without what something held."""
    text = f"{prediction.archive} {prediction.position_error_mrad:.3g}"
    if prediction.free is None:
        return text
    return f"{text}, {prediction.free.position_error_mrad:.3g} where nothing held it"


def _touched_in_fit(results: ServoResults) -> list[str]:
    """Return what held or pushed the arm in motions that were fitted."""
    texts = []
    for archive, spans in results.left_out.items():
        times = _times([(span.start, span.end) for span in spans])
        texts.append(
            f"in {archive}, something held or pushed the arm from {times}: this part was not fitted"
        )
    for archive, contacts in results.fitted_contacts.items():
        if archive not in results.left_out:
            texts.append(
                f"in {archive}, which was fitted, {_held(contacts)}: identify without this"
                " recording"
            )
    return texts


def _touched(prediction: ServoPrediction, unit: str) -> str:
    """Return what something did to an arm, and the errors with it and without."""
    parts = []
    if prediction.contacts:
        parts.append(_held(prediction.contacts))
    if prediction.pushed:
        most = max(prediction.pushed, key=lambda push: abs(push.change_mrad))
        joints = ", ".join(push.joint for push in prediction.pushed)
        parts.append(
            f"something pushed {joints}, which moved while command and model were at rest,"
            f" {most.joint} by {most.change_mrad:.0f} {unit} at {most.time:.1f} s"
        )
    text = f"in {prediction.archive}, {'; '.join(parts)}"
    if (free := prediction.free) is None:
        return text
    return (
        f"{text}; error {prediction.position_error_mrad:.3g} {unit},"
        f" {free.position_error_mrad:.3g} without it"
    )


def _held(contacts: Sequence[ServoContact]) -> str:
    """Return when something held the arm, and which joints."""
    joints = ", ".join(dict.fromkeys(contact.joint for contact in contacts))
    spans = _times(held_spans(contacts))
    return f"something held the arm from {spans} (more than friction of {joints} explains)"


def _times(spans: Sequence[tuple[float, float]]) -> str:
    return ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in spans)


def held_spans(contacts: Sequence[ServoContact]) -> list[tuple[float, float]]:
    """Return start and end [s] of the stretches in which something held any joint."""
    spans: list[tuple[float, float]] = []
    for start, end in sorted((contact.start, contact.end) for contact in contacts):
        if spans and start <= spans[-1][1]:
            spans[-1] = (spans[-1][0], max(end, spans[-1][1]))
        else:
            spans.append((start, end))
    return spans


def screen(results: ServoResults, read: Sequence[Part] = ()) -> list[Part]:
    """Return the parts of one screen: verdict, recordings, errors, parameters, warnings."""
    verdict = results.verdict
    parts: list[Part] = [Paragraph(verdict.line), *read, ""]
    parts += columns(_errors(results, results.validation[:_MAX_LINES]))
    parts += ["", *columns(_parameters(results, [*results.joint_names][:MAX_JOINT_ROWS])), ""]
    parts.append(f"{_delay(results)}; ? = not determined by the motion")
    parts.append(Paragraph(_units(results), most=2))
    parts += [Paragraph(text, "doubtful  ", 2) for text in verdict.warnings[:_MAX_LINES]]
    parts += [Paragraph(text, "next      ", 2) for text in verdict.next_steps[:_MAX_LINES]]
    return parts


def _units(results: ServoResults) -> str:
    """Return the units of the table of joints, each with the columns that have it."""
    units: dict[str, list[str]] = {results.error_unit: ["error"]}
    for name in _SHOWN:
        of_name = dict.fromkeys(each.unit for each in results.servo if each.name == name)
        units.setdefault(" or ".join(of_name), []).append(name)
    columns_by_unit = [
        f"{', '.join(names)} [{unit}]" for unit, names in units.items() if unit not in ("", "-")
    ]
    return f"units: {'; '.join(columns_by_unit)}"


def _delay(results: ServoResults) -> str:
    if results.delay_known:
        return f"command delay {1e3 * results.delay:.0f} ms"
    return "command delay unknown, as the commands have another clock"


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
            interval_text(value.lower, value.upper),
            value.unit,
            "" if value.determined else "not determined",
        )
        for value in results.servo
        if value.present
    ]
    lines += [*columns(rows, left=2), ""]
    lines.append(_delay(results))
    lines += [
        f"{choice.joint}: {' and '.join(choice.terms)} left out, which predicts other windows "
        f"better"
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
    unit = f"rms [{results.error_unit}]"
    rows = [[unit, "all", "MuJoCo's terms", "command", *other]]
    for each, simple in zip(shown, results.simulators["mujoco"].validation, strict=False):
        overall = [each.position_error_mrad, simple.position_error_mrad, each.command_error_mrad]
        if other:
            overall.append(each.compared_error_mrad or 0.0)
        rows.append([each.archive, *(f"{number:.3g}" for number in overall)])
        if each.free is None or simple.free is None:
            continue
        free = [each.free.position_error_mrad, simple.free.position_error_mrad]
        free.append(each.free.command_error_mrad)
        if other:
            free.append(each.free.compared_error_mrad or 0.0)
        rows.append(["  where nothing held it", *(f"{number:.3g}" for number in free)])
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
    overall = root_mean_square(errors)
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
    while max(map(len, columns(rows))) > SCREEN_COLUMNS:
        rows = [row[:-1] for row in rows]
    return rows


def _cell(value: ServoValue) -> str:
    if not value.present:
        return "-"
    return f"{value.value:.2g}{'' if value.determined else '?'}"
