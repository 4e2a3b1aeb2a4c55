"""Sentences about the conclusions of an import; only this module makes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import singledispatch
from typing import Final

from hil.archive import Findings
from hil.importers.conclusions import (
    Alternation,
    ChannelMeaning,
    ClockRestarted,
    ConcludedUnit,
    Conclusion,
    ConstantPositions,
    ConstantTorque,
    CopiedCommands,
    CounterContinued,
    DifferentCommands,
    EncoderTicks,
    EpisodeUnits,
    Examined,
    Excerpt,
    FastJoint,
    FixedFingers,
    JointOrder,
    JointRange,
    KnownCommands,
    LargeTorque,
    LeftOut,
    LittleMotion,
    LockedJoints,
    MappedUnit,
    MergedMessages,
    MissingNumbers,
    NameBasis,
    NotCommands,
    NoTorque,
    Omitted,
    OneTimeBase,
    OtherClock,
    OutsideLimits,
    PartialVelocity,
    RecordedArm,
    RecordedClock,
    RowCounter,
    SameStamp,
    ScaledVelocity,
    SecondPublisher,
    SortedSamples,
    StatedUnit,
    StoppedJoint,
    TooFewSamples,
    TorqueSize,
    UnitBasis,
    UnitsFrom,
    UnrelatedVelocity,
    UnusedChannels,
    UnusualRate,
    VelocityOrder,
    Within,
    ZeroTorque,
)
from hil.importers.units import UNITS
from identification.signals.messages import clock_lines
from identification.text import number

_BASIS: Final[Mapping[NameBasis, str]] = {
    NameBasis.NAME: "by the name",
    NameBasis.JOINT: "by the URDF's joint in the name",
    NameBasis.UNIT: "by the unit",
    NameBasis.WORD: "by a word in the name",
    NameBasis.WORDS: "by a word in the names, joints in the order of the log",
    NameBasis.FILE: "by the file name",
    NameBasis.OPTION: "as given with --columns",
    NameBasis.MESSAGE: "by the field of the joint states; joints by their names",
}
_OMITTED: Final[Mapping[Omitted, str]] = {
    Omitted.ZERO_TIMES: "leading rows with time 0",
    Omitted.NO_STAMPS: "leading messages without a stamp",
    Omitted.HEADERS: "repeated header lines",
    Omitted.EMPTY_LINES: "empty lines between the rows",
    Omitted.CUT_ROW: "truncated last row",
    Omitted.SOME_JOINTS: "messages with only some of the joints",
}
_MAP_CHECK: Final = "check unit, sign and zero in the column map"


def sentence(conclusion: Conclusion) -> str:
    """Return a conclusion in words, without full stop."""
    return worded(conclusion)


def as_findings(examined: Examined) -> Findings:
    """Return findings in words, as an archive stores them."""
    found = tuple(map(sentence, examined.found))
    return Findings(lines=found, warnings=tuple(map(sentence, examined.warnings)))


@singledispatch
def worded(conclusion: Conclusion) -> str:
    """Return the words of a type of conclusion; other rooms register theirs."""
    raise TypeError(f"{type(conclusion).__name__} has no words")


@worded.register
def _(meaning: ChannelMeaning) -> str:
    return f"{meaning.channels}: {meaning.kind}, {reason_of(meaning)}"


def reason_of(meaning: ChannelMeaning) -> str:
    """Return unit and reason of the meaning of channels."""
    basis = meaning.basis
    if basis is NameBasis.READY_MAP:
        return f"{meaning.unit}, as in the ready map {meaning.origin}"
    if basis is NameBasis.COMMANDS:
        return f"rad (m of sliding joints), {meaning.origin}"
    if basis is NameBasis.MESSAGE:
        return f"{meaning.unit}, {_BASIS[basis]}"
    if basis is NameBasis.OPTION:
        return _BASIS[basis]
    return f"{_BASIS[basis]}; {_unit_of(meaning)}"


def basis_of(meaning: ChannelMeaning) -> str:
    """Return the source of the channels' quantity."""
    return _BASIS[meaning.basis]


def _unit_of(meaning: ChannelMeaning) -> str:
    if meaning.unit_basis is UnitBasis.LOG:
        return f"{meaning.unit} as the log states"
    if meaning.unit_basis is UnitBasis.CUSTOM:
        return f"{next(iter(UNITS[meaning.kind]))} assumed"
    return "unit inferred from the numbers"


