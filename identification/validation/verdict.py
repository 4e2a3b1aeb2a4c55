"""Verdict on an identification: all checks with their findings, messages and next steps."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.text import filled, percentage
from identification.validation.causes import Kind
from identification.validation.evidence import SIGMAS, Evidence
from identification.validation.finding import (
    Finding,
    Level,
    Role,
    Thresholds,
    joined,
    little_torque,
)
from identification.validation.plausibility import ELEMENTS
from identification.validation.prediction import FRICTION_CHANGE
from identification.validation.residuals import Profile, ResidualChecks, Ripple

__all__ = ["Finding", "Thresholds", "Verdict", "judge"]

Array = NDArray[np.float64]
Facts = dict[str, Any]

# A wrong sign would increase the error of the fitted motion as well.
_NOT_COVERED: Final = (
    "fit a longer or more varied motion: the fitted motion does not cover the predicted one"
)
_RICHER: Final = "design a motion for this arm (`hil design`) and record it"
_WARMER: Final = "warm the arm up by moving it before recording"
_NEGATE: Final = "set scale = -1 for the torques in the column map, or negate all torque constants"
_FASTER: Final = "move {joints} faster and further, so that the torque exceeds the noise"
_INERTIA_OFF: Final = 1.2  # ratio of inertias; data sheets are accurate to 10 %
# Beyond this ratio the unit is wrong, or motor torques are in place of joint torques (gear ratios
# are 30 to 200); descriptions in use are closer.
_IMPOSSIBLE_SCALE: Final = 10.0
_JUMPS_SHOWN: Final = 3
_UNEXPLAINED: Final = "unexplained error"  # check
_NEAR: Final = 0.5  # of -1: scale of a torque of the opposite sign


@dataclass(frozen=True)
class Verdict:
    """Whether a model may be used, with findings and next steps."""

    good: bool  #: whether the model may be used
    line: str  #: one sentence: whether it predicts held-out motion well, with the error
    reasons: tuple[str, ...]  #: messages of wrong findings; empty if good
    warnings: tuple[str, ...] = ()  #: messages of doubtful findings
    #: of causes, then of the other wrong findings, or of doubtful ones if none is wrong; of
    #: symptoms only if no cause was found
    next_steps: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()  #: every check with its outcome


def judge(
    joint_names: Sequence[str],
    evidence: Evidence,
    thresholds: Thresholds = Thresholds(),  # noqa: B008 - frozen
    *,
    tested_on: str = "unseen motion",
) -> Verdict:
    """Return the verdict on axes of these names; `tested_on` describes the held-out motion."""
    names = tuple(joint_names)
    facts = _facts(names, evidence, thresholds) | {"on": tested_on}
    findings: list[Finding] = []
    for row in _ROWS:
        findings += row.findings(facts, names) if isinstance(row, _Row) else row(facts, names)
    findings = _without_explained(findings)
    wrong, doubtful = ([f for f in findings if f.level == one] for one in ("wrong", "doubtful"))
    measure = _measure(names, evidence)
    line = f"The model predicts {tested_on} well: {measure}."
    if wrong:
        line = f"The model must not be relied on: {wrong[0].words}; {measure}."
    causes = [finding for finding in (*wrong, *doubtful) if finding.role == "cause"]
    explained = bool(causes) and (not wrong or causes[0].level == "wrong")
    roles = ("condition",) if explained else ("condition", "symptom")
    others = [finding for finding in wrong or doubtful if finding.role in roles]
    steps = dict.fromkeys(finding.next_step for finding in (*causes, *others))
    return Verdict(
        good=not wrong,
        line=line,
        reasons=tuple(finding.words for finding in wrong),
        warnings=tuple(finding.words for finding in doubtful),
        next_steps=tuple(step for step in steps if step),
        findings=tuple(findings),
    )


def _without_explained(findings: Sequence[Finding]) -> list[Finding]:
    """Leave out that nothing explains the error, if a wrong cause does."""
    explained = any(one.role == "cause" and one.level == "wrong" for one in findings)
    return [one for one in findings if not (explained and one.check == _UNEXPLAINED)]


def _measure(names: Sequence[str], evidence: Evidence) -> str:
    """Errors on held-out motion, as the end of the verdict's sentence."""
    error = evidence.held_out
    if np.all(np.isnan(error.relative)):
        return "no torque error was measured"
    worst = int(np.nanargmax(error.relative))
    text = (
        f"{'in-sample ' if evidence.in_sample else ''}torque error {percentage(error.overall, 1)} "
        f"over all axes, {percentage(error.relative[worst], 1)} at worst ({names[worst]})"
    )
    if floor := evidence.floor:
        times = error.overall / floor
        # The floor is an estimate, from the fast part of the residual.
        ratio = f"{times:.1f} times the" if times >= 1.05 else "within the estimated"
        text += f"; {ratio} noise floor of {percentage(floor, 1)}"
    return text


