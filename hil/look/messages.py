"""Sentences about a look; only this module makes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import singledispatch
from typing import Any, Final, NamedTuple

import numpy as np

from hil.importers import messages as import_messages
from hil.importers.conclusions import (
    ChannelMeaning,
    ConcludedUnit,
    Conclusion,
    EpisodeUnits,
    FixedFingers,
    JointOrder,
    OutsideLimits,
    RecordedArm,
    StatedUnit,
    UnitBasis,
)
from hil.look.readings import (
    AngleUnit,
    ArmChange,
    Basis,
    BeyondEffort,
    BeyondMasses,
    BeyondRange,
    BeyondSpeed,
    Changes,
    Channels,
    ClockReading,
    CoarsePositions,
    ColumnOrder,
    Contradiction,
    CorrectedError,
    Correlation,
    DelayInterval,
    DelayProblem,
    DoubtfulArm,
    DoubtfulTime,
    Either,
    ErrorAsRead,
    ErrorExplained,
    ErrorRatio,
    Evidence,
    ExplainedTorque,
    Fact,
    FilterShape,
    FoundChange,
    FreeFit,
    GravityOption,
    LastBody,
    LateVelocity,
    LowPassedTorque,
    LowPassLag,
    MapEntries,
    MapKey,
    MirrorImage,
    MotorCurrents,
    MotorTorque,
    Mounting,
    NearestZero,
    NextBest,
    NextStep,
    NoBetter,
    NoJointTorque,
    NotSlopes,
    OtherAxes,
    OtherLengths,
    OtherScales,
    OtherTimes,
    PartError,
    ReadAsGiven,
    Reading,
    RigidShare,
    RivalChanges,
    RowsReading,
    Setting,
    SizeRatio,
    SlopeFactors,
    SlopeRatio,
    SmoothPositions,
    SpringsAlike,
    StatedPayload,
    StillJoints,
    StillUnexplained,
    TorqueDelay,
    TorqueFactor,
    TorqueUnit,
    Travel,
    UnexplainedTorque,
    UnseenFriction,
    UnseenZeros,
    Vector,
    Wrapped,
    ZeroTorques,
)
from hil.look.result import ChangedReading, Look, Row, TiedReading
from identification.estimators.delay_messages import undetermined_words
from identification.hypotheses.change_messages import part_words
from identification.hypotheses.joint_changes import (
    COUPLED,
    COUPLED_DRIVES,
    ORDERS,
    Meaning,
    Part,
)
from identification.signals.messages import (
    clock_lines,
    faults_words,
    jump_words,
    time_lines,
    times_words,
)
from identification.signals.row_faults import by_kind
from identification.signals.sample_times import SampleTimes, TimeBase
from identification.text import joined, number, percentage

_FACTS: Final[Mapping[Fact, str]] = {
    Fact.EVERY_JOINT_MOVES: "every joint moves",
    Fact.CONTINUOUS: "continuous, no wrap",
    Fact.WITHIN_LIMITS: "within the limits of the URDF",
    Fact.COMMANDED: "commanded",
    Fact.MEASURED: "measured",
    Fact.SLOPE: "position slope: unit, sign, order agree",
    Fact.SCALED_SLOPE: "scaled slope of the position",
    Fact.SLOPE_IN_DEGREES: "deg/s, positions in rad",
    Fact.SLOPE_OF_DEGREES: "rad/s, positions in deg",
    Fact.NEGATED_SLOPE: "negated",
    Fact.SLOPE_IN_REVOLUTIONS: "rev/min, positions in rad",
    Fact.NOT_EXAMINED: "not examined",
    Fact.TIMES_UNSEEN: "as stated, or twice or half as long",
    Fact.BACKWARDS: "rows that run backwards in time",
    Fact.ORDER_OF_URDF: "order of the URDF",
    Fact.SIGNS_OF_URDF: "as the URDF's axes",
    Fact.UNIT_AS_READ: "unit as read",
    Fact.ZERO_OF_URDF: "as the URDF",
    Fact.ZERO_STATED: "as in the map where the torque does not show it",
    Fact.UNCOUPLED: "uncoupled",
    Fact.WITH_GRAVITY: "torque with gravity",
    Fact.WITHOUT_GRAVITY: "torque without gravity",
    Fact.STATED_MOUNTING: "as stated, or upright",
    Fact.JOINT_SIDE: "joint side",
    Fact.JOINT_TORQUE: "joint side, a torque",
    Fact.LARGE_TORQUE: "larger than the arm needs",
    Fact.MOTOR_SIDE: "motor side (before the gears), or a current",
    Fact.SMALL_TORQUE: "too small for the arm with any gear",
    Fact.PAYLOAD_UNDETERMINED: "none stated; not determined",
    Fact.PAYLOAD_IN_LAST_BODY: "none stated; part of the last body",
    Fact.NO_TORQUE: "no torque and no motor current",
    Fact.SERVO_LOAD: "none; a servo's load or duty cycle",
    Fact.MOTOR_CURRENT: "none; motor currents",
    Fact.TORQUE_UNEXAMINED: "side, gravity, signs, joint order not examined",
    Fact.DELAY_UNDETERMINED: "not determined",
    Fact.NO_DELAY: "none",
    Fact.DELAY_OF_LOW_PASS: "none but that of the low-pass",
    Fact.NO_DELAY_SEEN: "none seen",
    Fact.NO_LOW_PASS: "none in the torque",
    Fact.NO_BODIES: "almost no rigid-body torque: a model was subtracted",
    Fact.RATE_OF_TORQUE: "torque rate (N·m/s)",
    Fact.NONE_FITS: "no tested explanation fits; the nearest are above",
    Fact.OTHER_ARM: "may not be the arm of the URDF",
}
_BASES: Final[Mapping[Basis, str]] = {
    Basis.ESTIMATED_TIMES: "stamps are not sample times; times estimated",
    Basis.MAP: "by the column map",
    Basis.GIVEN_RATE: "at the rate that was given",
    Basis.MESSAGE_TYPE: "by the message type",
    Basis.DATA_SET: "as in every LeRobot data set",
    Basis.USUAL_RATE: "that unit gives a usual rate",
    Basis.STATED_UNIT: "by name and stated unit",
    Basis.NAME_AND_RATE: "by the name; a usual rate",
    Basis.ROW_NAMES: "in the order of the names in the rows",
    Basis.NO_TURN: "no full-turn jumps",
    Basis.TURNS: "full-turn jumps",
    Basis.EVERY_ROW: "every row of every joint",
    Basis.POSITIONS_ALONE: "by the positions alone",
    Basis.LIMITS: "limits of the URDF",
    Basis.NAME: "by the name",
    Basis.NAME_OR_UNIT: "by name or unit",
    Basis.CHANNELS: "by the channels",
    Basis.ENCODER_NOISE: "broadband encoder noise",
    Basis.SMALL_NOISE: "small broadband noise",
    Basis.HIDDEN_BY_ROUNDING: "the steps hide noise, a filter or commands",
    Basis.NO_NOISE: "no noise above that frequency",
    Basis.NO_MOTION: "no joint moves",
    Basis.DRIVING_FRICTION: "otherwise friction would add energy",
    Basis.DISSIPATION: "friction dissipates energy in every joint",
    Basis.NOT_EXAMINED: "not examined",
    Basis.SIZE_UNTESTED: "size not tested: no masses, little weight",
    Basis.CELL: "by the cell",
    Basis.LAST_BODY_UNDETERMINED: "motion determines nothing of the last body",
    Basis.NO_GEOMETRY: "the torque shows them only with geometry",
    Basis.NO_ROW: "no usable row",
    Basis.NO_FILTER_BETTER: "no low-pass predicts it better",
    Basis.FREE_PARAMETERS: "free fit, no friction law",
    Basis.NO_BODIES: "friction torque does not show it",
    Basis.NO_GRAVITY: "torque without gravity does not show it",
    Basis.LITTLE_INERTIA: "too little inertia to tell",
    Basis.RATE: "a torque rate does not show it",
    Basis.INTEGRAL: "its integral follows the arm",
    Basis.INERTIA: "weight fits the URDF, inertia other times",
}
_STEPS: Final[Mapping[NextStep, str]] = {
    NextStep.STATE_UNIT_OR_GEARS: "state unit, sign or gears of both",
    NextStep.STATE_GRAVITY: "state --gravity X Y Z",
    NextStep.STATE_UNITS: "state --units deg, rad or range",
    NextStep.STATE_DRIVE: "state gear ratios or torque constants ([drive] of a map) if not",
    NextStep.STATE_TORQUE_CONSTANT: (
        "[drive] torque_constant of a map (N·m/A), or `hil torque-constants`"
    ),
    NextStep.NAME_JOINTS: "give the joint of each column",
    NextStep.ESTIMATE_DELAY: "--delay auto",
    NextStep.GIVE_URDF: "add --urdf ARM.urdf",
    NextStep.GIVE_URDF_OF_THIS_ARM: "give the URDF of this arm",
    NextStep.CHECK_COLUMNS: "check the order of the columns of both",
    NextStep.MOVE_ALL_OR_LOCK: "record a motion of all joints, or fix these (--locked NAME)",
    NextStep.MOVE_EACH_JOINT: "move the joints one by one",
    NextStep.REVERSE_THE_ROWS: "reverse the order of the rows, but not of the times",
    NextStep.STATE_RATE: "state the rate of the controller (--sample-rate HZ)",
    NextStep.PUSH_A_JOINT: "push one joint by hand and watch its torque",
    NextStep.COMPARE_A_POSTURE: (
        "compare a posture with the URDF's (viewer); [position] offset states it"
    ),
    NextStep.RECORD_ALL_TORQUE: "record the torque before a model is subtracted from it",
    NextStep.WEIGH_A_LOAD: "hold a known load with and without it (`hil torque-constants`)",
    NextStep.TURN_ONE_JOINT: "turn one joint alone and watch which angles change",
    NextStep.HOLD_STILL: "hold the arm still, stretched out, and read the torque",
    NextStep.RECORD_MEASURED: "record the measured ones",
    NextStep.RECORD_MEASURED_IF_ANY: "record the measured ones if the controller has them",
    NextStep.RECORD_TORQUE: "record it",
    NextStep.RECORD_FASTER: "record faster motion",
    NextStep.RECORD_PAYLOAD: "record with and without it (`hil payload`)",
    NextStep.IMPORT_COMMANDS: "`hil identify` finds their servo and friction",
    NextStep.CHECK_ENCODER: "check encoder and cable, or cut the recording before the jump",
    NextStep.CHECK_ENCODER_MOUNTING: "check its encoder and the coupling of its gear",
    NextStep.DESCRIBE_SPRING: "describe it in a cell file ([[robot.elements]]), if there is one",
    NextStep.CUT_THE_RECORDING: (
        "find out what changed (load, drive settings, temperature); identify each part by itself"
    ),
    NextStep.RECORD_COMMANDS: (
        "record the commanded positions as well: `hil identify` finds servo and friction by them"
    ),
    NextStep.ASK_FOR_POSITIONS: "ask for the raw encoder positions",
    NextStep.ASK_FOR_UNIT: "ask for the unit of the channel",
    NextStep.ASK_FOR_FILTER: "ask for the filter of the channel",
}
_MAX_JUMPS: Final = 3  # that a row names
_CHANGES: Final[Mapping[Meaning, str]] = {
    "torque sign": "torque negated",
    "position sign": "position negated",
    "axis sign": "position and torque negated",
    "torque order": "torques",
    "position order": "positions",
    "joint order": "joints",
    "degrees": "degrees",
    "radians": "radians",
    "no gravity": "without gravity",
    "angle sum": "plus",
    "angle difference": "minus",
    "drive sum": "plus",
    "drive difference": "minus",
}


class RowText(NamedTuple):
    """A row in words."""

    reading: str
    reason: str
    decide: str  #: what would decide it; "" if there is nothing
    evidence: str  #: the first reason


def row_text(row: Row) -> RowText:
    """Return a row in words."""
    decide = "" if row.decider is None else worded(row.decider)
    if isinstance(row.decider, OutsideLimits):
        decide = import_messages.remedy_of(row.decider)
    reasons = [*filter(None, (_reason(each, row.reading) for each in row.evidence))]
    return RowText(worded(row.reading), "; ".join(reasons), decide, next(iter(reasons), ""))


def _reason(evidence: Evidence, reading: Reading) -> str:
    """Return evidence in words; the second of two explanations is not repeated."""
    match evidence, reading:
        case NextBest(change, ratio), Either(change=second) if change == second:
            return f"the second: {ratio:.2f} × error"
    return worded(evidence)


def choice_text(choice: TiedReading) -> str:
    """Return one of several equally good readings in words."""
    if choice.reading is not None:
        return worded(choice.reading)
    return "motor current" if isinstance(choice.setting, MotorCurrents) else "torque of the motors"


def setting_text(setting: Setting | None) -> str:
    """Return the line of a column map, or the option, that states a reading; "" if none does."""
    return "" if setting is None else worded(setting)


def gravity_option(gravity: Vector) -> str:
    """Return the option that states a gravity."""
    return f"--gravity {' '.join(f'{part:g}' for part in gravity)}"


def fit_alike(choices: Sequence[TiedReading]) -> str:
    """Return how many readings fit equally well, in words."""
    return f"{'two' if len(choices) == 2 else 'three'} explanations fit equally well"


def as_json(look: Look) -> dict[str, Any]:
    """Return a look for programs."""
    questions = [
        [
            {
                "aspect": choice.aspect,
                "reading": choice_text(choice),
                "error": choice.error,
                "line": setting_text(choice.setting),
            }
            for choice in choices
        ]
        for choices in look.questions
    ]
    rows = [
        {
            "aspect": row.aspect,
            "reading": text.reading,
            "certainty": row.certainty.value,
            "reason": text.reason,
            "decide": text.decide,
        }
        for row, text in zip(look.rows, map(row_text, look.rows), strict=True)
    ]
    return {
        "source": look.source,
        "rows": rows,
        "questions": questions,
        "determines": [asdict(group) for group in look.groups],
        "map": look.map_text,
        "options": [] if look.gravity is None else [gravity_option(look.gravity)],
        "error": look.error,
    }


def described(change: ArmChange) -> str:
    """Return a change in words."""
    meaning = change.change.meaning
    if meaning == "mounting":
        text = f"mounted {change.change.name}"
    elif meaning == "zero":
        text = f"zero shifted by {np.degrees(change.change.size):.0f} deg"
    elif meaning == "scale":
        text = f"torque scaled by {number(1.0 + change.change.size)}"
    else:
        text = _CHANGES[meaning]
    if meaning in COUPLED:
        joint, other = _names(change)
        angle = f"recorded {joint} is {joint} {text} {other}"
        return f"{angle}, driven by rods or a belt" if meaning in COUPLED_DRIVES else angle
    if meaning in ORDERS:
        return f"{text} {_exchanged(change)}"
    if not change.change.joints:
        return text
    joints = change.change.joints
    all_of_them = len(joints) == len(change.joints)
    return f"{text}: {'all joints' if all_of_them else ', '.join(_names(change))}"


def _when(part: Part) -> str:
    if part.stop is None:
        return f"from {part.start:.3g} s on" if part.start > 0.0 else "throughout"
    return f"from {part.start:.3g} to {part.stop:.3g} s"


def _exchanged(change: ArmChange) -> str:
    found = change.change
    if len(found.joints) > 2 and found.order:
        names = change.joints
        pairs = zip(found.joints, found.order, strict=True)
        listing = ", ".join(f"{names[joint]} in place of {names[at]}" for joint, at in pairs)
        return f"in another order: {listing}"
    all_of_them = len(found.joints) == len(change.joints)
    return f"exchanged: {'all joints' if all_of_them else ', '.join(_names(change))}"


def _names(change: ArmChange) -> list[str]:
    return [change.joints[joint] for joint in change.change.joints]


def sentences(found: Sequence[Contradiction]) -> str:
    """Return contradictions of an arm in words."""
    return "; ".join(map(worded, found))


def _expected(size: SizeRatio | BeyondMasses) -> str:
    masses = "the URDF's masses" if size.by_masses else "arms of its reach"
    return f"what {masses} need"


# --- one function for each type


@singledispatch
def _worded(value: object) -> str:
    raise TypeError(f"{type(value).__name__} has no words in a row of a look")


def worded(value: object) -> str:
    """Return a reading, its evidence, or the step that decides it, in words."""
    return _worded(value)


@_worded.register
def _(fact: Fact) -> str:
    return _FACTS[fact]


@_worded.register
def _(basis: Basis) -> str:
    return _BASES[basis]


@_worded.register
def _(step: NextStep) -> str:
    return _STEPS[step]


@_worded.register
def _(clock: ClockReading) -> str:
    unit = "stamps of the messages; " if clock.of_messages else ""
    unit = f"{clock.unit}; " if clock.unit is not None else unit
    return f"{unit}{clock_lines(clock.base)[0]}"


@_worded.register
def _(base: TimeBase) -> str:
    return "; ".join(clock_lines(base)[1:])


@_worded.register
def _(rows: RowsReading) -> str:
    times = () if rows.times is None else filter(None, [times_words(rows.times)])
    jumps = [jump_words(jump) for jump in rows.jumps[:_MAX_JUMPS]]
    return "; ".join([*jumps, *map(faults_words, by_kind(rows.faults)), *times])


@_worded.register
def _(times: SampleTimes) -> str:
    return "; ".join(time_lines(times))


@_worded.register
def _(channels: Channels) -> str:
    return channels.channels if channels.unit is None else f"{channels.channels}: {channels.unit}"


@_worded.register
def _(order: JointOrder) -> str:
    return ", ".join(order.joints)


@_worded.register
def _(units: EpisodeUnits) -> str:
    return import_messages.worded(units)


@_worded.register
def _(joints: ZeroTorques) -> str:
    return f"zero throughout: {', '.join(joints.joints)}"


@_worded.register
def _(joints: NotSlopes) -> str:
    return f"not the slope of the position: {', '.join(joints.joints)}"


@_worded.register
def _(joints: StillJoints) -> str:
    return f"never move: {', '.join(joints.joints)}"


@_worded.register
def _(wrapped: Wrapped) -> str:
    return f"wrapped at a full turn, unwrapped: {wrapped.joints}"


@_worded.register
def _(positions: CoarsePositions) -> str:
    return f"in steps of {number(1e3 * positions.step, 2)} mrad"


@_worded.register
def _(positions: SmoothPositions) -> str:
    return f"low-passed below {number(positions.above, 2)} Hz, or commanded"


@_worded.register
def _(changes: Changes) -> str:
    return "; ".join(map(described, changes.changes))


@_worded.register
def _(change: ArmChange) -> str:
    return described(change)


@_worded.register
def _(found: FoundChange) -> str:
    explanation, change = found.explanation, found.explanation.change
    names = ", ".join(found.joints[joint] for joint in change.joints)
    size, half = explanation.size, number(explanation.half_interval, 2)
    when = "" if change.part is None else f" {_when(change.part)}"
    if size is None or explanation.rivals:
        return f"{part_words(change, found.joints)}{when}"
    match change.meaning:
        case "payload":
            more = "more" if size > 0.0 else "less"
            return f"load {number(abs(size))} ± {half} kg {more}{when}"
        case "drift":
            return f"zero of {names} drifts by {number(np.degrees(size), 2)} deg"
        case "scale":
            return f"torque of {names} {number(1.0 + size)} ± {half} times as large{when}"
        case _:
            return f"{change.meaning} of {names} {number(1.0 + size)} ± {half} times{when}"


@_worded.register
def _(error: CorrectedError) -> str:
    return f"{error.ratio:.2f} × error with it corrected"


@_worded.register
def _(rivals: RivalChanges) -> str:
    sets = (
        " with ".join(part_words(change, rivals.joints) for change in each)
        for each in rivals.changes
    )
    return f"or {', or '.join(sets)}"


@_worded.register
def _(error: PartError) -> str:
    return f"error there still {number(error.ratio, 2)} times that of the rest"


@_worded.register
def _(order: ColumnOrder) -> str:
    columns = {"torque": order.torque, "position": order.position}
    return "; ".join(
        f"{kind} columns belong to {', '.join(joints)}"
        for kind, joints in columns.items()
        if joints is not None
    )


@_worded.register
def _(unit: AngleUnit) -> str:
    return f"in {unit.unit}"


@_worded.register
def _(mounting: Mounting) -> str:
    return mounting.name


@_worded.register
def _(either: Either) -> str:
    return f"{worded(either.recorded)}, or {described(either.change)}"


@_worded.register
def _(zeros: UnseenZeros) -> str:
    return f"as the URDF; unseen in {', '.join(zeros.joints)}"


@_worded.register
def _(unit: TorqueUnit) -> str:
    return f"torque in {unit.unit}"


@_worded.register
def _(payload: StatedPayload) -> str:
    return f"{payload.mass:g} kg as stated"


@_worded.register
def _(error: ErrorAsRead) -> str:
    return f"other parts predict the torque to {number(100.0 * error.error, 2)} %"


@_worded.register
def _(delay: TorqueDelay) -> str:
    if delay.confirmed:
        return f"torque lags the position by {1e3 * delay.delay:.0f} ms"
    verb = "lags" if delay.delay > 0.0 else "leads"
    return f"torque perhaps {verb} position by {1e3 * abs(delay.delay):.0f} ms"


@_worded.register
def _(low_pass: LowPassedTorque) -> str:
    perhaps = "" if low_pass.confirmed else "perhaps: "
    return f"{perhaps}torque low-passed at {number(low_pass.bandwidth, 2)} Hz"


@_worded.register
def _(meaning: ChannelMeaning) -> str:
    if meaning.kind in ("position", "velocity") and meaning.unit_basis is UnitBasis.NUMBERS:
        return import_messages.basis_of(meaning)
    return import_messages.reason_of(meaning)


@_worded.register
def _(conclusion: Conclusion) -> str:
    return import_messages.sentence(conclusion)


@_worded.register
def _(unit: ConcludedUnit) -> str:
    return import_messages.source_of(unit)


@_worded.register
def _(unit: StatedUnit) -> str:
    return import_messages.source_of(unit)


@_worded.register
def _(fixed: FixedFingers) -> str:
    return import_messages.places_of(fixed)


@_worded.register
def _(arm: RecordedArm) -> str:
    return import_messages.links_of(arm)


@_worded.register
def _(outside: OutsideLimits) -> str:
    return import_messages.problem_of(outside)


@_worded.register
def _(travel: Travel) -> str:
    return f"{'at least' if travel.at_least else 'less than'} {number(travel.travel, 2)} rad or m"


@_worded.register
def _(found: Correlation) -> str:
    return f"correlation {found.correlation:.2f}"


@_worded.register
def _(slope: SlopeRatio) -> str:
    return f"slope over velocity {slope.ratio:.3f}"


@_worded.register
def _(slope: SlopeFactors) -> str:
    return ", ".join(f"{name} {number(factor, 4)}" for name, factor in slope.factors.items())


@_worded.register
def _(velocity: LateVelocity) -> str:
    return f"the velocity lags this slope by {1e3 * velocity.lag:.0f} ms"


@_worded.register
def _(error: ErrorRatio) -> str:
    return f"{error.ratio:.2f} × error ({-error.sigmas:.0f} std. errors)"


@_worded.register
def _(nearest: NextBest) -> str:
    return f"next best {nearest.ratio:.2f} × error: {described(nearest.change)}"


@_worded.register
def _(nearest: NearestZero) -> str:
    degrees = np.degrees(nearest.change.change.size)
    return f"{', '.join(_names(nearest.change))} {degrees:+.0f}°: {nearest.ratio:.2f} × error"


@_worded.register
def _(image: MirrorImage) -> str:
    return f"its mirror image moves the same way, with {described(image.change)}"


@_worded.register
def _(unseen: UnseenFriction) -> str:
    return f"no friction visible in {', '.join(unseen.joints)}"


@_worded.register
def _(explained: ErrorExplained) -> str:
    return f"to {number(100.0 * explained.error, 2)} % {_how(explained.how)}"


@_worded.register
def _(error: StillUnexplained) -> str:
    return f"but {percentage(error.error)} of the torque stays unexplained"


@_worded.register
def _(scales: OtherScales) -> str:
    if not scales.factors:
        return "the torque does not show the scale of most positions"
    factors = ", ".join(f"{joint} {number(factor, 2)}" for joint, factor in scales.factors)
    return f"the torque fits better with scaled positions: {factors}"


@_worded.register
def _(springs: SpringsAlike) -> str:
    joints = joined(springs.joints)
    return f"a spring or cable on {joints} instead leaves {springs.ratio:.2f} times its error"


@_worded.register
def _(found: NoBetter) -> str:
    changes = " or ".join(map(described, found.changes))
    return f"{changes} explains no more than chance"


@_worded.register
def _(rigid: RigidShare) -> str:
    return (
        f"at most {percentage(rigid.over_friction)} of the friction of a joint, and "
        f"{number(rigid.scale, 2)} times the torque of the URDF's masses"
    )


@_worded.register
def _(fit: FreeFit) -> str:
    return f"{number(fit.ratio, 2)} times the error of a fit with free masses, zeros and scales"


@_worded.register
def _(size: SizeRatio) -> str:
    return f"{number(size.ratio, 2)} times {_expected(size)}"


@_worded.register
def _(body: LastBody) -> str:
    return f"{body.determined} of {body.total} of its parameters known"


@_worded.register
def _(interval: DelayInterval) -> str:
    text = f"± {number(1e3 * interval.half, 1)} ms"
    if interval.delay is not None:
        return f"{1e3 * interval.delay:.1f} {text}"
    return f"{text}; predicts no better" if interval.unconfirmed else text


@_worded.register
def _(lag: LowPassLag) -> str:
    return f"it lags by {1e3 * lag.lag:.0f} ms, the torque by {1e3 * lag.delay:.0f} ms"


@_worded.register
def _(problem: DelayProblem) -> str:
    return undetermined_words(problem.estimate)


@_worded.register
def _(shape: FilterShape) -> str:
    kind = f"{'causal' if shape.causal else 'zero-phase'} order {shape.order}"
    if shape.confirmed:
        return f"{kind}, fits better"
    return f"{kind}; a delay or smooth friction reversal predicts as well"


@_worded.register
def _(found: BeyondRange) -> str:
    far = f"{np.degrees(found.excess):.0f}°" if found.turns else f"{number(found.excess, 2)} m"
    return f"{found.joint} moves {far} beyond its range"


@_worded.register
def _(found: BeyondSpeed) -> str:
    return f"{found.joint} moves at {number(found.ratio)} times its largest speed"


@_worded.register
def _(found: BeyondEffort) -> str:
    return f"the torque of {found.joint} reaches {number(found.ratio)} times its limit"


@_worded.register
def _(found: BeyondMasses) -> str:
    return f"the torque is {number(found.ratio, 2)} times {_expected(found)}"


@_worded.register
def _(lengths: OtherLengths) -> str:
    return (
        f"the torque fits links {number(lengths.factor, 2)} times as long (error "
        f"{percentage(lengths.error)}, with the URDF's {percentage(lengths.stated)})"
    )


@_worded.register
def _(times: OtherTimes) -> str:
    return f"recorded times are {times.factor:.3g} times the true times"


@_worded.register
def _(torque: UnexplainedTorque) -> str:
    return f"no masses explain {percentage(torque.error)} of the torque"


@_worded.register
def _(axes: OtherAxes) -> str:
    return f"the torque follows it only with other {' and '.join(axes.aspects)}"


@_worded.register
def _(state: MapKey) -> str:
    table, _, key = state.key.rpartition(".")
    return f'state [{table}] {key} = "..."'


@_worded.register
def _(entries: MapEntries) -> str:
    return "; ".join(
        f"[{key.rpartition('.')[0]}] {key.rpartition('.')[2]} = {_toml(value)}"
        if "." in key
        else f"{key} = {_toml(value)}"
        for key, value in entries.entries
    )


@_worded.register
def _(scaled: TorqueFactor) -> str:
    return f"check the unit; --columns 'torque=NAME*{number(scaled.factor, 2)}' applies the scale"


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return f"{value:g}"


@_worded.register
def _(option: GravityOption) -> str:
    return gravity_option(option.gravity)


@_worded.register
def _(torque: MotorTorque) -> str:
    return (
        f'[torque] side = "motor"; [drive] gear_ratio = {_about(torque)}; the maker\'s are right)'
    )


@_worded.register
def _(currents: MotorCurrents) -> str:
    return (
        "[motor_current] in place of [torque]; [drive] torque_constant = "
        f"{_about(currents)}, N·m/A with gears)"
    )


def _about(motors: MotorTorque | MotorCurrents) -> str:
    """Return the ratios of the joints, and the joints without one, in an open bracket."""
    each = ", ".join(number(ratio) for ratio in motors.ratios)
    if not motors.unseen or len(motors.unseen) == len(motors.ratios):
        return f"[{each}] (about"
    return f"[{each}] (about; {', '.join(motors.unseen)} as the others"


# --- what an identification says of a log that it has looked at


@import_messages.worded.register
def _(explained: ExplainedTorque) -> str:
    return f"torque: follows the arm of the URDF, {_how(explained)}"


def _how(explained: ExplainedTorque) -> str:
    parts = (
        f"low-passed at {number(explained.low_pass, 2)} Hz" if explained.low_pass else "",
        "with rotors heavier than the links" if explained.heavy_rotors else "",
        f"with a spring or balancer on {joined(explained.springs)}" if explained.springs else "",
    )
    return ", ".join(filter(None, parts))


@import_messages.worded.register
def _(none: NoJointTorque) -> str:
    reasons = f"{_why_no_torque(none)}; {_as_a_torque(none)}"
    return f"torque: ignored, as it looks like the load or duty cycle of a servo: {reasons}"


@_worded.register
def _(none: NoJointTorque) -> str:
    return f"{_why_no_torque(none)}; {_as_a_torque(none)}"


def _why_no_torque(none: NoJointTorque) -> str:
    if none.unexplained is not None:
        return f"no masses explain {percentage(none.unexplained)} of it"
    if none.ratio is not None:
        return f"it is {number(none.ratio, 2)} times the torque that the URDF's masses need"
    if none.is_load:
        return "its name says so"
    return "it is never negative, although the joints move in both directions"


def _as_a_torque(none: NoJointTorque) -> str:
    factor = "" if none.ratio is None else f"*{number(1.0 / none.ratio, 2)}"
    return f"to use it anyway, name it: --columns 'torque=NAME{factor}'"


@import_messages.worded.register
def _(given: ReadAsGiven) -> str:
    return (
        f"torque: read as given, although {percentage(given.error)} of it stays unexplained: "
        f"{worded(given.no_better)}"
    )


@import_messages.worded.register
def _(arm: DoubtfulArm) -> str:
    return f"warning: the URDF may describe another arm: {sentences(arm.found)}"


@import_messages.worded.register
def _(changed: ChangedReading) -> str:
    text = row_text(changed.row)
    reason = (
        f"as in {changed.source}, which has the same columns" if changed.source else text.reason
    )
    return f"{changed.row.aspect}: {text.reading}, inferred; {reason}"


@import_messages.worded.register
def _(time: DoubtfulTime) -> str:
    return (
        f"warning: recorded times are {time.factor:.3g} times the true times: the torque's inertia"
        f" fits other times, its weight fits the URDF; {_STEPS[NextStep.STATE_RATE]}"
    )