@worded.register
def _(unused: UnusedChannels) -> str:
    return f"not used: {', '.join(unused.channels)}"


@worded.register
def _(order: JointOrder) -> str:
    return f"joints in the order of the names in the rows: {', '.join(order.joints)}"


_UNITS_FROM: Final[Mapping[UnitsFrom, str]] = {
    UnitsFrom.OPTION: "as stated (--units)",
    UnitsFrom.ENCODER: "as the steps are an encoder's",
    UnitsFrom.CALIBRATION: "as degrees would leave the calibrated range",
    UnitsFrom.BEYOND_RANGE: "as some numbers exceed 100",
    UnitsFrom.BEYOND_LIMITS: "as degrees would leave the limits of the URDF",
}


@worded.register
def _(units: EpisodeUnits) -> str:
    names = {
        "deg": "in degrees",
        "rad": "in radians",
        "range": "-100 to 100 of the calibrated range",
    }
    gripper = "" if units.unit == "rad" else "; a gripper 0 to 100"
    return f"joints {names[units.unit]}, {_UNITS_FROM[units.basis]}{gripper}"


@worded.register
def _(fixed: FixedFingers) -> str:
    return f"{', '.join(fixed.positions)}: fixed {places_of(fixed)}"


def places_of(fixed: FixedFingers) -> str:
    """Return where the joints of a gripper are fixed, and why."""
    places = [f"{number(place)} {fixed.units[name]}" for name, place in fixed.positions.items()]
    if len(set(places)) == 1:
        places = places[:1]  # of all
    return f"at {', '.join(places)}: a gripper that was not recorded"


@worded.register
def _(arm: RecordedArm) -> str:
    return f"arm: {arm.arm}, {links_of(arm)}"


def links_of(arm: RecordedArm) -> str:
    """Return between which links the recorded arm lies, and by what."""
    reason = "names" if arm.by_names else "number"
    return f"between {arm.links}, by the {reason} of the recorded joints; all others are fixed"


@worded.register
def _(unit: MappedUnit) -> str:
    return f"{unit.kind}: the map says {unit.unit}, the file {unit.stated}; used: {unit.unit}"


@worded.register
def _(unit: StatedUnit) -> str:
    return f"{unit.kind}: {source_of(unit)}"


@worded.register
def _(unit: ConcludedUnit) -> str:
    return f"{unit.kind}: {source_of(unit)}"


def source_of(unit: StatedUnit | ConcludedUnit) -> str:
    """Return the source of a quantity's unit."""
    if isinstance(unit, StatedUnit):
        return f"in {unit.unit}, as the file states"
    none = "no unit is stated; read as"
    if isinstance(unit, EncoderTicks):
        return (
            f"{none} encoder ticks ({unit.ticks} per turn, zero at {unit.middle}): within the "
            "limits of the URDF, which radians and degrees would exceed"
        )
    if unit.kind == "time":
        return f"{none} {unit.unit}, which gives a usual rate"
    if unit.kind == "velocity":
        return f"{none} degrees per second, which match the slope of the positions"
    return f"{none} degrees: within the limits of the URDF, where radians would be far outside"


@worded.register
def _(left_out: LeftOut) -> str:
    return f"dropped: {_OMITTED[left_out.what]} ({left_out.count})"


@worded.register
def _(excerpt: Excerpt) -> str:
    return (
        f"used {excerpt.count} of {excerpt.total} rows: {excerpt.stretches} stretches of motion "
        "spread over the whole recording (`hil import log` reads every row)"
    )


@worded.register
def _(missing: MissingNumbers) -> str:
    return (
        f"dropped: rows with a missing number ({missing.count} of {missing.total}, "
        f"the first after {missing.before} rows)"
    )


@worded.register
def _(continued: CounterContinued) -> str:
    times = f"{continued.times} times" if continued.times > 1 else "once"
    return f"time: {continued.clock} wrapped {times} and was unwrapped"


@worded.register
def _(swapped: SortedSamples) -> str:
    many = swapped.count > 1
    count = f"{swapped.count} {swapped.sample}s" if many else f"one {swapped.sample}"
    of_log = "time: " if swapped.sample == "row" else ""
    return f"{of_log}{count} out of order: sorted by stamp"


@worded.register
def _(publisher: SecondPublisher) -> str:
    where = ", ".join(number(angle) for angle in publisher.pose) or "0"
    return (
        f"dropped {publisher.count} of {publisher.total} {publisher.sample}s that come from a"
        f" second publisher: all their positions are {where}"
    )


