"""Schema of `rollout.json`: position errors of simulated windows of a measured motion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field, ValidationError

from hil.base.errors import InputError
from hil.base.safe_input import read_text
from hil.results.results import Frozen, Known
from identification.text import number, percentage

ROLLOUT: Final = "rollout.json"
JUDGED_HORIZON: Final = 2
"""Index of the horizon at which joint and effect are named: 0.5 s."""
_BAND_HORIZON: Final = 1  # index of the horizon of the band: 0.2 s
WANTED_COVERAGE: Final = (0.88, 0.99)  # share of measured positions in a 95 % band


class ArmErrors(Frozen):
    """Errors of an arm; lists over the horizons."""

    joints: list[list[float]]  #: root mean square position error per joint, rad or m
    tool: list[Known]  #: that of the tool in stable windows, m; null without any
    unstable: int  #: windows in which the simulation became unstable
    unstable_joints: list[int]  #: of these, by the joint that was the first to leave the motion

    def overall(self, horizon: int) -> float:
        """Return the root mean square over all joints at a horizon, rad or m."""
        return float(np.sqrt(np.mean(np.square(self.joints[horizon]))))


class PolishedParameter(Frozen):
    """A parameter before and after polishing."""

    name: str
    unit: str
    before: float
    after: float


class PolishResult(Frozen):
    """Parameters that were fitted to simulated windows of the fitted motion."""

    accepted: bool  #: whether the held-out windows are predicted better
    reason: str  #: why it is used or not, one sentence
    windows: int  #: of the fitted motion
    change: float  #: mean of the logarithms of held-out errors, polished over identified
    errors: ArmErrors  #: of the polished arm on the held-out windows
    parameters: list[PolishedParameter]


class ServoParameter(Frozen):
    """A parameter of a joint's servo or drive."""

    name: str
    unit: str
    value: float
    deviation: Known  #: standard deviation; null where nothing is determined
    determined: bool  #: whether it differs from zero by more than its interval


class ServoResult(Frozen):
    """Servo, friction and rotor inertias from positions alone, with the masses of the URDF."""

    parameters: list[ServoParameter]
    delay: float  #: of the command, s
    delay_deviation: Known  #: standard deviation, s

    @property
    def message(self) -> str:
        """What is determined, in two sentences."""
        unknown = [parameter.name for parameter in self.parameters if not parameter.determined]
        text = (
            "Positions determine gains, friction and rotor inertias in proportion to the masses of"
            " the URDF only."
        )
        return f"{text} Not determined: {', '.join(unknown)}." if unknown else text

    @property
    def notes(self) -> list[str]:
        """Delay of the command, and what is determined."""
        spread = "" if self.delay_deviation is None else f" ± {milli(self.delay_deviation)}"
        return [f"delay of the command: {milli(self.delay)}{spread} ms", self.message]

    def table(self, joint_names: Sequence[str]) -> list[str]:
        """Return a row for each joint, with the number that ends its parameters' names."""
        by_joint: dict[str, dict[str, ServoParameter]] = {}
        for parameter in self.parameters:
            name, _, joint = parameter.name.partition("_")
            by_joint.setdefault(joint, {})[name] = parameter
        names = list(next(iter(by_joint.values())))
        first = next(iter(by_joint.values()))
        heads = [f"{name} [{first[name].unit}]" for name in names]
        labels = [f"{number} {name}" for number, name in enumerate(joint_names, 1)]
        width = max(map(len, ["joint", *labels]))
        rows = [f"{'joint':{width}}" + "".join(f"{head:>20}" for head in heads)]
        for label, row in zip(labels, by_joint.values(), strict=True):
            figures = "".join(f"{_with_deviation(row[name]):>20}" for name in names)
            rows.append(f"{label:{width}}{figures}")
        return rows


def _with_deviation(parameter: ServoParameter) -> str:
    if not parameter.determined or parameter.deviation is None:
        return "not determined"
    return f"{number(parameter.value, 4)} ± {number(parameter.deviation, 2)}"


