"""Findings in words: a sentence for each key, a next step for each remedy.

Sentences are format strings of what a finding has: its `values`, `{motion}` (the motion that was
predicted), `{joints}` (names of its joints), `{axes}` (the same with "and", or all of them),
`{joint}` and `{other}` of a pair, `{numbers}` (from 1), and `{each}`: its joints, each with an
entry of its own figures. `{x:pc1}` is a percentage of one decimal as on pages, `{x:more}` "more" or
"less" by its sign.
"""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from identification.hypotheses.change_messages import CHANGES_OF_A_PART, part_words
from identification.hypotheses.joint_changes import (
    COUPLED,
    COUPLED_DRIVES,
    ORDERS,
    SIGNS,
    Change,
    Meaning,
)
from identification.model.friction import FrictionLaw
from identification.model.messages import law_option, law_text
from identification.signals.messages import faults_words, time_lines
from identification.signals.position_steps import PositionJump
from identification.signals.row_faults import RowFaults
from identification.signals.sample_times import SampleTimes
from identification.text import joined, number, percentage
from identification.validation.consistency import ConsistencyCheck, ImpossibleParameter
from identification.validation.finding import (
    Finding,
    FindingKey,
    Level,
    RemedyKey,
    RepeatedSamples,
    Role,
    TestedOn,
)

UNTESTED: Final = "tested"
"""Name of the check whether every joint was tested on held-out motion."""
IMPOSSIBLE: Final = "physical signs"
"""Name of the check whether bodies with these parameters can exist."""
NO_BODIES: Final = "bodies in the torque"
"""Name of the check whether the torque belongs to an arm."""
OTHER_TIMES: Final = "times"
"""Name of the check whether inertia and weight have the ratio of the arm."""
RATE_OF_TORQUE: Final = "rate of the torque"
"""Name of the check whether it is a torque, and not its rate."""
TORQUE_AND_MOTION: Final = "torque and motion"
"""Name of the check whether any masses explain the torque."""
ARM: Final = "arm of the URDF"
"""Name of the check whether the model describes the arm of the URDF."""
FORM: Final = "form of friction"
"""Name of the check whether a friction law lacks a term."""
LEFT_OPEN: Final = "undetermined by the motion"
"""Name of the check whether models of the same fit predict alike."""

_ELEMENTS: Final = "a spring, a balancer or a hydraulic counterweight"
_SHOWN_VIOLATIONS: Final = 4
_NO_CONSISTENT: Final = "no physically consistent parameters fit the data"


@dataclass(frozen=True)
class WordedFinding:
    """A finding in words."""

    check: str  # name of the check
    # "wrong": the model must not be used; "doubtful": a warning; "information": neutral
    level: Level
    words: str  # message without full stop
    next_step: str = ""  # remedy; empty if none is needed
    # a "cause" explains errors; the step of a "symptom" is given only if no cause was found
    role: Role = "condition"
    # what a model that predicts well must not be used for without care, for the verdict's sentence
    reservation: str = ""
    # share of the squared error that is gone with this corrected, 0 to 1; None: not measured
    explains: float | None = None
    # indices of the joints that it names; empty if it names none
    joints: tuple[int, ...] = ()
    key: str = ""  # what was found; stays when the words change; empty in earlier files


@dataclass(frozen=True)
class Naming:
    """Names in messages: of the joints, and of the motion that was predicted."""

    joints: tuple[str, ...] = ()
    motion: TestedOn = TestedOn.UNSEEN

    def all_of(self, joints: Sequence[int]) -> str:
        """Return joints by their indices."""
        return joined([self.joints[joint] for joint in joints])


class Optional(NamedTuple):
    """Words for which a finding may lack the figures."""

    words: str
    otherwise: str = ""  # words in that case


class Sentence(NamedTuple):
    """How a finding is worded."""

    check: str
    words: str
    each: str = ""  # entry of a joint
    reservation: str = ""
    optional: Mapping[str, Optional] = {}  # by their names in the words


def worded(finding: Finding, naming: Naming) -> WordedFinding:
    """Return a finding in words."""
    sentence = SENTENCES[finding.key]
    text = _Text(finding, naming, sentence)
    return WordedFinding(
        check=text.of(sentence.check),
        level=finding.level,
        words=text.of(sentence.words),
        next_step="" if finding.remedy is None else text.of(REMEDIES[finding.remedy]),
        role=finding.role,
        reservation=text.of(sentence.reservation),
        explains=finding.explains,
        joints=finding.joints,
        key=finding.key,
    )


def impossible_words(violation: ImpossibleParameter) -> str:
    """Return what is impossible about a parameter."""
    if violation.value is None:
        return f"the link of {violation.joint} would need a negative mass or moment of inertia"
    return f"{violation.quantity} of {violation.joint} would be negative ({violation.value:.3g})"


def consistency_words(check: ConsistencyCheck) -> str:
    """Return what physical consistency costs, and which parameters prevent it."""
    cost = _consistency_cost(check)
    if check.impossible:
        return f"{_NO_CONSISTENT} {cost}"
    if check.costly:
        return (
            "the parameters are not physically consistent, and the nearest consistent ones predict"
            f" worse {cost}"
        )
    return (
        f"consistent parameters predict {'better' if check.predicts_better else 'as well'} {cost}"
    )


def _consistency_cost(check: ConsistencyCheck) -> str:
    points = round(100.0 * check.cost, 2) + 0.0
    error = f"({check.judged_on} torque error {points:+.2f} points)"
    if not check.costly or not check.violations:
        return error
    return f"{error}: {joined([*map(impossible_words, check.violations)], _SHOWN_VIOLATIONS)}"


