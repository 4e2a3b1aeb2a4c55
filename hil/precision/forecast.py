"""Precision that a design promises: before the search, and of the motion that was found.

Not imported by the package: what reads archives also reads designs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.terminal_text import plural
from hil.cell import Cell
from hil.design.settings import MAX_VIA_POINTS, DesignSettings, preset
from hil.pipeline.estimating import posterior_of
from hil.pipeline.note_messages import scale_words
from hil.pipeline.options import FIXED
from hil.pipeline.prepared import reduction_of, stated_settings, versions_of
from hil.pipeline.torque_scale import TorqueScale, torque_scale
from hil.precision.given_recordings import given_sources
from hil.precision.required_quantities import ReferenceMotions, RequiredQuantities
from identification.distributions import NORMAL_95
from identification.estimators.elasticity import KnownGears, fitted_gears
from identification.estimators.payload_estimate import parameter_change
from identification.estimators.payload_problem import FRICTION_DRIFT_STD
from identification.excitation import Excitation, LoadQuantities, Objective, midpoints
from identification.excitation.motion_precision import Precision, Quantities
from identification.factor.estimate import inverse_variance
from identification.factor.factor import Factor
from identification.model.known_payload import Payload
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.reduction.intervals import excess_scores
from identification.reduction.reduction import Reduction
from identification.selection.settings import Strength
from planner import JointLimits, Trajectory
from sim_fixtures.servo import loops_per_cycle

from .predicted_variances import PredictedRows
from .requirements import MIN_CONSECUTIVE_MET, Requirement, require_known

MODEL_ERROR_SHARE: Final = 0.03
"""Torque error of a fitted model, as a share of each joint's torque, where nothing was recorded.
On the real arms of the board (`docs/board.md`) it is 2 to 17 %, on the simulated NS 16 2 %."""
ERROR_CORRELATION_TIME: Final = 0.015
"""Its correlation [s]: the simulated NS 16 with unmodelled effects has 14 ms."""
NOISE_SHARE: Final = 0.01
"""White noise of the torque in one cycle, which repetitions average, as a share of the torque."""
SIMULATED_SHARE: Final = 0.002
"""Torque error of the fitted model of a simulated arm, likewise, in addition to the noise of its
currents: its servo, encoders and smoothing. Chosen by what a campaign of the simulated NS 16 left
(0.3 % promised friction 1.3 times too wide)."""
_DEFAULT_CYCLE: Final = 0.001  # s, of a cell without controller
REFERENCE_PERIOD: Final = 0.04
"""Sampling of a motion on which precision is computed [s]."""
_KNOWN_ARM_SECONDS: Final = 60.0  # s of motion, from which an arm is assumed to be known
_MAX_PREDICTED_RATIO: Final = 0.85
"""Predicted over required interval for which a motion is made long enough. An interval is itself
estimated, from some sixty blocks of time: to 9 % (1 / sqrt(2 * 60)). It is to be met for sure, not
by every second motion: two standard deviations."""
_YEAR_SECONDS: Final = 3.156e7  # s
_MIN_MEASURED_RECORDINGS: Final = 3  # recordings whose torque error is measured
_MAX_WEIGHING_SECONDS: Final = 10.0  # s, longest motion for a payload
_WEIGHING_POINTS: Final = (4, 16)  # fewest and most via points of such a motion
_MOVE_SHARE: Final = 0.7
"""Time at speed of a move to the next via point of a search for a payload, as a share of that in
which the slowest joint crosses its range."""
_MAX_REPETITIONS: Final = 1000  # repetitions that are counted
_ENDLESS_INFORMATION_FACTOR: Final = 1e9  # factor of the information of motions without end


@dataclass(frozen=True)
class Forecast:
    """What is promised for one requirement.

    Attributes:
        requirement: what was wanted.
        worst: the quantity that is worst.
        half: half of its 95 % interval after the planned repetitions, in units of the requirement.
        repetitions: of this motion that meet the requirement, at least `MIN_CONSECUTIVE_MET`, as a
            campaign runs them; None if none do.
        motions: different motions of this kind that meet it, once each; None if none do.
        limit: half of the interval that the scale of the torque alone leaves; zero if the interval
            is in units of the torque of this arm.
    """

    requirement: Requirement
    worst: str
    half: float
    repetitions: int | None
    motions: int | None
    limit: float

    def message(self, planned: int, scale: TorqueScale) -> str:
        """Return the forecast as a sentence without full stop."""
        shown = self.requirement.shown
        after = plural(planned, "repetition")
        text = f"{self.requirement}: {self.worst} {shown(self.half)} after {after}"
        if self.repetitions is None and self.limit > self.requirement.value:
            return (
                f"{text}; no motion of this arm can meet it: {shown(self.limit)} remain, "
                f"{scale_words(scale)} (weigh a known load with `hil torque-constants`, or state "
                f"torque_uncertainty{self._own_units})"
            )
        if self.repetitions is not None:
            return f"{text}; met by {plural(self.repetitions, 'repetition')}"
        text += "; repetitions of one motion do not meet it, as the error of the model repeats"
        if self.motions is None:
            return f"{text}, and no number of such motions does"
        return f"{text}: {plural(self.motions, 'different motion')} of this kind would"

    @property
    def _own_units(self) -> str:
        if self.requirement.kind == "mass":
            return ""
        return ', or omit "absolute", in units of the torque of this arm'

    def to_dict(self) -> dict[str, Any]:
        """Return the forecast for JSON and TOML; what does not exist is left out."""
        table = {
            "requirement": str(self.requirement),
            "worst": self.worst,
            "half": self.half,
            "wanted": self.requirement.value,
            "limit": self.limit,
            "repetitions": self.repetitions,
            "motions": self.motions,
        }
        return {name: value for name, value in table.items() if value is not None}


@dataclass(frozen=True, eq=False)
class PrecisionDesign:
    """Requirements about an arm, and what is known of its parameters and its torque error."""

    cell: Cell
    required: RequiredQuantities
    subject: Array  #: parameters (p,) that the torque's scale multiplies: the arm's, or a load's
    values: Array  #: known parameters of the arm (p,)
    prior: Array  #: information of prior and recordings (p, p)
    error: Array  #: density (n,) of the torque error that every repetition has [(N m)² s]
    noise: Array  #: density (n,) of the noise that repetitions average [(N m)² s]
    reference: ReferenceMotions
    scale: TorqueScale
    source: str  #: where the torque error is from
    rigid: bool  #: whether the arm is a simulated one with rigid gears
    gears: KnownGears | None  #: by recordings; None: none

    @classmethod
    def of(
        cls,
        cell: Cell,
        requirements: Sequence[Requirement],
        motions: Sequence[Trajectory],
        given: Sequence[Path],
        payload: Payload | None = None,
        *,
        effects: bool = False,
    ) -> PrecisionDesign:
        """Return the requirements about a cell, on its validation motions.

        Without recordings the torque error of a real arm is assumed; for a simulated one it is the
        noise of its currents.

        Args:
            cell: of the arm.
            requirements: of precision.
            motions: validation motions.
            given: recordings of the arm.
            payload: that requirements are about, recorded on an arm that is known.
            effects: whether a simulated arm has effects that the model leaves out.

        Raises:
            InputError: a requirement names no joint or parameter, or is beyond what can be had.
            CellError: the cell lacks `[nominal]`.
        """
        require_known(requirements, cell.model)
        if any((requirement.kind == "mass") == (payload is None) for requirement in requirements):
            raise InputError(
                None,
                "the mass of a payload and the arm itself need different motions",
                field="--precision",
                remedy="for a payload add --for payload, with no other requirement than its mass; "
                "for the arm omit --for payload, and its mass",
            )
        sampled = [midpoints(motion, REFERENCE_PERIOD) for motion in motions]
        reference = ReferenceMotions(cell.model, sampled)
        nominal = cell.nominal_values()
        scatter = reference.scatter(nominal)
        simulated = cell.file.controller is not None and cell.only_simulated
        exact = simulated and not effects
        error, noise, source = _assumed_error(cell, scatter, exact=exact)
        factor = Factor.from_samples(cell.model, Motion.joined(sampled), reference.torque(nominal))
        prior = posterior_of(cell, factor, "auto", Strength()).prior.gaussian.information
        values = nominal
        gears = None
        scale = torque_scale(cell, (), simulated=simulated)
        if cell.file.drive_train is not None:
            scale = replace(scale, by_currents=True)
        if given:
            values, prior, measured, gears = _posterior(cell, given)
            # One recording shows both; repetitions average the noise.
            error = np.maximum(measured - noise, _error_density(SIMULATED_SHARE, scatter))
            source = "of the given recordings"
        information = prior + reference.information(error)
        subject = values
        if payload is None:
            required = reference.required(requirements, values, information)
        else:
            information = (
                prior if given else prior + _KNOWN_ARM_SECONDS * reference.information(error)
            )
            required, subject = _load(cell.model, requirements[0], payload, values, information)
        made = cls(
            cell, required, subject, values, prior, error, noise, reference, scale, source, exact,
            gears,
        )  # fmt: skip
        made._require_possible()
        return made

    def precision(self, repetitions: float) -> Precision:
        """Return the criterion of a search for a motion with that number of repetitions."""
        density = self.error + self.noise / repetitions
        return Precision(self.required.quantities, density, self.prior)

    def lengthened(self, settings: DesignSettings, repetitions: float) -> DesignSettings:
        """Return settings of a longer motion, if repetitions of one as long as theirs are too few.

        That is so if random motions of that length do not meet all requirements with a reserve. Via
        points are added at equal density, up to `MAX_VIA_POINTS`.
        """
        points = settings.via_points
        longest = settings.constraints.max_duration
        if points is None:
            return settings
        precision = self.precision(repetitions)
        rate = self.reference.information(precision.density)
        for count in range(points.n_via, MAX_VIA_POINTS + 1):
            seconds = longest * count / points.n_via
            if precision.ratios(seconds * rate).max() <= _MAX_PREDICTED_RATIO:
                break
        return settings.replaced(
            via_points={"n_via": count}, constraints={"max_duration": round(seconds, 1)}
        )

    def forecasts(self, excitation: Excitation, repetitions: int) -> list[Forecast]:
        """Return what a motion promises for each requirement after a number of repetitions."""
        shown = self._shown(midpoints(excitation.trajectory))
        limits = self._of_scale(shown, repetitions, _ENDLESS_INFORMATION_FACTOR)
        forecasts = []
        worst = self.required.worst(self._ratios(shown, repetitions, 1.0))
        for k, (requirement, label, ratio) in enumerate(worst):
            mine = self.required.owners == k
            repeated = partial(self._meets, shown, mine, motions=1.0)
            various = partial(self._meets, shown, mine, repetitions)
            forecasts.append(
                Forecast(
                    requirement=requirement,
                    worst=label,
                    half=ratio * requirement.value,
                    repetitions=_least(repeated, MIN_CONSECUTIVE_MET),
                    motions=_least(various, 1),
                    limit=float(limits[mine].max()) * requirement.value,
                )
            )
        return forecasts

    def _shown(self, motion: Motion) -> _Shown:
        """Return what a sampled motion shows; a payload is seen by two recordings of the arm."""
        if isinstance(self.required.quantities, LoadQuantities):
            step = float(motion.time[1] - motion.time[0])
            objective = Objective(self.cell.model, precision=self.precision(1.0))
            return _Shown(step * objective.precise_grams(motion), None)
        rows = PredictedRows.of(self.cell, motion, self.values, gears=self.gears, rigid=self.rigid)
        p = self.cell.model.n_parameters
        return _Shown(rows.grams[:, :p, :p], rows)

    def _meets(
        self, shown: _Shown, which: NDArray[np.bool_], repetitions: float, motions: float
    ) -> bool:
        """Return whether the ratios of some quantities (k,) are all at most one."""
        return bool(self._ratios(shown, repetitions, motions)[which].max() <= 1.0)

    def _ratios(self, shown: _Shown, repetitions: float, motions: float) -> Array:
        """Return the ratios (k,) for what a motion shows.

        `motions` is the number of different motions of its kind.
        """
        precision = self.precision(repetitions)
        quantities = self.required.quantities
        if shown.rows is None or not isinstance(quantities, Quantities):
            by_joint = motions * shown.grams / precision.density[:, None, None]
            ratios = precision.ratios(by_joint.sum(axis=0))
        else:
            variances = shown.rows.variances(
                quantities.directions, self.prior, precision.density, motions
            )
            half = shown.rows.interval_factor(motions) * np.sqrt(variances.total)
            ratios = half / quantities.allowed
        return np.asarray(np.hypot(ratios, self._of_scale(shown, repetitions, motions)))

    def _of_scale(self, shown: _Shown, repetitions: float, motions: float) -> Array:
        """Return the part of the ratios (k,) by the torque's scale; zero if it is no error."""
        is_absolute = self.required.absolute
        if not self.scale.std.any() or not is_absolute.any():
            return np.zeros(len(is_absolute))
        precision = self.precision(repetitions)
        by_joint = motions * shown.grams / precision.density[:, None, None]
        pulls = (by_joint @ self.subject).T
        slope = precision.spread(by_joint.sum(axis=0)).slope
        moved = slope @ pulls * self.scale.std
        by_scale = NORMAL_95 * np.linalg.norm(moved, axis=1) / self.required.quantities.allowed
        return np.where(is_absolute, by_scale, 0.0)

    def _require_possible(self) -> None:
        """Raise InputError for a requirement beyond what a year of different motions gives."""
        precision = self.precision(1.0)
        rate = self.reference.information(precision.density, has_offsets=precision.has_offsets)
        for requirement, worst, ratio in self.required.worst(
            precision.ratios(_YEAR_SECONDS * rate)
        ):
            if ratio > 1.0:
                year = ratio * requirement.value
                raise InputError(
                    None,
                    f"{requirement} cannot be reached: a year of motion leaves "
                    f"{requirement.shown(year)} ({worst})",
                    field="--precision",
                    remedy=f"a day leaves {requirement.shown(year * math.sqrt(365.0))}, an hour "
                    f"{requirement.shown(year * math.sqrt(365.0 * 24.0))}",
                )