class RolloutResult(Frozen):
    """Result of a rollout, `rollout.json`."""

    cell: str
    simulated: bool
    joint_names: list[str]
    units: list[str]  #: of positions and their errors, rad or m
    parameters: str  #: SHA-256 of the `parameters.json` with the identified arm; empty without
    drive: str  #: what acts on the joints
    tool: str  #: link whose origin is the tool
    windows: int
    step: float = Field(gt=0.0)  #: s
    horizons: list[float]  #: s
    identified: ArmErrors
    nominal: ArmErrors | None
    no_nominal: str  #: why there is no nominal arm; empty
    samples: int
    seed: int
    sample_errors: list[ArmErrors]
    widened: float  #: factor of the deviations of the drawn arms
    #: share of measured positions in the 95 % band, per horizon and joint
    inside: list[list[float]]
    leading_joint: str
    leading_effect: str  #: empty if no single one
    polish: PolishResult | None
    notes: list[str]
    servo: ServoResult | None = None  #: of recordings without torque
    #: error of joints that continue at their start velocity, over all joints at the horizons
    continued: list[float] = Field(default_factory=list)

    @property
    def ratio(self) -> list[float] | None:
        """Error of the identified over the nominal arm's at the horizons."""
        if self.nominal is None:
            return None
        return [
            self.identified.overall(k) / max(self.nominal.overall(k), 1e-300)
            for k in range(len(self.horizons))
        ]

    @property
    def band(self) -> float:
        """Share of measured positions in the 95 % band at 0.2 s."""
        return float(np.mean(self.inside[_BAND_HORIZON]))

    @property
    def band_holds(self) -> bool:
        """Whether that share is near 95 %."""
        return WANTED_COVERAGE[0] <= self.band <= WANTED_COVERAGE[1]

    @property
    def message(self) -> str:
        """The result in two to four sentences."""
        polish = self._advice if self.polish is None else self.polish.reason
        return " ".join(filter(None, [self._against_nominal, self._leading, polish]))

    @property
    def _advice(self) -> str:
        """When a polish would help; empty if not.

        Of thirteen motions of six real arms a polish lowered the error at the first horizon by 14
        to 74 % in the six in which it was larger than that of joints that continue at their start
        velocity; in the others by at most 10 %.
        """
        error = self.identified.overall(0)
        if not self.continued or error <= self.continued[0]:
            return ""
        return (
            f"At {self.horizons[0]:g} s it is further off than joints that continue at their start"
            f" velocity ({milli(error)} against {milli(self.continued[0])} {self._unit}):"
            " --polish, which fits friction, rotor inertias and delay to simulated windows, often"
            " reduces this."
        )

    @property
    def _is_mostly_unstable(self) -> bool:
        return 2 * self.identified.unstable > self.windows

    @property
    def _against_nominal(self) -> str:
        if self._is_mostly_unstable:
            return (
                "The identified arm does not follow the recorded motion:"
                f" {self.identified.unstable} of {self.windows} windows become unstable, and its"
                " errors say no more."
            )
        if self.ratio is None:
            return f"There is no nominal arm to compare with: {self.no_nominal}."
        worse = [h for h, ratio in zip(self.horizons, self.ratio, strict=True) if ratio >= 1.0]
        if worse:
            return f"From {worse[0]:g} s on the identified arm is no better than the nominal one."
        return (
            f"The identified arm is better than the nominal one up to {self.horizons[-1]:g} s:"
            f" {percentage(self.ratio[JUDGED_HORIZON], 1)} of its position error at"
            f" {self.horizons[JUDGED_HORIZON]:g} s."
        )

    @property
    def _leading(self) -> str:
        cause = (
            f"most of this error comes from its {self.leading_effect}"
            if self.leading_effect
            else "neither dry friction, viscous friction nor delay explains this error alone"
        )
        most = max(self.identified.unstable_joints)
        if 2 * most > self.windows:
            return f"{self.leading_joint} makes {most} of {self.windows} windows unstable; {cause}."
        return f"{self.leading_joint} contributes most to the flange error; {cause}."

    @property
    def band_message(self) -> str:
        """A warning about the band; empty if it holds."""
        if not self.sample_errors or self.band_holds:
            return ""
        return (
            f"{percentage(self.band, 1)} at {self.horizons[_BAND_HORIZON]:g} s is not"
            f" {percentage(WANTED_COVERAGE[0])} to {percentage(WANTED_COVERAGE[1])}:"
            " do not rely on this band"
        )

    def stability(self) -> list[str]:
        """Return a sentence about each arm that becomes unstable."""
        arms = {"identified": self.identified, "nominal": self.nominal}
        if self.polish is not None:
            arms["polished"] = self.polish.errors
        lines = []
        for name, arm in arms.items():
            if arm is not None and arm.unstable:
                pairs = zip(self.joint_names, arm.unstable_joints, strict=True)
                first = ", ".join(f"{joint} in {count}" for joint, count in pairs if count)
                lines.append(
                    f"{name}: unstable in {arm.unstable} of {self.windows} windows (first {first}),"
                    " which count with an error of pi"
                )
        if unstable := sum(arm.unstable for arm in self.sample_errors):
            lines.append(f"samples: {unstable} of their windows are unstable")
        return lines

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        columns = "".join(f"{f'{h:g} s':>10}" for h in self.horizons)
        lines = [
            f"{self.windows} windows of {self.cell}, driven by {self.drive}",
            *self.notes,
            *([] if self.servo is None else self.servo.table(self.joint_names)),
            *([] if self.servo is None else self.servo.notes),
            f"{'position error (rms)':42}{columns}",
        ]
        arms = {"identified": self.identified, "nominal": self.nominal}
        if self.polish is not None:
            arms["polished"] = self.polish.errors
        for name, arm in arms.items():
            if arm is None:
                continue
            for joint, label in enumerate(self.joint_names):
                unit = "mrad" if self.units[joint] == "rad" else "mm"
                row = "".join(f"{milli(at[joint]):>10}" for at in arm.joints)
                lines.append(f"{f'{name:10} {label[:22]:22} [{unit}]':42}{row}")
            tool = "".join(f"{milli(at):>10}" for at in arm.tool)
            lines.append(f"{f'{name:10} {self.tool[:22]:22} [mm]':42}{tool}")
        if self.continued:
            row = "".join(f"{milli(error):>10}" for error in self.continued)
            lines.append(f"{f'at the start velocity, all joints [{self._unit}]':42}{row}")
        if self.sample_errors:
            spread = [
                [arm.overall(k) for arm in self.sample_errors] for k in range(len(self.horizons))
            ]
            row = "".join(f"{milli(float(np.median(errors))):>10}" for errors in spread)
            lines.append(f"{f'{self.samples} samples, median [{self._unit}]':42}{row}")
            shares = "".join(f"{percentage(float(np.mean(at)), 1):>10}" for at in self.inside)
            lines.append(f"{'measured positions in their 95 % band':42}{shares}")
        lines += self.stability()
        if self.band_message:
            lines.append(f"warning: {self.band_message}")
        return [*lines, self.message]

    @property
    def _unit(self) -> str:
        """Unit of errors of all joints together."""
        return " or ".join(sorted({"mrad" if unit == "rad" else "mm" for unit in self.units}))

    @classmethod
    def load(cls, path: Path) -> RolloutResult:
        """Read a `rollout.json`; InputError if it is none."""
        try:
            return cls.model_validate_json(read_text(path))
        except (OSError, ValueError, ValidationError) as error:
            problem = f"cannot be read as a rollout ({str(error).splitlines()[0]})"
            raise InputError(path, problem, remedy="run `hil rollout` again") from error


def milli(value: float | None) -> str:
    """Return a thousandth of the unit with three digits, a dash if it is unknown."""
    if value is None:
        return "-"
    return f"{1e3 * value:.0f}" if abs(value) >= 1.0 else number(1e3 * value)
