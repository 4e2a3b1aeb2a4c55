"""Every check of a verdict: what was found, in words, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.validation.causes import Cause, Kind
from identification.validation.evidence import SIGMAS, Evidence, GravityDirection
from identification.validation.finding import Finding, Level, Thresholds, joined
from identification.validation.prediction import FRICTION_CHANGE
from identification.validation.residuals import Profile, Ripple

Array = NDArray[np.float64]
Findings = Iterator[Finding]

# What was fitted well and is predicted badly has no wrong sign, which would spoil both.
_NOT_COVERED: Final = (
    "fit a longer or richer motion: what was fitted does not cover what was predicted"
)
_RICHER: Final = "design a motion for this arm (`hil design`) and record that"
_WARMER: Final = "warm the arm up by moving it before recording"
# A maker's figures are good to ten per cent; twice that is worth a word.
_INERTIA_OFF: Final = 0.2
# No arm's links are wrong by that much in a description in use: it is a unit, or torques of the
# motors mistaken for those of the joints (gears turn 30 to 200 times).
_IMPOSSIBLE_SCALE: Final = 10.0
_JUMPS_SHOWN: Final = 3


def _where(mask: NDArray[np.bool_]) -> list[int]:
    return [int(place) for place in np.flatnonzero(mask)]


@dataclass(frozen=True)
class Case:
    """What is judged.

    Attributes:
        names: of the n axes.
        evidence: see :func:`identification.validation.evidence.gather`.
        limit: what a good result keeps to.
    """

    names: Sequence[str]
    evidence: Evidence
    limit: Thresholds

    def some(self, joints: Iterable[int]) -> str:
        """Names of joints, the first few of many."""
        return joined([self.names[j] for j in joints])

    def all(self, joints: Iterable[int]) -> str:
        """Names of all of these joints."""
        return ", ".join(self.names[j] for j in joints)

    @property
    def gravity(self) -> GravityDirection | None:
        """The direction that fits best, where the declared one is wrong."""
        found = self.evidence.gravity
        off = found is not None and found.off(self.limit.gravity, self.limit.gravity_angle)
        return found if off else None

    @property
    def spiked(self) -> NDArray[np.bool_]:
        """Joints (n,) of which few samples make most of the error."""
        checks, limit = self.evidence.residuals, self.limit
        if checks is None:
            return np.zeros(len(self.names), dtype=np.bool_)
        power, share = checks.outliers.power, checks.outliers.share
        few = (share < limit.outliers) & (share > 0.0)
        return np.asarray((power > limit.outlying_power) & few)

    @property
    def spoilt_by_outliers(self) -> bool:
        """Whether the error on unseen motion is beyond its limit with a few samples only."""
        checks, error, limit = self.evidence.residuals, self.evidence.held_out, self.limit
        if checks is None or not self.spiked.any():
            return False
        without = checks.outliers.without
        axis = (error.relative > limit.axis) & (without.relative <= limit.axis)
        overall = error.overall > limit.overall >= without.overall
        return overall or bool(np.any(axis & self.spiked))

    def stand_out(self, pattern: Profile | Ripple) -> list[int]:
        """Joints with a pattern of the residual that is beyond chance, and large enough."""
        checks, limit = self.evidence.residuals, self.limit
        assert checks is not None
        large = checks.share(pattern.rms) > limit.pattern
        large &= pattern.rms > limit.pattern_of_residual * checks.rms
        return _where(pattern.significant & large)

    def worst_bins(self, joints: Iterable[int], profile: Profile, per: str) -> str:
        """Where each joint's pattern is largest, in units."""
        checks = self.evidence.residuals
        assert checks is not None
        share, found = checks.share(profile.rms), []
        for j in joints:
            at, size = profile.worst(j)
            torque, angle = ("N·m", "rad") if self.evidence.revolute(j) else ("N", "m")
            found.append(
                f"{self.names[j]} ({size:+.3g} {torque} about {at:.2g} {angle}{per},"
                f" {share[j]:.1%} of its torque)"
            )
        return ", ".join(found)