class _Shown(NamedTuple):
    """What a motion shows: Gram matrices of the joints (n, p, p) [integrals], and all sums."""

    grams: Array
    rows: PredictedRows | None  #: of an arm; None for a payload


def _load(
    model: RobotModel,
    requirement: Requirement,
    payload: Payload,
    values: Array,
    arm_information: Array,
) -> tuple[RequiredQuantities, Array]:
    """Return the mass of a payload as what is wanted, and its change of the parameters (p,).

    The arm is known with the information `arm_information` (p, p); its friction may drift.
    """
    change = parameter_change(model, payload.frame)
    drift = np.where(model.friction_columns, FRICTION_DRIFT_STD * values, 0.0)
    scale = 1.0 / np.sqrt(np.diag(arm_information))
    unit = np.linalg.inv(arm_information * scale[:, None] * scale)
    covariance = unit * scale[:, None] * scale + np.diag(drift**2)
    deviation = np.sqrt(np.diag(covariance))
    root = deviation[:, None] * np.linalg.cholesky(covariance / deviation[:, None] / deviation)
    direction = np.zeros((1, change.shape[1]))
    direction[0, -1] = 1.0
    allowed = np.array([requirement.value * (payload.mass if requirement.relative else 1.0)])
    quantities = LoadQuantities(direction, allowed, change, root)
    owners = np.zeros(1, dtype=np.intp)
    return RequiredQuantities(
        (requirement,), quantities, ("mass",), owners
    ), change @ payload.parameters


