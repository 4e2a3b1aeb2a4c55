"""Parameters polished on simulated windows of the fitted motion, judged on held-out ones."""

from __future__ import annotations

import numpy as np

from hil.base.progress import Reporter
from hil.results.rollout_result import ArmErrors, PolishedParameter, PolishResult
from identification.export.exported_arm import ExportedArm
from identification.rollout.polish import Driven, polished
from identification.rollout.position_errors import RolloutErrors, errors_of, horizon_rows
from identification.text import percentage


def polish(
    fitted: Driven,
    held_out: Driven,
    identified: RolloutErrors,
    reporter: Reporter,
    *,
    in_sample: bool,
) -> tuple[PolishResult, ExportedArm]:
    """Polish an arm on fitted windows, and judge it on held-out ones.

    It is used if the geometric mean of the held-out errors is lower and no more windows are
    unstable.

    Args:
        fitted: windows that are fitted.
        held_out: windows that judge.
        identified: errors before the polish.
        reporter: of progress.
        in_sample: whether there are no held-out windows; it is never used then.

    Raises:
        NotSimulatedError: MuJoCo does not accept the arm.
    """
    with reporter.task("polishing", 1) as task:
        best = polished(fitted)
        task.advance(1)
    windows = held_out.motion.windows
    measured = windows.reached[:, horizon_rows(windows)]
    errors = errors_of(best.on(held_out.motion).positions(), measured, best.arm.model.chain)
    change = float(np.mean(np.log(errors.joints / identified.joints)))
    accepted = change < 0.0 and errors.unstable <= identified.unstable and not in_sample
    return PolishResult(
        accepted=accepted,
        reason=_reason(change, errors, identified, accepted=accepted, in_sample=in_sample),
        windows=len(fitted.motion.windows),
        change=change,
        errors=ArmErrors.of(errors),
        parameters=_parameters(fitted, best),
    ), best.arm


def _reason(
    change: float,
    errors: RolloutErrors,
    identified: RolloutErrors,
    *,
    accepted: bool,
    in_sample: bool,
) -> str:
    """Return why a polished arm is used or not."""
    if in_sample:
        return "The polished arm is not used: nothing was held out to judge it on."
    factor = percentage(float(abs(np.expm1(change))), 1)
    direction = "lowers" if change < 0.0 else "raises"
    result = (
        f"Polishing {direction} the held-out position error by {factor} (geometric mean over joints"
        " and horizons)"
    )
    if not accepted and change < 0.0:
        result += f", but makes {errors.unstable} windows unstable instead of {identified.unstable}"
    return f"{result}: {'used' if accepted else 'not used'}."


def _parameters(start: Driven, best: Driven) -> list[PolishedParameter]:
    """Return the parameters that a polish changed, before and after."""
    model = start.arm.model
    rows = list[PolishedParameter]()

    def add(name: str, unit: str, before: float, after: float) -> None:
        if before != after:
            rows.append(PolishedParameter(name=name, unit=unit, before=before, after=after))

    part = model.friction_part
    rotors = model.layout.rotors
    names = model.parameter_names[part]
    units = model.units[part]
    friction = start.arm.values[part].tolist(), best.arm.values[part].tolist()
    for row in zip(names, units, *friction, strict=True):
        add(*row)
    if model.layout.rotor_inertia:
        inertia = start.arm.standard[rotors].tolist(), best.arm.standard[rotors].tolist()
        for joint, (before, after) in enumerate(zip(*inertia, strict=True)):
            unit = "kg·m²" if model.chain.revolute[joint] else "kg"
            add(f"I{joint + 1}m", unit, before, after)
    old = start.motion.servo
    new = best.motion.servo
    if old is None or new is None:
        add("delay of the torque", "s", start.motion.delay, best.motion.delay)
        return rows
    for name, turning, along in (("kp", "N·m/rad", "N/m"), ("kd", "N·m·s/rad", "N·s/m")):
        gains = getattr(old, name).tolist(), getattr(new, name).tolist()
        for joint, (before, after) in enumerate(zip(*gains, strict=True)):
            unit = turning if model.chain.revolute[joint] else along
            add(f"{name}_{joint + 1}", unit, before, after)
    add("delay of the servo", "s", old.delay, new.delay)
    return rows
