"""Identification of a payload from archives recorded without and with it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import ArchiveError, InputError
from hil.base.one_screen import columns
from hil.base.progress import Reporter
from hil.cell.cell import FLANGES
from hil.pipeline.note_messages import SCALE_SOURCES, note_lines, scale_words, scaled_words
from hil.pipeline.options import Options
from hil.pipeline.other_meanings import in_a_sentence, require_weight
from hil.pipeline.prepared import Prepared, prepare_sources, samples_of
from hil.pipeline.sources import (
    Source,
    Sources,
    aligned,
    archives_in,
    arm_differences,
    gather_sources,
    refuse_duplicates,
)
from hil.pipeline.torque_scale import TorqueScale, torque_scale
from identification.estimators.payload_estimate import (
    NAMES,
    PayloadEstimate,
    contradiction,
    figures_of,
    identify_payload,
    reach,
)
from identification.estimators.payload_problem import KnownArm, Run
from identification.factor.columns import standard_factor
from identification.factor.messages import blocks_words
from identification.hypotheses.gravity_direction import find_gravity
from identification.model.pseudo_inertia import Body
from identification.model.robot import STANDARD_GRAVITY, RobotModel
from identification.signals.samples import Samples
from identification.validation.finding import Thresholds
from identification.validation.finding_messages import MOUNTING_STEP

from .payload_settings import NOT_DETERMINED, ControllerLoad, controller_settings

_MIN_CENTRE_LIMIT: Final = 0.5  # m, of a hand tool on an arm that is shorter itself
_FITTED_SHARE: Final = 0.7  # of each bare recording, when the direction of gravity is tried
_MAX_BARE_RECORDINGS: Final = 3  # enough to determine gravity
_UNITS: Final = dict(zip(NAMES, ["kg", *["m"] * 3, *["kg·m²"] * 6], strict=True))


def weight_per_mass(model: RobotModel) -> float:
    """Return the gravity [m/s²] that loads the flange, also where the torque is without it."""
    return float(np.linalg.norm(model.gravity if np.any(model.gravity) else STANDARD_GRAVITY))


@dataclass(frozen=True, eq=False)
class PayloadFound:
    """An identified payload."""

    estimate: PayloadEstimate
    body: Body
    frame: str  #: link in whose frame `body` is
    gravity: float  #: magnitude [m/s²]
    bare: tuple[str, ...]  #: names of the archives without payload
    loaded: tuple[str, ...]  #: names of the archives with payload
    scale: TorqueScale  #: how well the torques are known
    mounting: str | None  #: why the stated direction of gravity is unlikely, with a remedy
    #: what the recordings certainly are other than described, with a remedy each
    otherwise: tuple[str, ...]
    #: as typed: archives or folders without and with payload
    typed: tuple[tuple[Path, ...], tuple[Path, ...]]
    with_currents: bool  #: whether all archives hold motor currents
    warnings: tuple[str, ...]

    @property
    def figures(self) -> Array:
        """Values of `NAMES` (10,)."""
        return figures_of(self.body)

    @property
    def wrist_torque(self) -> tuple[float, float, float]:
        """Maximum torque of its weight about the frame's origin and its interval [N·m]."""
        value, low, high = (self.gravity * part for part in self.estimate.moment)
        return value, low, high

    @property
    def is_doubtful(self) -> bool:
        """Whether the recordings are other than described, so that nothing should be set."""
        return self.mounting is not None or bool(self.otherwise)

    def outside(self, expected: Mapping[str, float]) -> list[str]:
        """Return a sentence about each expected value outside its interval.

        Raises:
            InputError: a name is unknown.
        """
        sentences = []
        for name, value in expected.items():
            if name not in NAMES:
                problem = f"{name!r} is not a property of a payload"
                remedy = f"use one of {', '.join(NAMES)}, for example mass=4.0"
                raise InputError(None, problem, field="--check", remedy=remedy)
            low, high = self.estimate.intervals[NAMES.index(name)]
            if not low <= value <= high:
                unit = _UNITS[name]
                sentences.append(
                    f"{name} {value:g} {unit} is outside the 95 % interval {low:.4g} to"
                    f" {high:.4g} {unit}"
                )
        return sentences

    def remedy(self, expected: Mapping[str, float]) -> list[str]:
        """Return what to do if an expected value is outside its interval."""
        mass = expected.get("mass")
        if mass is None:
            return [
                "check the torque constants with a known load: repeat with --check mass=KG, which"
                " prints the command for it"
            ]
        ratio = mass / self.body.mass
        lines = [
            f"the torques are too large by a factor of {1.0 / ratio:.3f} if the load weighs"
            f" {mass:g} kg; they come from the torque constants or sensors"
        ]
        if not self.with_currents:
            lines.append(
                "the archives hold torques without motor currents: check unit and scale of"
                f" [torque] in the column map (scale = {ratio:.4f} times the present one)"
            )
            return lines
        if not self.bare:
            lines.append(
                "estimate the torque constants from the known load: record the same motion without"
                " it, then hil torque-constants BARE --loaded LOADED"
            )
            return lines
        lines.append(f"estimate the torque constants from the known load: {self._gains(expected)}")
        return lines

    def _gains(self, expected: Mapping[str, float]) -> str:
        """Return the command that estimates torque constants from these recordings."""
        bare, loaded = self.typed
        # The same factor is in mass and inertia, and not in the centre.
        ratio = expected["mass"] / self.body.mass
        factors = [ratio, 1.0, 1.0, 1.0, *[ratio] * 6]
        figures = {
            name: expected.get(name, float(factor * value))
            for name, factor, value in zip(NAMES, factors, self.figures, strict=True)
        }
        centre = ",".join(_rounded(figures[name], 4) for name in NAMES[1:4])
        arguments = ["hil", "torque-constants", *map(str, bare)]
        for path in loaded:
            arguments += ["--loaded", str(path)]
        arguments += ["--mass", f"{figures['mass']:g}", f"--centre={centre}", "--frame", self.frame]
        if self.determines(*NAMES[4:]):
            order = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
            tensor = ",".join(_rounded(figures[name], 5) for name in order)
            arguments.append(f"--inertia={tensor}")
        return shlex.join(arguments)

    def determines(self, *names: str) -> bool:
        """Return whether all figures are determined."""
        return not set(names) & set(self.estimate.undetermined)

    @property
    def sentences(self) -> list[str]:
        """Summary for the operator."""
        body = self.body
        estimate = self.estimate
        torque = self.wrist_torque
        low, high = estimate.intervals[0]
        centre = ", ".join(
            f"{_rounded(1e3 * part, 1)}" if self.determines(name) else "?"
            for name, part in zip(NAMES[1:4], body.centre, strict=True)
        )
        lines = [
            f"The payload weighs {body.mass:.4g} kg (95 %: {low:.4g} to"
            f" {high:.4g} kg), its centre of mass is at {centre} mm in the frame {self.frame};"
            f" its weight loads the flange with up to {torque[0]:.3g} N·m"
            f" ({torque[1]:.3g} to {torque[2]:.3g}).",
            f"The intervals are computed {scale_words(self.scale)}.",
        ]
        ambiguous = [
            name
            for name in estimate.undetermined
            if not estimate.impossible or name not in NAMES[4:]
        ]
        if ambiguous:
            lines.append(f"{', '.join(ambiguous)} {NOT_DETERMINED}.")
        if estimate.impossible:
            lines.append(
                f"The estimate of {', '.join(estimate.impossible)} is negative, which no body has:"
                " the inertia is not determined. Friction or delay of the torques may differ"
                " between the recordings; record the same motion bare and loaded, on a warm arm."
            )
        if estimate.is_beyond_reach:
            distance = float(np.linalg.norm(body.centre))
            lines.append(
                f"A load of {body.mass:.3g} kg whose centre of mass is {distance:.2g} m from the"
                " frame would be larger than a block of foam: the difference may be a change of "
                "the arm itself. Record both on a warm arm, one after the other, and check with a "
                "load of"
                " known mass."
            )
        if self.mounting is not None:
            lines.append(f"The mounting is doubtful: {self.mounting}. No controller settings.")
        lines += [f"Doubtful: {each}. No controller settings." for each in self.otherwise]
        return lines

    @property
    def table(self) -> list[tuple[str, float | None, float, float, str]]:
        """Rows of name, value (None: not determined), interval and unit."""
        rows = zip(NAMES, self.figures.tolist(), self.estimate.intervals.tolist(), strict=True)
        return [
            (name, value if self.determines(name) else None, low, high, _UNITS[name])
            for name, value, (low, high) in rows
        ]

    @property
    def controllers(self) -> dict[str, str]:
        """Commands that set the payload, by controller; units and frames as in its manual.

        What is not determined has a comment instead of its command. Empty if the recordings are
        other than described.
        """
        if self.is_doubtful:
            return {}
        with_centre = self.determines(*NAMES[1:4])
        with_inertia = self.determines(*NAMES[4:])
        return controller_settings(ControllerLoad(self.body, with_centre, with_inertia))

    def lines(
        self,
        expected: Mapping[str, float] | None = None,
        outside: Sequence[str] = (),
        *,
        settings: bool = True,
    ) -> list[str]:
        """Return sentences, table and commands, and the comparison with expected values.

        Without `settings` the commands of controllers are named and not written.
        """
        lines = [*self.sentences, ""]
        figures = columns([_row(*row) for row in self.table])
        lines += [
            f"{figure}  {row[-1]}".rstrip() for figure, row in zip(figures, self.table, strict=True)
        ]
        for controller, command in self.controllers.items() if settings else ():
            lines += ["", f"{controller}:", command]
        lines += ["", *(f"warning: {warning}" for warning in self.warnings)]
        lines += [f"check: {sentence}" for sentence in outside]
        if outside:
            lines += [f"next: {sentence}" for sentence in self.remedy(expected or {})]
        elif expected:
            lines.append(f"check: {', '.join(expected)} inside the 95 % interval")
        if self.controllers and not settings:
            lines.append(f"settings of {', '.join(self.controllers)}: -v")
        return lines

    @property
    def _method(self) -> str:
        by_model = "" if self.bare else ", against the model of the arm"
        return f"{blocks_words(self.estimate.blocks)}{by_model}"

    def as_json(self) -> dict[str, Any]:
        """Return all values as JSON data; infinite ends and undetermined values are null."""
        torque = self.wrist_torque
        estimate = self.estimate

        def figure(value: float | None, low: float, high: float, unit: str) -> dict[str, Any]:
            interval = [end if np.isfinite(end) else None for end in (low, high)]
            return {"value": value, "interval": interval, "unit": unit}

        return {
            "frame": self.frame,
            "figures": {
                name: figure(value, low, high, unit) for name, value, low, high, unit in self.table
            },
            "wrist_torque": figure(*torque, "N·m"),
            "undetermined": list(estimate.undetermined),
            "impossible": list(estimate.impossible),
            "torque_uncertainty": {
                "std": self.scale.std.tolist(),
                "of": scaled_words(self.scale),
                "source": SCALE_SOURCES[self.scale.source],
            },
            "mounting": self.mounting,
            "otherwise": list(self.otherwise),
            "least_squares": estimate.parameters.tolist(),
            "method": self._method,
            "controllers": self.controllers,
            "bare": list(self.bare),
            "loaded": list(self.loaded),
            "warnings": list(self.warnings),
        }