def payload_search(limits: JointLimits) -> DesignSettings:
    """Return settings of a search for a motion that weighs a payload: at most ten seconds.

    It has as many via points as random moves within these limits take that time.
    """
    crossing = (limits.upper - limits.lower) / limits.velocity
    move = float(np.max(_MOVE_SHARE * crossing + limits.velocity / limits.acceleration))
    count = round(_MAX_WEIGHING_SECONDS / move) - 1
    few, many = _WEIGHING_POINTS
    # A heavy payload leaves few motions feasible: more of them, and slower ones, are tried.
    return short_search().replaced(
        search={"population": 60, "generations": 8},
        constraints={"max_duration": _MAX_WEIGHING_SECONDS},
        via_points={"n_via": min(max(count, few), many), "slowest": 0.2},
    )


def short_search() -> DesignSettings:
    """Return settings of a search of some seconds for a wanted precision."""
    return preset("gradient").replaced(
        search={"population": 24, "generations": 2, "gradient": 30, "starts": 1},
        via_points={"n_via": 8},
    )


def _least(meets: Callable[[int], bool], lowest: int) -> int | None:
    """Return the least count, to `_MAX_REPETITIONS`, from which on a condition holds."""
    if not meets(_MAX_REPETITIONS):
        return None
    low = lowest - 1
    high = _MAX_REPETITIONS
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if meets(middle) else (middle, high)
    return high