def untested(case: Case) -> Findings:
    """What was not predicted has no error, which must not pass for a small one."""
    evidence, error = case.evidence, case.evidence.held_out
    if evidence.in_sample:
        yield Finding(
            "tested",
            "wrong",
            "everything was fitted and nothing held out: all errors are in-sample, and no unseen"
            " motion tells whether the model predicts",
            "run `hil identify --predict ARCHIVE` with a recording that is not fitted, without"
            " `hil identify --in-sample`",
        )
    if still := case.some(_where(error.rows < case.limit.rows)):
        yield Finding(
            "tested",
            "wrong",
            f"{still} moved in fewer than {case.limit.rows} samples of {evidence.tested_on}, which"
            " tests nothing",
            f"record an unseen motion in which {still} moves; if it is meant to stand still, lock"
            " it (locked under [robot] in the cell file, or `hil import log --held JOINT`)",
        )
    if silent := case.some(_where((error.rows > 0) & (error.torque_squared == 0.0))):
        yield Finding(
            "tested",
            "wrong",
            f"the torque of {silent} is zero throughout {evidence.tested_on}: there is nothing to"
            " compare with",
            f"record the torque of {silent}, to more digits if it was rounded away",
        )


def jumps(case: Case) -> Findings:
    """Positions that stepped where no arm can follow."""
    found = case.evidence.surroundings.jumps
    if not found:
        return
    where = [
        f"{jump.joint} by {jump.size:+.3g} after {jump.time:.3f} s of {jump.recording}"
        for jump in sorted(found, key=lambda jump: -abs(jump.size))
    ]
    names = joined([*dict.fromkeys(jump.joint for jump in found)])
    yield Finding(
        "position jumps",
        "wrong",
        "the measured position jumped where no arm can follow (rad or m): "
        + joined(where, _JUMPS_SHOWN),
        f"look at encoder, coupling and cable of {names}, and record again; or leave out what was"
        " recorded after the jump",
        "cause",
    )


def determined(case: Case) -> Findings:
    """Parameters the motion says nothing about, alone or in combination."""
    estimate, coupling, most = case.evidence.estimate, case.evidence.coupling, case.limit.condition
    if estimate.undetermined:
        words = f"the motion does not determine {', '.join(estimate.undetermined)}"
        yield Finding("excitation", "wrong", words, _RICHER)
        return
    text = f"condition number {estimate.condition:.0f} of the regressor with columns of unit length"
    if coupling is not None and np.isfinite(coupling.index):
        text += f", coupling index {coupling.index:.0f} of at most {coupling.largest:.0f}"
    if estimate.condition > most:
        yield Finding(
            "excitation",
            "doubtful",
            f"the motion excites the parameters poorly ({text}; good motions stay below {most:.0f}"
            "): trust the predictions on motions like this one rather than single parameters",
            _RICHER,
        )
    else:
        yield Finding("excitation", "good", f"the motion determines every parameter ({text})")


def outliers(case: Case) -> Findings:
    """Single samples that make most of the error."""
    checks, joints = case.evidence.residuals, _where(case.spiked)
    if checks is None or not joints:
        return
    share = checks.outliers.share
    most = max(joints, key=lambda j: float(share[j]))
    yield Finding(
        "outliers",
        "wrong" if case.spoilt_by_outliers else "doubtful",
        f"single samples far outside of all others cause most of the error of {case.some(joints)}"
        f" on {case.evidence.tested_on} (at most {share[most]:.2%} of the samples,"
        f" {case.names[most]}); without them it is {checks.outliers.without.overall:.1%} over all"
        " axes",
        "look at the torques in the log: spikes, damaged packets, collisions; correct or leave them"
        " out, and fit with an estimator that bounds their influence (`hil identify --estimator"
        " tukey`, or huber)",
        "cause",
    )


def gravity(case: Case) -> Findings:
    """Gravity in another direction than the cell says."""
    if (found := case.gravity) is None:
        return
    declared, best = (
        ", ".join(f"{value + 0.0:.2f}" for value in np.round(one, 2))
        for one in (found.declared, found.best)
    )
    yield Finding(
        "gravity",
        "wrong",
        f"gravity seems to pull along ({best}) m/s² in the axes of the base,"
        f" {np.degrees(found.angle):.0f}° from ({declared}) m/s² as declared: with it"
        f" {case.evidence.tested_on} is predicted with {np.sqrt(found.ratio):.2f} times the error",
        "check how the arm is mounted, and set gravity of [robot] in the cell file to that; if it"
        " is right, check the zero positions of the joints",
        "cause",
    )