def _row(name: str, value: float | None, low: float, high: float, _: str) -> tuple[str, ...]:
    """Return the cells of a figure, rounded to two digits of half its interval."""
    if value is None:
        return (name, "not determined", "", "", "")
    half = 0.5 * (high - low)
    finite = np.isfinite(half) and half > 0.0
    decimals = max(0, 1 - math.floor(math.log10(half))) if finite else 4
    shown, low_text, high_text = (_rounded(each, decimals) for each in (value, low, high))
    return (name, shown, low_text, "to", high_text)


def _rounded(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # + 0.0: no minus before a zero


def find_payload(
    bare: Sequence[Path],
    loaded: Sequence[Path],
    reporter: Reporter,
    *,
    frame: str | None = None,
    options: Options = Options(estimator="wls"),
) -> PayloadFound:
    """Identify the payload of the loaded recordings as their difference to the bare ones.

    Settings are chosen on the bare recordings; `[robot.payload]` of the cells is ignored.

    Args:
        bare: archives, folders of them, or campaign folders.
        loaded: likewise.
        reporter: of progress.
        frame: link of the payload, by default that of `flange_of`.
        options: of the identification.

    Raises:
        NoPayloadError: the loaded recordings show no payload.
        InputError: archives cannot be used, are of two arms, or hold torque without gravity.
        IdentificationError: the recordings do not determine the mass.
    """
    sides = _sides(bare, loaded)
    by_side = _sources_of(sides)
    training = (*by_side[False].training, *by_side[True].training)
    cell = by_side[False].cell.without_payload()
    if by_side[False].plan is None and by_side[True].plan is None:
        training, _ = aligned(training)
    first = training[: len(by_side[False].training)]
    last = training[len(by_side[False].training) :]
    sources = replace(by_side[False], cell=cell, training=first, held_out=first)
    prepared = prepare_sources(sources, options, reporter)
    cell = prepared.sources.cell
    meanings = require_weight(cell.model, prepared.fitted, training, first[0].path)
    otherwise = tuple(in_a_sentence(each) for each in meanings if each.level == "wrong")
    frame = frame or flange_of(cell.model)
    runs = _runs(prepared, last, frame, reporter)
    simulated = all(side.header.only_simulated for side in by_side.values())
    recordings = [source.recording for source in training]
    scale = torque_scale(cell, recordings, simulated=simulated)
    with reporter.task("weighing", 2) as task:
        mounting = doubtful_mounting(cell.model, prepared.fitted)
        task.advance(1)
        contradictions = PayloadContradictions(mounting, otherwise)
        estimate, body = weighed(cell.model, runs, scale, frame, sides, training, contradictions)
        task.advance(1)
    doubtful = [in_a_sentence(each) for each in meanings if each.level != "wrong"]
    sentences = note_lines((*prepared.sources.warnings, *by_side[True].warnings))
    warnings = (*sentences, *doubtful)
    return PayloadFound(
        estimate=estimate,
        body=body,
        frame=frame,
        gravity=weight_per_mass(cell.model),
        bare=tuple(source.name for source in first),
        loaded=tuple(source.name for source in last),
        scale=scale,
        mounting=mounting,
        otherwise=otherwise,
        typed=(tuple(bare), tuple(loaded)),
        with_currents=all(recording.motor_current is not None for recording in recordings),
        warnings=tuple(dict.fromkeys(warnings)),
    )


class NoPayloadError(InputError):
    """The recordings show no payload; more of them may."""


class PayloadContradictions(NamedTuple):
    """Why recordings may be other than described, with a remedy each."""

    mounting: str | None
    otherwise: tuple[str, ...]


def _no_payload(
    estimate: PayloadEstimate, contradictions: PayloadContradictions, loaded: Sequence[Path]
) -> NoPayloadError:
    """Return the error of loaded recordings without a payload, which names the first of them."""
    low, high = estimate.intervals[0]
    others = f", like {len(loaded) - 1} more given as loaded" if len(loaded) > 1 else ""
    problem = f"shows no payload{others}: its mass is between {low:.3g} and {high:.3g} kg"
    remedy = "give recordings made with the payload here, and the ones without it as bare"
    if contradictions.mounting is not None:
        problem += ", as the arm is stated to be mounted"
        remedy = f"the mounting is doubtful: {contradictions.mounting}; then {remedy}"
    if contradictions.otherwise:
        problem += ", with the recordings as described"
        remedy = "; ".join([*contradictions.otherwise, f"then {remedy}"])
    return NoPayloadError(loaded[0], problem, remedy=remedy)


def _sides(bare: Sequence[Path], loaded: Sequence[Path]) -> dict[bool, list[Path]]:
    """Return the archives without (False) and with the payload."""
    sides = {False: list(archives_in(bare)), True: list(archives_in(loaded))}
    if not sides[False] or not sides[True]:
        problem = "recordings without and with the payload are needed"
        remedy = "give both: hil payload BARE... --loaded LOADED"
        raise InputError(None, problem, remedy=remedy)
    refuse_duplicates([*sides[False], *sides[True]])
    return sides


def _sources_of(sides: Mapping[bool, Sequence[Path]]) -> dict[bool, Sources]:
    """Return the bare (False) and the loaded recordings: of one arm, with torques."""
    sources = {
        kind: gather_sources(paths, Options().split, in_sample=True)
        for kind, paths in sides.items()
    }
    bare = sources[False].cell
    loaded = sources[True].cell
    if differing := arm_differences(bare, loaded):
        problem = f"is of another arm than {bare.path}: {' and '.join(differing)} differ"
        remedy = "give bare and loaded recordings of one arm"
        raise ArchiveError(sides[True][0], problem, field="--loaded", remedy=remedy)
    for source in (*sources[False].training, *sources[True].training):
        if source.recording.torque is None:
            problem = "contains no joint torques"
            remedy = "give drive.torque_constant in the column map"
            raise ArchiveError(source.path, problem, field="torque", remedy=remedy)
    return sources


def _runs(
    prepared: Prepared, loaded: Sequence[Source], frame: str, reporter: Reporter
) -> list[Run]:
    """Reduce the bare recordings, which are prepared, and the loaded ones."""
    cell = prepared.sources.cell
    bare = prepared.sources.training
    runs = []
    with reporter.task("reducing recordings", len(bare) + len(loaded)) as task:
        for source, samples in zip(bare, prepared.fitted, strict=True):
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=False))
            task.advance(1, source.name)
        for source in loaded:
            samples = samples_of(source, cell, prepared.settings)
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=True))
            task.advance(1, source.name)
    return runs