def _facts(names: tuple[str, ...], evidence: Evidence, limit: Thresholds) -> Facts:
    """Numbers and conditions of all findings by name; unknown ones are left out."""
    error, training, estimate = evidence.held_out, evidence.training, evidence.estimate
    checks, relative, explained = evidence.residuals, error.relative, error.explained
    times = relative / np.maximum(training.relative, 1e-12)
    # An error below that of a pattern is one of rounding or smoothing.
    grown = (times > limit.generalisation) & (relative > limit.pattern)
    large = relative > limit.axis
    overall, covered = error.overall > limit.overall, limit.generalisation * training.overall
    minor = _minor(evidence, limit)
    # Little torque does not excuse an axis that was fitted several times better.
    lost = _lost_in_noise(evidence, limit)
    none, little = explained <= limit.explained, explained < limit.little_explained
    # Less torque on unseen motion alone raises the share.
    growth = error.rms / np.maximum(training.rms, 1e-300)
    far = relative > np.where(growth > limit.generalisation, 0.25, 0.5) * limit.axis
    any_explained = not np.all(np.isnan(explained))
    worst = int(np.nanargmin(explained)) if any_explained else 0
    facts: Facts = {
        "limit": limit, "error": error, "relative": relative, "explained": explained,
        "evidence": evidence, "times": times, "condition": estimate.condition,
        "everything": evidence.in_sample,
        "still": error.rows < limit.rows,
        "silent": (error.rows > 0) & (error.torque_squared == 0.0),
        "poor": not estimate.undetermined and estimate.condition > limit.condition,
        "rich": not estimate.undetermined and not estimate.condition > limit.condition,
        "overall_covered": overall and not error.overall > covered,
        "overall_grown": overall and error.overall > covered,
        "large_covered": large & ~grown & ~minor, "large_grown": large & grown & ~minor,
        "large_minor": large & minor, "torque": error.torque_rms,
        "unit": np.array([_unit(evidence, j) for j in range(len(names))], dtype=np.object_),
        "none": none & ~minor, "little": little & ~(none & ~minor),
        "much": any_explained and not little.any(),
        "least": explained[worst], "least_explained": names[worst],
        "grown_far": grown & far & ~lost, "grown_little": grown & ~(far & ~lost),
    }  # fmt: skip
    facts |= _undetermined_facts(evidence)
    if (share := evidence.disagreement) is not None and not estimate.undetermined:
        # Undetermined parameters vary between repetitions.
        facts |= {"disagreement": share, "disagree": share > limit.inconsistency}
    floor, causes = evidence.floor, evidence.causes
    if floor is not None and causes is not None and not causes:
        much = error.overall > max(limit.unexplained, limit.multiple * floor)
        facts |= {"unexplained": much, "floor": floor}
        facts["multiple"] = error.overall / max(floor, 1e-300)
    facts |= _systematic_facts(names, evidence, limit) | _context_facts(evidence, limit)
    facts |= _cause_facts(evidence, limit)
    facts |= _change_facts(names, evidence, facts)
    return facts if checks is None else facts | _residual_facts(checks, facts, evidence)


def _undetermined_facts(evidence: Evidence) -> Facts:
    """Facts on parameters without an estimate, and on joints that moved in one direction only."""
    labels, one_way = evidence.estimate.undetermined, evidence.one_way
    if one_way is None:
        return {"undetermined": ", ".join(labels)}
    # Of a joint that moved in one direction both are the same column.
    pairs = [(f"f0_{joint}", f"fo_{joint}") for joint in range(1, len(one_way) + 1)]
    apart = np.array([{*pair} <= {*labels} for pair in pairs]) & one_way
    explained = {label for joint in np.flatnonzero(apart) for label in pairs[joint]}
    return {
        "undetermined": ", ".join(label for label in labels if label not in explained),
        "only_sum": apart,
        "one_way": one_way & ~apart,
        "friction_pair": np.array([" and ".join(pair) for pair in pairs], dtype=np.object_),
    }


def _unit(evidence: Evidence, joint: int) -> str:
    return "N·m" if evidence.revolute(joint) else "N"


def _minor(evidence: Evidence, limit: Thresholds) -> NDArray[np.bool_]:
    """Return axes whose torque is too small to condemn a model alone (n,).

    It is lost in its noise, or small against that of the other axes or against its own limit.
    """
    error = evidence.held_out
    torque = error.torque_rms
    slides = np.isin(np.arange(len(torque)), evidence.prismatic)
    minor = little_torque(torque, slides, limit) | _lost_in_noise(evidence, limit)
    if (most := evidence.context.torque_limit) is not None:
        minor |= torque < limit.minor_of_limit * np.nan_to_num(most)
    return np.asarray(minor & (error.rows > 0))


def _lost_in_noise(evidence: Evidence, limit: Thresholds) -> NDArray[np.bool_]:
    """Return axes whose torque is lost in its noise (n,)."""
    torque = evidence.held_out.torque_rms
    if evidence.noise_floor is None:
        return np.zeros(len(torque), dtype=np.bool_)
    return np.asarray(np.nan_to_num(evidence.noise_floor) > 0.5 * limit.axis * torque)