def _consistency_remedy(check: ConsistencyCheck) -> str:
    """A spring bears the weight on one axis, which no body can; a wrong sign spoils several."""
    usual = "check signs, torque constants, coupling and URDF"
    if not check.is_balanced:
        return usual
    return (
        f"describe {_ELEMENTS} on {check.overloaded} as [[robot.elements]] of the cell file; if it"
        f" has none, {usual}"
    )


class _Text(string.Formatter):
    """Format strings filled with what a finding has."""

    def __init__(self, finding: Finding, naming: Naming, sentence: Sentence) -> None:
        names = [naming.joints[joint] for joint in finding.joints]
        self._naming = naming
        self._fields: dict[str, Any] = {
            "motion": naming.motion,
            "joints": joined(names),
            "axes": " and ".join(names) or "all axes",
            "joint": names[0] if names else "",
            "other": names[-1] if names else "",
            "numbers": ", ".join(str(joint + 1) for joint in finding.joints),
            **finding.values,
        }
        entries = []
        for row, name in enumerate(names):
            figures = {key: figures[row] for key, figures in finding.each.items()}
            entries.append(f"{name} {self.vformat(sentence.each, (), figures)}")
        self._fields["each"] = joined(entries)
        for name, (words, otherwise) in sentence.optional.items():
            needed = {field for _, field, _, _ in self.parse(words) if field}
            is_known = needed <= self._fields.keys()
            self._fields[name] = self.of(words) if is_known else otherwise

    def of(self, text: str) -> str:
        return self.vformat(text, (), self._fields)

    def format_field(self, value: Any, format_spec: str) -> str:
        match value:
            case Change() if format_spec == "check":
                return _CHECKS[value.meaning]
            case Change():
                return _change(value, self._naming)
            case PositionJump():
                after = f"after {value.time:.3f} s of {value.recording}"
                size = "" if format_spec == "time" else f"by {value.size:+.3g} {value.unit} "
                return f"{value.joint} {size}{after}"
            case RowFaults():
                return faults_words(value)
            case SampleTimes():
                return "; ".join(time_lines(value))
            case ConsistencyCheck():
                return f"{_consistency_cost(value)}: {_consistency_remedy(value)}"
            case FrictionLaw():
                return law_option(value) if format_spec == "option" else law_text(value)
            case RepeatedSamples():
                return f"{value.joint} {value.count} in {value.recording}"
            case tuple() if format_spec == "with":
                return " with ".join(self.format_field(change, "") for change in value)
            case tuple() if format_spec == "sets":
                return ", or ".join(self.format_field(changes, "with") for changes in value)
            case tuple() if format_spec == "names":
                return self._naming.all_of(value)
            case tuple():
                most = int(format_spec) if format_spec.isdecimal() else len(value)
                entry_spec = format_spec if format_spec.endswith("f") else ""
                entries = [self.format_field(entry, entry_spec) for entry in value]
                return " or ".join(entries) if format_spec == "or" else joined(entries, most)
            case float() if format_spec == "more":
                return "more" if value > 0.0 else "less"
            case float() if "pc" in format_spec:
                decimals = int(format_spec[-1])
                return percentage(value, decimals, signed=format_spec.startswith("+"))
            case float() if format_spec in _SIGNIFICANT:
                return number(value, _SIGNIFICANT[format_spec])
        return format(value, format_spec)


_SIGNIFICANT: Final = {".2g": 2, ".3g": 3}  # digits by format
_SIGN: Final = "direction of axes"
_ORDER: Final = "order of joints"
_COUPLED_ANGLES: Final = "coupled angles"
_CHECKS: Final[Mapping[Meaning, str]] = {
    **dict.fromkeys(SIGNS, _SIGN),
    **dict.fromkeys(ORDERS, _ORDER),
    **dict.fromkeys(COUPLED, _COUPLED_ANGLES),
}
_QUANTITIES: Final[Mapping[Meaning, str]] = {
    "torque sign": "torque",
    "position sign": "position",
    "axis sign": "position and torque",
    "torque order": "torques",
    "position order": "positions",
    "joint order": "positions and torques",
}


def _change(change: Change, naming: Naming) -> str:
    """Return a sign, an order, a coupled angle, or what is other in a part, in words."""
    if change.meaning in CHANGES_OF_A_PART:
        return part_words(change, naming.joints)
    joints = naming.all_of(change.joints) or "all axes"
    if change.meaning in _QUANTITIES:
        done = "negated" if change.meaning in SIGNS else "interchanged"
        return f"{_QUANTITIES[change.meaning]} of {joints} {done}"
    joint, other = (naming.joints[index] for index in change.joints)
    sign = "plus" if change.meaning.endswith("sum") else "minus"
    angle = f"the angle of {joint} {sign} the angle of {other}"
    return f"{angle}, driven by rods or a belt" if change.meaning in COUPLED_DRIVES else angle


_CORRECTED: Final = Optional(
    "; correcting this multiplies the error of predicted parts of {whole} by {ratio:.2f}"
)


def _fault(check: str, words: str, sized: Optional | None = None) -> Sentence:
    """Return the sentence of a change, with the error that is left with it corrected if known.

    Args:
        check: it belongs to.
        words: of the sentence, with `sized` where its size is.
        sized: its size in words, or that the motion does not determine it.
    """
    optional = {"corrected": _CORRECTED}
    if sized is not None:
        optional["sized"] = sized
    return Sentence(check, f"{words}{{corrected}}", optional=optional)