def weighed(
    model: RobotModel,
    runs: Sequence[Run],
    scale: TorqueScale,
    frame: str,
    sides: Mapping[bool, Sequence[Path]],
    training: Sequence[Source],
    contradictions: PayloadContradictions,
    arm: KnownArm | None = None,
) -> tuple[PayloadEstimate, Body]:
    """Return the payload of reduced recordings.

    Args:
        model: of the arm.
        runs: reduced recordings.
        scale: of torques.
        frame: of the payload.
        sides: the bare and the loaded archives.
        training: their recordings.
        contradictions: of the bare recordings.
        arm: what is known of it.

    Raises:
        InputError: there is no payload, the recordings contradict each other, or no arm can carry
            what was found.
        IdentificationError: the recordings do not determine the mass.
    """
    estimate = identify_payload(model, runs, scale.std, arm)
    if estimate.body is None:
        raise _no_payload(estimate, contradictions, sides[True])
    _require_agreement(model, runs, estimate, frame, sides, training, arm)
    positions = [np.abs(source.recording.position).max(axis=0) for source in training]
    travel = np.max(positions, axis=0)
    _require_within_reach(estimate, reach(model, frame, travel), frame)
    return estimate, estimate.body


def doubtful_mounting(model: RobotModel, bare: Sequence[Samples]) -> str | None:
    """Return why another direction of gravity is likely, from the bare recordings; else None.

    The check of :mod:`identification.validation`: fitted to the beginning of each recording, the
    best direction predicts the rest much better than the stated one.
    """
    first = []
    last = []
    for samples in bare[:_MAX_BARE_RECORDINGS]:
        count = len(samples.torque)
        cut = round(_FITTED_SHARE * count)
        first.append(samples.between(0, cut))
        last.append(samples.between(cut, count))
    gravity = find_gravity(model, standard_factor(model, first), standard_factor(model, last))
    limits = Thresholds()
    angle = float(np.degrees(gravity.angle))
    if not (gravity.ratio < limits.gravity and angle > limits.gravity_angle):
        return None
    declared, best = (
        ", ".join(f"{part:.2f}" for part in vector) for vector in (gravity.declared, gravity.best)
    )
    return (
        f"with gravity ({best}) m/s² in base axes, {angle:.0f}° from the declared ({declared})"
        f" m/s², the bare recordings are predicted with {np.sqrt(gravity.ratio):.2f} times the "
        f"error;"
        f" {MOUNTING_STEP}, and import the recordings again; if it is right, check the zero"
        " positions of the joints"
    )


