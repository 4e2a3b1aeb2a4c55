"""Rows of a look about the torque: signs, order, zero, gravity, size, delay, low-pass."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.cell.nominal import nominal_of
from hil.look.maps import entries_of
from hil.look.result import Certainty, Choice, Group, Row
from identification.estimators.delay import DelayEstimate
from identification.estimators.prior import LEARNED, body_prior, fit_posterior
from identification.factor.factor import Factor
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, Samples
from identification.text import percentage
from identification.validation.faults import COUPLED
from identification.validation.nominal_scale import nominal_scale
from identification.validation.reading_changes import Axes, Change, Meaning
from identification.validation.readings import EXPLAINED, SEPARATE, Readings, Step

Array = NDArray[np.float64]

MOUNTINGS: Final = {
    "": (0.0, 0.0, 0.0),
    "upside down": (0.0, 0.0, 9.81),
    "on a wall, +x down": (9.81, 0.0, 0.0),
    "on a wall, -x down": (-9.81, 0.0, 0.0),
    "on a wall, +y down": (0.0, 9.81, 0.0),
    "on a wall, -y down": (0.0, -9.81, 0.0),
    "upright": (0.0, 0.0, -9.81),
}
"""Gravity in the base frame by mounting [m/s²]; "" for a torque without gravity."""
_ASPECTS: Final[Mapping[Meaning, str]] = {
    "torque sign": "signs",
    "position sign": "signs",
    "axis sign": "signs",
    "torque order": "order",
    "position order": "order",
    "joint order": "order",
    "degrees": "angle unit",
    "radians": "angle unit",
    "zero": "zero",
    "angle sum": "coupling",
    "angle difference": "coupling",
    "no gravity": "gravity",
    "mounting": "mounting",
}
"""The row of the table that a change belongs to."""
_HALF: Final = 0.5
_MOST_CHOICES: Final = 3
_ALIKE: Final = 1.02  # error ratio of readings of which the recording does not choose one
_OTHER_UNIT: Final = 3.0  # factor beyond which the masses of a URDF do not explain a torque
_THOUSAND: Final = 1000.0
_WEAK: Final = 0.9  # posterior over prior deviation of a parameter that the recording hardly moves
# Masses of arms over the cube of their reach, kg/m³: 11 (Gen3) to 216 (TX40).
_DENSITY: Final = 45.0
_DENSITY_SPREAD: Final = 3.0  # factor of one standard deviation
_GRAVITY: Final = 9.81


@dataclass(frozen=True)
class Size:
    """Measured torque over that which the arm needs.

    Attributes:
        factor: of the whole arm; None where neither masses nor weight say.
        by_masses: whether it is by the URDF's masses, else by those of arms of its reach.
    """

    factor: float | None
    by_masses: bool

    @classmethod
    def of(cls, cell: Cell, model: RobotModel, samples: Samples) -> Size:
        """Compare samples with the nominal arm, or with the weight of arms of its reach.

        The model is that of the cell, or of another gravity, which has other base parameters.
        """
        nominal = nominal_of(mounted(cell, tuple(model.gravity)))
        if nominal is None:
            return cls(_by_reach(model, samples), by_masses=False)
        scale = nominal_scale(model, nominal.values, [samples]).scale
        if not np.isfinite(scale).any():
            return cls(_by_reach(model, samples), by_masses=True)
        scales = np.abs(scale[np.isfinite(scale)])
        positive = scales[scales > 0.0]
        return cls(float(np.median(positive)) if len(positive) else None, by_masses=True)

    @property
    def basis(self) -> str:
        """What is expected by."""
        return "the URDF's masses" if self.by_masses else "the masses of arms of its reach"

    @property
    def is_off(self) -> bool:
        """Whether the torque has another order of magnitude than the arm needs."""
        if self.factor is None:
            return False
        limit = _OTHER_UNIT if self.by_masses else _DENSITY_SPREAD**3
        return not 1.0 / limit < self.factor < limit

    @property
    def is_thousand(self) -> bool:
        """Whether it is about 1000 or 1/1000, the factor of units."""
        if self.factor is None:
            return False
        return bool(abs(abs(np.log(self.factor)) - np.log(_THOUSAND)) < np.log(2.0))


def mounted(cell: Cell, gravity: tuple[float, ...]) -> Cell:
    """Return a cell with another gravity in the base frame [m/s²]."""
    robot = cell.file.robot.model_copy(update={"gravity": gravity})
    return replace(cell, file=cell.file.model_copy(update={"robot": robot}))


def _by_reach(model: RobotModel, samples: Samples) -> float | None:
    """Return the weight that the torque shows over that of an arm of this reach; None if none."""
    if not np.any(model.gravity):
        return None
    factor = Factor.by_time(model, samples)
    values = fit_posterior(model, factor, body_prior(model, factor).gaussian, 5.0).estimate.values
    rigid = np.where(model.friction_columns, 0.0, values)
    weight = np.ptp(model.torque(rigid, Motion.at_rest(samples.motion.position)), axis=0).max()
    reach = float(np.linalg.norm(model.chain.translation[1:], axis=1).sum())
    if not weight > 0.0 or not reach > 0.0:
        return None
    mass = _DENSITY * reach**3
    return float(weight / (0.3 * mass * _GRAVITY * reach))


@dataclass(frozen=True, eq=False)
class Finding:
    """What the torque says of a recording.

    Attributes:
        map_text: the column map of the import; None for a bag.
    """

    cell: Cell
    recording: Recording
    readings: Readings
    axes: Axes
    map_text: str | None
    source: Path

    @cached_property
    def size(self) -> Size:
        """Measured torque over that which the arm needs."""
        return Size.of(self.cell, self.readings.model, self.readings.samples)

    def rows(self, groups: Sequence[Group] = ()) -> list[Row]:
        """Return the rows of the table; `groups` are the parameters that are determined."""
        rows = [
            self._order(),
            self._signs(),
            self._unit(),
            self._zero(),
            self._coupling(),
            self._gravity(),
            self._mounting(),
            self._size(),
            self._payload(groups),
        ]
        error = self.readings.score.overall
        if error > EXPLAINED:
            rows = [_no_longer_sure(row, error) for row in rows]
        rows.append(
            Row("as read", f"torque predicted to {100.0 * error:.2g} % from other parts", "sure",
                "with free parameters, before a fit of the friction law")
        )  # fmt: skip
        return rows

    def steps(self, *meanings: Meaning) -> list[Step]:
        """Return the changes of some meanings."""
        return [step for step in self.readings.steps if step.change.meaning in meanings]

    def names(self, change: Change) -> str:
        """Return the names of the joints of a change."""
        if len(change.joints) == self.cell.model.n_joints:
            return "all joints"
        return ", ".join(self.cell.joint_names[joint] for joint in change.joints)

    def _row_of(self, aspect: str, steps: list[Step], text: str, decide: str) -> Row:
        ratio = float(np.prod([step.ratio for step in steps]))
        sigmas = min(step.sigmas for step in steps)
        certainty: Certainty = "sure" if all(step.sure for step in steps) else "open"
        nearest = self.readings.nearest
        rivals = [nearest[step.change.meaning] for step in steps if step.change.meaning in nearest]
        if any(rival[1].sigmas < SEPARATE and _repeats(rival[0], steps) for rival in rivals):
            certainty = "open"
        reason = f"error {ratio:.2f} times that as recorded ({-sigmas:.0f} standard errors)"
        if all(step.by_friction for step in steps):
            reason = "friction would drive the joint otherwise"
        return Row(aspect, text, certainty, reason, decide)

    def _unchanged(self, aspect: str, reading: str, *meanings: Meaning, decide: str = "") -> Row:
        """Return the row of an aspect that is as recorded, and how sure that is."""
        nearest = self.readings.nearest
        rivals = [nearest[meaning] for meaning in meanings if meaning in nearest]
        if not rivals:
            return Row(aspect, reading, "likely", "not examined", decide)
        change, against = min(rivals, key=lambda rival: rival[1].sigmas)
        reason = f"next best: {self.described(change)}, error {against.ratio:.2f} times"
        if against.sigmas > SEPARATE:
            return Row(aspect, reading, "sure", reason)
        if against.sigmas < _HALF * SEPARATE or against.ratio < _ALIKE:
            both = f"{reading}, or {self.described(change)}"
            return Row(aspect, both, "open", reason, decide)
        return Row(aspect, reading, "likely", reason, decide)

    def described(self, change: Change) -> str:
        """Return a change in words."""
        texts: Mapping[Meaning, str] = {
            "torque sign": "torque negated",
            "position sign": "position negated",
            "axis sign": "position and torque negated",
            "torque order": "torques exchanged",
            "position order": "positions exchanged",
            "joint order": "joints exchanged",
            "degrees": "degrees",
            "radians": "radians",
            "no gravity": "without gravity",
            "mounting": f"mounted {change.name}",
            "angle sum": "plus",
            "angle difference": "less",
            "zero": f"zero moved by {np.degrees(change.size):.0f} deg",
        }
        if change.meaning in COUPLED:
            joint, other = (self.cell.joint_names[place] for place in change.joints)
            return f"the angle of {joint} is recorded {texts[change.meaning]} that of {other}"
        text = texts[change.meaning]
        if len(change.joints) > 2 and change.order:
            names = self.cell.joint_names
            pairs = zip(change.joints, change.order, strict=True)
            listing = ", ".join(f"{names[joint]} in place of {names[at]}" for joint, at in pairs)
            return f"{text.removesuffix(' exchanged')} in another order: {listing}"
        return f"{text}: {self.names(change)}" if change.joints else text

    def _order(self) -> Row:
        steps = self.steps("torque order", "position order", "joint order")
        if not steps:
            return self._unchanged("order", "joints in the order of the URDF", "torque order",
                              "position order", "joint order",
                              decide="move the joints one by one")  # fmt: skip
        kinds = sorted({step.change.meaning for step in steps})
        names = np.array(self.cell.joint_names)
        texts = []
        if "torque order" in kinds or "joint order" in kinds:
            listing = ", ".join(names[np.argsort(self.axes.torque_order)])
            texts.append(f"torque columns are of {listing}")
        if "position order" in kinds or "joint order" in kinds:
            listing = ", ".join(names[np.argsort(self.axes.position_order)])
            texts.append(f"position columns are of {listing}")
        return self._row_of("order", steps, "; ".join(texts), "name the joint of each column")

    def _signs(self) -> Row:
        steps = self.steps("torque sign", "position sign", "axis sign")
        if steps:
            text = "; ".join(self.described(step.change) for step in steps)
            return self._row_of("signs", steps, text, "push one joint by hand and see its torque")
        friction = self.readings.score.friction
        share = self.readings.score.share
        dissipates = (friction > SEPARATE) & (share > 0.0)
        if dissipates.all():
            return Row(
                "signs", "as the URDF's axes", "sure", "friction takes energy in every joint"
            )
        row = self._unchanged("signs", "as the URDF's axes", "torque sign", "position sign",
                         decide="push one joint by hand and see its torque")  # fmt: skip
        unsure = ", ".join(
            name for name, sure in zip(self.cell.joint_names, dissipates, strict=True) if not sure
        )
        return Row(row.aspect, row.reading, row.certainty,
                   f"{row.reason}; friction is not seen in {unsure}", row.decide)  # fmt: skip

    def _unit(self) -> Row:
        steps = self.steps("degrees", "radians")
        if steps:
            unit = "deg" if self.axes.factor < 1.0 else "rad"
            return self._row_of("angle unit", steps, f"in {unit}", f'[position] unit = "{unit}"')
        return self._unchanged("angle unit", "unit as read", "degrees", "radians")

    def _zero(self) -> Row:
        steps = self.steps("zero")
        decide = "compare a posture with the URDF's (viewer)"
        unseen = [self.cell.joint_names[joint] for joint in self.readings.unseen_zeros]
        if steps:
            text = "; ".join(self.described(step.change) for step in steps)
            return self._row_of("zero", steps, text, decide)
        row = self._unchanged("zero", "as the URDF", "zero", decide=decide)
        if not unseen:
            return row
        text = f"as the URDF where the torque shows it; not shown: {', '.join(unseen)}"
        change, against = self.readings.nearest["zero"]
        reason = f"{self.described(change)}: error {against.ratio:.2f} times"
        return Row("zero", text, "open", reason, decide)

    def _coupling(self) -> Row:
        steps = self.steps(*COUPLED)
        decide = "turn one joint alone and see which angles change"
        if steps:
            text = "; ".join(self.described(step.change) for step in steps)
            return self._row_of("coupling", steps, text, decide)
        return self._unchanged("coupling", "no angle contains another's", *COUPLED, decide=decide)

    def _gravity(self) -> Row:
        steps = self.steps("no gravity")
        if steps:
            return self._row_of("gravity", steps, "torque without gravity", "--gravity 0 0 0")
        decide = "hold the arm still, stretched out, and see the torque"
        return self._unchanged("gravity", "torque with gravity", "no gravity", decide=decide)

    def _mounting(self) -> Row:
        steps = self.steps("mounting")
        if steps:
            return self._row_of("mounting", steps, steps[-1].change.name, "state --gravity X Y Z")
        return self._unchanged("mounting", "as stated, else upright", "mounting",
                          decide="state --gravity X Y Z")  # fmt: skip

    def _size(self) -> Row:
        factor = self.size.factor
        if factor is None:
            reason = "no masses in the URDF and little weight: size not tested"
            decide = "state gear ratios or torque constants ([drive] of a map) if not"
            return Row("side", "joint side", "likely", reason, decide)
        reason = f"measured over expected by {self.size.basis}: {factor:.2g}"
        if not self.size.is_off:
            certainty: Certainty = "sure" if self.size.by_masses else "likely"
            return Row("side", "joint side, a torque", certainty, reason)
        if self.size.is_thousand:
            unit = "mN.m" if factor > 1.0 else "kN.m"
            return Row("side", f"torque in {unit}", "likely", reason, f'[torque] unit = "{unit}"')
        if factor > 1.0:
            return Row("side", "larger than the arm needs", "open", reason, "check the unit")
        return Row("side", "motor side (before the gears), or a current", "open", reason,
                   "ask for the unit of the channel")  # fmt: skip

    def _payload(self, groups: Sequence[Group]) -> Row:
        payload = self.cell.file.robot.payload
        if payload is not None:
            return Row("payload", f"{payload.mass:g} kg as stated", "sure", "by the cell")
        decide = "record with and without it (`hil payload`)"
        last = next((group for group in reversed(groups) if group.quantity == "body"), None)
        if last is None or not last.identifiable:
            reason = "the motion determines no parameter of the last body"
            return Row("payload", "none stated; not determined", "open", reason, decide)
        total = last.identifiable + last.weak + last.missing
        reason = (
            f"the motion determines {last.identifiable} of the {total} parameters of the body of"
            f" {last.body}, with all that it carried"
        )
        return Row("payload", "none stated; part of the last body", "likely", reason, decide)

    def questions(self) -> tuple[tuple[Choice, ...], ...]:
        """Return the readings that fit alike, the best of each meaning."""
        choices = []
        for step in self.readings.steps:
            if not step.alike:
                continue
            pairs = [(step.change, step.error), *step.alike]
            meanings = [change.meaning for change, _ in pairs]
            first = [pair for k, pair in enumerate(pairs) if meanings[k] not in meanings[:k]]
            shown = first[:_MOST_CHOICES] if len(first) > 1 else pairs[:2]
            choices.append(tuple(self._choice(step, *pair) for pair in shown))
        size = self.size
        if size.is_off and not size.is_thousand and (size.factor or 1.0) < 1.0:
            choices.append(self._sides())
        return tuple(choices)

    def _choice(self, step: Step, change: Change, error: float) -> Choice:
        others = [change if other is step else other.change for other in self.readings.steps]
        axes = Axes.of(others, self.cell.model.n_joints)
        entries: Mapping[str, Any] = {}
        if self.map_text is not None:
            entries = entries_of(axes, self.map_text, self.source, self.cell.joint_names)
        line = "; ".join(
            f"[{key.rpartition('.')[0]}] {key.rpartition('.')[2]} = {_toml(value)}"
            if "." in key
            else f"{key} = {_toml(value)}"
            for key, value in entries.items()
        )
        if not line and change.meaning in ("no gravity", "mounting"):
            gravity = (0.0, 0.0, 0.0) if change.meaning == "no gravity" else MOUNTINGS[change.name]
            line = f"--gravity {' '.join(f'{part:g}' for part in gravity)}"
        aspect = _ASPECTS[change.meaning]
        return Choice(aspect, self.described(change), error, line, tuple(entries.items()))

    def _sides(self) -> tuple[Choice, ...]:
        ratio = 1.0 / (self.size.factor or 1.0)
        count = self.cell.model.n_joints
        each = ", ".join([f"{ratio:.0f}"] * count)
        return (
            Choice("side", "torque of the motors", None,
                   f'[torque] side = "motor"; [drive] gear_ratio = [{each}] (about; the maker\'s)'),
            Choice("side", "motor current", None,
                   f"[motor_current] in place of [torque]; [drive] torque_constant = [{each}] "
                   "(about, N·m/A with gears)"),
        )  # fmt: skip

    def entries(self) -> dict[str, Any]:
        """Return the entries of the map for the sure conclusions."""
        if self.map_text is None:
            return {}
        sure = [step.change for step in self.readings.steps if step.sure]
        axes = Axes.of(sure, self.cell.model.n_joints)
        entries = entries_of(axes, self.map_text, self.source, self.cell.joint_names)
        if self.size.is_off and self.size.is_thousand:
            entries["torque.unit"] = "mN.m" if (self.size.factor or 1.0) > 1.0 else "kN.m"
        return entries

    def options(self) -> tuple[str, ...]:
        """Return the options for `hil identify` that the sure conclusions need."""
        if any(step.sure for step in self.steps("no gravity")):
            return ("--gravity 0 0 0",)
        steps = [step for step in self.steps("mounting") if step.sure]
        if not steps:
            return ()
        return (f"--gravity {' '.join(f'{part:g}' for part in self.readings.model.gravity)}",)


def _no_longer_sure(row: Row, error: float) -> Row:
    """Return a row that rests on a torque which the arm does not explain."""
    if row.certainty != "sure" or row.aspect == "payload":
        return row
    reason = f"{row.reason}; but {percentage(error)} of the torque stays unexplained"
    return replace(row, certainty="likely", reason=reason)


def _repeats(change: Change, steps: list[Step]) -> bool:
    """Whether a change concerns the joints of steps that are orders."""
    return change.meaning.endswith("order") and any(
        set(change.joints) & set(step.change.joints) for step in steps
    )


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return f"{value:g}"


def without_torque(recording: Recording) -> Row:
    """Return the row of a log without torque."""
    if recording.motor_current is None:
        decide = "record it"
        if recording.commanded_position is not None:
            decide = "import it: `hil rollout --polish` identifies servo and friction"
        return Row("torque", "none, and no motor current", "sure", "by the channels", decide)
    return Row("torque", "none; motor currents", "sure", "by name or unit",
               "[drive] torque_constant of a map (N·m/A), or `hil torque-constants`")  # fmt: skip


def channel_rows(delay: DelayEstimate | None, low_pass: Preprocessing | None) -> Iterator[Row]:
    """Yield delay and low-pass of the torque."""
    if delay is None:
        yield Row("delay", "not determined", "open", "no usable row")
    elif delay.significant:
        half = 1e3 * delay.half_interval
        yield Row("delay", f"torque {1e3 * delay.delay:.0f} ms behind the position", "sure",
                  f"± {half:.1g} ms", "--delay auto")  # fmt: skip
    elif delay.determined:
        yield Row(
            "delay", "none", "sure", f"{1e3 * delay.delay:.1f} ± {1e3 * delay.half_interval:.1g} ms"
        )
    elif abs(delay.delay) > delay.half_interval:
        side = "behind" if delay.delay > 0.0 else "before"
        text = f"perhaps: torque {1e3 * abs(delay.delay):.0f} ms {side} the position"
        reason = f"± {1e3 * delay.half_interval:.1g} ms; other parts are not predicted better"
        yield Row("delay", text, "open", reason, "record faster motion")
    else:
        yield Row("delay", "none seen", "likely", str(delay.reason), "record faster motion")
    if low_pass is None or low_pass.torque_bandwidth is None:
        yield Row("low-pass", "none in the torque", "likely", "none predicts it better")
        return
    kind = "causal" if low_pass.torque_shape.causal else "without phase"
    yield Row("low-pass", f"torque low-passed at {low_pass.torque_bandwidth:.2g} Hz", "likely",
              f"order {low_pass.torque_shape.order}, {kind}, fits better",
              "ask for the filter of the channel")  # fmt: skip


def determined(readings: Readings) -> tuple[Group, ...]:
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
                good = sum(value < LEARNED for value in ratios)
                weak = sum(LEARNED <= value < _WEAK for value in ratios)
                groups.append(Group(name, quantity, good, weak, len(ratios) - good - weak))
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