def _change_facts(names: tuple[str, ...], evidence: Evidence, known: Facts) -> Facts:
    """Facts on joints whose torque or friction differs on unseen motion.

    With repetitions friction is compared apart from noise, see :func:`_systematic_facts`.
    """
    limit, error = known["limit"], evidence.held_out
    ratio, std = np.full((2, len(names)), np.nan)
    gain, friction = np.zeros((2, len(names)), dtype=np.bool_)
    for one in evidence.changes:
        (gain if one.kind == "gain" else friction)[one.joint] = True
        ratio[one.joint], std[one.joint] = one.ratio, 2.0 * one.std
    # They would be read as changes of single joints, or have spoilt the parameters.
    contaminated = known.get("carried", False) or known.get("gravity_off", False)
    contaminated |= any(
        one.fault.discrete or one.ratio < limit.cause for one in evidence.causes or ()
    )
    if contaminated:
        return {}
    matters = error.relative > limit.unexplained
    facts: Facts = {"ratio": ratio, "ratio_half": std}
    facts |= {"other_gain": gain & matters, "slightly_other_gain": gain & ~matters}
    if evidence.friction_change is None:
        change = ratio - 1.0
        far = friction & matters & (np.abs(change) > FRICTION_CHANGE)
        facts |= {"change": change, "much_warmer": friction & far.any()}
        facts |= {"warmer": friction & (not far.any())}
        facts["friction_axes"] = joined([names[j] for j in np.flatnonzero(friction)])
    return facts


def _systematic_facts(names: tuple[str, ...], evidence: Evidence, limit: Thresholds) -> Facts:
    """Facts on slow errors, and on friction that differs on held-out motion."""
    nothing, known = np.zeros(len(names)), evidence.systematic
    share = nothing if known is None else np.nan_to_num(known)
    apart = evidence.systematic_without_friction
    beyond = (share if apart is None else np.nan_to_num(apart)) > limit.systematic
    facts: Facts = {
        "no_repetitions": known is None,
        "systematic": share,
        "systematic_large": (share > limit.systematic) & beyond,
        "systematic_small": (share > limit.noticeable) & (share <= limit.systematic),
    }
    if (change := evidence.friction_change) is not None:
        by_friction = (share > limit.systematic) & ~beyond
        changed = by_friction | ((np.abs(change) > limit.friction) & ~beyond)
        facts |= {"change": change, "warmer": changed & ~by_friction.any()}
        facts |= {"much_warmer": changed & by_friction.any()}
        facts["friction_axes"] = joined([names[j] for j in np.flatnonzero(by_friction)])
    return facts


def _cause_facts(evidence: Evidence, limit: Thresholds) -> Facts:
    """Facts on gravity, on a load on one side only, and on outliers."""
    facts: Facts = {"rival": np.inf, "outliers_decide": False}
    if (gravity := evidence.gravity) is not None:
        angle, error = float(np.degrees(gravity.angle)), float(np.sqrt(gravity.ratio))
        off = gravity.ratio < limit.gravity and angle > limit.gravity_angle
        facts |= {"gravity_off": off, "gravity_angle": angle, "gravity_error": error}
        for name, value in (("declared", gravity.declared), ("best", gravity.best)):
            facts[name] = ", ".join(f"{one + 0.0:.2f}" for one in np.round(value, 2))
        facts["rival"] = error if off else np.inf
    if (load := evidence.load) is not None:
        most = 2 * load.axes >= len(evidence.held_out.rows)
        half = f" ± {load.half_interval:.2g}" if np.isfinite(load.half_interval) else ""
        more = f"{abs(load.mass):.3g}{half} kg {'more' if load.mass > 0.0 else 'less'}"
        # A mass whose interval includes zero is no load; one without an interval is not known.
        certain = not load.half_interval < np.inf or abs(load.mass) > load.half_interval
        carried = load.explained >= limit.load and most and certain
        facts |= {"carried": carried, "more": more, "load": load}
    if (checks := evidence.residuals) is not None:
        # Few samples cause most of the error, and it exceeds its limit with them only.
        found, error_of = checks.outliers, evidence.held_out
        few = (found.power > limit.outlying_power) & (found.share < limit.outliers)
        # An error of rounding has a distribution of its own.
        few &= (found.share > 0.0) & (np.nan_to_num(error_of.relative) > limit.pattern)
        axis = (error_of.relative > limit.axis) & (found.without.relative <= limit.axis)
        all_axes = error_of.overall > limit.overall >= found.without.overall
        decide = bool(few.any()) and (all_axes or bool(np.any(axis & few)))
        facts |= {"outliers": found, "outlying": found.share, "outliers_decide": decide}
        facts |= {"outliers_spoil": few & decide, "outliers_exist": few & (not decide)}
    return facts