class _Template(NamedTuple):
    """What is said of one kind of cause: templates that :func:`_figures` fill.

    Attributes:
        check: what was looked at.
        statement: what seems to be wrong.
        step: what to do about it.
        scale: from a cause's size to the figure that is shown.
        offset: added to that.
    """

    check: str
    statement: str
    step: str
    scale: float = 1.0
    offset: float = 0.0


def _order(of: str) -> _Template:
    return _Template(
        "order of joints",
        f"the {of} of {{first}} and {{last}} seem to be interchanged",
        "check the order of the columns in the column map against the joints of the URDF",
    )


def _change(of: str) -> _Template:
    return _Template(
        "sameness",
        f"in {{part}} the {of} of {{joints}} seems to be {{size}} times that in the rest of the"
        " fitted recordings",
        "look at what changed in between: temperature, brakes, drive settings of {joints}",
        offset=1.0,
    )


_TEMPLATES: Final[dict[Kind, _Template]] = {
    "delay": _Template(
        "delay",
        "the torque of {joints} lags the position by {size} ms {more} than assumed",
        "run `hil identify --delay auto`, and correct the delay where it arises",
        scale=1e3,
    ),
    "gain": _Template(
        "torque constant",
        "the torque of {joints} is {size} times what fits the torques of the other axes",
        "check torque constant and gear ratio of {joints}; recordings with and without a known"
        " payload determine the constant (`hil gains --loaded`)",
        offset=1.0,
    ),
    "torque sign": _Template(
        "direction of axes",
        "the torque of {joints} seems to have the other sign",
        "check the sign of the torque of {joints} in the column map, or of its torque constant",
    ),
    "axis sign": _Template(
        "direction of axes",
        "{joints} seems to turn in the direction opposite to the URDF's: the sign of its gear ratio"
        " or direction may be wrong",
        "jog {joints} by hand and compare its direction of rotation with the URDF's",
    ),
    "torque order": _order("torques"),
    "position order": _order("positions"),
    "joint order": _order("positions and torques"),
    "payload": _Template(
        "sameness",
        "in {part} the arm seems to have carried {size} kg {more} than in the rest of the fitted"
        " recordings",
        "identify the recordings of each payload separately, and state a payload that is known in"
        " their cell file ([robot.payload])",
    ),
    "changed gain": _change("torque"),
    "changed friction": _change("friction"),
    "changed arm": _Template(
        "sameness",
        "{part} seems to be of another arm, tool or setting than the rest of the fitted recordings",
        "identify from recordings of one arm in one condition",
    ),
}


def causes(case: Case) -> Findings:
    """Faults whose correction makes parts of the fitted recordings better predictable."""
    found, best = case.evidence.causes, case.gravity
    if found is None:
        return
    explained = np.inf if best is None else float(np.sqrt(best.ratio))
    for cause in () if case.spoilt_by_outliers else found.found:
        if cause.ratio > explained:
            continue
        template = _TEMPLATES[cause.fault.kind]
        figures = _figures(case, cause, template)
        yield Finding(
            template.check,
            "wrong" if cause.fault.discrete or cause.ratio < case.limit.cause else "doubtful",
            f"{template.statement.format(**figures)}; with that corrected, parts of the fitted"
            f" motion are predicted from the rest with {cause.ratio:.2f} times the error",
            template.step.format(**figures),
            "cause",
        )
    if found.undecided and not case.evidence.in_sample and not found.found:
        yield Finding(
            "direction of axes",
            "information",
            f"the data do not determine the direction of {case.all(found.undecided)}: the opposite"
            " direction fits about as well",
        )