_UNKNOWN: Final = "which the motion does not determine"
_TIMES: Final = Optional(
    "{size:.3g} ± {half_interval:.2g} times as large as", f"of another size, {_UNKNOWN}, than"
)
_CONSTANT: Final = (
    "is {size:.3g} ± {half_interval:.2g} times the value consistent with the other axes"
)
_DRIVEN: Final = (
    "rods or belts probably drive {joint}: its recorded angle is its own FACTOR the angle of"
    " {other}, whose motor does not carry its torque"
)
_EXCEEDS: Final = "the torque error on {motion} exceeds {limit:pc0}"
_SLOW: Final = "the torque error on {motion} beyond noise exceeds {limit:pc1}: {each}"
_ROWS_EQUAL: Final = (
    "the residual is correlated over {memory:.3g} ms (median axis): {rows} rows carry as much as"
    " {worth:.0f} independent rows, for {parameters} parameters"
)
_OF_RESIDUAL: Final = (
    "({error:+.3g} {torque_unit} about {at:.2g} {unit}, {relative:pc1} of its torque)"
)
_RIPPLE: Final = "({harmonic} per motor turn, {relative:pc1} of its torque)"
_COARSE: Final = "the position resolution is coarse: {each}"
_LAW: Final = "the friction law is {law}, chosen by inner prediction; the recordings state {stated}"
_NEAREST: Final = "none of the tested explanations fits the recording; the nearest is"
_TORQUE_LAGS: Final = "the torque lags the position by {delay:.3g} ± {half_interval:.2g} ms"
_ALIKE: Final = Optional("; another torque constant of {alike_joints:names} explains it as well")
_WITH_FRICTION: Final = Optional(" ({fitted_friction:pc1} with fitted friction)")
_AT_SPEED: Final = (
    "friction of {name} is {value:.3g} at its top speed of {speed:.3g}, less than half of its"
    " Coulomb friction {coulomb:.3g}"
)

