"""Rows of a look about the torque: signs, order, zero, gravity, size, delay, low-pass."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from hil.base.safe_input import parse_toml
from hil.cell import Cell
from hil.cell.nominal import nominal_of
from hil.importers.channels import channels_of
from hil.importers.conclusions import Certainty
from hil.importers.log_files import LogFiles
from hil.look.corrected_map import entries_of
from hil.look.readings import (
    AngleUnit,
    ArmChange,
    Basis,
    Changes,
    ColumnOrder,
    Decider,
    DelayInterval,
    DelayProblem,
    Either,
    ErrorAsRead,
    ErrorExplained,
    ErrorRatio,
    Evidence,
    Fact,
    FilterShape,
    FreeFit,
    GravityOption,
    LastBody,
    LowPassedTorque,
    LowPassLag,
    MapEntries,
    MirrorImage,
    MotorCurrents,
    MotorTorque,
    Mounting,
    NearestZero,
    NextBest,
    NoBetter,
    NoJointTorque,
    OtherScales,
    OtherTimes,
    Reading,
    RigidShare,
    Setting,
    SizeRatio,
    SpringsAlike,
    StatedPayload,
    StillUnexplained,
    TorqueDelay,
    TorqueFactor,
    TorqueUnit,
    UnseenFriction,
    UnseenZeros,
    Vector,
)
from hil.look.readings import NextStep as Decide
from hil.look.result import Aspect, ParameterGroup, Row, TiedReading
from identification.estimators.delay import DelayEstimate
from identification.estimators.prior import (
    DETERMINED_STD_RATIO,
    body_prior,
    fit_posterior,
    nominal_ratio,
)
from identification.factor.factor import Factor
from identification.hypotheses.diagnosis import (
    RigidTorque,
    TorqueDiagnosis,
    rigid_torque,
    unexplained_share,
)
from identification.hypotheses.inertia_scale import shows_times
from identification.hypotheses.joint_changes import (
    COUPLED,
    ORDERS,
    SIGNS,
    UNITS,
    Axes,
    Change,
    Meaning,
)
from identification.hypotheses.mirror_images import SignRival, Signs
from identification.hypotheses.readings import Readings, Step
from identification.hypotheses.scores import (
    EXPLAINED_ERROR,
    SEPARATE_SIGMAS,
    Score,
    is_backwards,
)
from identification.hypotheses.torque_low_pass import TorqueLowPass
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.motion import Motion
from identification.model.robot import STANDARD_GRAVITY, RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Samples
from identification.validation.nominal_scale import nominal_scale

MOUNTINGS: Final[Mapping[str, Vector]] = {
    "": (0.0, 0.0, 0.0),
    "upside down": (0.0, 0.0, 9.81),
    "on a wall, +x down": (9.81, 0.0, 0.0),
    "on a wall, -x down": (-9.81, 0.0, 0.0),
    "on a wall, +y down": (0.0, 9.81, 0.0),
    "on a wall, -y down": (0.0, -9.81, 0.0),
    "upright": (0.0, 0.0, -9.81),
}
"""Gravity in the base frame by mounting [m/s²]; "" for a torque without gravity."""
_ASPECTS: Final[Mapping[Meaning, Aspect]] = {
    **dict.fromkeys(SIGNS, "signs"),
    **dict.fromkeys(ORDERS, "order"),
    **dict.fromkeys(UNITS, "angle unit"),
    **dict.fromkeys(COUPLED, "coupling"),
    "zero": "zero",
    "scale": "scale",
    "no gravity": "gravity",
    "mounting": "mounting",
}
"""Row of the table for a change."""
_OPEN_SIGMAS_SHARE: Final = 0.5
_MAX_CHOICES: Final = 3
# error ratio of readings of which the recording does not choose one
_ALIKE_ERROR_RATIO: Final = 1.02
_OTHER_UNIT_FACTOR: Final = 3.0  # factor beyond which the masses of a URDF do not explain a torque
_SAME_LAG: Final = 0.2  # of the lag of a low-pass, by which a delay that is this lag differs
_THOUSAND: Final = 1000.0
_MAX_GEAR_RATIO: Final = 1000.0  # motor turns per joint turn; built are 1 to some 300
_MAX_GEAR_RATIO_SPREAD: Final = 10.0  # factor between the ratios of a joint and of the arm
# posterior over prior deviation of a parameter that the recording hardly moves
_WEAK_STD_RATIO: Final = 0.9
# Masses of arms over the cube of their reach, kg/m³: 11 (Gen3) to 216 (TX40).
_ARM_DENSITY: Final = 45.0
_DENSITY_SPREAD: Final = 3.0  # factor of one standard deviation


def tilt_name(angle: float) -> str:
    """Return the name of a mounting whose gravity is at an angle [rad] to the declared one."""
    return f"tilted by {np.degrees(angle):.0f}°"


@dataclass(frozen=True)
class Size:
    """Measured torque over the torque that the arm needs.

    Attributes:
        factor: of the whole arm; None where neither masses nor weight say.
        by_masses: whether from the masses of the URDF, else from usual masses for its reach.
        of_joints: the factor of each joint, with sign; None where the motion does not show it.
    """

    factor: float | None
    by_masses: bool
    of_joints: tuple[float | None, ...] = ()

    @classmethod
    def of(cls, cell: Cell, model: RobotModel, samples: Samples) -> Size:
        """Compare samples with the nominal arm, or with the weight of arms of its reach.

        The model is that of the cell, or of another gravity, which has other base parameters.
        """
        nominal = nominal_of(mounted(cell, tuple(model.gravity)))
        if nominal is None:
            return cls(_by_reach(model, samples), by_masses=False)
        nominal_torque = nominal_scale(model, nominal.values, [samples])
        scale = nominal_torque.scale
        if not np.isfinite(scale).any():
            of_all, std = nominal_ratio(model, Factor.of(model, samples))
            if std < of_all / SEPARATE_SIGMAS:
                return cls(of_all, by_masses=True)
            return cls(_by_reach(model, samples), by_masses=True)
        # A scale that may be zero has no order of magnitude.
        known = nominal_torque.nonzero
        if not known.any():
            return cls(None, by_masses=True)
        factor = float(np.median(np.abs(scale[known])))
        known &= np.abs(np.log(np.abs(scale, where=known, out=np.ones(len(scale))) / factor)) < (
            np.log(_MAX_GEAR_RATIO_SPREAD)
        )
        of_joints = tuple(
            float(each) if is_known else None for each, is_known in zip(scale, known, strict=True)
        )
        return cls(factor, by_masses=True, of_joints=of_joints)

    @property
    def is_off(self) -> bool:
        """Whether the torque has another order of magnitude than the arm needs."""
        if self.factor is None:
            return False
        limit = _OTHER_UNIT_FACTOR if self.by_masses else _DENSITY_SPREAD**3
        return not 1.0 / limit < self.factor < limit

    @property
    def may_be_geared(self) -> bool:
        """Whether it may be too small because it acts on motors, behind gears."""
        return self.is_off and 1.0 / _MAX_GEAR_RATIO < (self.factor or 1.0) < 1.0

    @property
    def is_thousand(self) -> bool:
        """Whether it is about 1000 or 1/1000, the factor of units."""
        if self.factor is None:
            return False
        return bool(abs(abs(np.log(self.factor)) - np.log(_THOUSAND)) < np.log(2.0))


def sides_alike(
    size: Size, joints: Sequence[str], gears: Sequence[Change] = ()
) -> tuple[TiedReading, ...]:
    """Return what a torque too small for the joint side may be; empty if it is not too small.

    Args:
        size: of the torque.
        joints: names of all.
        gears: changes of scales and signs that the gears explain.
    """
    if not size.may_be_geared or size.is_thousand:
        return ()
    torque = _motor_torque(size, joints, gears)
    settings = (torque, MotorCurrents(torque.ratios, torque.unseen))
    return tuple(TiedReading("side", None, None, setting) for setting in settings)


def _motor_torque(size: Size, joints: Sequence[str], gears: Sequence[Change]) -> MotorTorque:
    """Return the gear ratios with which a torque of motors has the size that the arm needs."""
    factors = size.of_joints or (None,) * len(joints)
    axes = Axes.of(gears, len(joints))
    of_joints = axes.torque_sign / axes.torque_scale
    ratios = tuple(
        float(each) / (seen or size.factor or 1.0)
        for each, seen in zip(of_joints, factors, strict=True)
    )
    unseen = tuple(
        name
        for name, seen, each in zip(joints, factors, of_joints, strict=True)
        if seen is None and each == 1.0
    )
    return MotorTorque(ratios, unseen)


def mounted(cell: Cell, gravity: tuple[float, ...]) -> Cell:
    """Return a cell with another gravity in the base frame [m/s²]."""
    robot = cell.file.robot.model_copy(update={"gravity": gravity})
    return replace(cell, file=cell.file.model_copy(update={"robot": robot}))


def _by_reach(model: RobotModel, samples: Samples) -> float | None:
    """Return the weight in the torque over the weight of an arm of this reach, or None."""
    if not np.any(model.gravity):
        return None
    factor = Factor.by_time(model, samples)
    values = fit_posterior(model, factor, body_prior(model, factor).gaussian, 5.0).estimate.values
    rigid = np.where(model.friction_columns, 0.0, values)
    weight = np.ptp(model.torque(rigid, Motion.at_rest(samples.motion.position)), axis=0).max()
    reach = float(np.linalg.norm(model.chain.translation[1:], axis=1).sum())
    if not weight > 0.0 or not reach > 0.0:
        return None
    mass = _ARM_DENSITY * reach**3
    return float(weight / (0.3 * mass * -STANDARD_GRAVITY[2] * reach))


@dataclass(frozen=True, eq=False)
class TorqueFindings:
    """What the torque shows about a recording.

    Attributes:
        torque: what it is as recorded, as a whole.
        map_text: the column map of the import; None for a bag.
        files: the recording, parsed.
        gravities: that were tried, by mounting, "" for none [m/s²].
        is_side_open: whether nothing states that the torque acts on the joints, not the motors.
        explained: how a low-pass, rotors or springs explain the torque as read at least as well as
            the changes that were found, none of which is then certain; None if they do not.
    """

    cell: Cell
    recording: Recording
    torque: TorqueDiagnosis
    readings: Readings
    axes: Axes
    map_text: str | None
    source: Path
    files: LogFiles
    gravities: Mapping[str, Vector]
    is_side_open: bool = True
    explained: ErrorExplained | None = None

    @cached_property
    def size(self) -> Size:
        """Measured torque over the torque that the arm needs."""
        return Size.of(self.cell, self.readings.model, self.readings.samples)

    @cached_property
    def rigid(self) -> RigidTorque:
        """Share of the torque that bodies cause."""
        return rigid_torque(self.readings.model, self.readings.samples)

    @cached_property
    def is_backwards(self) -> bool:
        """Whether the rows run backwards in time."""
        readings = self.readings
        return is_backwards(readings.model, readings.samples, readings.score)

    @property
    def _shows_times(self) -> bool:
        """Whether the torque distinguishes the times from others."""
        readings = self.readings
        return shows_times(readings.model, readings.samples, readings.score)

    def rows(self, groups: Sequence[ParameterGroup] = ()) -> list[Row]:
        """Return the rows of the table; `groups` are the parameters that are determined."""
        rows = [
            self._order(),
            self._signs(),
            self._unit(),
            self._zero(),
            *self._scale(),
            self._coupling(),
            self._gravity(),
            self._mounting(),
            self._size(),
            self._payload(groups),
        ]
        if self.is_backwards:
            backwards = (Basis.DRIVING_FRICTION,)
            step = Decide.REVERSE_THE_ROWS
            likely = Certainty.LIKELY
            row = Row("time", Fact.BACKWARDS, likely, backwards, step, is_fault=True)
            rows.insert(0, row)
        if self.torque.time is not None:
            rows.insert(0, _other_times(self.torque.time))
        elif not self._shows_times:
            little = (Basis.LITTLE_INERTIA,)
            step = Decide.STATE_RATE
            rows.insert(0, Row("time", Fact.TIMES_UNSEEN, Certainty.UNDETERMINED, little, step))
        if self.rigid.is_nothing or self.torque.is_rate:
            rest = [row for row in rows if row.aspect != "side"]
            bodies, basis = _RATE, Basis.RATE
            if self.rigid.is_nothing:
                bodies, basis = self._no_bodies(), Basis.NO_BODIES
            rows = [bodies, *(_says_nothing(row, basis) for row in rest)]
        error = self.readings.score.overall
        if self.fits_badly:
            beside = FreeFit(self.readings.adequacy.ratio)
            rows.append(Row("explanation", Fact.NONE_FITS, Certainty.UNDETERMINED, (beside,)))
        if error > EXPLAINED_ERROR:
            rows = [no_longer_certain(row, StillUnexplained(error)) for row in rows]
        as_read = ErrorAsRead(
            unexplained_share(self.readings.model, self.readings.samples, self.readings.score)
        )
        evidence: tuple[Evidence, ...] = (Basis.FREE_PARAMETERS,)
        if self.no_better is not None:
            evidence = (*evidence, self.no_better)
        if self.explained is not None:
            evidence = (*evidence, self.explained)
        rows.append(Row("as read", as_read, Certainty.CERTAIN, evidence))
        return rows

    @property
    def other_scales(self) -> OtherScales | None:
        """Return why the unit of positions is undetermined; None if it is stated or shown."""
        scales = self.readings.scales
        if scales is None or scales.agrees:
            return None
        names = self.cell.joint_names
        return OtherScales(tuple((names[j], float(scales.factor[j])) for j in scales.other))

    @property
    def no_better(self) -> NoBetter | None:
        """The changes that fit best, but not better than by chance; None without any."""
        changes = self.readings.no_better
        if not changes:
            return None
        shown = _first_of_each([(change, 0.0) for change in changes])[:_MAX_CHOICES]
        return NoBetter(tuple(self._of_arm(change) for change, _ in shown))

    @property
    def fits_badly(self) -> bool:
        """Whether no tested change explains the torque as well as a free fit."""
        if self.explained is not None:
            return False
        doubted = any(not step.sure for step in self.readings.steps)
        return doubted and not self.readings.adequacy.is_enough

    def or_explained(self, explained: ErrorExplained) -> TorqueFindings:
        """Return the findings if this explains the torque as well: then no change is certain."""
        steps = tuple(replace(step, is_adequate=False) for step in self.readings.steps)
        return replace(self, readings=replace(self.readings, steps=steps), explained=explained)

    def as_stated(self, rows: Samples, score: Score) -> TorqueFindings:
        """Return the findings without any change, if none explains the torque as well.

        Changes that fit an arm without what explains the torque imitate it, and so do those
        that come nearest.

        Args:
            rows: some of the recording, as read.
            score: of a torque with what explains it.
        """
        readings = Readings((), self.cell.model, rows, score, {})
        return replace(self, readings=readings, axes=Axes.of((), self.cell.model.n_joints))

    def steps(self, *meanings: Meaning) -> list[Step]:
        """Return the changes of some meanings."""
        return [step for step in self.readings.steps if step.change.meaning in meanings]

    def _of_arm(self, change: Change) -> ArmChange:
        return ArmChange(change, self.cell.joint_names)

    def _changes(self, steps: Sequence[Step]) -> Changes:
        return Changes(tuple(self._of_arm(step.change) for step in steps))

    def _changed(
        self, aspect: Aspect, steps: list[Step], reading: Reading, decider: Decider
    ) -> Row:
        """Return the row of an aspect that is other than recorded, and how certain that is."""
        ratio = float(np.prod([step.ratio for step in steps]))
        sigmas = min(step.sigmas for step in steps)
        certainty = Certainty.UNDETERMINED
        if all(step.sure for step in steps):
            certainty = Certainty.CERTAIN
        nearest = self.readings.nearest
        rivals = [nearest[step.change.meaning] for step in steps if step.change.meaning in nearest]
        if any(rival[1].sigmas < SEPARATE_SIGMAS and _repeats(rival[0], steps) for rival in rivals):
            certainty = Certainty.UNDETERMINED
        evidence: Evidence = ErrorRatio(ratio, sigmas)
        if all(step.by_friction for step in steps):
            evidence = Basis.DRIVING_FRICTION
        springs = tuple(self._springs_alike(steps))
        return Row(aspect, reading, certainty, (evidence, *springs), decider, is_changed=True)

    def _springs_alike(self, steps: Sequence[Step]) -> Iterator[SpringsAlike]:
        """Yield the springs that explain the rows best in place of each of some steps."""
        best = {step.springs[0]: step.error for step in steps if step.springs}
        names = self.cell.joint_names
        for (change, error), found in best.items():
            yield SpringsAlike(tuple(names[joint] for joint in change.joints), error / found)

    def _unchanged(
        self, aspect: Aspect, reading: Fact, *meanings: Meaning, decider: Decider | None = None
    ) -> Row:
        """Return the row of an aspect that is as recorded, and how certain that is."""
        nearest = self.readings.nearest
        rivals = [nearest[meaning] for meaning in meanings if meaning in nearest]
        if not rivals:
            return Row(aspect, reading, Certainty.LIKELY, (Basis.NOT_EXAMINED,), decider)
        change, against = min(rivals, key=lambda rival: rival[1].sigmas)
        next_best = NextBest(self._of_arm(change), against.ratio)
        if against.sigmas > SEPARATE_SIGMAS:
            return Row(aspect, reading, Certainty.CERTAIN, (next_best,))
        if (
            against.sigmas < _OPEN_SIGMAS_SHARE * SEPARATE_SIGMAS
            or against.ratio < _ALIKE_ERROR_RATIO
        ):
            both = Either(reading, next_best.change)
            return Row(aspect, both, Certainty.UNDETERMINED, (next_best,), decider)
        return Row(aspect, reading, Certainty.LIKELY, (next_best,), decider)

    def _order(self) -> Row:
        steps = self.steps(*ORDERS)
        if not steps:
            decider = Decide.MOVE_EACH_JOINT
            return self._unchanged("order", Fact.ORDER_OF_URDF, *ORDERS, decider=decider)
        kinds = {step.change.meaning for step in steps}
        names = np.array(self.cell.joint_names)
        torque = position = None
        if kinds & {"torque order", "joint order"}:
            torque = tuple(names[np.argsort(self.axes.torque_order)].tolist())
        if kinds & {"position order", "joint order"}:
            position = tuple(names[np.argsort(self.axes.position_order)].tolist())
        return self._changed("order", steps, ColumnOrder(torque, position), Decide.NAME_JOINTS)

    def _signs(self) -> Row:
        steps = self.steps(*SIGNS)
        decider = Decide.PUSH_A_JOINT
        if steps:
            return self._changed("signs", steps, self._changes(steps), decider)
        if self.is_backwards:
            undetermined = Certainty.UNDETERMINED
            backwards = (Basis.DRIVING_FRICTION,)
            return Row("signs", Fact.SIGNS_OF_URDF, undetermined, backwards, decider)
        friction = self.readings.score.friction
        share = self.readings.score.share
        dissipates = (friction > SEPARATE_SIGMAS) & (share > 0.0)
        reading = Fact.SIGNS_OF_URDF
        if dissipates.all():
            row = Row("signs", reading, Certainty.CERTAIN, (Basis.DISSIPATION,))
        else:
            row = self._unchanged("signs", reading, "torque sign", "position sign", decider=decider)
            unseen = tuple(
                name
                for name, seen in zip(self.cell.joint_names, dissipates, strict=True)
                if not seen
            )
            row = replace(row, evidence=(*row.evidence, UnseenFriction(unseen)))
        if not self.readings.rivals or row.certainty is Certainty.UNDETERMINED:
            return row
        image = Change("axis sign", self.readings.rivals[0].flipped)
        evidence = (*row.evidence, MirrorImage(self._of_arm(image)))
        return replace(row, certainty=Certainty.LIKELY, evidence=evidence)

    def _unit(self) -> Row:
        steps = self.steps("degrees", "radians")
        if steps:
            unit: Literal["deg", "rad"] = "deg" if self.axes.factor < 1.0 else "rad"
            entry = MapEntries((("position.unit", unit),))
            return self._changed("angle unit", steps, AngleUnit(unit), entry)
        return self._unchanged("angle unit", Fact.UNIT_AS_READ, "degrees", "radians")

    def _zero(self) -> Row:
        steps = self.steps("zero")
        decider = Decide.COMPARE_A_POSTURE
        unseen = tuple(self.cell.joint_names[joint] for joint in self.readings.unseen_zeros)
        if steps:
            return self._changed("zero", steps, self._changes(steps), decider)
        row = self._unchanged("zero", Fact.ZERO_OF_URDF, "zero", decider=decider)
        if not unseen:
            return row
        change, against = self.readings.nearest["zero"]
        nearest = NearestZero(self._of_arm(change), against.ratio)
        if self._states_zeros:
            return Row("zero", Fact.ZERO_STATED, Certainty.LIKELY, (nearest,))
        return Row("zero", UnseenZeros(unseen), Certainty.UNDETERMINED, (nearest,), decider)

    @property
    def _states_zeros(self) -> bool:
        """Whether the column map states what is added to positions."""
        entries = parse_toml(self.map_text or "")
        return "offset" in entries.get("position", {})

    def _no_bodies(self) -> Row:
        share = RigidShare(float(self.rigid.over_friction.max()), self.rigid.scale)
        decider = Decide.RECORD_ALL_TORQUE
        certain = Certainty.CERTAIN
        return Row("bodies", Fact.NO_BODIES, certain, (share,), decider, is_fault=True)

    def _scale(self) -> Iterator[Row]:
        """Yield the scales of torques, if some differ from the others."""
        if steps := self.steps("scale"):
            decider = Decide.WEIGH_A_LOAD
            yield self._changed("scale", steps, self._changes(steps), decider)

    def _coupling(self) -> Row:
        steps = self.steps(*COUPLED)
        decider = Decide.TURN_ONE_JOINT
        if steps:
            return self._changed("coupling", steps, self._changes(steps), decider)
        return self._unchanged("coupling", Fact.UNCOUPLED, *COUPLED, decider=decider)

    def _gravity(self) -> Row:
        steps = self.steps("no gravity")
        if steps:
            option = GravityOption((0.0, 0.0, 0.0))
            return self._changed("gravity", steps, Fact.WITHOUT_GRAVITY, option)
        decider = Decide.HOLD_STILL
        return self._unchanged("gravity", Fact.WITH_GRAVITY, "no gravity", decider=decider)

    def _mounting(self) -> Row:
        steps = self.steps("mounting")
        decider = Decide.STATE_GRAVITY
        if steps:
            return self._changed("mounting", steps, Mounting(steps[-1].change.name), decider)
        if self.steps("no gravity"):
            undetermined = Certainty.UNDETERMINED
            return Row("mounting", Fact.STATED_MOUNTING, undetermined, (Basis.NO_GRAVITY,), decider)
        return self._unchanged("mounting", Fact.STATED_MOUNTING, "mounting", decider=decider)

    def _size(self) -> Row:
        factor = self.size.factor
        if factor is None:
            untested = (Basis.SIZE_UNTESTED,)
            decider = Decide.STATE_DRIVE
            return Row("side", Fact.JOINT_SIDE, Certainty.LIKELY, untested, decider)
        evidence = (SizeRatio(factor, self.size.by_masses),)
        if not self.size.is_off:
            certainty = Certainty.CERTAIN if self.size.by_masses else Certainty.LIKELY
            return Row("side", Fact.JOINT_TORQUE, certainty, evidence)
        if self.size.is_thousand:
            unit: Literal["mN.m", "kN.m"] = "mN.m" if factor > 1.0 else "kN.m"
            entry = MapEntries((("torque.unit", unit),))
            return Row("side", TorqueUnit(unit), Certainty.LIKELY, evidence, entry)
        if factor > 1.0:
            reading = Fact.LARGE_TORQUE
            scaled = TorqueFactor(1.0 / factor)
            return Row("side", reading, Certainty.UNDETERMINED, evidence, scaled)
        if not self.size.may_be_geared:
            reading = Fact.SMALL_TORQUE
            scaled = TorqueFactor(1.0 / factor)
            return Row("side", reading, Certainty.UNDETERMINED, evidence, scaled)
        decides: Decider = Decide.ASK_FOR_UNIT
        if not self.is_side_open and self.map_text is not None:
            decides = _motor_torque(self.size, self.cell.joint_names, self._gears)
        return Row("side", Fact.MOTOR_SIDE, Certainty.UNDETERMINED, evidence, decides)

    def _payload(self, groups: Sequence[ParameterGroup]) -> Row:
        payload = self.cell.file.robot.payload
        if payload is not None:
            stated = StatedPayload(payload.mass)
            return Row("payload", stated, Certainty.CERTAIN, (Basis.CELL,))
        decider = Decide.RECORD_PAYLOAD
        carrier = self.cell.joint_names[self.cell.model.chain.last_joint]
        bodies = [group for group in groups if group.quantity == "body"]
        last = next((group for group in bodies if group.body == carrier), None)
        if last is None or not last.identifiable:
            none = (Basis.LAST_BODY_UNDETERMINED,)
            reading = Fact.PAYLOAD_UNDETERMINED
            return Row("payload", reading, Certainty.UNDETERMINED, none, decider)
        total = last.identifiable + last.weak + last.missing
        evidence = (LastBody(last.identifiable, total, last.body),)
        reading = Fact.PAYLOAD_IN_LAST_BODY
        return Row("payload", reading, Certainty.LIKELY, evidence, decider)

    def questions(self) -> tuple[tuple[TiedReading, ...], ...]:
        """Return the readings that fit equally well, the best of each meaning."""
        choices: list[tuple[TiedReading, ...]] = []
        if self.readings.score.overall > EXPLAINED_ERROR:
            return ()  # none of them is right
        disputed = self.readings.disputed_signs
        for step in self.readings.steps:
            alike = step.alike
            if step in disputed:  # asked of all joints at once
                alike = tuple(pair for pair in alike if pair[0].meaning not in SIGNS)
            if not alike:
                continue
            pairs = [(step.change, step.error), *alike]
            first = _first_of_each(pairs)
            shown = first[:_MAX_CHOICES] if len(first) > 1 else pairs[:2]
            choices.append(tuple(self._choice(step, *pair) for pair in shown))
        if any(step.change.meaning in SIGNS for step in disputed):
            choices.append(self._signs_alike())
        if self.rigid.is_nothing or self.torque.is_rate or not self.is_side_open:
            return tuple(choices)
        if sides := sides_alike(self.size, self.cell.joint_names, self._gears):
            choices.append(sides)
        return tuple(choices)

    @property
    def _gears(self) -> list[Change]:
        """Scales and signs that are not in the map, which belong to the gears."""
        return [step.change for step in self.readings.steps if not step.sure]

    def _choice(self, step: Step, change: Change, error: float) -> TiedReading:
        others = [change if other is step else other.change for other in self.readings.steps]
        axes = Axes.of(others, self.cell.model.n_joints)
        setting: Setting | None = self._line_of(axes)
        if setting is None and change.meaning in ("no gravity", "mounting"):
            setting = GravityOption(self.gravities[change.name])
        return TiedReading(_ASPECTS[change.meaning], self._of_arm(change), error, setting)

    def _line_of(self, axes: Axes) -> MapEntries | None:
        """Return the entries of a map that state axes, or None."""
        if self.map_text is None:
            return None
        entries = self._entries_of(axes, self.map_text)
        return MapEntries(tuple(entries.items())) if entries else None

    def _signs_alike(self) -> tuple[TiedReading, ...]:
        """Return the signs found, then the signs of each mirror image of the arm."""
        found = SignRival(Signs.of(self.axes), (), self.readings.score.overall)
        choices = []
        for each in (found, *self.readings.rivals)[:_MAX_CHOICES]:
            image = Change("axis sign", each.flipped)
            changes = [*(step.change for step in self.readings.steps), image]
            axes = Axes.of(changes, self.cell.model.n_joints)
            reading = Changes(tuple(map(self._of_arm, each.signs.changes)))
            choices.append(TiedReading("signs", reading, each.error, self._line_of(axes)))
        return tuple(choices)

    def _entries_of(self, axes: Axes, text: str) -> dict[str, Any]:
        names = {channel.name for channel in channels_of(self.source, files=self.files)}
        return entries_of(axes, text, names, self.cell.joint_names)

    def entries(self) -> dict[str, Any]:
        """Return the entries of the map for the certain conclusions."""
        if self.map_text is None:
            return {}
        sure = [step.change for step in self.readings.steps if step.sure]
        axes = Axes.of(sure, self.cell.model.n_joints)
        entries = self._entries_of(axes, self.map_text)
        if self.size.is_off and self.size.is_thousand:
            entries["torque.unit"] = "mN.m" if (self.size.factor or 1.0) > 1.0 else "kN.m"
        return entries

    def gravity(self) -> Vector | None:
        """Return the gravity that the certain conclusions need; None if it is as stated [m/s²]."""
        if any(step.sure for step in self.steps("no gravity")):
            return (0.0, 0.0, 0.0)
        if any(step.sure for step in self.steps("mounting")):
            return tuple(self.readings.model.gravity.tolist())
        return None


_RATE: Final = Row(
    "torque",
    Fact.RATE_OF_TORQUE,
    Certainty.CERTAIN,
    (Basis.INTEGRAL,),
    Decide.RECORD_TORQUE,
    is_fault=True,
)


def _first_of_each(pairs: Sequence[tuple[Change, float]]) -> list[tuple[Change, float]]:
    """Return the first change of each meaning; a joint turned to the other side is another one."""
    first: dict[object, tuple[Change, float]] = {}
    for change, error in pairs:
        first.setdefault((change.meaning, change.size > 0.0), (change, error))
    return list(first.values())


def _other_times(factor: float) -> Row:
    """Return the row of recorded times that are not of the motion."""
    found, step = OtherTimes(factor), Decide.STATE_RATE
    return Row("time", found, Certainty.LIKELY, (Basis.INERTIA,), step, is_fault=True)


def _says_nothing(row: Row, basis: Basis) -> Row:
    """Return a row that rests on the torque of bodies, of a torque without."""
    if row.aspect == "payload":
        return row
    return replace(row, certainty=Certainty.UNDETERMINED, evidence=(basis,), decider=None)


def no_longer_certain(row: Row, evidence: Evidence) -> Row:
    """Return a row, downgraded because the torque that it rests on is not explained well enough."""
    if row.certainty is not Certainty.CERTAIN or row.aspect == "payload":
        return row
    return replace(row, certainty=Certainty.LIKELY, evidence=(*row.evidence, evidence))


def _repeats(change: Change, steps: list[Step]) -> bool:
    """Whether a change concerns the joints of steps that are orders."""
    return change.meaning in ORDERS and any(
        set(change.joints) & set(step.change.joints) for step in steps
    )


def without_torque(recording: Recording, load: NoJointTorque | None = None) -> Row:
    """Return the row of a log without torque, or with the load of a servo in its place."""
    if recording.motor_current is None:
        decider = Decide.RECORD_TORQUE if load is None else Decide.RECORD_COMMANDS
        if recording.commanded_position is not None:
            decider = Decide.IMPORT_COMMANDS
        if load is not None:
            return Row("torque", Fact.SERVO_LOAD, Certainty.LIKELY, (load,), decider)
        return Row("torque", Fact.NO_TORQUE, Certainty.CERTAIN, (Basis.CHANNELS,), decider)
    decider = Decide.STATE_TORQUE_CONSTANT
    return Row("torque", Fact.MOTOR_CURRENT, Certainty.CERTAIN, (Basis.NAME_OR_UNIT,), decider)


def channel_rows(delay: DelayEstimate | None, low_pass: TorqueLowPass | None) -> Iterator[Row]:
    """Yield delay and low-pass of the torque."""
    yield _of_low_pass(delay, low_pass) or _delay_row(delay)
    bandwidth = None if low_pass is None else low_pass.settings.torque_bandwidth
    if low_pass is None or bandwidth is None:
        none = (Basis.NO_FILTER_BETTER,)
        yield Row("low-pass", Fact.NO_LOW_PASS, Certainty.LIKELY, none)
        return
    confirmed = low_pass.confirmed
    shape = low_pass.settings.torque_shape
    reading = LowPassedTorque(bandwidth, confirmed=confirmed)
    certainty = Certainty.LIKELY if confirmed else Certainty.UNDETERMINED
    evidence = (FilterShape(shape.order, shape.causal, confirmed=confirmed),)
    yield Row("low-pass", reading, certainty, evidence, Decide.ASK_FOR_FILTER)


def _of_low_pass(delay: DelayEstimate | None, low_pass: TorqueLowPass | None) -> Row | None:
    """Return the row of a delay that is the lag of a low-pass; None if there is no such low-pass.

    The low-pass predicts other parts better than its lag alone does.
    """
    if delay is None or not delay.significant or low_pass is None or not low_pass.confirmed:
        return None
    bandwidth, shape = low_pass.settings.torque_bandwidth, low_pass.settings.torque_shape
    if bandwidth is None or not shape.causal:
        return None
    lag = shape.lag(bandwidth)
    if abs(delay.delay - lag) > _SAME_LAG * lag:
        return None
    evidence = (LowPassLag(lag, delay.delay),)
    return Row("delay", Fact.DELAY_OF_LOW_PASS, Certainty.LIKELY, evidence)


def by_estimated_times(row: Row) -> Row:
    """Return a row, no longer certain because the sample times were estimated."""
    if row.certainty is not Certainty.CERTAIN:
        return row
    evidence = (*row.evidence, Basis.ESTIMATED_TIMES)
    return replace(row, certainty=Certainty.LIKELY, evidence=evidence)


def _delay_row(delay: DelayEstimate | None) -> Row:
    if delay is None:
        none = (Basis.NO_ROW,)
        return Row("delay", Fact.DELAY_UNDETERMINED, Certainty.UNDETERMINED, none)
    half = delay.half_interval
    if delay.significant:
        reading = TorqueDelay(delay.delay, confirmed=True)
        evidence = DelayInterval(half)
        return Row("delay", reading, Certainty.CERTAIN, (evidence,), Decide.ESTIMATE_DELAY)
    if delay.determined:
        about_zero = DelayInterval(half, delay.delay)
        return Row("delay", Fact.NO_DELAY, Certainty.CERTAIN, (about_zero,))
    if abs(delay.delay) > half:
        reading = TorqueDelay(delay.delay, confirmed=False)
        evidence = DelayInterval(half, unconfirmed=True)
        return Row("delay", reading, Certainty.UNDETERMINED, (evidence,), Decide.RECORD_FASTER)
    problem = DelayProblem(delay)
    return Row("delay", Fact.NO_DELAY_SEEN, Certainty.LIKELY, (problem,), Decide.RECORD_FASTER)


def determined(readings: Readings) -> tuple[ParameterGroup, ...]:
    """Return how many parameters of each body and joint the recording determines.

    By the posterior over the prior standard deviation of each base parameter.
    """
    model = readings.model
    samples = readings.samples
    factor = Factor.by_time(model, samples)
    ratio = fit_posterior(model, factor, body_prior(model, factor).gaussian).ratio
    groups = []
    joints = _joints_of(readings)
    for joint, name in enumerate(model.joint_names):
        for quantity in ("body", "friction"):
            ratios = [
                float(ratio[k])
                for k, (owner, kind) in enumerate(joints)
                if owner == joint and kind == quantity
            ]
            if ratios:
                good = sum(value < DETERMINED_STD_RATIO for value in ratios)
                weak = sum(DETERMINED_STD_RATIO <= value < _WEAK_STD_RATIO for value in ratios)
                groups.append(ParameterGroup(name, quantity, good, weak, len(ratios) - good - weak))
    return tuple(groups)


def _joints_of(readings: Readings) -> list[tuple[int, str]]:
    """Return the joint of each parameter, and whether it is of its body or its friction."""
    model = readings.model
    width = model.layout.width
    owners = [(min(int(pivot) // width, model.n_joints - 1), "body") for pivot in model.base.pivots]
    assert width >= len(LINK_SYMBOLS)
    owners += [(term.owner, "friction") for term in model.friction.terms]
    owners += [(-1, "element")] * (model.n_parameters - len(owners))
    return owners