def _figures(case: Case, cause: Cause, template: _Template) -> dict[str, str]:
    """What the fields of a template stand for."""
    joints = [case.names[j] for j in cause.fault.joints] or ["all axes"]
    size, scale = cause.size or 0.0, template.scale
    return {
        "joints": ", ".join(joints),
        "first": joints[0],
        "last": joints[-1],
        "part": "" if cause.fault.part is None else cause.fault.part.words,
        "size": f"{abs(template.offset + scale * size):.3g} ± {scale * 2.0 * cause.std:.2g}",
        "more": "more" if size > 0.0 else "less",
    }


def scale(case: Case) -> Findings:
    """Torques that are not as large as the nominal inertias ask for."""
    found = case.evidence.surroundings.nominal_scale
    if found is None:
        return
    if case.evidence.causes is not None:
        # Torques in another joint's column, or with the wrong sign, are not of the nominal size.
        found = found.without(j for one in case.evidence.causes.found for j in one.fault.joints)
    known, common = _where(np.isfinite(found.scale)), found.common
    if found.negated:
        figures = [f"{case.names[j]} {found.scale[j]:.2g}" for j in known]
        yield Finding(
            "direction of axes",
            "wrong",
            "all torques seem to have the other sign: over that of the nominal inertias they are"
            f" {joined(figures)}",
            "give the torques of the column map scale = -1, or all torque constants the other sign",
            "cause",
        )
    elif off := found.off.tolist() if common == 1.0 else known:
        figures = [f"{case.names[j]} {found.scale[j]:.3g} ± {found.tolerance[j]:.2g}" for j in off]
        step = f"check torque constant and gear ratio of {case.some(off)}, and the payload"
        if common != 1.0:
            step = "check the unit of the torque (N·m, N·mm?), its side (motor or joint?)"
        yield Finding(
            "scale of the torque",
            "wrong" if abs(np.log(common)) > np.log(_IMPOSSIBLE_SCALE) else "doubtful",
            "the torque is not as large as the nominal inertias ask for, by a factor: "
            + joined(figures),
            f"{step}, and the masses of the URDF",
            "cause",
        )


def load(case: Case) -> Findings:
    """A body that hung on the arm on one side only."""
    found = case.evidence.load
    if found is None or found.explained < case.limit.load or 2 * found.axes < len(case.names):
        return
    half = f" ± {found.half_interval:.2g}" if np.isfinite(found.half_interval) else ""
    more = f"{abs(found.mass):.3g}{half} kg {'more' if found.mass > 0.0 else 'less'}"
    most = "more than 99%" if found.explained > 0.99 else f"{found.explained:.0%}"
    yield Finding(
        "load",
        "wrong",
        f"on {case.evidence.tested_on} the arm seems to have carried {more} than on what was"
        f" fitted: a body on its last link explains {most} of the error beyond that of the fit",
        "record both with the same tool and payload, or identify and predict with the payload that"
        " was carried",
        "cause",
    )


def friction_change(case: Case) -> Findings:
    """Friction that was another one on unseen motion."""
    evidence, change = case.evidence, case.evidence.friction_change
    if change is None:
        return
    decisive = evidence.spoilt_by_friction(case.limit.systematic)
    worth = np.abs(change) > case.limit.friction
    worth &= ~evidence.beyond_friction(case.limit.systematic)
    alike: dict[str, list[int]] = {}  # joints that did the same together
    for j in _where(decisive | worth):
        what = f"{abs(change[j]):.0%} {'higher' if change[j] > 0.0 else 'lower'}"
        alike.setdefault(what, []).append(j)
    if not alike:
        return
    changes = ", of ".join(f"{case.all(those)} was {what}" for what, those in alike.items())
    words = f"friction of {changes} on {evidence.tested_on} than when it was estimated"
    if decisive.any():
        words += (
            f", more than the {FRICTION_CHANGE:.0%} expected of warmer gears; that explains the"
            f" error of {case.all(_where(decisive))}"
        )
    level: Level = "wrong" if decisive.any() else "doubtful"
    yield Finding("friction", level, f"{words}; was the arm as warm?", _WARMER, "cause")


def plausible(case: Case) -> Findings:
    """Signs that nature does not make."""
    for words in case.evidence.implausible.impossible:
        step = "check the sign of the torque and the direction of each axis in the column map or"
        yield Finding("physical signs", "wrong", words, f"{step} cell", "symptom")
    for words in case.evidence.implausible.doubtful:
        step = "where a model must be physical (simulation, URDF), take the consistent estimate"
        yield Finding("physical signs", "doubtful", words, step)