@worded.register
def _(merged: MergedMessages) -> str:
    how = (
        "with the same stamps" if merged.same_stamps else "interpolated to the stamps of the first"
    )
    kinds = " and ".join(f"({', '.join(joints)})" for joints in merged.groups)
    return f"merged from separate messages, {how}: {kinds}"


@worded.register
def _(restarted: ClockRestarted) -> str:
    return (
        f"the clock restarts {restarted.parts - 1} times: read as {restarted.parts} motions "
        "with a second between them"
    )


@worded.register
def _(copied: CopiedCommands) -> str:
    remedy = "record the measured positions too"
    if copied.measured:
        options = " or ".join(f"--columns 'position={name}'" for name in copied.measured)
        remedy = f"if they are measured, choose {options}"
    return (
        f"the positions equal {copied.commands} bit for bit: they are commands, and a real arm "
        f"lags behind its commands; {remedy}"
    )


@worded.register
def _(counter: RowCounter) -> str:
    return (
        f"{counter.column} counts rows, and the map reads it in {counter.unit}: right only if the "
        f"controller's cycle is one {counter.unit}; otherwise state sample_rate and no [time]"
    )


@worded.register
def _(base: OneTimeBase) -> str:
    counts = ", ".join(f"{name} {count}" for name, count in base.counts.items())
    some = f"; dropped {base.left_out} of these without a neighbour" if base.left_out else ""
    return (
        f"quantities with their own time stamps ({counts} samples) were interpolated to the times "
        f"of the {base.base.replace('_', ' ')}{some}"
    )


@worded.register
def _(clock: OtherClock) -> str:
    return (
        f"commands have another clock: shifted by {clock.offset:.3f} s, where commanded and "
        f"measured speeds match best; the delay between them is then unknown"
    )


@worded.register
def _(velocity: PartialVelocity) -> str:
    joints = ", ".join(velocity.joints)
    return f"velocity: not used, as no message has a value for {joints}"


@worded.register
def _(commands: NotCommands) -> str:
    return f"{commands.topic}: {commands.problem}; not used as commanded positions"


@worded.register
def _(different: DifferentCommands) -> str:
    first, second = different.topics
    remedy = f"choose one: --command-topic {first} or {second}"
    return f"{first} and {second} carry different commands, so neither is used; {remedy}"


@worded.register
def _(known: KnownCommands) -> str:
    return f"commanded_position: known at {known.count} of {known.total} samples"


@worded.register
def _(few: TooFewSamples) -> str:
    return f"{few.count} samples"


@worded.register
def _(locked: LockedJoints) -> str:
    held = [
        f"{name} at {number(place, 4)} {locked.units[name]}"
        for name, place in locked.positions.items()
    ]
    return f"locked: {', '.join(held)}"


@worded.register
def _(clock: RecordedClock) -> str:
    return f"time: {'; '.join(clock_lines(clock.base))}"


@worded.register
def _(found: JointRange) -> str:
    text = f"{found.joint}: {found.low:.3f} .. {found.high:.3f} {'rad' if found.turns else 'm'}"
    if found.turns:
        text += f" ({math.degrees(found.low):.0f} .. {math.degrees(found.high):.0f} deg)"
    if found.limits is not None:
        lower, upper = found.limits
        text += f", limits of the URDF {lower:.3f} .. {upper:.3f}"
    return text


@worded.register
def _(unusual: UnusualRate) -> str:
    return f"{number(unusual.rate)} samples per second are unusual: check the unit of the time"


@worded.register
def _(same: SameStamp) -> str:
    return (
        f"samples with the same time stamp are up to {same.apart:.3g} {same.unit} apart"
        f" ({same.count} such stamps): two sources write this log, or its clock stood still or"
        " ticks much more slowly than it samples"
    )


@worded.register
def _(alternation: Alternation) -> str:
    return (
        f"samples alternate between two sequences up to {number(alternation.apart)}"
        f" {alternation.unit} apart ({alternation.count} samples): two sources write these joints,"
        " one of them with other or older samples; record only one"
    )


@worded.register
def _(outside: OutsideLimits) -> str:
    return f"{problem_of(outside)}; {remedy_of(outside)}"


def problem_of(outside: OutsideLimits) -> str:
    """Return how positions leave the limits of the URDF."""
    ranges = ", ".join(
        f"{name}: {number(low)} .. {number(high)}" for name, (low, high) in outside.ranges.items()
    )
    some = f"{_percent(outside.fraction)} of the rows leave"
    share = "every row leaves" if outside.fraction == 1.0 else some
    return f"as mapped, {share} the limits of the URDF ({ranges})"