def _context_facts(evidence: Evidence, limit: Thresholds) -> Facts:
    """Facts on other models, nominal scale, delay and limits."""
    context, ours, facts = evidence.context, evidence.held_out.overall, Facts()
    for name, theirs in (("nominal", evidence.nominal), ("controller", context.controller)):
        if theirs is not None:
            better = ours > theirs.overall + limit.nominal
            facts |= {name: theirs, f"{name}_better": better, f"{name}_worse": not better}
    if jumps := sorted(context.jumps, key=lambda jump: -abs(jump.size)):
        where = [f"{j.joint} by {j.size:+.3g} after {j.time:.3f} s of {j.recording}" for j in jumps]
        facts |= {"jumped": joined(where, _JUMPS_SHOWN)}
        facts["jumping"] = joined(list(dict.fromkeys(jump.joint for jump in jumps)))
    if (scale := context.nominal_scale) is not None:
        negated = scale.negated
        if evidence.causes is not None and not negated:
            # Torques of another joint or with the wrong sign have no nominal size.
            scale = scale.without(j for one in evidence.causes for j in one.fault.joints)
        common, known = scale.common, np.isfinite(scale.scale)
        off = known if common != 1.0 else scale.off
        impossible = abs(np.log(common)) > np.log(_IMPOSSIBLE_SCALE)
        facts |= {"scale": scale.scale, "tolerance": scale.tolerance}
        opposite = off & (scale.scale + scale.tolerance < 0.0) & (np.abs(scale.scale + 1.0) < _NEAR)
        facts |= {"negated": known & negated, "opposite": opposite & (not negated)}
        off = off & ~opposite & (not negated)
        facts |= {"impossible_scale": off & impossible, "other_scale": off & (not impossible)}
    if (dissipation := evidence.dissipation) is not None:
        positive = scale is not None and bool(np.any(scale.scale - scale.tolerance > 0.0))
        alone = not (positive or np.any(facts.get("negated", False)))
        facts |= {"driving": dissipation.described, "all_driving": dissipation.all_driving & alone}
    if (inertia := context.controller_inertia) is not None:
        far = np.abs(np.log(inertia.ratio)) > np.log(_INERTIA_OFF)
        known = np.isfinite(inertia.ratio)
        facts |= {"inertia": inertia.ratio, "inertia_off": far, "inertia_same": known & ~far.any()}
    if (share := context.saturated) is not None:
        full = share > limit.saturated
        facts |= {"saturated": share, "full": full, "unsaturated": not full.any()}
    if (delays := context.delays) is not None:
        assumed = context.assumed_delay
        same = delays.significant and assumed == delays.applied
        # With a poor motion a delay cannot be separated from the parameters.
        poor = bool(evidence.estimate.undetermined) or evidence.estimate.condition > limit.condition
        beyond = max(limit.delay * delays.cycle, SIGMAS * delays.std)
        late = delays.determined and abs(delays.delay - assumed) > beyond
        facts |= {
            "compensated": same, "stated": 1e3 * delays.assumed, "assumed": 1e3 * assumed,
            "delay": 1e3 * delays.delay, "half": 1e3 * delays.half_interval,
            "late": late and not (same or poor),
            "on_time": delays.determined and not (late or same or poor),
        }  # fmt: skip
    return facts


def _residual_facts(checks: ResidualChecks, facts: Facts, evidence: Evidence) -> Facts:
    """Facts on patterns of the residual that are significant and large enough."""
    limit: Thresholds = facts["limit"]

    def notable(pattern: Profile | Ripple) -> NDArray[np.bool_]:
        large = checks.share(pattern.rms) > limit.pattern
        return pattern.significant & large & (pattern.rms > limit.pattern_of_residual * checks.rms)

    parameters, correlation = len(evidence.estimate.names), checks.autocorrelation
    worth = np.nansum(correlation.effective_rows)
    short = bool(worth < limit.rows_per_parameter * parameters)
    found: Facts = {"short": short, "long": not short, "parameters": parameters, "worth": worth}
    found |= {"memory": 1e3 * np.nanmedian(correlation.time), "rows": correlation.rows.sum()}
    for name, profile in (("speed", checks.speed), ("position", checks.position)):
        share, joints, worst = checks.share(profile.rms), notable(profile), []
        for j in range(len(share)):
            (at, error), turns = profile.worst(j), evidence.revolute(j)
            angle = ("rad" if turns else "m") + ("/s" if name == "speed" else "")
            unit = "N·m" if turns else "N"
            worst.append(
                f"({error:+.3g} {unit} about {at:.2g} {angle}, {percentage(share[j], 1)} of its "
                "torque)"
            )
        found |= {f"over_{name}": joints, f"not_over_{name}": not joints.any()}
        found[f"worst_{name}"] = np.array(worst, dtype=np.object_)
    if (ripple := checks.ripple) is not None:
        share, joints = checks.share(ripple.rms), notable(ripple)
        matters = joints & (share > limit.ripple)
        found |= {"ripple": share, "no_ripple": not joints.any(), "large_ripple": matters}
        found |= {"usual_ripple": joints & ~matters.any()}
        found["harmonic"] = np.array([ripple.strongest(j) for j in range(len(share))])
    if (drift := checks.drift) is not None:
        # A change counts by its share of the torque.
        size, joints = np.abs(drift.change) * checks.friction_share, drift.significant
        matters = joints & (size > limit.drift)
        found |= {"drift": drift.change, "no_drift": not joints.any(), "large_drift": matters}
        found |= {"little_drift": joints & ~matters.any()}
        found["drifted"] = size[joints].max(initial=0.0)
    return found