def size(case: Case) -> Findings:
    """The relative error, over all axes and on each."""
    evidence, error, limit = case.evidence, case.evidence.held_out, case.limit
    check, on = "error on unseen motion", evidence.tested_on
    if error.overall > limit.overall:
        grown = error.overall > limit.generalisation * evidence.training.overall
        words = f"the torque error on {on} is {error.overall:.1%} over all axes, more than"
        step = (
            "check gear ratios, signs, torque constants and the delay between torque and position"
        )
        words = f"{words} {limit.overall:.0%}"
        yield Finding(check, "wrong", words, _NOT_COVERED if grown else step, "symptom")
    large = error.relative > limit.axis
    covered = ~(error.relative > limit.generalisation * evidence.training.relative)
    blamed = case.some(_where(large & covered))
    step = f"check sign, gear ratio and torque constant of {blamed}, and whether the torque there"
    for j in _where(large):
        words = f"the torque error of {case.names[j]} on {on} is {error.relative[j]:.0%}, more than"
        todo = f"{step} is more than noise" if covered[j] else _NOT_COVERED
        yield Finding(check, "wrong", f"{words} {limit.axis:.0%}", todo, "symptom")


def unexplained(case: Case) -> Findings:
    """An error far above the noise of the recordings for which no cause was found."""
    evidence, limit = case.evidence, case.limit
    error, floor, causes = evidence.held_out.overall, evidence.floor, evidence.causes
    if floor is None or causes is None or causes.found:
        return
    if error > limit.unexplained and error > limit.multiple * floor:
        best = causes.best
        least = "" if best is None else f" (the best of them leaves {best.ratio:.0%} of it)"
        yield Finding(
            "unexplained error",
            "wrong",
            f"the torque error on {evidence.tested_on} is {error:.1%}, {error / floor:.1f} times"
            f" the noise floor of {floor:.1%}, and none of the faults that were tried explains it:"
            " delay, torque constants, signs and order of joints, payload, changes between parts"
            f" of what was fitted{least}",
            "look at what the model leaves out: the friction curves of the report, elasticity,"
            " springs or balancers ([[robot.elements]] of the cell file), temperature",
            "symptom",
        )


def explained(case: Case) -> Findings:
    """Whether the model beats the mean torque of each axis."""
    error, limit, check = case.evidence.held_out, case.limit, "variance explained (R²)"
    share = error.explained
    if np.all(np.isnan(share)):
        return
    grown = error.relative > limit.generalisation * case.evidence.training.relative
    little = _where(share < limit.little_explained)
    faster = f"move {case.some(little)} faster and further, so that its torque stands out of noise"
    for j, name in enumerate(case.names):
        if share[j] <= limit.explained:
            words = f"on {name} the model is no better than a constant, the mean of its torque"
            yield Finding(check, "wrong", words, _NOT_COVERED if grown[j] else faster, "symptom")
        elif share[j] < limit.little_explained:
            words = f"the model explains only {share[j]:.0%} of what varies in the torque of {name}"
            yield Finding(check, "doubtful", words, faster, "symptom")
    worst = int(np.nanargmin(share))
    if share[worst] >= limit.little_explained:
        least = "more than 99.9%" if share[worst] > 0.999 else f"{share[worst]:.1%} or more"
        words = f"the model explains {least} of what varies in the torque of each axis"
        yield Finding(check, "good", f"{words} (least: {case.names[worst]})")


def growth(case: Case) -> Findings:
    """An error that is much larger on unseen motion than where it was fitted."""
    unseen, seen = case.evidence.held_out.relative, case.evidence.training.relative
    times = unseen / np.maximum(seen, 1e-12)
    grown, large = times > case.limit.generalisation, unseen > 0.5 * case.limit.axis
    levels: tuple[tuple[Level, NDArray[np.bool_]], ...]
    levels = ("wrong", grown & large), ("doubtful", grown & ~large)
    for level, axes in levels:
        each = ", ".join(
            f"of {case.names[j]} {times[j]:.1f} times to {unseen[j]:.1%}" for j in _where(axes)
        )
        if each:
            words = f"the torque error grows from the training motion to {case.evidence.tested_on}"
            yield Finding("generalisation", level, f"{words}: {each}", _NOT_COVERED, "symptom")


