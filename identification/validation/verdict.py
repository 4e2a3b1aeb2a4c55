"""Is the result good? Every check with its finding, one sentence, and what to do next."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.validation.causes import Kind
from identification.validation.evidence import SIGMAS, Evidence
from identification.validation.finding import Finding, Level, Role, Thresholds, joined
from identification.validation.prediction import FRICTION_CHANGE
from identification.validation.residuals import Profile, ResidualChecks, Ripple

__all__ = ["Finding", "Thresholds", "Verdict", "judge"]

Array = NDArray[np.float64]
Facts = dict[str, Any]

# What is smaller would be shown as nothing.
_SHOWN: Final = 0.0005
# What was fitted well and is predicted badly has no wrong sign, which would spoil both.
_NOT_COVERED: Final = (
    "fit a longer or richer motion: what was fitted does not cover what was predicted"
)
_RICHER: Final = "design a motion for this arm (`hil design`) and record that"
_WARMER: Final = "warm the arm up by moving it before recording"
_FASTER: Final = "move {joints} faster and further, so that its torque stands out of noise"
# A maker's figures are good to ten per cent; twice that is worth a word.
_INERTIA_OFF: Final = 1.2
# No arm's links are wrong by that much in a description in use: it is a unit, or torques of the
# motors mistaken for those of the joints (gears turn 30 to 200 times).
_IMPOSSIBLE_SCALE: Final = 10.0
_JUMPS_SHOWN: Final = 3


@dataclass(frozen=True)
class Verdict:
    """Answer to "is the result good?"."""

    good: bool  #: whether the model may be used
    line: str  #: one sentence: whether it predicts unseen motion well, and by how much
    reasons: tuple[str, ...]  #: what is wrong, in words; empty if good
    #: what is not as it should be, but too small or too uncertain to say no
    warnings: tuple[str, ...] = ()
    #: what to do: first about what explains errors, then about the reasons. About other warnings
    #: only where there is no reason, since what is wrong makes warnings of its own; about mere
    #: errors only where nothing was found that explains them
    next_steps: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()  #: every check with its outcome


def judge(
    joint_names: Sequence[str],
    evidence: Evidence,
    thresholds: Thresholds = Thresholds(),  # noqa: B008 - frozen
    *,
    tested_on: str = "unseen motion",
) -> Verdict:
    """Give the verdict on the axes of these names; `tested_on` is the held-out motion in words."""
    names = tuple(joint_names)
    facts = _facts(names, evidence, thresholds) | {"on": tested_on}
    findings: list[Finding] = []
    for row in _ROWS:
        findings += row.findings(facts, names) if isinstance(row, _Row) else row(facts, names)
    wrong, doubtful = ([f for f in findings if f.level == one] for one in ("wrong", "doubtful"))
    measure = _measure(names, evidence)
    line = f"The model predicts {tested_on} well: {measure}."
    if wrong:
        line = f"The model must not be relied on: {wrong[0].words}; {measure}."
    causes = [finding for finding in (*wrong, *doubtful) if finding.role == "cause"]
    explained = bool(causes) and (not wrong or causes[0].level == "wrong")
    asked = ("condition",) if explained else ("condition", "symptom")
    others = [finding for finding in wrong or doubtful if finding.role in asked]
    steps = dict.fromkeys(finding.next_step for finding in (*causes, *others))
    return Verdict(
        good=not wrong,
        line=line,
        reasons=tuple(finding.words for finding in wrong),
        warnings=tuple(finding.words for finding in doubtful),
        next_steps=tuple(step for step in steps if step),
        findings=tuple(findings),
    )


def _measure(names: Sequence[str], evidence: Evidence) -> str:
    """How well unseen motion is predicted, in figures."""
    error, systematic = evidence.held_out, evidence.systematic
    if np.all(np.isnan(error.relative)):
        return "no torque error was measured"
    worst = int(np.nanargmax(error.relative))
    text = (
        f"{'in-sample ' if evidence.in_sample else ''}torque error {error.overall:.1%} over all"
        f" axes, {error.relative[worst]:.1%} at worst ({names[worst]})"
    )
    if floor := evidence.floor:
        text += f"; {error.overall / floor:.1f} times the noise floor of {floor:.1%}"
    if systematic is not None and np.nanmax(systematic, initial=0.0) >= _SHOWN:
        axis = int(np.nanargmax(systematic))
        text += f"; beyond what noise explains {systematic[axis]:.1%} at worst ({names[axis]})"
    return text


def _facts(names: tuple[str, ...], evidence: Evidence, limit: Thresholds) -> Facts:
    """Numbers and conditions of all findings by name; what is not known is left out."""
    error, training, estimate = evidence.held_out, evidence.training, evidence.estimate
    checks, relative, explained = evidence.residuals, error.relative, error.explained
    times = relative / np.maximum(training.relative, 1e-12)
    grown, large = times > limit.generalisation, relative > limit.axis
    overall, covered = error.overall > limit.overall, limit.generalisation * training.overall
    none, little = explained <= limit.explained, explained < limit.little_explained
    any_explained = not np.all(np.isnan(explained))
    worst = int(np.nanargmin(explained)) if any_explained else 0
    indices = evidence.coupling or (np.inf, np.inf)
    facts: Facts = {
        "limit": limit, "error": error, "relative": relative, "explained": explained,
        "evidence": evidence, "times": times, "condition": estimate.condition,
        "everything": evidence.in_sample,
        "still": error.rows < limit.rows,
        "silent": (error.rows > 0) & (error.torque_squared == 0.0),
        "undetermined": ", ".join(estimate.undetermined),
        "poor": not estimate.undetermined and estimate.condition > limit.condition,
        "rich": not estimate.undetermined and not estimate.condition > limit.condition,
        "coupling": f", coupling index {indices[0]:.0f} of at most {indices[1]:.0f}"
        if np.isfinite(indices[0]) else "",
        "overall_covered": overall and not error.overall > covered,
        "overall_grown": overall and error.overall > covered,
        "large_covered": large & ~grown, "large_grown": large & grown,
        "none": none, "little": little & ~none,
        "much": any_explained and not little.any(),
        "least": explained[worst], "least_explained": names[worst],
        "grown_far": grown & (relative > 0.5 * limit.axis),
        "grown_little": grown & ~(relative > 0.5 * limit.axis),
    }  # fmt: skip
    if (share := evidence.disagreement) is not None and not estimate.undetermined:
        # What a motion does not determine differs from repetition to repetition.
        facts |= {"disagreement": share, "disagree": share > limit.inconsistency}
    floor, causes = evidence.floor, evidence.causes
    if floor is not None and causes is not None and not causes.found:
        much = error.overall > max(limit.unexplained, limit.multiple * floor)
        left = "" if causes.best is None else f"; the best of them leaves {causes.best.ratio:.0%}"
        facts |= {"unexplained": much, "floor": floor, "left": left}
        facts["multiple"] = error.overall / max(floor, 1e-300)
    facts |= _systematic_facts(names, evidence, limit) | _around_facts(evidence, limit)
    facts |= _cause_facts(evidence, limit)
    return facts if checks is None else facts | _residual_facts(checks, facts, evidence)


def _systematic_facts(names: tuple[str, ...], evidence: Evidence, limit: Thresholds) -> Facts:
    """Slow errors, and friction that was another one on unseen motion."""
    nothing, known = np.zeros(len(names)), evidence.systematic
    share = nothing if known is None else np.nan_to_num(known)
    apart = evidence.systematic_apart
    beyond = (share if apart is None else np.nan_to_num(apart)) > limit.systematic
    small = (share > limit.noticeable) & (share <= limit.systematic)
    # A known weight tests torque constants where gravity loads the joint.
    weighed = small if evidence.loaded is None else small & evidence.loaded
    steps = [
        step.format(joined([names[j] for j in np.flatnonzero(axes)]))
        for axes, step in (
            (weighed, "check the torque constant of {} with a known payload (`hil gains`)"),
            (
                small & ~weighed,
                "compare the torque constant of {} with the drive's data sheet: gravity does not"
                " load it, so that no payload determines it",
            ),
        )
        if axes.any()
    ]
    facts: Facts = {
        "no_repetitions": known is None,
        "systematic": share,
        "systematic_large": (share > limit.systematic) & beyond,
        "systematic_small": small,
        "constants": "; ".join(steps),
    }
    if (change := evidence.friction_change) is not None:
        spoilt = (share > limit.systematic) & ~beyond
        changed = spoilt | ((np.abs(change) > limit.friction) & ~beyond)
        facts |= {"change": change, "warmer": changed & ~spoilt.any()}
        facts |= {"much_warmer": changed & spoilt.any()}
        facts["spoilt"] = joined([names[j] for j in np.flatnonzero(spoilt)])
    return facts


def _cause_facts(evidence: Evidence, limit: Thresholds) -> Facts:
    """Gravity, a load on one side only, and outliers: what else may explain errors."""
    facts: Facts = {"rival": np.inf, "without_outliers": False}
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
        facts |= {"carried": load.explained >= limit.load and most, "more": more, "load": load}
    if (checks := evidence.residuals) is not None:
        # Few samples make most of the error, and are what takes it beyond its limit.
        found, error_of = checks.outliers, evidence.held_out
        spiked = (found.power > limit.outlying_power) & (found.share < limit.outliers)
        spiked &= found.share > 0.0
        axis = (error_of.relative > limit.axis) & (found.without.relative <= limit.axis)
        all_axes = error_of.overall > limit.overall >= found.without.overall
        spoilt = bool(spiked.any()) and (all_axes or bool(np.any(axis & spiked)))
        facts |= {"outliers": found, "outlying": found.share, "without_outliers": spoilt}
        facts |= {"spikes_spoil": spiked & spoilt, "spikes": spiked & (not spoilt)}
    return facts


def _around_facts(evidence: Evidence, limit: Thresholds) -> Facts:
    """What the surroundings of the model say: other models, nominal sizes, delay, limits."""
    around, ours, facts = evidence.surroundings, evidence.held_out.overall, Facts()
    for name, theirs in (("nominal", evidence.nominal), ("controller", around.controller)):
        if theirs is not None:
            better = ours > theirs.overall + limit.nominal
            facts |= {name: theirs, f"{name}_better": better, f"{name}_worse": not better}
    if jumps := sorted(around.jumps, key=lambda jump: -abs(jump.size)):
        where = [f"{j.joint} by {j.size:+.3g} after {j.time:.3f} s of {j.recording}" for j in jumps]
        facts |= {"jumped": joined(where, _JUMPS_SHOWN)}
        facts["jumping"] = joined(list(dict.fromkeys(jump.joint for jump in jumps)))
    if (scale := around.nominal_scale) is not None:
        if evidence.causes is not None:
            # Torques in another joint's column, or with the wrong sign, are not of nominal size.
            scale = scale.without(j for one in evidence.causes.found for j in one.fault.joints)
        common, known = scale.common, np.isfinite(scale.scale)
        off = known if common != 1.0 else scale.off
        impossible = abs(np.log(common)) > np.log(_IMPOSSIBLE_SCALE)
        unit = "the unit of the torque (N·m, N·mm?), its side (motor or joint?)"
        constant = "torque constant and gear ratio, and the payload"
        facts |= {"scale": scale.scale, "tolerance": scale.tolerance}
        facts |= {"negated": known & scale.negated}
        facts["impossible_scale"] = off & impossible & (not scale.negated)
        facts["other_scale"] = off & (not impossible) & (not scale.negated)
        facts["to_check"] = unit if common != 1.0 else constant
    if (inertia := around.controller_inertia) is not None:
        far = np.abs(np.log(inertia.ratio)) > np.log(_INERTIA_OFF)
        known = np.isfinite(inertia.ratio)
        facts |= {"inertia": inertia.ratio, "inertia_off": far, "inertia_same": known & ~far.any()}
    if (share := around.saturated) is not None:
        full = share > limit.saturated
        facts |= {"saturated": share, "full": full, "unsaturated": not full.any()}
    if (delays := around.delays) is not None:
        assumed = np.broadcast_to(around.assumed_delay, delays.applied.shape)
        same = delays.significant and delays.agree and np.array_equal(assumed, delays.applied)
        # Of a poor motion a delay is another combination of parameters.
        poor = bool(evidence.estimate.undetermined) or evidence.estimate.condition > limit.condition
        beyond = np.maximum(limit.delay * delays.cycle, SIGMAS * delays.std)
        late = delays.determined & (np.abs(delays.delays - assumed) > beyond)
        on_time = delays.determined & ~late.any() & (not same) & (not poor)
        facts |= {
            "compensated": same, "common": 1e3 * delays.common, "stated": 1e3 * delays.assumed,
            "common_half": 1e3 * delays.half_interval, "assumed": 1e3 * assumed,
            "delay": 1e3 * delays.delays, "half": 1e3 * delays.interval_factor * delays.std,
            "late": late & (not same) & (not poor),
            "on_time": on_time & (not delays.agree),
            "all_on_time": bool(on_time.any()) and delays.agree,
        }  # fmt: skip
    return facts


def _residual_facts(checks: ResidualChecks, facts: Facts, evidence: Evidence) -> Facts:
    """Patterns of the residual that are beyond chance, and large enough."""
    limit: Thresholds = facts["limit"]

    def stand_out(pattern: Profile | Ripple) -> NDArray[np.bool_]:
        large = checks.share(pattern.rms) > limit.pattern
        return pattern.significant & large & (pattern.rms > limit.pattern_of_residual * checks.rms)

    parameters, worth = len(evidence.estimate.names), np.nansum(checks.colour.effective_rows)
    short = bool(worth < limit.rows_per_parameter * parameters)
    found: Facts = {"short": short, "long": not short, "parameters": parameters, "worth": worth}
    found |= {"memory": 1e3 * np.nanmedian(checks.colour.time), "rows": checks.colour.rows.sum()}
    for name, profile in (("speed", checks.speed), ("position", checks.position)):
        share, joints, worst = checks.share(profile.rms), stand_out(profile), []
        for j in range(len(share)):
            (at, error), turns = profile.worst(j), evidence.revolute(j)
            angle = ("rad" if turns else "m") + ("/s" if name == "speed" else "")
            unit = "N·m" if turns else "N"
            worst.append(
                f"({error:+.3g} {unit} about {at:.2g} {angle}, {share[j]:.1%} of its torque)"
            )
        found |= {f"over_{name}": joints, f"not_over_{name}": not joints.any()}
        found[f"worst_{name}"] = np.array(worst, dtype=np.object_)
    if (ripple := checks.ripple) is not None:
        share, joints = checks.share(ripple.rms), stand_out(ripple)
        matters = joints & (share > limit.ripple)
        found |= {"ripple": share, "no_ripple": not joints.any(), "large_ripple": matters}
        found |= {"usual_ripple": joints & ~matters.any()}
        found["harmonic"] = np.array([ripple.strongest(j) for j in range(len(share))])
    if (drift := checks.drift) is not None:
        # Friction that hardly makes torque may change as it likes.
        size, joints = np.abs(drift.change) * checks.friction_share, drift.significant
        matters = joints & (size > limit.drift)
        found |= {"drift": drift.change, "no_drift": not joints.any(), "large_drift": matters}
        found |= {"little_drift": joints & ~matters.any()}
        found["drifted"] = size[joints].max(initial=0.0)
    return found


class _Row(NamedTuple):
    """A finding for each level whose condition holds.

    In words and step {name} is a fact, {joints} the joints of the condition, and <...> these joints
    with what stands inside, of each joint.
    """

    check: str  # what was looked at
    levels: Mapping[Level, str]  # name of a condition by level
    words: str  # template
    step: str = ""  # template
    role: Role = "condition"  # of the finding

    def findings(self, facts: Facts, names: Sequence[str]) -> Iterator[Finding]:
        """Findings of the conditions that are known and hold."""
        for level, condition in self.levels.items():
            holds = facts.get(condition, False)
            joints = np.flatnonzero(holds).tolist() if isinstance(holds, np.ndarray) else []
            if joints or (not isinstance(holds, np.ndarray) and holds):
                said = [_filled(one, facts, names, joints) for one in (self.words, self.step)]
                yield Finding(self.check, level, said[0], said[1], self.role)


def _filled(template: str, facts: Facts, names: Sequence[str], joints: Sequence[int]) -> str:
    """A template with facts, and with what it says of each joint."""
    own = facts | {"joints": joined([names[j] for j in joints])}
    parts = re.split("<(.*?)>", template)
    for k, part in enumerate(parts):
        if k % 2:
            each = (
                {key: one[j] if isinstance(one, np.ndarray) else one for key, one in own.items()}
                for j in joints
            )
            said = zip(joints, each, strict=True)
            parts[k] = joined([f"{names[j]} {part.format(**values)}" for j, values in said])
        else:
            parts[k] = part.format(**own)
    return "".join(parts)


class _CauseRow(NamedTuple):
    """What is said of one kind of cause, and how its size is shown: offset + scale * size."""

    check: str
    words: str
    step: str
    scale: float = 1.0
    offset: float = 0.0


# fmt: off
def _order(of: str) -> _CauseRow:
    return _CauseRow(
        "order of joints", f"the {of} of {{joints}} seem to be interchanged",
        "check the order of the columns in the column map against the joints of the URDF")


def _changed(of: str) -> _CauseRow:
    return _CauseRow(
        "sameness",
        f"in {{part}} the {of} of {{joints}} seems to be {{size}} times that in the rest of the"
        " fitted recordings",
        "look at what changed in between: temperature, brakes, drive settings of {joints}",
        offset=1.0)


_CAUSES: Final[dict[Kind, _CauseRow]] = {
    "delay": _CauseRow(
        "delay", "the torque of {joints} lags the position by {size} ms {more} than assumed",
        "run `hil identify --delay auto`, and correct the delay where it arises", scale=1e3),
    "gain": _CauseRow(
        "torque constant",
        "the torque of {joints} is {size} times what fits the torques of the other axes",
        "check torque constant and gear ratio of {joints}; recordings with and without a known"
        " payload determine the constant (`hil gains --loaded`)", offset=1.0),
    "torque sign": _CauseRow(
        "direction of axes", "the torque of {joints} seems to have the other sign",
        "check the sign of the torque of {joints} in the column map, or of its torque constant"),
    "axis sign": _CauseRow(
        "direction of axes",
        "{joints} seems to turn in the direction opposite to the URDF's: the sign of its gear ratio"
        " or direction may be wrong",
        "jog {joints} by hand and compare its direction of rotation with the URDF's"),
    "torque order": _order("torques"),
    "position order": _order("positions"),
    "joint order": _order("positions and torques"),
    "payload": _CauseRow(
        "sameness",
        "in {part} the arm seems to have carried {size} kg {more} than in the rest of the fitted"
        " recordings",
        "identify the recordings of each payload separately, and state a payload that is known in"
        " their cell file ([robot.payload])"),
    "changed gain": _changed("torque"),
    "changed friction": _changed("friction"),
    "changed arm": _CauseRow(
        "sameness",
        "{part} seems to be of another arm, tool or setting than the rest of the fitted recordings",
        "identify from recordings of one arm in one condition"),
}
# fmt: on


def _causes(facts: Facts, names: Sequence[str]) -> Iterator[Finding]:
    """Faults whose correction makes parts of the fitted recordings better predictable."""
    causes = facts["evidence"].causes
    for cause in () if causes is None or facts["without_outliers"] else causes.found:
        if cause.ratio > facts["rival"]:
            continue
        check, words, step, scale, offset = _CAUSES[cause.fault.kind]
        joints, size = [names[j] for j in cause.fault.joints] or ["all axes"], cause.size or 0.0
        own = {
            "joints": " and ".join(joints),
            "part": "" if cause.fault.part is None else cause.fault.part.words,
            "size": f"{abs(offset + scale * size):.3g} ± {scale * 2.0 * cause.std:.2g}",
            "more": "more" if size > 0.0 else "less",
        }
        sure = cause.fault.discrete or cause.ratio < facts["limit"].cause
        words = (
            f"{words.format(**own)}; with that corrected, parts of the fitted motion are predicted"
            f" from the rest with {cause.ratio:.2f} times the error"
        )
        yield Finding(check, "wrong" if sure else "doubtful", words, step.format(**own), "cause")


def _physical_signs(facts: Facts, _: Sequence[str]) -> Iterator[Finding]:
    """Signs that nature does not make."""
    impossible, doubtful = facts["evidence"].implausible
    step = "check the sign of the torque and the direction of each axis in the column map or cell"
    for words in impossible:
        yield Finding("physical signs", "wrong", words, step, "symptom")
    step = "where a model must be physical (simulation, URDF), take the consistent estimate"
    for words in doubtful:
        yield Finding("physical signs", "doubtful", words, step)


def _mended(facts: Facts, _: Sequence[str]) -> Iterator[Finding]:
    """What was wrong with the recordings and is made good in what was fitted."""
    yield from facts["evidence"].surroundings.mended


# In the order in which reasons are given: the first one is in the verdict's line.
# fmt: off
_ROWS: Final[tuple[_Row | Callable[[Facts, Sequence[str]], Iterator[Finding]], ...]] = (
    _Row("tested", {"wrong": "everything"},
         "everything was fitted and nothing held out: all errors are in-sample, and no unseen"
         " motion shows whether the model predicts",
         "run `hil identify --predict ARCHIVE` with a recording that is not fitted, without"
         " `hil identify --in-sample`"),
    _Row("tested", {"wrong": "still"},
         "{joints} moved in fewer than {limit.rows} samples of {on}, which tests nothing",
         "record an unseen motion in which {joints} moves; if it is meant to stand still, lock it"
         " (locked under [robot] in the cell file, or `hil import log --held JOINT`)"),
    _Row("tested", {"wrong": "silent"},
         "the torque of {joints} is zero throughout {on}: there is nothing to compare with",
         "record the torque of {joints}, to more digits if it was rounded away"),
    _Row("position jumps", {"wrong": "jumped"},
         "the measured position jumped where no arm can follow (rad or m): {jumped}",
         "look at encoder, coupling and cable of {jumping}, and record again; or leave out what was"
         " recorded after the jump", "cause"),
    _Row("excitation", {"wrong": "undetermined"},
         "the motion does not determine {undetermined}", _RICHER),
    _Row("excitation", {"doubtful": "poor"},
         "the motion excites the parameters poorly (condition number {condition:.0f} of the"
         " regressor with columns of unit length{coupling}; good motions stay below"
         " {limit.condition:.0f}): trust the predictions on motions like this one rather than"
         " single parameters", _RICHER),
    _Row("excitation", {"good": "rich"},
         "the motion determines every parameter (condition number {condition:.0f} of the regressor"
         " with columns of unit length{coupling})"),
    _Row("outliers", {"wrong": "spikes_spoil", "doubtful": "spikes"},
         "single samples far outside of all others cause most of the error on {on}"
         " (<{outlying:.2%}> of the samples); without them it is {outliers.without.overall:.1%}"
         " over all axes",
         "look at the torques in the log: spikes, damaged packets, collisions; correct or leave"
         " them out, and fit with an estimator that bounds their influence (`hil identify"
         " --estimator tukey`, or huber)", "cause"),
    _Row("gravity", {"wrong": "gravity_off"},
         "gravity seems to pull along ({best}) m/s² in the axes of the base, {gravity_angle:.0f}°"
         " from ({declared}) m/s² as declared: with it {on} is predicted with {gravity_error:.2f}"
         " times the error",
         "check how the arm is mounted, and set gravity of [robot] in the cell file to that; if it"
         " is right, check the zero positions of the joints", "cause"),
    _causes,
    _Row("direction of axes", {"wrong": "negated"},
         "all torques seem to have the other sign: over that of the nominal inertias they are"
         " <{scale:.2g}>",
         "give the torques of the column map scale = -1, or all torque constants the other sign",
         "cause"),
    _Row("scale of the torque", {"wrong": "impossible_scale", "doubtful": "other_scale"},
         "the torque is not as large as the nominal inertias ask for, by a factor:"
         " <{scale:.3g} ± {tolerance:.2g}>",
         "check {to_check} of {joints}, and the masses of the URDF", "cause"),
    _Row("load", {"wrong": "carried"},
         "on {on} the arm seems to have carried {more} than on what was fitted: a body on its last"
         " link explains {load.explained:.0%} of the error beyond that of the fit",
         "record both with the same tool and payload, or identify and predict with the payload that"
         " was carried", "cause"),
    _Row("friction", {"wrong": "much_warmer"},
         "friction on {on} was another one than when it was estimated: <{change:+.0%}>, more than"
         f" the {FRICTION_CHANGE:.0%} expected of warmer gears; that explains the error of"
         " {spoilt}; was the arm as warm?", _WARMER, "cause"),
    _Row("friction", {"doubtful": "warmer"},
         "friction on {on} was another one than when it was estimated: <{change:+.0%}>; was the arm"
         " as warm?", _WARMER, "cause"),
    _physical_signs,
    _Row("error on unseen motion", {"wrong": "overall_covered"},
         "the torque error on {on} is {error.overall:.1%} over all axes, more than"
         " {limit.overall:.0%}",
         "check gear ratios, signs, torque constants and the delay between torque and position",
         "symptom"),
    _Row("error on unseen motion", {"wrong": "overall_grown"},
         "the torque error on {on} is {error.overall:.1%} over all axes, more than"
         " {limit.overall:.0%}", _NOT_COVERED, "symptom"),
    _Row("error on unseen motion", {"wrong": "large_covered"},
         "the torque error on {on} is more than {limit.axis:.0%}: <{relative:.0%}>",
         "check sign, gear ratio and torque constant of {joints}, and whether the torque there is"
         " more than noise", "symptom"),
    _Row("error on unseen motion", {"wrong": "large_grown"},
         "the torque error on {on} is more than {limit.axis:.0%}: <{relative:.0%}>", _NOT_COVERED,
         "symptom"),
    _Row("unexplained error", {"wrong": "unexplained"},
         "the torque error on {on} is {error.overall:.1%}, {multiple:.1f} times the noise floor of"
         " {floor:.1%}, and none of the faults that were tried explains it (delay, torque"
         " constants, signs and order of joints, payload, changes between parts of what was"
         " fitted{left})",
         "look at what the model leaves out: the friction curves of the report, elasticity, springs"
         " or balancers ([[robot.elements]] of the cell file), temperature", "symptom"),
    _Row("variance explained (R²)", {"wrong": "none"},
         "on {joints} the model is no better than a constant, the mean of its torque", _FASTER,
         "symptom"),
    _Row("variance explained (R²)", {"doubtful": "little"},
         "the model explains little of what varies in the torque: <{explained:.0%}>", _FASTER,
         "symptom"),
    _Row("variance explained (R²)", {"good": "much"},
         "the model explains {least:.1%} or more of what varies in the torque of each axis"
         " (least: {least_explained})"),
    _Row("generalisation", {"wrong": "grown_far", "doubtful": "grown_little"},
         "the torque error grows from the training motion to {on}:"
         " <{times:.1f} times to {relative:.1%}>", _NOT_COVERED, "symptom"),
    _Row("systematic error", {"doubtful": "no_repetitions"},
         "without repetitions of one motion an error of the drive train (a coupling or torque"
         " constant) cannot be distinguished from noise, and was not looked for",
         "record the same motion several times"),
    _Row("systematic error", {"wrong": "systematic_large"},
         "noise does not explain a torque error on {on} of <{systematic:.1%}> (limit"
         " {limit.systematic:.1%}): the model lacks something, or what is known of the arm is"
         " wrong", "check sign, gear ratio, coupling and torque constant of {joints}", "symptom"),
    _Row("systematic error", {"doubtful": "systematic_small"},
         "noise does not explain a torque error on {on} of <{systematic:.1%}>: the model lacks"
         " something small, or a constant is off", "{constants}", "symptom"),
    _Row("repetitions", {"wrong": "disagree"},
         "repetitions disagree: their estimates differ by up to <{disagreement:.0%}> of the torque,"
         " more than {limit.inconsistency:.0%}",
         "look at the repetitions one by one: something changed between them"),
    _Row("against the nominal model", {"wrong": "nominal_better"},
         "the nominal model predicts better: {nominal.overall:.1%} against {error.overall:.1%}",
         "use the nominal model, or fit a longer and richer motion", "symptom"),
    _Row("against the nominal model", {"good": "nominal_worse"},
         "the nominal model misses by {nominal.overall:.1%} where this one misses by"
         " {error.overall:.1%}"),
    _Row("against the controller's model", {"doubtful": "controller_better"},
         "the controller's own dynamic model predicts better: {controller.overall:.1%} against"
         " {error.overall:.1%}",
         "fit a longer and richer motion before replacing what the controller has", "symptom"),
    _Row("against the controller's model", {"good": "controller_worse"},
         "the controller's own dynamic model misses by {controller.overall:.1%} where this one"
         " misses by {error.overall:.1%}"),
    _Row("against the controller's inertia", {"doubtful": "inertia_off"},
         "the controller's own inertia (joint side, rotors included) is not the identified one, but"
         " times <{inertia:.2f}>",
         "check torque constant and gear ratio of {joints}, and what the arm carries"),
    _Row("against the controller's inertia", {"good": "inertia_same"},
         "the controller's own inertia of each joint is about the identified one, times"
         " <{inertia:.2f}>"),
    _Row("delay", {"doubtful": "compensated"},
         "the torque lags the position by {common:.3g} ± {common_half:.2g} ms ({stated:.3g} ms were"
         " stated); that was compensated",
         "state it (`hil identify --delay SECONDS`), or correct it where it arises"),
    _Row("delay", {"doubtful": "late"},
         "the torque seems to lag the position by another time than was assumed:"
         " <{delay:.3g} ± {half:.2g} ms ({assumed:.3g} ms assumed)>",
         "compare with `hil identify --delay auto`, or correct the delay in the cell", "cause"),
    _Row("delay", {"good": "all_on_time"},
         "no delay stands out but the assumed one; the torque lags the position by {common:.3g} ±"
         " {common_half:.2g} ms ({stated:.3g} ms assumed)"),
    _Row("delay", {"good": "on_time"},
         "no delay stands out but the assumed one; the torque lags the position by:"
         " <{delay:.3g} ± {half:.2g} ms ({assumed:.3g} ms assumed)>"),
    _mended,
    _Row("saturation", {"good": "unsaturated"}, "no torque or current was at its limit"),
    _Row("saturation", {"doubtful": "full"},
         "torque or current was at its limit: <in {saturated:.1%} of its samples>; what is logged"
         " there may be less than what was needed",
         "slow the motion down where {joints} is at its limit", "cause"),
    _Row("whiteness", {"doubtful": "short"},
         "the recordings are short: the residual is correlated over {memory:.3g} ms (median axis),"
         " so that {rows} rows are worth about {worth:.0f} independent ones, for {parameters}"
         " parameters", "record a longer motion, or the same one several times"),
    _Row("whiteness", {"good": "long"},
         "the residual is correlated over {memory:.3g} ms (median axis), so that {rows} rows are"
         " worth about {worth:.0f} independent ones, for {parameters} parameters; the standard"
         " deviations allow for that"),
    _Row("residual over speed", {"doubtful": "over_speed"},
         "what is left over depends on speed: <{worst_speed}>: friction may not be of the form that"
         " was fitted",
         "try further friction terms for {joints} (Stribeck, asymmetric, third)", "symptom"),
    _Row("residual over speed", {"good": "not_over_speed"},
         "what is left over hardly depends on the joints' speed"),
    _Row("residual over position", {"doubtful": "over_position"},
         "what is left over depends on position: <{worst_position}>",
         "check the URDF's geometry and gravity direction, and look for a hose, spring or payload"
         " that the model does not have", "symptom"),
    _Row("residual over position", {"good": "not_over_position"},
         "what is left over hardly depends on the posture"),
    _Row("torque ripple", {"good": "no_ripple"}, "no torque ripple stands out"),
    _Row("torque ripple", {"information": "usual_ripple"},
         "a torque ripple comes and goes with the motors' turning, which is usual:"
         " <({harmonic} per motor turn, {ripple:.1%} of its torque)>"),
    _Row("torque ripple", {"doubtful": "large_ripple"},
         "a torque ripple comes and goes with the motors' turning:"
         " <({harmonic} per motor turn, {ripple:.1%} of its torque)>",
         "let it average out over a long motion, or compensate it apart: the model does not have"
         " it"),
    _Row("friction over time", {"good": "no_drift"},
         "no change of friction stands out while the recordings were made"),
    _Row("friction over time", {"information": "little_drift"},
         "friction changed while the recordings were made: <by {drift:+.1%}>; that is at most"
         " {drifted:.1%} of an axis's torque"),
    _Row("friction over time", {"doubtful": "large_drift"},
         "friction changed while the recordings were made: <by {drift:+.1%}>", _WARMER, "cause"),
)
# fmt: on