class _Row(NamedTuple):
    """A finding for each level whose condition is true.

    In message and step, {name} is a fact, {joints} the joints of the condition; <...> is repeated
    for each of these joints, with its name and its entries of facts that are arrays.
    """

    check: str
    levels: Mapping[Level, str]  # name of a condition by level
    words: str  # template of the message
    step: str = ""  # template
    role: Role = "condition"

    def findings(self, facts: Facts, names: Sequence[str]) -> Iterator[Finding]:
        """Yield the findings of the conditions that are known and true."""
        for level, condition in self.levels.items():
            value = facts.get(condition, False)
            joints = np.flatnonzero(value).tolist() if isinstance(value, np.ndarray) else []
            if joints or (not isinstance(value, np.ndarray) and value):
                texts = [_filled(one, facts, names, joints) for one in (self.words, self.step)]
                yield Finding(self.check, level, texts[0], texts[1], self.role)


def _filled(template: str, facts: Facts, names: Sequence[str], joints: Sequence[int]) -> str:
    """Fill a template of a row."""
    facts = facts | {"joints": joined([names[j] for j in joints])}
    parts = re.split("<(.*?)>", template)
    for k, part in enumerate(parts):
        if k % 2:
            each = (
                {key: one[j] if isinstance(one, np.ndarray) else one for key, one in facts.items()}
                for j in joints
            )
            texts = zip(joints, each, strict=True)
            parts[k] = joined([f"{names[j]} {filled(part, **values)}" for j, values in texts])
        else:
            parts[k] = filled(part, **facts)
    return "".join(parts)


class _CauseRow(NamedTuple):
    """Finding of one kind of cause; its size is displayed as offset + scale * size."""

    check: str
    words: str
    step: str
    scale: float = 1.0
    offset: float = 0.0


# fmt: off
def _order(of: str) -> _CauseRow:
    return _CauseRow(
        "order of joints", f"the {of} of {{joints}} are probably interchanged",
        "check the order of the columns in the column map against the joints of the URDF")


def _changed(of: str) -> _CauseRow:
    return _CauseRow(
        "sameness", f"in {{part}} the {of} of {{joints}} is {{size}} times that of the other data",
        "check what changed between the recordings: temperature, brakes, drive settings of"
        " {joints}", offset=1.0)


_CAUSES: Final[dict[Kind, _CauseRow]] = {
    "delay": _CauseRow(
        "delay", "the torque of {joints} lags the position by {size} ms {more} than assumed",
        "run `hil identify --delay auto`, or correct the delay at its source", scale=1e3),
    "gain": _CauseRow(
        "torque constant",
        "the torque of {joints} is {size} times the value consistent with the other axes",
        "check torque constant and gear ratio of {joints}; recordings with and without a known"
        " payload determine the constant (`hil torque-constants --loaded`)", offset=1.0),
    "load friction": _CauseRow(
        "friction over load", "friction grows with the load, by {size} of the transmitted torque"
        " (median axis)",
        "fit it: add `load` to the terms of `--friction`, as in"
        " `--friction coulomb,viscous,load,offset`"),
    "torque sign": _CauseRow(
        "direction of axes", "the torque of {joints} has probably the wrong sign",
        "check the sign of the torque of {joints} in the column map, or of its torque constant"),
    "axis sign": _CauseRow(
        "direction of axes",
        "{joints} probably turns opposite to the URDF: wrong sign of gear ratio or direction",
        "jog {joints} by hand and compare its direction of rotation with the URDF's"),
    "torque order": _order("torques"),
    "position order": _order("positions"),
    "joint order": _order("positions and torques"),
    "payload": _CauseRow(
        "sameness", "in {part} the arm carried {size} kg {more} than in the other data",
        "identify the recordings of each payload separately, or state a known payload in their"
        " cell file ([robot.payload])"),
    "changed gain": _changed("torque"),
    "changed friction": _changed("friction"),
    "changed arm": _CauseRow(
        "sameness", "{part} is probably of another arm, tool or setting than the other data",
        "identify from recordings of one arm in one condition"),
}
# fmt: on


_SIGN_OR_SCALE: Final[tuple[Kind, ...]] = ("torque sign", "axis sign", "gain")


def _negated(facts: Facts) -> bool:
    """Return whether the torques of all joints have the wrong sign, one cause of many signs."""
    return any(np.any(facts.get(name, False)) for name in ("negated", "all_driving"))


def _causes(facts: Facts, names: Sequence[str]) -> Iterator[Finding]:
    """Faults whose correction makes parts of the fitted recordings more predictable."""
    causes = facts["evidence"].causes
    for cause in () if causes is None or facts["outliers_decide"] else causes:
        if cause.ratio > facts["rival"] or (cause.fault.kind in _SIGN_OR_SCALE and _negated(facts)):
            continue
        check, words, step, scale, offset = _CAUSES[cause.fault.kind]
        joints, size = [names[j] for j in cause.fault.joints] or ["all axes"], cause.size or 0.0
        own = {
            "joints": " and ".join(joints),
            "part": "" if cause.fault.part is None else cause.fault.part.name,
            "size": f"{abs(offset + scale * size):.3g} ± {scale * 2.0 * cause.std:.2g}",
            "more": "more" if size > 0.0 else "less",
        }
        certain = cause.fault.discrete or cause.ratio < facts["limit"].cause
        words = (
            f"{words.format(**own)}; correcting this multiplies the error of predicted parts of the"
            f" fitted motion by {cause.ratio:.2f}"
        )
        level: Level = "wrong" if certain else "doubtful"
        yield Finding(check, level, words, step.format(**own), "cause")