def systematic(case: Case) -> Findings:
    """Slow errors that neither noise nor warmer gears explain."""
    check, on = "systematic error", case.evidence.tested_on
    most, share = case.limit.systematic, case.evidence.systematic
    if share is None:
        yield Finding(
            check,
            "doubtful",
            "without repetitions of one motion an error of the drive train (a coupling or torque"
            " constant) cannot be distinguished from noise, and was not looked for",
            "record the same motion several times",
        )
        return
    known, excused = np.nan_to_num(share), case.evidence.spoilt_by_friction(most)
    if wrong := _where((known > most) & ~excused):
        each = ", ".join(f"{share[j]:.1%} ({case.names[j]})" for j in wrong)
        yield Finding(
            check,
            "wrong",
            f"noise does not explain a torque error of {each} on {on} (limit {most:.1%}): the model"
            " lacks something, or what is known of the arm is wrong",
            f"check sign, gear ratio, coupling and torque constant of {case.all(wrong)}",
            "symptom",
        )
    if small := _where((known > case.limit.noticeable) & (known <= most)):
        each = ", ".join(f"{share[j]:.1%} of the torque of {case.names[j]}" for j in small)
        yield Finding(
            check,
            "doubtful",
            f"noise does not explain {each} on {on}: the model lacks something small, or a constant"
            " is off",
            _constants(case, small),
            "symptom",
        )


def _constants(case: Case, joints: Sequence[int]) -> str:
    """How to check torque constants: by a known weight, where gravity loads the joint."""
    loaded = case.evidence.loaded
    weighed = [j for j in joints if loaded is None or loaded[j]]
    steps = []
    if names := case.all(weighed):
        steps.append(f"check the torque constant of {names} with a known payload (`hil gains`)")
    if names := case.all(j for j in joints if j not in weighed):
        steps.append(
            f"compare the torque constant of {names} with the drive's data sheet: gravity does not"
            " load it, so that no payload tells it"
        )
    return "; ".join(steps)


def consistent(case: Case) -> Findings:
    """Repetitions that do not say the same."""
    share, most = case.evidence.disagreement, case.limit.inconsistency
    if share is None or case.evidence.estimate.undetermined:
        return  # what a motion does not determine differs from repetition to repetition
    for j in _where(share > most):
        yield Finding(
            "repetitions",
            "wrong",
            f"repetitions disagree: their estimates differ by up to {share[j]:.0%} of the torque of"
            f" {case.names[j]}, more than {most:.0%}",
            "look at the repetitions one by one: something changed between them",
        )


def nominal(case: Case) -> Findings:
    """Against the maker's figures."""
    ours, theirs, check = case.evidence.held_out, case.evidence.nominal, "against the nominal model"
    if theirs is None:
        return
    if ours.overall > theirs.overall + case.limit.nominal:
        words = f"the nominal model predicts better: {theirs.overall:.1%} against"
        step = "use the nominal model, or fit a longer and richer motion"
        yield Finding(check, "wrong", f"{words} {ours.overall:.1%}", step, "symptom")
        return
    text = f"the nominal model misses by {theirs.overall:.1%} where this one misses by"
    text += f" {ours.overall:.1%}"
    if not np.all(np.isnan(theirs.relative)):
        worst = int(np.nanargmax(theirs.relative))
        text += f"; it is worst on {case.names[worst]} ({theirs.relative[worst]:.0%})"
    yield Finding(check, "good", text)


def controller(case: Case) -> Findings:
    """Against the dynamic model inside the controller, where it sent what that says."""
    theirs, ours = case.evidence.surroundings.controller, case.evidence.held_out.overall
    if theirs is None:
        return
    check, own = "against the controller's model", "the controller's own dynamic model"
    if ours > theirs.overall + case.limit.nominal:
        words = f"{own} predicts better: {theirs.overall:.1%} against {ours:.1%}"
        step = "fit a longer and richer motion before replacing what the controller has"
        yield Finding(check, "doubtful", words, step, "symptom")
    else:
        words = f"{own} misses by {theirs.overall:.1%} where this one misses by {ours:.1%}"
        yield Finding(check, "good", words)