SENTENCES: Final[Mapping[FindingKey, Sentence]] = {
    "nothing held out": Sentence(UNTESTED, "no motion was held out: all errors are in-sample"),
    "joints not fitted": Sentence(
        UNTESTED, "the fitted motion does not move {joints}, but {motion} does"
    ),
    "joints at rest": Sentence(UNTESTED, "{joints} moved for less than {least:g} s of {motion}"),
    "no torque": Sentence(
        UNTESTED, "the measured torque of {joints} is zero or constant throughout {motion}"
    ),
    "play": Sentence(
        "play",
        "positions step to and fro where the load of the joint reverses, as with play between"
        " encoder and link: {each}",
        "({size:.2g} ± {half_interval:.1g} {unit}, {count} times)",
    ),
    "position jumps": Sentence(
        "position jumps",
        "the measured position jumped faster than an arm can move: {jumps:3}",
    ),
    "faulty rows": Sentence("rows", "{recording}: {faults}"),
    "spikes": Sentence(
        "rows",
        "isolated torque spikes are excluded from fit and error: {each} of {rows} samples of the"
        " fitted motion",
        "{count:g}",
    ),
    "commanded positions": Sentence(
        "positions",
        "the positions of {recordings:6} equal the commands bit for bit: the real arm lags behind"
        " them{lag}, and every speed and acceleration is the plan's, not the arm's",
        optional={"lag": Optional(" by about {delay:.0f} ms")},
    ),
    "counted rows": Sentence(
        "time",
        "the times of {recording} count rows, and the map reads them in {unit}: unless the"
        " controller's cycle is one {unit}, all speeds and accelerations are wrong by the same"
        " factor",
    ),
    "retimed": Sentence("clock", "{recordings:6}: {times}"),
    "repeated samples": Sentence(
        "clock",
        "the log repeats or delays position samples, or lacks rows, while the arm moves:"
        " {samples:6} (first: {first:time})",
    ),
    "unwrapped angles": Sentence(
        "wrapped angles", "angles that wrap at a full turn were unwrapped: {angles:6}"
    ),
    "coarse positions": Sentence(
        "resolution",
        f"{_COARSE}; rounding makes up more than {{limit:pc0}} of the acceleration",
        "{step:.2g} {unit}",
    ),
    "coarse positions at rest": Sentence(
        "resolution",
        f"{_COARSE}; friction reverses over {{presliding:.2g}}, so rounding decides its direction"
        " at rest",
        "{step:.2g} {unit}",
    ),
    "folded noise": Sentence(
        "sampling rate",
        "sampled at {rate:.3g} Hz, the torque has noise up to half this rate; aliasing moves it"
        " below {bandwidth:g} Hz, where it makes up {noise:pc0} of the squared residual",
    ),
    "saturation": Sentence(
        "saturation",
        "torque or current was at its limit: {each}; the true value may be larger",
        "in {saturated:pc1} of its samples",
    ),
    "no saturation": Sentence("saturation", "no torque or current was at its limit"),
    "undetermined": Sentence(
        "excitation",
        "the motion does not determine {count} of {total} parameters ({parameters:3}){friction}",
        optional={
            "friction": Optional(", among them the friction of {friction_joints:names}"),
        },
    ),
    "undetermined in one direction": Sentence(
        "excitation",
        "{joints} moved in one direction only, so of Coulomb friction and torque offset the motion"
        " determines only the sum: {each}",
        "{coulomb} + {offset}",
    ),
    "poor excitation": Sentence(
        "excitation",
        "the motion excites the parameters poorly: condition number {condition:.0f} of the"
        " regressor with unit columns, limit {limit:.0f}; predictions are reliable for similar"
        " motions only, single parameters are not",
    ),
    "one direction": Sentence(
        "excitation",
        "{joints} moved in one direction only on the fitted motion: Coulomb friction and torque"
        " offset share one regressor column there, so only their sum is determined",
    ),
    "good excitation": Sentence(
        "excitation",
        "the motion determines every parameter: condition number {condition:.0f} of the regressor"
        " with unit columns",
    ),
    "no bodies": Sentence(
        NO_BODIES,
        "the torque contains almost no rigid-body part: at most {over_friction:pc0} of the friction"
        " on any axis, and {scale:.2g} times what the URDF's masses need; a model of the arm was"
        " subtracted from it, as by a controller that reports external torque",
    ),
    "no gravity": Sentence(
        "gravity",
        "gravity was removed from the torque: a model without gravity predicts the fitted motion"
        " with {ratio:.2f} times the error",
    ),
    "part of gravity": Sentence(
        "gravity",
        "most of gravity was removed from the torque, by a model that does not fit this arm: a"
        " model without gravity predicts the fitted motion with {ratio:.2f} times the error, but"
        " some gravity is left",
    ),
    "rate of a torque": Sentence(
        RATE_OF_TORQUE,
        "the recorded torque is a torque rate (N·m/s): its time integral follows the arm, the"
        " recorded signal does not",
    ),
    "other times": Sentence(
        OTHER_TIMES,
        "the recorded times are {time:.3g} times the true times, with which inertia and weight in"
        " the torque fit the arm of the URDF",
    ),
    "torque of another run": Sentence(
        TORQUE_AND_MOTION,
        "no masses explain {error:pc0} of the torque of {motion}: it comes from another run than"
        " the positions, from another arm, or its columns are misread",
    ),
    "rows backwards": Sentence(
        "time",
        "the rows run backwards in time: as recorded, friction would add energy to every axis,"
        " while gravity and inertia have the right sign",
    ),
    "zeros": Sentence(
        "zeros",
        "joint zeros differ from the URDF: add {each}; this leaves {error:pc0} of the error on rows"
        " that were not used for the choice",
        "{degrees:+.1f}°",
    ),
    "zeros, not all certain": Sentence(
        "zeros",
        "joint zeros differ from the URDF, though not all of them certainly: add {each}; this"
        " leaves {error:pc0} of the error on rows that were not used for the choice",
        "{degrees:+.1f}°",
    ),
    "zeros, nearest": Sentence(
        "zeros",
        f"{_NEAREST} joint zeros that differ from the URDF ({{each}})",
        "{degrees:+.1f}°",
    ),
    "alike": Sentence(
        "{change:check}",
        "several explanations fit equally well: {alike:or}; each leaves {error:pc0} of the error on"
        " rows that were not used for the choice",
    ),
    "nearest": Sentence("{change:check}", f"{_NEAREST} {{change}}"),
    "another arm": Sentence(ARM, "the arm would have {scale:.2g} times the masses of the URDF"),
    "gravity": Sentence(
        "gravity",
        "with gravity ({best}) m/s² in base axes, {angle:.0f}° from the declared ({declared})"
        " m/s², {motion} is predicted with {error:.2f} times the error",
    ),
    "scale of the torque": Sentence(
        "scale of the torque",
        "ratio of measured to nominal inertial torque (expected: 1): {each}",
        "{scale:.3g} ± {tolerance:.2g}",
    ),
    "all torques opposite": Sentence(
        _SIGN,
        "all torques have the opposite sign of the nominal inertial torques: ratio {each}",
        "{scale:.2g}",
    ),
    "all axes driven by friction": Sentence(
        _SIGN,
        "all torques have the opposite sign: friction would drive every axis, {each} at top speed",
        "{friction:.3g} ± {half_interval:.2g}",
    ),
    "torque opposite": Sentence(
        _SIGN,
        "the torque has the opposite sign of the nominal inertial torque: ratio {each}",
        "{scale:.2g}",
    ),
    "outliers": Sentence(
        "outliers",
        "isolated outliers cause most of the error on {motion} ({each} of the samples); without"
        " them it is {without:pc1} over all axes",
        "{outlying:pc2}",
    ),
    "delay of the torque": _fault(
        "delay",
        "the torque of {axes} lags the position by {sized} than assumed",
        Optional(
            "{size:.3g} ± {half_interval:.2g} ms {difference:more}",
            f"another time, {_UNKNOWN},",
        ),
    ),
    "drift of a joint": _fault(
        "zeros",
        "the zero of {axes} drifts by {sized} over the fitted motion",
        Optional("about {size:.2g}°", f"an angle, {_UNKNOWN},"),
    ),
    "torque constant": _fault(
        "torque constant",
        "the torque of {axes} {sized}",
        Optional(_CONSTANT, f"has another scale than the other axes, {_UNKNOWN}"),
    ),
    "torque constant or spring": _fault(
        "torque constant",
        "the torque of {axes} has another scale than the other axes, or a spring or cable acts on"
        " it: both explain the motion alike",
    ),
    "spring": _fault(
        "springs",
        "{axes} has a torque that depends on its own angle, as from a spring, balancer or cable",
    ),
    "torque constant, as assumed": Sentence(
        "torque constant",
        f"the torque of {{axes}} {_CONSTANT}, within the assumed uncertainty of the torques"
        " (standard deviation of the ratio {scale_std:pc1})",
    ),
    "load friction": _fault(
        "friction over load",
        "friction grows with the load, by {sized} of the transmitted torque (median axis)",
        Optional("{size:.3g} ± {half_interval:.2g}", f"a share, {_UNKNOWN},"),
    ),
    "torque sign": _fault(_SIGN, "the torque of {axes} probably has the wrong sign"),
    "position sign": _fault(_SIGN, "the position of {axes} probably has the wrong sign"),
    "axis sign": _fault(
        _SIGN, "{axes} probably turns opposite to the URDF: wrong sign of gear ratio or direction"
    ),
    "torque order": _fault(_ORDER, "the torques of {axes} are probably interchanged"),
    "position order": _fault(_ORDER, "the positions of {axes} are probably interchanged"),
    "joint order": _fault(_ORDER, "the positions and torques of {axes} are probably interchanged"),
    "angle sum": _fault(
        _COUPLED_ANGLES,
        "the recorded angle of {joint} is probably its own plus the angle of {other}",
    ),
    "angle difference": _fault(
        _COUPLED_ANGLES,
        "the recorded angle of {joint} is probably its own minus the angle of {other}",
    ),
    "drive sum": _fault(_COUPLED_ANGLES, _DRIVEN.replace("FACTOR", "plus")),
    "drive difference": _fault(_COUPLED_ANGLES, _DRIVEN.replace("FACTOR", "minus")),
    "payload of a part": _fault(
        "sameness",
        "in {part} the arm carried {sized} than in the other data",
        Optional(
            "{size:.3g} ± {half_interval:.2g} kg {difference:more}",
            f"another mass, {_UNKNOWN},",
        ),
    ),
    "torque of a part": _fault(
        "sameness",
        "in {part} the torque of {axes} is {sized} in the other data",
        _TIMES,
    ),
    "friction of a part": _fault(
        "sameness",
        "in {part} the friction of {axes} is {sized} in the other data",
        _TIMES,
    ),
    "arm of a part": _fault(
        "sameness",
        "{part} was probably recorded with another arm, tool or setting than the other data",
    ),
    "undetermined change of a part": Sentence(
        "sameness",
        "{part} differs from the other data, and several explanations fit it: {alike:sets}",
    ),
    "unexplained part": Sentence(
        "sameness",
        "{part} differs from the other data; the nearest explanation is {nearest:with}{kilograms}"
        "{times}, {left}",
        optional={
            "kilograms": Optional(" ({mass:.3g} ± {half_interval:.2g} kg {difference:more})"),
            "times": Optional(" ({factor:.3g} ± {half_interval:.2g} times)"),
            "left": Optional(
                "with which the error is still {excess:.2g} times as large as in the other data",
                "which is not certain",
            ),
        },
    ),
    "load": Sentence(
        "load",
        "on {motion} the arm carried {load} on the fitted motion: a body on the last link explains"
        " {explained:pc0} of the additional error",
        optional={
            "interval": Optional(" ± {half_interval:.2g}"),
            "load": Optional(
                "{mass:.3g}{interval} kg {difference:more} than",
                "a load part of the time that it did not carry",
            ),
        },
    ),
    "changed torque": Sentence(
        "sameness",
        "ratio of the torque on {motion} to the torque on the fitted motion: {each}",
        "{factor:.3g} ± {half_interval:.2g}",
    ),
    "changed friction": Sentence(
        "friction",
        "friction on {motion} differs from the estimate: {each}, beyond the {limit:pc0} that gear"
        " temperature causes; this explains the error of {joints}{alike}",
        "{change:+pc0}",
        optional={"alike": _ALIKE},
    ),
    "slightly changed friction": Sentence(
        "friction",
        "friction on {motion} differs by more than {limit:pc0}: {each}; gear temperature may have"
        " changed{alike}",
        "{change:+pc0}",
        "friction of {joints} changed",
        {"alike": _ALIKE},
    ),
    "negative Coulomb friction": Sentence(
        IMPOSSIBLE,
        "Coulomb friction of {name} is negative ({value:.3g}): a torque or a direction has the"
        " wrong sign",
    ),
    "little friction at speed": Sentence(IMPOSSIBLE, _AT_SPEED),
    "little friction at speed by a chosen term": Sentence(
        "friction law", f"{_AT_SPEED}, by a friction term that was chosen by inner prediction"
    ),
    "negative parameter": Sentence(
        IMPOSSIBLE, "{name} is negative: {value:.3g} ± {std:.2g} {unit}"
    ),
    "no consistent parameters": Sentence(IMPOSSIBLE, f"{_NO_CONSISTENT} {{consistency}}"),
    "friction law lacks a term": Sentence(
        FORM,
        "the friction law of {joints} lacks a term, such as {each}; the intervals of its"
        " coefficients allow for that",
        "{term}, {friction:pc0} of its friction",
        "the friction law of {joints} is uncertain",
    ),
    "complete friction law": Sentence(FORM, "no joint's friction law lacks a term that matters"),
    "chosen friction law": Sentence("friction law", _LAW),
    "chosen friction law in place of the stated": Sentence(
        "friction law", f"{_LAW}, which predicts parts of the fitted motion worse"
    ),
    "overall error": Sentence(
        "error on unseen motion",
        "the torque error on {motion} is {overall:pc1} over all axes, limit {limit:pc0}",
    ),
    "axis error": Sentence("error on unseen motion", f"{_EXCEEDS}: {{each}}", "{relative:pc0}"),
    "axis error of little torque": Sentence(
        "error on unseen motion",
        f"{_EXCEEDS} for axes of little torque: {{each}}",
        "{relative:pc0} of {torque:.2g} {unit}",
    ),
    "axis error on unseen motion alone": Sentence(
        "error on unseen motion", f"{_EXCEEDS}: {{each}}", "{relative:pc0}"
    ),
    "unexplained error": Sentence(
        "unexplained error",
        "the torque error on {motion} is {overall:pc1} over all axes{beyond}, {floors:.1f} times"
        " the noise floor of {floor:pc1}; none of the tested faults explains it (delay, torque"
        " constants, springs, signs and order of joints, payload, changes between recordings)",
        optional={"beyond": Optional(", limit {limit:pc0}")},
    ),
    "undetermined by the motion": Sentence(
        LEFT_OPEN,
        "parameters that fit the recording equally well (to {fitted:pc1}) differ by {open:pc1} of"
        " the torque on {motion}, as the fitted motion does not determine them; the error of"
        " {overall:pc1} there may come from a fault with such an effect (low sampling rate, coarse"
        " resolution, small payload) or from chance",
    ),
    "nothing explained": Sentence(
        "variance explained (R²)",
        "the model of {joints} predicts no better than the mean torque (R² at most {limit:g})",
    ),
    "little explained": Sentence(
        "variance explained (R²)",
        "the model explains less than {limit:pc0} of the torque variance: {each}",
        "{explained:pc0}",
    ),
    "explained": Sentence(
        "variance explained (R²)",
        "the model explains at least {least:pc1} of the torque variance of each axis (lowest:"
        " {joints})",
    ),
    "generalisation": Sentence(
        "generalisation",
        "the torque error on {motion} is more than {limit:g} times as large as on the fitted"
        " motion: {each}",
        "{growth:.1f} times, {relative:pc1}",
    ),
    "no repetitions": Sentence(
        "systematic error",
        "without repetitions of one motion, errors of the drive train (coupling, torque constant)"
        " cannot be distinguished from noise and were not tested",
    ),
    "systematic error": Sentence("systematic error", _SLOW, "{slow:pc1}"),
    "different repetitions": Sentence(
        "repetitions",
        "the estimates of single repetitions differ by more than {limit:pc0} of the torque: {each}",
        "{difference:pc0}",
    ),
    "nominal model better": Sentence(
        "against the nominal model",
        "the nominal model predicts better: error {nominal:pc1}{with_friction}, identified model"
        " {identified:pc1}",
        optional={"with_friction": _WITH_FRICTION},
    ),
    "nominal model worse": Sentence(
        "against the nominal model",
        "the error of the nominal model is {nominal:pc1}{with_friction}, of the identified model"
        " {identified:pc1}",
        optional={"with_friction": _WITH_FRICTION},
    ),
    "controller's model better": Sentence(
        "against the controller's model",
        "the controller's own dynamic model predicts better: error {controller:pc1}, identified"
        " model {identified:pc1}",
    ),
    "controller's model worse": Sentence(
        "against the controller's model",
        "the error of the controller's own dynamic model is {controller:pc1}, of the identified"
        " model {identified:pc1}",
    ),
    "controller's inertia differs": Sentence(
        "against the controller's inertia",
        "ratio of the controller's inertia (joint side, with rotors) to the identified one: {each}",
        "{ratio:.2f}",
    ),
    "controller's inertia agrees": Sentence(
        "against the controller's inertia",
        "the controller's inertia agrees with the identified one: ratio {each}",
        "{ratio:.2f}",
    ),
    "compensated delay": Sentence(
        "delay",
        f"{_TORQUE_LAGS} ({{stated:.3g}} ms stated); {{what}} was compensated",
        optional={"what": Optional("{used:.3g} ms", "this")},
    ),
    "delay chosen by prediction": Sentence(
        "delay",
        "the torque lags the position by {delay:.3g} ms (chosen by inner prediction); this was"
        " compensated",
    ),
    "suspected delay": Sentence(
        "delay",
        "the torque probably lags the position by {delay:.3g} ± {half_interval:.2g} ms"
        " ({assumed:.3g} ms assumed); this was not compensated: the interval is wide, and parts of"
        " the fitted motion are not predicted clearly better with it",
    ),
    "other delay": Sentence(
        "delay",
        "the delay of the torque differs from the assumed one: {delay:.3g} ± {half_interval:.2g} ms"
        " ({assumed:.3g} ms assumed)",
    ),
    "assumed delay": Sentence(
        "delay",
        f"{_TORQUE_LAGS} ({{stated:.3g}} ms stated{{in_fit}}), {{agreement}}",
        optional={
            "in_fit": Optional(", {used:.3g} ms in the fit"),
            "agreement": Optional(
                "within {tolerance:.2g} ms of what the fit assumed",
                "which agrees with what the fit assumed",
            ),
        },
    ),
    "filtered torque": Sentence(
        "torque bandwidth",
        "the recorded torque is probably filtered by a low-pass of {bandwidth:.3g} Hz ({shape});"
        " the model is filtered in the same way",
    ),
    "filtered or computed torque": Sentence(
        "torque bandwidth",
        "the recorded torque has no noise above {bandwidth:.2g} Hz: it was filtered by a low-pass"
        " or computed",
    ),
    "short recordings": Sentence("whiteness", f"the recordings are short: {_ROWS_EQUAL}"),
    "correlated residual": Sentence(
        "whiteness", f"{_ROWS_EQUAL}; the standard deviations include this"
    ),
    "residual over speed": Sentence(
        "residual over speed",
        "the residual depends on speed: {each}; the friction law may have another form",
        _OF_RESIDUAL,
    ),
    "no residual over speed": Sentence(
        "residual over speed", "the residual does not depend noticeably on speed"
    ),
    "residual over position": Sentence(
        "residual over position", "the residual depends on position: {each}", _OF_RESIDUAL
    ),
    "no residual over position": Sentence(
        "residual over position", "the residual does not depend noticeably on position"
    ),
    "large ripple": Sentence(
        "torque ripple",
        "torque ripple with the motor angle exceeds {limit:pc0} of the torque: {each}",
        _RIPPLE,
    ),
    "usual ripple": Sentence(
        "torque ripple", "torque ripple with the motor angle, of usual size: {each}", _RIPPLE
    ),
    "ripple over the angle": Sentence(
        "torque ripple",
        "a torque repeats with the angle, as the ripple of a motor or gear does: {each}",
        "({periods:.4g} times per turn of the joint, {relative:pc1} of its torque)",
    ),
    "no ripple": Sentence("torque ripple", "no torque ripple is significant"),
    "large friction drift": Sentence(
        "friction over time",
        "friction changed during the recordings: {each}, more than {limit:pc0} of the torque",
        "by {change:+pc1}",
        "friction of {joints} changed during the recordings",
    ),
    "small friction drift": Sentence(
        "friction over time",
        "friction changed during the recordings: {each}, at most {most:pc1} of an axis's torque",
        "by {change:+pc1}",
    ),
    "no friction drift": Sentence(
        "friction over time", "friction did not change significantly during the recordings"
    ),
}
"""The sentence of each finding."""