_BALANCED: Final = (
    f"describe {ELEMENTS} that carries part of the weight in [[robot.elements]] of the cell file;"
    " else check the sign of the torque and the direction of each axis"
)


def _physical_signs(facts: Facts, _: Sequence[str]) -> Iterator[Finding]:
    """Parameters with physically impossible signs."""
    impossible, doubtful, added = facts["evidence"].implausible
    if _negated(facts):
        impossible, doubtful = (), ()
    step = "check the sign of the torque and the direction of each axis in the column map or cell"
    for words in impossible:
        own = _BALANCED if ELEMENTS in words else step
        yield Finding("physical signs", "wrong", words, own, "symptom")
    step = "use the consistent estimate where the model must be physical (simulation, URDF)"
    for words in doubtful:
        yield Finding("physical signs", "doubtful", words, step)
    step = "compare with `hil identify --friction coulomb,viscous,offset`"
    for words in added:
        yield Finding("friction law", "doubtful", words, step)


def _corrections(facts: Facts, _: Sequence[str]) -> Iterator[Finding]:
    """Faults of the recordings that were corrected before the fit."""
    yield from facts["evidence"].context.corrections


# In the order of the verdict's reasons: its line has the first one.
# fmt: off
_ROWS: Final[tuple[_Row | Callable[[Facts, Sequence[str]], Iterator[Finding]], ...]] = (
    _Row("tested", {"wrong": "everything"},
         "no motion was held out: all errors are in-sample",
         "predict a recording that is not fitted (`hil identify --predict ARCHIVE`)"),
    _Row("tested", {"wrong": "still"},
         "{joints} moved in fewer than {limit.rows} samples of {on}",
         "record a validation motion that moves {joints}; a joint that must not move is locked"
         " (`locked` under [robot] in the cell file, or `hil import log --held JOINT`)"),
    _Row("tested", {"wrong": "silent"},
         "the measured torque of {joints} is zero throughout {on}",
         "record the torque of {joints} with sufficient resolution"),
    _Row("position jumps", {"wrong": "jumped"},
         "the measured position jumped faster than an arm can move (rad or m): {jumped}",
         "check encoder, coupling and cable of {jumping} and record again, or cut the recording"
         " before the jump", "cause"),
    _Row("excitation", {"wrong": "undetermined"},
         "the motion does not determine {undetermined}", _RICHER),
    _Row("excitation", {"wrong": "only_sum"},
         "the motion determines only the sum of Coulomb friction and offset of the torque of"
         " {joints}, which moved in one direction only: <{friction_pair}>",
         "record a motion in which {joints} moves in both directions"),
    _Row("excitation", {"doubtful": "poor"},
         "the motion excites the parameters poorly: condition number {condition:.0f} of the"
         " regressor with unit columns, limit {limit.condition:.0f}; predictions are"
         " reliable for similar motions only, single parameters are not", _RICHER),
    _Row("excitation", {"doubtful": "one_way"},
         "{joints} moved in one direction only on the fitted motion: Coulomb friction and offset of"
         " the torque are one column of the regressor there, and only their sum is determined",
         "record a motion in which {joints} moves in both directions"),
    _Row("excitation", {"good": "rich"},
         "the motion determines every parameter: condition number {condition:.0f} of the regressor"
         " with unit columns"),
    _Row("outliers", {"wrong": "outliers_spoil", "doubtful": "outliers_exist"},
         "isolated outliers cause most of the error on {on} (<{outlying:.2%}> of the samples);"
         " without them it is {outliers.without.overall:.1%} over all axes",
         "check the recorded torques for spikes, damaged packets and collisions; remove them, or"
         " use a robust estimator (`hil identify --estimator tukey` or huber)", "cause"),
    _Row("gravity", {"wrong": "gravity_off"},
         "with gravity ({best}) m/s² in base axes, {gravity_angle:.0f}° from the declared"
         " ({declared}) m/s², {on} is predicted with {gravity_error:.2f} times the error",
         "set gravity of [robot] in the cell file to the mounting of the arm; if it is right,"
         " check the zero positions of the joints", "cause"),
    _Row("direction of axes", {"wrong": "negated"},
         "all torques have the opposite sign of the nominal inertial torques: ratio <{scale:.2g}>",
         _NEGATE, "cause"),
    _Row("direction of axes", {"wrong": "all_driving"},
         "all torques have the opposite sign: friction would drive every axis, <{driving}> at top"
         " speed",
         _NEGATE, "cause"),
    _Row("direction of axes", {"wrong": "opposite"},
         "the torque has the opposite sign of the nominal inertial torque: ratio <{scale:.2g}>",
         "check the sign of the torque of {joints} in the column map, or of its torque constant",
         "cause"),
    _causes,
    _Row("scale of the torque", {"wrong": "impossible_scale", "doubtful": "other_scale"},
         "ratio of measured torque to the torque of the nominal inertias:"
         " <{scale:.3g} ± {tolerance:.2g}>",
         "check unit, side (motor or joint), torque constant and gear ratio of the torque of"
         " {joints}, the payload, and the masses of the URDF", "cause"),
    _Row("load", {"wrong": "carried"},
         "on {on} the arm carried {more} than on the fitted motion: a body on the last link"
         " explains {load.explained:.0%} of the additional error",
         "record both with the same tool and payload, or state the payload of each in its cell"
         " file", "cause"),
    _Row("sameness", {"wrong": "other_gain", "doubtful": "slightly_other_gain"},
         "the torque on {on} differs from that of the fitted motion by a factor: <{ratio:.3g} ±"
         " {ratio_half:.2g}>",
         "check what changed for {joints} between the recordings: torque constant, unit or scale of"
         " the torque, drive settings; identify the recordings of each state separately", "cause"),
    _Row("friction", {"wrong": "much_warmer"},
         "friction on {on} differs from the estimate: <{change:+.0%}>, beyond the"
         f" {percentage(FRICTION_CHANGE)} that gear temperature causes; this explains the error of"
         " {friction_axes}",
         _WARMER, "cause"),
    _Row("friction", {"doubtful": "warmer"},
         "friction on {on} differs by more than {limit.friction:.0%}: <{change:+.0%}>; gear"
         " temperature may have changed", _WARMER, "cause"),
    _physical_signs,
    _Row("error on unseen motion", {"wrong": "overall_covered"},
         "the torque error on {on} is {error.overall:.1%} over all axes, limit"
         " {limit.overall:.0%}",
         f"describe {ELEMENTS}, if the arm has one, in [[robot.elements]] of the cell file; else"
         " check gear ratios, signs, torque constants and the delay between torque and position",
         "symptom"),
    _Row("error on unseen motion", {"wrong": "overall_grown"},
         "the torque error on {on} is {error.overall:.1%} over all axes, limit"
         " {limit.overall:.0%}", _NOT_COVERED, "symptom"),
    _Row("error on unseen motion", {"wrong": "large_covered"},
         "the torque error on {on} exceeds {limit.axis:.0%}: <{relative:.0%}>",
         "check sign, gear ratio and torque constant of {joints}, and whether the torque exceeds"
         " its noise", "symptom"),
    _Row("error on unseen motion", {"doubtful": "large_minor"},
         "the torque error on {on} exceeds {limit.axis:.0%} for axes of little torque:"
         " <{relative:.0%} of {torque:.2g} {unit}>", _FASTER, "symptom"),
    _Row("error on unseen motion", {"wrong": "large_grown"},
         "the torque error on {on} exceeds {limit.axis:.0%}: <{relative:.0%}>", _NOT_COVERED,
         "symptom"),
    _Row(_UNEXPLAINED, {"wrong": "unexplained"},
         "the torque error on {on} is {error.overall:.1%}, {multiple:.1f} times the noise floor of"
         " {floor:.1%}; none of the tested faults explains it (delay, torque constants, signs and"
         " order of joints, payload, changes between recordings)",
         "check for effects that the model lacks: friction curves of the report, elasticity,"
         " springs or balancers ([[robot.elements]] of the cell file), temperature", "symptom"),
    _Row("variance explained (R²)", {"wrong": "none"},
         "the model of {joints} predicts no better than the mean torque (R² at most"
         " {limit.explained:g})", _FASTER, "symptom"),
    _Row("variance explained (R²)", {"doubtful": "little"},
         "the model explains less than {limit.little_explained:.0%} of the torque variance:"
         " <{explained:.0%}>", _FASTER, "symptom"),
    _Row("variance explained (R²)", {"good": "much"},
         "the model explains at least {least:.1%} of the torque variance of each axis (lowest:"
         " {least_explained})"),
    _Row("generalisation", {"wrong": "grown_far", "doubtful": "grown_little"},
         "the torque error on {on} is more than {limit.generalisation:g} times that of the fitted"
         " motion: <{times:.1f} times, {relative:.1%}>", _NOT_COVERED, "symptom"),
    _Row("systematic error", {"doubtful": "no_repetitions"},
         "without repetitions of one motion, errors of the drive train (coupling, torque constant)"
         " cannot be distinguished from noise and were not tested",
         "record the same motion several times"),
    _Row("systematic error", {"wrong": "systematic_large"},
         "the torque error on {on} beyond noise exceeds {limit.systematic:.1%}:"
         " <{systematic:.1%}>",
         "check sign, gear ratio, coupling and torque constant of {joints}", "symptom"),
    _Row("systematic error", {"doubtful": "systematic_small"},
         "the torque error on {on} beyond noise exceeds {limit.noticeable:.1%}:"
         " <{systematic:.1%}>",
         "check the torque constant of {joints} with a known payload"
         " (`hil torque-constants`), or without gravity load against the drive's data sheet",
         "symptom"),
    _Row("repetitions", {"wrong": "disagree"},
         "the estimates of single repetitions differ by more than {limit.inconsistency:.0%} of the"
         " torque: <{disagreement:.0%}>",
         "compare the repetitions: conditions changed between them"),
    _Row("against the nominal model", {"wrong": "nominal_better"},
         "the nominal model predicts better: error {nominal.overall:.1%}, identified model"
         " {error.overall:.1%}",
         "use the nominal model, or fit a longer and more varied motion", "symptom"),
    _Row("against the nominal model", {"good": "nominal_worse"},
         "the error of the nominal model is {nominal.overall:.1%}, of the identified model"
         " {error.overall:.1%}"),
    _Row("against the controller's model", {"doubtful": "controller_better"},
         "the controller's own dynamic model predicts better: error {controller.overall:.1%},"
         " identified model {error.overall:.1%}",
         "fit a longer and more varied motion before replacing the controller's model", "symptom"),
    _Row("against the controller's model", {"good": "controller_worse"},
         "the error of the controller's own dynamic model is {controller.overall:.1%}, of the"
         " identified model {error.overall:.1%}"),
    _Row("against the controller's inertia", {"doubtful": "inertia_off"},
         "ratio of the controller's inertia (joint side, with rotors) to the identified one:"
         " <{inertia:.2f}>",
         "check torque constant and gear ratio of {joints}, and the payload"),
    _Row("against the controller's inertia", {"good": "inertia_same"},
         "the controller's inertia agrees with the identified one: ratio <{inertia:.2f}>"),
    _Row("delay", {"doubtful": "compensated"},
         "the torque lags the position by {delay:.3g} ± {half:.2g} ms ({stated:.3g} ms"
         " stated); this was compensated",
         "state it (`hil identify --delay SECONDS`), or correct it at its source"),
    _Row("delay", {"doubtful": "late"},
         "the delay of the torque differs from the assumed one: {delay:.3g} ± {half:.2g} ms"
         " ({assumed:.3g} ms assumed)",
         "compare with `hil identify --delay auto`, or correct the delay in the cell", "cause"),
    _Row("delay", {"good": "on_time"},
         "the delay of the torque is as assumed: {delay:.3g} ± {half:.2g} ms"
         " ({stated:.3g} ms assumed)"),
    _corrections,
    _Row("saturation", {"good": "unsaturated"}, "no torque or current was at its limit"),
    _Row("saturation", {"doubtful": "full"},
         "torque or current was at its limit: <in {saturated:.1%} of its samples>; the true value"
         " may be larger",
         "slow the motion down where {joints} is at its limit", "cause"),
    _Row("whiteness", {"doubtful": "short"},
         "the recordings are short: the residual is correlated over {memory:.3g} ms (median axis),"
         " {rows} rows equal {worth:.0f} independent ones, for {parameters} parameters",
         "record a longer motion, or the same one several times"),
    _Row("whiteness", {"good": "long"},
         "the residual is correlated over {memory:.3g} ms (median axis), {rows} rows equal"
         " {worth:.0f} independent ones, for {parameters} parameters; the standard deviations"
         " include this"),
    _Row("residual over speed", {"doubtful": "over_speed"},
         "the residual depends on speed: <{worst_speed}>; the friction law may have another form",
         "try further friction terms for {joints} (Stribeck, asymmetric, third)", "symptom"),
    _Row("residual over speed", {"good": "not_over_speed"},
         "the residual does not depend noticeably on speed"),
    _Row("residual over position", {"doubtful": "over_position"},
         "the residual depends on position: <{worst_position}>",
         "check the URDF's geometry and gravity direction, and for a hose, spring or payload that"
         " the model lacks", "symptom"),
    _Row("residual over position", {"good": "not_over_position"},
         "the residual does not depend noticeably on position"),
    _Row("torque ripple", {"good": "no_ripple"}, "no torque ripple is significant"),
    _Row("torque ripple", {"information": "usual_ripple"},
         "torque ripple with the motor angle, of usual size:"
         " <({harmonic} per motor turn, {ripple:.1%} of its torque)>"),
    _Row("torque ripple", {"doubtful": "large_ripple"},
         "torque ripple with the motor angle exceeds {limit.ripple:.0%} of the torque:"
         " <({harmonic} per motor turn, {ripple:.1%} of its torque)>",
         "record a long motion, which averages it, or compensate it separately: the model does not"
         " include it"),
    _Row("friction over time", {"good": "no_drift"},
         "friction did not change significantly during the recordings"),
    _Row("friction over time", {"information": "little_drift"},
         "friction changed during the recordings: <by {drift:+.1%}>, at most {drifted:.1%} of an"
         " axis's torque"),
    _Row("friction over time", {"doubtful": "large_drift"},
         "friction changed during the recordings: <by {drift:+.1%}>, more than"
         " {limit.drift:.0%} of the torque", _WARMER, "cause"),
)
# fmt: on