def _posterior(cell: Cell, paths: Sequence[Path]) -> tuple[Array, Array, Array, KnownGears | None]:
    """Return what recordings show of an arm.

    These are parameters (p,), their information (p, p), the torque error (n,), and its gears.
    """
    settings = stated_settings(cell, FIXED)
    reductions = list[Reduction]()
    errors = list[Array]()
    for source in given_sources(cell, paths):
        versions = versions_of(source, cell, settings)
        measured = len(errors) < _MIN_MEASURED_RECORDINGS
        reductions.append(reduction_of(cell, settings, versions, unmodelled=measured))
        if measured:
            step = float(np.median(np.diff(versions[0].motion.time)))
            factor = reductions[-1].factor
            alone = posterior_of(cell, factor, "auto", Strength())
            noise = alone.free(factor).estimate.noise_std
            errors.append(noise**2 * step * alone.design_effect)
    every = Reduction.total(cell.model, reductions)
    total = every.factor
    posterior = posterior_of(cell, total, "auto", Strength())
    estimate = posterior.free(total).estimate
    weights = inverse_variance(estimate.noise_std**2)
    data = total.weighted(weights).A / posterior.design_effect
    information = data + posterior.prior.belief.gaussian.information
    gears = None
    if every.unmodelled is not None and every.unmodelled.elastic is not None:
        elastic = every.unmodelled.elastic
        fitted = fitted_gears(
            estimate,
            total,
            elastic,
            posterior.design_effect,
            posterior.precision,
            times=every.times,
            excess=excess_scores(estimate, every, estimate.values),
        )
        size = elastic.compliance / elastic.recordings
        gears = KnownGears(size, fitted.mean, fitted.covariance)
    return estimate.values, information, np.median(errors, axis=0), gears