_DRIVES: Final = "check sign, gear ratio and torque constant of {joints}"
_SAMENESS: Final = (
    "check what changed between the recordings: temperature, brakes, drive settings of {axes}"
)
_COVER: Final = (
    "fit a longer or more varied motion: the fitted motion does not cover the predicted one"
)
_WARM_UP: Final = "warm the arm up by moving it before recording"
_ALL_SIGNS: Final = "check the sign of the torque and the direction of each axis"
_COUPLED: Final = (
    "turn one joint alone and watch which angles change; if both do, state in the column map of"
    " the log: coupled = [[{numbers}, FACTOR]] in [position] and [velocity] (columns counted from"
    " 1)"
)
_COUPLED_DRIVE: Final = (
    "see whether rods or belts drive {joint}; if they do, state in the column map of the log: side"
    ' = "motor" in [position], [velocity] and [torque]; in [drive] gear_ratio = [1.0, ...] with an'
    " entry for each joint, and coupling = [[{numbers}, FACTOR]] (columns counted from 1)"
)

_MOUNTING: Final = (
    "state how the arm is mounted: `--gravity {}` where a log is read with its URDF, or gravity of"
    " [robot] in the cell file"
)
MOUNTING_STEP: Final = _MOUNTING.format("X Y Z")
"""What to do about a wrong direction of gravity."""