def remedy_of(outside: OutsideLimits) -> str:
    """Return what would keep positions within the limits of the URDF."""
    if outside.within is Within.DEGREES:
        entry = '[position] unit = "deg" in the column map'
        return f"read as degrees, none would: write {entry}"
    if outside.within is Within.ORDER:
        order = ", ".join(outside.order)
        return (
            f"with the columns in the order {order}, none would: check the joint order, or "
            f"{_MAP_CHECK}"
        )
    return _MAP_CHECK


def _percent(share: float) -> str:
    """Return a share below 1 that does not read as all."""
    return f"{number(min(100.0 * share, 99.9))} %"


@worded.register
def _(little: LittleMotion) -> str:
    return f"no joint moves further than {_travel(little)}: check the unit of the positions"


def _travel(little: LittleMotion) -> str:
    if not little.turns:
        return f"{number(little.travel, 2)} m"
    as_degrees = number(math.degrees(little.travel), 2)
    return f"{number(little.travel, 2)} rad ({as_degrees} if the log is in degrees)"


@worded.register
def _(fast: FastJoint) -> str:
    return (
        f"{fast.joint} would move at {number(fast.speed)} rad/s (or m/s), its limit in the URDF is "
        f"{number(fast.limit)}: check the units of position (degrees?) and time (milliseconds?)"
    )


@worded.register
def _(other: VelocityOrder) -> str:
    return (
        "the velocities have another order than the positions: as mapped they differ from the "
        f"slopes by {other.deviation:.0f} %, in the order {', '.join(other.order)} by "
        f"{other.least:.0f} %: list both kinds of columns in the same order"
    )


@worded.register
def _(velocity: UnrelatedVelocity) -> str:
    return (
        f"the velocity of {velocity.joint} does not follow its position (correlation "
        f"{velocity.correlation:.2f}): check the order of the joints"
    )


@worded.register
def _(scaled: ScaledVelocity) -> str:
    factors = ", ".join(
        f"{number(factor, 4)} for {name}" for name, factor in scaled.factors.items()
    )
    return (
        f"the velocity is the slope of the position times {factors}: check the units, signs "
        "and gears of both, and the time unit"
    )


@worded.register
def _(none: NoTorque) -> str:
    use = "nothing can be identified from it"
    if none.is_commanded:
        use = "servo and friction are identified, bodies cannot be"
    return f"the log has neither torque nor motor current: {use}"


@worded.register
def _(zero: ZeroTorque) -> str:
    return f"the torque of {zero.joint} is zero throughout"


@worded.register
def _(constant: ConstantTorque) -> str:
    return (
        f"the torque of {constant.joint} is {number(constant.torque)} throughout, although it"
        " moves: it was not measured"
    )


@worded.register
def _(large: LargeTorque) -> str:
    return (
        f"the torque of {large.joint} reaches {number(large.torque)} {large.unit}, its limit in the"
        f" URDF is {number(large.limit)} {large.unit}: check its unit and side (motor or joint)"
    )


@worded.register
def _(size: TorqueSize) -> str:
    reference = (
        "the torques of the URDF's masses" if size.by_masses else "the effort limits of the URDF"
    )
    listing = ", ".join(f"{name}: {number(ratio, 2)}" for name, ratio in size.ratios.items())
    which = "large" if size.too_large else "small"
    start = f"the torques are too {which} for this arm: measured over {reference} {listing}; check "
    if size.too_large:
        return start + (
            "their unit (mN·m read as N·m would be 1000 times too large), side (motor or joint) "
            "and the masses of the URDF"
        )
    return start + (
        "their unit (N·m read as mN·m would be 1000 times too small) and side (motor or joint)"
    )


@worded.register
def _(stopped: StoppedJoint) -> str:
    return (
        f"the position of {stopped.joint} stays the same from {stopped.time:.3f} s to the end "
        f"while its command moves by {stopped.travel:.3g} {stopped.unit}: it is assumed to stand "
        "still; if it moved, its encoder failed"
    )


@worded.register
def _(constant: ConstantPositions) -> str:
    return (
        f"the position of {', '.join(constant.joints)} is the same in all {constant.samples}"
        " samples: it is assumed to stand still; if it moved, its encoder or its column is wrong"
    )