def inertia(case: Case) -> Findings:
    """The controller's own diagonal inertia against the model's."""
    found, check = case.evidence.surroundings.controller_inertia, "against the controller's inertia"
    if found is None or not np.isfinite(found.ratio).any():
        return
    ratio, known = found.ratio, _where(np.isfinite(found.ratio))
    off = [j for j in known if not 1.0 / (1.0 + _INERTIA_OFF) <= ratio[j] <= 1.0 + _INERTIA_OFF]
    figures = joined([f"{case.names[j]} {ratio[j]:.2f}" for j in off or known])
    if not off:
        words = "the controller's own inertia of each joint is about the identified one, times"
        yield Finding(check, "good", f"{words} {figures}")
        return
    yield Finding(
        check,
        "doubtful",
        "the controller's own inertia (joint side, rotors included) is not the identified one, but"
        f" times {figures}",
        f"check torque constant and gear ratio of {case.some(off)}, and what the arm carries",
    )


def delay(case: Case) -> Findings:
    """Torque that lags the position by another time than the fit took it to, axis by axis."""
    surroundings, estimate = case.evidence.surroundings, case.evidence.estimate
    found = surroundings.delays
    if found is None:
        return
    assumed = np.broadcast_to(surroundings.assumed_delay, found.applied.shape)
    if found.significant and found.agree and np.array_equal(assumed, found.applied):
        yield Finding(
            "delay",
            "doubtful",
            f"the torque lags the position by {1e3 * found.common:.3g} ±"
            f" {1e3 * found.half_interval:.2g} ms ({1e3 * found.assumed:.3g} ms were stated); that"
            " was compensated",
            "state it (`hil identify --delay SECONDS`), or correct it where it arises",
        )
        return
    known = _where(found.determined)
    # Of a poor motion a delay is another combination of parameters.
    poor = bool(estimate.undetermined) or estimate.condition > case.limit.condition
    if poor or not known:
        return
    measured = [
        f"{name} {1e3 * found.delays[j]:.3g} ± {1e3 * found.interval_factor * found.std[j]:.2g} ms"
        f" ({1e3 * assumed[j]:.3g} ms assumed)"
        for j, name in enumerate(case.names)
    ]
    beyond = np.maximum(case.limit.delay * found.cycle, SIGMAS * found.std)
    off = _where(found.determined & (np.abs(found.delays - assumed) > beyond))
    if off:
        words = "the torque seems to lag the position by another time than was assumed: "
        words += joined([measured[j] for j in off])
        step = "compare with `hil identify --delay auto`, or correct the delay in the cell"
        yield Finding("delay", "doubtful", words, step, "cause")
    else:
        words = "no delay stands out but the assumed one; the torque lags the position by: "
        yield Finding("delay", "good", words + joined([measured[j] for j in known], 2))


def mended(case: Case) -> Findings:
    """What was wrong with the recordings and is made good in what was fitted."""
    yield from case.evidence.surroundings.mended


def saturation(case: Case) -> Findings:
    """Motors at their limit."""
    share = case.evidence.surroundings.saturated
    if share is None:
        return
    joints = _where(share > case.limit.saturated)
    if not joints:
        yield Finding("saturation", "good", "no torque or current was at its limit")
        return
    found = ", ".join(f"{case.names[j]} in {share[j]:.1%} of its samples" for j in joints)
    yield Finding(
        "saturation",
        "doubtful",
        f"torque or current was at its limit: {found}; what is logged there may be less than what"
        " was needed",
        f"slow the motion down where {case.some(joints)} is at its limit",
        "cause",
    )