REMEDIES: Final[Mapping[RemedyKey, str]] = {
    "hold out a motion": (
        "predict a recording that is not fitted (`hil identify --predict ARCHIVE`)"
    ),
    "move the joints": (
        "record a validation motion that moves {joints}; a joint that must not move is locked"
        " (`locked` under [robot] in the cell file, or `hil import log --held JOINT`)"
    ),
    "resolve the torque": "record the torque of {joints} with sufficient resolution",
    "check the encoder of a joint": (
        "check encoder, coupling and belt of {joints}, and record again from a calibrated posture"
    ),
    "describe the spring": (
        f"describe {_ELEMENTS} on {{joints}} as [[robot.elements]] of the cell file; if there is"
        " none, check its torque constant and the masses of the URDF"
    ),
    "check the encoder": (
        "check encoder, coupling and cable of {jumping:6} and record again, or cut the recording"
        " before the jump"
    ),
    "find why the logger stopped": (
        "find out why the logger stopped; the rest of the recording is used"
    ),
    "check what wrote rows twice": "find out what wrote rows twice; each was used once",
    "check what displaced rows": (
        "check encoder and cable of the joint; all other rows of the recording are used"
    ),
    "separate the motions": (
        "split the log into one file per motion if the motions are from different days"
    ),
    "check for damaged packets": "check for damaged packets; all other samples are used",
    "record the positions": (
        "give the column of the measured positions (--columns 'position=NAME{{}}'), or record it"
    ),
    "state the sampling rate": ("state the rate of the controller: sample_rate = HZ and no [time]"),
    "log the time": "log the controller's time with each sample",
    "log each sample once": "log each sample of the controller once, with the controller's time",
    "record more digits": (
        "record positions with more digits, or identify with a lower --bandwidth"
    ),
    "record more digits, or leave slow rows out": (
        "record positions with more digits, or exclude slow rows (`hil identify --exclude-rows"
        " slow`)"
    ),
    "log at a higher rate": (
        "log at a higher rate, or filter the torque below half the rate before it is sampled"
    ),
    "slow the motion down": "slow the motion down where {joints} is at its limit",
    "design a motion": "design a motion for this arm (`hil design`) and record it",
    "move in both directions": "record a motion that moves {joints} in both directions",
    "record all torque": (
        "record the torque of the motors or of joint sensors, before the controller's model is"
        " subtracted"
    ),
    "state that gravity was removed": (
        "state that the torque has no gravity: `--gravity 0 0 0` with a log, or gravity of [robot]"
        " in the cell file"
    ),
    "record torque with gravity": "record the torque before gravity is subtracted from it",
    "record the torque itself": "record the torque itself, or integrate it over time",
    "record both in one run": (
        "record torques and positions in one run, and compare the columns of both recordings"
    ),
    "reverse the rows": (
        "reverse the order of the rows, but not of the times, and check the program that wrote them"
    ),
    "correct the zeros": (
        "correct them: [position] offset = [{offsets:.4f}] (rad) in the column map; compare with a"
        " posture of the arm"
    ),
    "correct the zeros if so": (
        "compare a posture of the arm with the URDF at the same angles; if they differ: [position]"
        " offset = [{offsets:.4f}] (rad) in the column map"
    ),
    "compare a posture": "compare a posture of the arm with the URDF at the same angles",
    "jog and compare": ("jog {joints} and compare direction, order and torque with the column map"),
    "compare with the map": "compare direction and order of {joints} with the column map",
    "check masses and units": (
        "check unit and side (motor or joint) of the torque, gear ratios and torque constants, and"
        " the units of the masses of the URDF"
    ),
    "state the mounting": (
        f"{_MOUNTING.format('{option}')}; if it is right, check the zero positions of the joints"
    ),
    "check the scale": (
        "check unit, side (motor or joint), torque constant and gear ratio of the torque of"
        " {joints}, the payload, and the masses of the URDF"
    ),
    "negate all torques": (
        "set scale = -1 for the torques in the column map, or negate all torque constants"
    ),
    "check the sign of the torque": (
        "check the sign of the torque of {joints} in the column map, or of its torque constant"
    ),
    "check the torque for spikes": (
        "check the recorded torques for spikes, damaged packets and collisions; remove them, or use"
        " a robust estimator (`hil identify --estimator tukey` or huber)"
    ),
    "check the positions for steps": (
        "check the positions for steps: the predicted torque jumps there and the measured one does"
        " not, as with play in a gear or coupling, a slipping encoder or rounded positions"
    ),
    "use the delay found": ("run `hil identify --delay auto`, or correct the delay at its source"),
    "check the constant": (
        "check torque constant and gear ratio of {axes}; recordings with and without a known"
        " payload determine the constant (`hil torque-constants --loaded`)"
    ),
    "fit load friction": (
        "fit it: add `load` to the terms of `--friction`, as in `--friction"
        " coulomb,viscous,load,offset`"
    ),
    "check the sign in the map": (
        "check the sign of the torque of {axes} in the column map, or of its torque constant"
    ),
    "check the sign of the position": "check the sign of the position of {axes} in the column map",
    "jog the axes": "jog {axes} by hand and compare its direction of rotation with the URDF's",
    "check the order": (
        "check the order of the columns in the column map against the joints of the URDF"
    ),
    "state the coupled angle": _COUPLED.replace("FACTOR", "1"),
    "state the coupled difference": _COUPLED.replace("FACTOR", "-1"),
    "state the coupled drive": _COUPLED_DRIVE.replace("FACTOR", "1.0"),
    "state the opposite coupled drive": _COUPLED_DRIVE.replace("FACTOR", "-1.0"),
    "separate the payloads": (
        "identify the recordings of each payload separately, or state a known payload in their cell"
        " file ([robot.payload])"
    ),
    "check what changed in between": _SAMENESS,
    "find what changed in between": (
        "find out what changed there (payload, drive settings, temperature), and identify the"
        " recordings of each state separately"
    ),
    "separate the arms": "identify from recordings of one arm in one condition",
    "record with one payload": (
        "record both with the same tool and payload, or state the payload of each in its cell file"
    ),
    "check what changed": (
        "check what changed for {joints} between the recordings: torque constant, unit or scale of"
        " the torque, drive settings; identify the recordings of each state separately"
    ),
    "warm the arm up": _WARM_UP,
    "warm the arm up, and check what else changed": (
        f"{_WARM_UP}, and check what else changed for {{alike_joints:names}}"
    ),
    "check all signs": f"{_ALL_SIGNS} in the column map or cell",
    "describe a balancer": (
        f"describe {_ELEMENTS} that carries part of the weight in [[robot.elements]] of the cell"
        f" file; else {_ALL_SIGNS}"
    ),
    "use the consistent estimate": (
        "use the consistent estimate where the model must be physical (simulation, URDF)"
    ),
    "compare with basic friction": (
        "compare with `hil identify --friction coulomb,viscous,offset`"
    ),
    "describe the friction": (
        "describe the friction of {joints} by further terms (`--friction` or [robot.friction]), or"
        " use its curve in the report"
    ),
    "keep the stated friction": (
        "keep it with `hil identify --friction {stated:option}` if it is known"
    ),
    "describe elements, or check the drives": (
        f"describe {_ELEMENTS}, if the arm has one, in [[robot.elements]] of the cell file; else"
        " check gear ratios, signs, torque constants and the delay between torque and position"
    ),
    "cover the motion": _COVER,
    "cover the motion in both directions": (
        f"{_COVER}, in which every joint moves in both directions"
    ),
    "cover the motion, or check what changed": (
        f"{_COVER}; if it does, check what changed for {{joints}} between the recordings"
    ),
    "check the drives": f"{_DRIVES}, and whether the torque exceeds its noise",
    "check the drives and the unit": f"{_DRIVES}, and the unit of the torque",
    "move faster": "move {joints} faster and further, so that the torque exceeds the noise",
    "check for missing effects": (
        "check for effects that the model lacks: friction (see its curves in the report),"
        " elasticity, springs or balancers ([[robot.elements]] of the cell file), temperature"
    ),
    "repeat the motion": "record the same motion three times or more (one of them is held out)",
    "check the coupling": "check sign, gear ratio, coupling and torque constant of {joints}",
    "check the constant with a payload": (
        "check the torque constant of {joints} with a known payload (`hil torque-constants`), or"
        " without gravity load against the drive's data sheet"
    ),
    "compare the repetitions": "compare the repetitions: conditions changed between them",
    "use the nominal model": "use the nominal model, or fit a longer and more varied motion",
    "fit more before replacing the controller's": (
        "fit a longer and more varied motion before replacing the controller's model"
    ),
    "check the constant and the payload": (
        "check torque constant and gear ratio of {joints}, and the payload"
    ),
    "state the delay": (
        "state the delay (`hil identify --delay SECONDS`), or correct it at its source"
    ),
    "state the delay, or correct the program": (
        "state the delay (`hil identify --delay SECONDS`), or correct it in the recording program"
    ),
    "compare with the delay found": (
        "compare with `hil identify --delay auto`, or state the delay if it is known (`--delay"
        " SECONDS`)"
    ),
    "compare with the delay found, or correct the cell": (
        "compare with `hil identify --delay auto`, or correct the delay in the cell"
    ),
    "record the torque unfiltered": (
        "record the torque unfiltered, or state its low-pass with --torque-bandwidth"
    ),
    "record a longer motion": "record a longer motion, or the same one several times",
    "try friction terms": ("try further friction terms for {joints} (Stribeck, asymmetric, cubic)"),
    "check the geometry": (
        "check the URDF's geometry and gravity direction, and for a hose, spring or payload that"
        " the model lacks"
    ),
    "measure the play": (
        "turn the link of {joints} to and fro by hand with the motor at rest: play in gear or"
        " coupling shows as a free angle of this size; errors where the load reverses come from it"
    ),
    "average the ripple": (
        "record a long motion, which averages it, or compensate it separately: the model does not"
        " include it"
    ),
}
"""What to do, for each remedy."""