def _assumed_error(cell: Cell, scatter: Array, *, exact: bool) -> tuple[Array, Array, str]:
    """Return densities (n,) of the torque's error and noise [(N m)² s], and what they are of.

    `scatter` is that of the torques (n,) [N m]; the model of an `exact` arm leaves out nothing.
    """
    share = SIMULATED_SHARE if exact else MODEL_ERROR_SHARE
    error = _error_density(share, scatter)
    if exact:
        source = f"of the simulated arm: its current noise, and {100 * share:g} % of the torque"
        return error, _current_noise(cell), source
    source = f"assumed, {100 * share:g} % of each joint's torque; recordings measure it (--given)"
    return error, (NOISE_SHARE * scatter) ** 2 * _cycle(cell), source


def _error_density(share: float, scatter: Array) -> Array:
    """Return the density (n,) of an error that is a share of the torques' scatter (n,)."""
    return (share * scatter) ** 2 * ERROR_CORRELATION_TIME


def _current_noise(cell: Cell) -> Array:
    """Return the density (n,) of the torque noise of a simulated arm's currents [(N m)² s].

    It is another one in each period of the servo loops.
    """
    simulation = cell.simulation
    variance = simulation.current_noise**2 + simulation.current_resolution**2 / 12.0
    torques = cell.drive_train.joint_torque(np.eye(len(cell.joint_names)))
    step = cell.period / loops_per_cycle(cell.period)
    return np.asarray(variance * (torques**2).sum(axis=0) * step)


def _cycle(cell: Cell) -> float:
    return _DEFAULT_CYCLE if cell.file.controller is None else cell.period