def noise(case: Case) -> Findings:
    """What the samples are worth, given how long the residual remembers."""
    checks, parameters = case.evidence.residuals, len(case.evidence.estimate.names)
    if checks is None:
        return
    worth, memory = checks.colour.effective_rows, 1e3 * float(np.nanmedian(checks.colour.time))
    text = (
        f"the residual is correlated over {memory:.3g} ms (median axis), so that"
        f" {checks.colour.rows.sum()} rows are worth about {np.nansum(worth):.0f} independent ones,"
        f" for {parameters} parameters"
    )
    if np.nansum(worth) < case.limit.rows_per_parameter * parameters:
        step = "record a longer motion, or the same one several times"
        yield Finding("whiteness", "doubtful", f"the recordings are short: {text}", step)
    else:
        yield Finding("whiteness", "good", f"{text}; the standard deviations allow for that")


def over_speed(case: Case) -> Findings:
    """A friction law of another form."""
    checks, check = case.evidence.residuals, "residual over speed"
    if checks is None:
        return
    if not (joints := case.stand_out(checks.speed)):
        words = "what is left over hardly depends on the joints' speed"
        yield Finding(check, "good", words)
        return
    yield Finding(
        check,
        "doubtful",
        f"what is left over depends on speed: {case.worst_bins(joints, checks.speed, '/s')}:"
        " friction may not be of the form that was fitted",
        f"try further friction terms for {case.some(joints)} (Stribeck, asymmetric, third)",
        "symptom",
    )


def over_position(case: Case) -> Findings:
    """Gravity, geometry, or something that hangs on the arm."""
    checks, check = case.evidence.residuals, "residual over position"
    if checks is None:
        return
    if not (joints := case.stand_out(checks.position)):
        yield Finding(check, "good", "what is left over hardly depends on the posture")
        return
    yield Finding(
        check,
        "doubtful",
        f"what is left over depends on position: {case.worst_bins(joints, checks.position, '')}",
        "check the URDF's geometry and gravity direction, and look for a hose, spring or payload"
        " that the model does not have",
        "symptom",
    )


def over_motor_angle(case: Case) -> Findings:
    """Torque ripple."""
    checks, check = case.evidence.residuals, "torque ripple"
    if checks is None or checks.ripple is None:
        return
    ripple = checks.ripple
    if not (joints := case.stand_out(ripple)):
        yield Finding(check, "good", "no torque ripple stands out")
        return
    share = checks.share(ripple.rms)
    matters = [j for j in joints if share[j] > case.limit.ripple]
    found = ", ".join(
        f"{case.names[j]} ({ripple.strongest(j)} per motor turn, {share[j]:.1%} of its torque)"
        for j in matters or joints
    )
    text = f"a torque ripple comes and goes with the motors' turning: {found}"
    if not matters:
        yield Finding(check, "information", f"{text}, which is usual")
        return
    step = "let it average out over a long motion, or compensate it apart: the model does not have"
    yield Finding(check, "doubtful", text, f"{step} it")


def over_time(case: Case) -> Findings:
    """Friction that changed while the recordings were made."""
    checks, check = case.evidence.residuals, "friction over time"
    if checks is None or checks.drift is None:
        return
    change, significant = checks.drift.change, checks.drift.significant
    # Friction that hardly makes torque may change as it likes.
    size = np.abs(change) * checks.friction_share
    matters = _where(significant & (size > case.limit.drift))
    joints = matters or _where(significant)
    if not joints:
        words = "no change of friction stands out while the recordings were made"
        yield Finding(check, "good", words)
        return
    found = ", ".join(
        f"{case.names[j]} by {abs(change[j]):.1%} {'up' if change[j] > 0.0 else 'down'}"
        for j in joints
    )
    text = f"friction changed while the recordings were made: {found}"
    if matters:
        yield Finding(check, "doubtful", text, _WARMER, "cause")
    else:
        text += f"; that is at most {size[joints].max():.1%} of an axis's torque"
        yield Finding(check, "information", text)


CHECKS: Final[tuple[Callable[[Case], Findings], ...]] = (
    untested,
    jumps,
    determined,
    outliers,
    gravity,
    causes,
    scale,
    load,
    friction_change,
    plausible,
    size,
    unexplained,
    explained,
    growth,
    systematic,
    consistent,
    nominal,
    controller,
    inertia,
    delay,
    mended,
    saturation,
    noise,
    over_speed,
    over_position,
    over_motor_angle,
    over_time,
)
"""In the order in which reasons are given: the first one is in the verdict's line."""