def _require_agreement(
    model: RobotModel,
    runs: Sequence[Run],
    estimate: PayloadEstimate,
    frame: str,
    sides: Mapping[bool, Sequence[Path]],
    training: Sequence[Source],
    arm: KnownArm | None,
) -> None:
    """Raise InputError if two recordings carried different bodies."""
    weighings = contradiction(model, runs, estimate, arm)
    if weighings is None:
        return
    first, second = weighings
    loaded = next(run.loaded for run in runs if run.name == second.name)
    if not loaded:
        mass, low, high = second.mass
        heavier, lighter = (second, first) if mass > 0.0 else (first, second)
        low, high = (low, high) if mass > 0.0 else (-high, -low)
        raise InputError(
            None,
            f"the bare recordings contradict each other: {heavier.name} carries"
            f" {abs(mass):.3g} kg ({low:.3g} to {high:.3g} kg) more than {lighter.name}",
            remedy="give bare recordings with one tool, or none, on the flange",
        )
    phrases = []
    for weighing in weighings:
        mass, low, high = weighing.mass
        centre = ", ".join(
            f"{1e3 * part:.0f}" if np.isfinite(part) else "?" for part in weighing.centre
        )
        phrases.append(
            f"{weighing.name} weighs {mass:.4g} kg ({low:.4g} to {high:.4g} kg) with its centre at"
            f" ({centre}) mm in {frame}"
        )
    other = next(source.path for source in training if source.name == second.name)
    command = ["hil", "payload", *map(str, sides[False]), "--loaded", str(other)]
    raise InputError(
        None,
        f"the loaded recordings contradict each other: {phrases[0]}, {phrases[1]}",
        field="--loaded",
        remedy="a load that was turned, moved or changed is another payload; weigh each by itself:"
        f" {shlex.join(command)}",
    )


def _require_within_reach(estimate: PayloadEstimate, length: float, frame: str) -> None:
    """Raise InputError if the centre of mass is further from the flange than the arm is long.

    A load's moment about the base is then at least twice that of the same mass at the flange, which
    no maker's rating allows.
    """
    value, low, high = (part / estimate.parameters[9] for part in estimate.moment)
    if value <= max(length, _MIN_CENTRE_LIMIT):
        return
    mass = estimate.parameters[9]
    raise InputError(
        None,
        f"the estimated body ({mass:.3g} kg) cannot hang on this arm: its centre of mass would be"
        f" {value:.2g} m ({low:.2g} to {high:.2g} m) from {frame}, and the arm is"
        f" {length:.2g} m long",
        field="--loaded",
        remedy="record the same motion bare and loaded, with the wrist in many poses; check that"
        " torques of all joints have the right sign and unit, and that only the payload differs",
    )


def flange_of(model: RobotModel) -> str:
    """Return the flange link: `tool0`, `flange`, or the link of the last joint."""
    last = {
        name: pose for name, pose in model.chain.frames.items() if pose.joint == model.n_joints - 1
    }
    named = next((name for name in FLANGES if name in last), None)
    return named or min(last, key=lambda name: float(np.abs(last[name].translation).sum()))
