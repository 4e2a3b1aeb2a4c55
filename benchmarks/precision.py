"""Whether precision to order keeps what it promises: `python -m benchmarks.precision --stops 200`.

Four independent parts, each with its number of seeds:

- ``--campaigns N``: campaigns of a warm arm with effects in virtual time, by default of the NS 16,
  by one quick design for ``--require``, as long as that of ``hil design --quick``, run with
  ``--until-precise``; ``--as-modelled`` without the effects that the model leaves out, as
  ``hil run`` simulates a cell; ``--arm`` two_joints, ur5 or panda. Figures: outcomes, repetitions,
  robot time over that of thirty repetitions of this motion and of one of 20 s, promised and reached
  intervals of the requirements, both after the same repetitions, their ratio, also of what is
  promised with the torque error and the gears that the two validation runs of a campaign show
  (``by_recordings``: before them these are assumed), largest errors, the share of parameters whose
  true value is in its 95 % interval at the end, and the processor time of the last update of the
  estimate.
- ``--stops N``: the same rule on simulated torques of the NS 16 with coloured noise and an error
  that every repetition has: coverage of all intervals when the rule has stopped, and after six
  repetitions without looking. Required are 1.1 times the intervals after six repetitions.
- ``--weighings N``: loads of `benchmarks.payload` weighed by payload campaigns of the NS 16 in
  virtual time, scaled to 3 to 12 kg, with one design for 12 kg at 0.25 m, until ``--require-mass``
  is met, or after ``--pairs`` of a bare and a loaded motion. One whose motion is rejected, as a
  motor was at its limit, is counted.
- ``--payloads N``: loads of `benchmarks.payload` weighed without a bare recording, against the
  model of three bare recordings of other motions. Friction differs by 4 % between recordings.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.payload import arm_model, load_of, recordings_of, samples_of
from benchmarks.simulated_cells import DATA_SHEETS, simulated_cell
from drivers.transports.simulated import SimulatedTransport
from hil.base.progress import Silent, Task
from hil.campaign import Campaign, Stop
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.plan import CampaignPlan, plan_around, validation_motions
from hil.campaign.reached_precision import PrecisionMeter
from hil.cell import Cell
from hil.control.link import MotionLink
from hil.control.motion_checks import MotionChecks
from hil.control.planted_arm import planted_truth, planted_values
from hil.control.simulated_cell import (
    controller_settings,
    simulated_controller,
    simulated_link,
    simulated_provenance,
)
from hil.control.virtual_link import VirtualLink
from hil.design.design import run_search
from hil.design.problem import problem_of
from hil.payload.payload_run import flange_of
from hil.precision.forecast import PrecisionDesign, payload_search, short_search
from hil.precision.requirements import MIN_CONSECUTIVE_MET, Requirement, requirements_from
from hil.weighing.payload_campaign import (
    MIN_PAIRS,
    PayloadCampaign,
    PayloadMounting,
    assumed_payload,
    loaded_cell,
)
from hil.weighing.weighed import Weighed
from identification.estimators.payload_estimate import NAMES, figures_of, identify_payload
from identification.estimators.payload_problem import KnownArm, Run
from identification.estimators.prior import body_prior, design_effect_of, fit_posterior
from identification.excitation import ViaPointMotion
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.model.pseudo_inertia import Body
from identification.model.robot import RobotModel
from sim_fixtures import SimulatedController
from sim_fixtures.ns16 import CELL_PATH
from sim_fixtures.plant import Carried

Array = NDArray[np.float64]

Figures = dict[str, Any]

_CELLS: Final = {
    "ns16": CELL_PATH,
    "two_joints": Path(__file__).parents[1] / "examples" / "two_joints" / "cell.toml",
}
_THIRTY: Final = 30
_DRIFT: Final = 0.016
"""Drift of friction that is left of a warm arm: the warm-up ends where a motion of 75 s changes
friction by 0.2 %, and the simulated arm needs 600 s for 63 % of what is left."""
_USUAL: Final = 20.0  # s, longest motion of `hil design` without requirements
_HEAVIEST: Final = 12.0  # kg; heavier loads leave no feasible motion of the cell
_FARTHEST: Final = (0.0, 0.0, 0.25)  # m, centre of mass in the frame of the flange
_RATE: Final = 250.0  # Hz
_MEMORY: Final = 0.02  # s, of the noise
_NOISE: Final = 0.02  # of the torque's scatter
_REPEATED: Final = 0.003  # likewise, of the error that every repetition has
_MOST: Final = 12  # repetitions of a simulated rule


def campaigns(arm: str, count: int, required: str, first_seed: int, effects: bool) -> Figures:
    """Run campaigns of an arm until they are precise."""
    seeds = range(first_seed, first_seed + count)
    with tempfile.TemporaryDirectory() as scratch:
        return campaigns_of(cell_of(arm, Path(scratch)), required, seeds, effects=effects)


def cell_of(arm: str, folder: Path) -> Cell:
    """Return the simulated cell of one of `ARMS`; that of another maker is made in a folder."""
    path = _CELLS.get(arm)
    return simulated_cell(arm, folder) if path is None else Cell.load(path)


def campaigns_of(cell: Cell, required: str, seeds: range, *, effects: bool) -> Figures:
    """Run campaigns of a cell by one quick design until they are precise."""
    requirements = requirements_from([required])
    drift = _DRIFT if effects else 0.0
    cell = cell.with_campaign(validation_runs=2, repetitions=_THIRTY)
    cell = cell.with_values({"campaign.approach_speed": 1.0, "simulation.friction_drift": drift})
    motions = [motion.trajectory for motion in _validation(cell)]
    promise = PrecisionDesign.of(cell, requirements, motions, (), effects=effects)
    settings = promise.lengthened(short_search(), MIN_CONSECUTIVE_MET)
    problem = problem_of(cell, settings, None, promise.precision(MIN_CONSECUTIVE_MET))
    excitation = run_search(cell, settings, Silent(), problem=problem).excitation
    plan = plan_around(cell, excitation)
    done = list[_Ended]()
    for seed in seeds:
        changed = cell.with_campaign(simulation_seed=seed)
        done.append(_ended(changed, plan, requirements, promise, effects=effects))
        show(done[-1].summary() | {"seed": seed}, only_json=True)
    repetitions = [campaign.repetitions for campaign in done]
    forecasts = [promise.forecasts(excitation, number) for number in repetitions]
    promised = np.array([[expected.half for expected in forecast] for forecast in forecasts])
    reached = np.array([campaign.reached for campaign in done])
    return {
        "campaigns": len(seeds),
        "outcomes": dict(Counter(campaign.outcome for campaign in done)),
        "repetitions": float(np.mean(repetitions)),
        "duration_s": excitation.trajectory.duration,
        "robot_time_of_thirty": float(np.mean(repetitions)) / _THIRTY,
        "robot_time_of_thirty_of_20_s": float(np.mean(repetitions))
        * excitation.trajectory.duration
        / (_THIRTY * _USUAL),
        "required": [requirement.value for requirement in requirements],
        "promised": np.median(promised, axis=0).tolist(),
        "promised_repetitions": [expected.repetitions for expected in forecasts[0]],
        "reached": np.median(reached, axis=0).tolist(),
        "reached_over_promised": np.quantile(
            reached / promised, (0.05, 0.5, 0.95), axis=0
        ).T.tolist(),
        "reached_over_promised_by_recordings": np.quantile(
            reached / [campaign.promised for campaign in done], (0.05, 0.5, 0.95), axis=0
        ).T.tolist(),
        "last_look_s": float(np.median([campaign.look for campaign in done])),
        "largest_error": np.median([campaign.largest for campaign in done], axis=0).tolist(),
        "quantities_inside": np.mean([campaign.inside for campaign in done], axis=0).tolist(),
        "errors_within_required": float(np.mean([campaign.within for campaign in done])),
        "met_and_all_within": float(
            np.mean([campaign.outcome == "met" and campaign.all_within for campaign in done])
        ),
    }


def _validation(cell: Cell) -> tuple[ViaPointMotion, ...]:
    return validation_motions(cell, MotionChecks.of(cell))


@dataclass(frozen=True)
class _Ended:
    """A campaign that has ended.

    Attributes:
        outcome, repetitions: of its record.
        reached: halves of the intervals, one for each requirement.
        promised: likewise, for the repetitions that were run, given the validation runs.
        largest: largest errors, likewise in units of the requirement.
        inside: of each requirement, the share of quantities whose true value is in its interval.
        within: share of them whose error is at most what was required.
        all_within: whether that is so for all.
        look: processor time of the last look [s].
    """

    outcome: str
    repetitions: int
    reached: list[float]
    promised: list[float]
    largest: list[float]
    inside: list[float]
    within: float
    all_within: bool
    look: float

    def summary(self) -> dict[str, Any]:
        return asdict(self)


class _Warmth(Silent):
    """Keeps the mean factor on the friction in each repetition; simulated friction drifts.

    From a repetition's begin to its end by a thousandth: less than its interval.
    """

    def __init__(self, controller: SimulatedController) -> None:
        self._plant = controller.plant
        self._after = [self._plant.friction_scale]  # each motion (n,)
        self.factors: list[Array] = []

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        with super().task(title, total):
            yield Task(lambda *_: self._after.append(self._plant.friction_scale))

    def say(self, text: str) -> None:
        if text.startswith("precision after"):
            self.factors.append(np.mean(self._after[-2:], axis=0))


def _ended(
    cell: Cell,
    plan: CampaignPlan,
    requirements: Sequence[Requirement],
    promise: PrecisionDesign,
    *,
    effects: bool,
) -> _Ended:
    """Run one campaign, and compare its estimate with the simulated arm."""
    controller = simulated_controller(
        cell, effects=effects, settings=controller_settings(cell, effects=effects)
    )
    link = VirtualLink.over(SimulatedTransport(controller), cell, finish=controller.finish)
    warmth = _Warmth(controller)
    with tempfile.TemporaryDirectory() as scratch:
        campaign = Campaign.create(Path(scratch) / "it", cell, plan)
        campaign.run(
            link,
            Stop(),
            warmth,
            provenance=simulated_provenance(cell, effects=effects),
            durable=False,
            unrehearsed=True,
            until_precise=requirements,
        )
        record = campaign.precision
        assert record is not None
        number = record.looks[-1].repetitions
        paths = campaign.folder.completed("excitation")[:number]
        meter = PrecisionMeter(campaign, requirements)
        for count in range(1, number + 1):
            begin = time.process_time()
            measured = meter.estimate(paths[:count])
            look = time.process_time() - begin
        motions = [motion.trajectory for motion in plan.validation]
        given = campaign.folder.completed("validation")
        shown = PrecisionDesign.of(cell, requirements, motions, given, effects=effects)
        # The campaign does not count these recordings.
        shown = replace(shown, prior=promise.prior)
        promised = [forecast.half for forecast in shown.forecasts(plan.excitation, number)]
    model = cell.model
    scale = np.ones(model.n_parameters)
    drift = np.mean(warmth.factors, axis=0)
    scale[model.friction_part] = [
        drift[term.owner] if term.term.is_friction else 1.0 for term in model.friction.terms
    ]
    quantities = measured.required.quantities
    planted = dict(zip(model.parameter_names, scale * planted_values(cell), strict=True))
    estimate = measured.estimate
    # A chosen effect, such as torque ripple, has no planted parameters: it counts as estimated.
    true = map(planted.get, estimate.names, estimate.values.tolist())
    truth = quantities.directions @ np.array(list(true))
    error = np.abs(measured.values - truth)
    within = error <= quantities.allowed
    return _Ended(
        outcome=record.outcome,
        repetitions=number,
        reached=[quantity.half for quantity in record.looks[-1].reached],
        promised=promised,
        largest=[
            requirement.value
            * float(np.max((error / quantities.allowed)[measured.required.owners == k]))
            for k, requirement in enumerate(requirements)
        ],
        inside=[
            float(np.mean((error <= measured.half)[measured.required.owners == k]))
            for k in range(len(requirements))
        ],
        within=float(np.mean(within)),
        all_within=bool(within.all()),
        look=look,
    )


def stops(count: int) -> dict[str, Any]:
    """Stop simulated campaigns by the rule, and count the intervals that hold the truth."""
    model = arm_model()
    stopped: list[float] = []
    planned: list[float] = []
    numbers: list[int] = []
    for seed in range(count):
        random = np.random.default_rng([seed, 52])
        recording = next(iter(recordings_of(seed, model.joint_names, (None,))))
        samples = samples_of(recording, model)
        truth = _posterior(model, Factor.by_time(model, samples))[0].values
        clean = model.torque(truth, samples.motion.kinematics())
        scatter = clean.std(axis=0)
        repeated = clean + _REPEATED * scatter * _coloured(random, clean.shape)
        factors = []
        for _ in range(_MOST):
            torque = repeated + _NOISE * scatter * _coloured(random, clean.shape)
            factors.append(Factor.by_time(model, replace(samples, torque=torque)))
        half = _interval(model, factors[: _MOST // 2])[1]
        number = _MOST
        met = 0
        for repetition in range(1, _MOST + 1):
            met = met + 1 if np.all(_interval(model, factors[:repetition])[1] <= 1.1 * half) else 0
            if met == MIN_CONSECUTIVE_MET:
                number = repetition
                break
        numbers.append(number)
        for share, some in ((stopped, factors[:number]), (planned, factors[: _MOST // 2])):
            values, half = _interval(model, some)
            share.append(float(np.mean(np.abs(values - truth) <= half)))
    return {
        "stops": count,
        "repetitions": float(np.mean(numbers)),
        "covered_at_the_stop": float(np.mean(stopped)),
        "covered_without_looking": float(np.mean(planned)),
    }


def payloads(count: int) -> dict[str, Any]:
    """Weigh loads against the model of the arm, without bare recordings of the motion."""
    model = arm_model()
    errors: list[float] = []
    inside: list[NDArray[np.bool_]] = []
    widths: list[float] = []
    for seed in range(count):
        load = load_of(seed)
        bare = (None, None, None)
        recordings = recordings_of(seed + 10_000, model.joint_names, bare, other_motions=True)
        factors = [Factor.by_time(model, samples_of(recording, model)) for recording in recordings]
        total = sum(factors[1:], factors[0])
        estimate, prior, effect = _posterior(model, total)
        known_arm = KnownArm.of(total, estimate, prior, effect)
        loaded = next(iter(recordings_of(seed, model.joint_names, (load,))))
        run = Run.of("loaded", model, samples_of(loaded, model), None, loaded=True)
        load_estimate = identify_payload(model, [run], arm=known_arm)
        truth = figures_of(load)
        inside.append(
            (load_estimate.intervals[:, 0] <= truth) & (truth <= load_estimate.intervals[:, 1])
        )
        errors.append(float(load_estimate.parameters[9]) / load.mass - 1.0)
        widths.append(float(np.diff(load_estimate.intervals[0])[0]) / 2.0 / load.mass)
    error = np.array(errors)
    return {
        "payloads": count,
        "mass_error": float(np.sqrt(np.mean(error**2))),
        "worst": float(np.abs(error).max()),
        "within_one_percent": float(np.mean(np.abs(error) < 0.01)),
        "within_two_percent": float(np.mean(np.abs(error) < 0.02)),
        "half_width": float(np.median(widths)),
        "covered": dict(zip(NAMES, np.mean(inside, axis=0).tolist(), strict=True)),
    }


def weighings(count: int, required: str, most: int, first_seed: int) -> dict[str, Any]:
    """Weigh loads of 3 to 12 kg by payload campaigns of the NS 16 in virtual time.

    12 kg are assumed, as far from the flange as the farthest load.

    Each ends when it is precise, after at most so many pairs of a bare and a loaded motion.
    The arm is as modelled: its currents have noise, its servo errors, and it has no other effects.
    """
    requirements = requirements_from([required])
    cell = Cell.load(CELL_PATH).with_campaign(repetitions=most)
    # The arm is jogged home: the shortest way there would overload the wrist.
    cell = cell.with_values(
        {"simulation.initial_deg": cell.campaign.home_deg, "campaign.standstill_s": 1.0}
    )
    assumed = assumed_payload(cell, _HEAVIEST, _FARTHEST)
    settings = payload_search(cell.joint_limits)
    promise = PrecisionDesign.of(
        cell, requirements, [motion.trajectory for motion in _validation(cell)], (), assumed
    )
    problem = problem_of(
        loaded_cell(cell, "load", assumed), settings, None, promise.precision(MIN_PAIRS)
    )
    plan = plan_around(cell, run_search(cell, settings, Silent(), problem=problem).excitation)
    errors = []
    inside = []
    halves = []
    pairs = []
    rejected = 0
    for seed in range(first_seed, first_seed + count):
        heavy = load_of(seed)  # of up to 16 kg
        share = _HEAVIEST / 16.0
        load = Body(share * heavy.mass, heavy.centre, share * heavy.inertia)
        try:
            weighed = _weighed(cell.with_campaign(simulation_seed=seed), plan, load, requirements)
        except RepetitionsRejectedError as refusal:
            show({"seed": seed, "rejected": refusal.reasons[-1]}, only_json=True)
            rejected += 1
            continue
        truth = figures_of(load)
        intervals = weighed.payload.estimate.intervals
        inside.append((intervals[:, 0] <= truth) & (truth <= intervals[:, 1]))
        errors.append(weighed.payload.body.mass / load.mass - 1.0)
        halves.append((intervals[0, 1] - intervals[0, 0]) / 2.0 / load.mass)
        pairs.append(weighed.pairs)
        figures = {"seed": seed, "pairs": pairs[-1], "error": errors[-1], "half": halves[-1]}
        show(figures, only_json=True)
    error = np.abs(errors)
    return {
        "weighings": count,
        "rejected": rejected,
        "motion": plan.excitation.trajectory.duration,
        "motions": 2.0 * float(np.mean(pairs)),
        "mass_error": float(np.sqrt(np.mean(error**2))),
        "worst": float(error.max()),
        "within_one_percent": float(np.mean(error < 0.01)),
        "half_width": float(np.median(halves)),
        "covered": dict(zip(NAMES, np.mean(inside, axis=0).tolist(), strict=True)),
    }


def _weighed(
    cell: Cell, plan: CampaignPlan, load: Body, requirements: Sequence[Requirement]
) -> Weighed:
    """Run one payload campaign on an arm that carries a load, as it is in the flange's frame."""
    joint, rotation, translation = cell.model.chain.frame(flange_of(cell.model))
    carried = Carried(
        joint,
        load.mass,
        translation + rotation @ load.centre,
        rotation @ load.inertia @ rotation.T,
    )

    def link(side: Campaign, session: int) -> MotionLink:
        is_loaded = side.cell.model.payload is not None
        truth = replace(planted_truth(cell), carried=carried if is_loaded else None)
        return simulated_link(side.cell, truth=truth, session=session)

    with tempfile.TemporaryDirectory() as scratch:
        campaign = Campaign.create(Path(scratch) / "it", cell, plan)
        weighing = PayloadCampaign.of(campaign, "load", assumed_payload(cell, _HEAVIEST, _FARTHEST))
        return weighing.run(
            lambda side, choices: side.run(**choices),
            PayloadMounting(weighing, Silent()),
            Silent(),
            requirements=requirements,
            choices={"unrehearsed": True, "durable": False},
            links=link,
        )


def _posterior(model: RobotModel, factor: Factor) -> tuple[Estimate, Array, float]:
    """Return the posterior of a factor, and information (p, p) and effect of its prior."""
    prior = body_prior(model, factor).gaussian
    effect = design_effect_of(factor, prior)
    return fit_posterior(model, factor, prior, effect).estimate, prior.information, effect


def _interval(model: RobotModel, factors: Sequence[Factor]) -> tuple[Array, Array]:
    """Return parameters (p,) and halves of their intervals by repetitions together."""
    estimate = _posterior(model, sum(factors[1:], factors[0]))[0]
    return estimate.values, estimate.interval_factor * estimate.std


def _coloured(random: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Return noise of unit variance with a memory (m, n)."""
    keep = np.exp(-1.0 / (_MEMORY * _RATE))
    drive = np.sqrt(1.0 - keep**2) * random.standard_normal(shape)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0))


def main() -> None:
    """Print the figures of the parts that were asked for."""
    parser = parser_of(__doc__)
    parser.add_argument("--campaigns", type=int, default=0)
    parser.add_argument("--arm", choices=(*_CELLS, *DATA_SHEETS), default="ns16")
    parser.add_argument("--as-modelled", action="store_true", help="campaigns without effects")
    parser.add_argument("--first-seed", type=int, default=1, help="of campaigns and weighings")
    parser.add_argument("--require", default="torque 30, friction 10%")
    parser.add_argument("--stops", type=int, default=0)
    parser.add_argument("--weighings", type=int, default=0)
    parser.add_argument("--require-mass", default="mass of payload 1 %")
    parser.add_argument("--pairs", type=int, default=_MOST, help="of motions at most to weigh")
    parser.add_argument("--payloads", type=int, default=0)
    options = parser.parse_args()
    if options.pairs < MIN_PAIRS:
        parser.error(f"--pairs {options.pairs}: at least {MIN_PAIRS} pairs weigh a load")
    figures: dict[str, Any] = {}
    if options.campaigns:
        figures["campaigns"] = campaigns(
            options.arm,
            options.campaigns,
            options.require,
            options.first_seed,
            effects=not options.as_modelled,
        )
    if options.stops:
        figures["stops"] = stops(options.stops)
    if options.weighings:
        figures["weighings"] = weighings(
            options.weighings, options.require_mass, options.pairs, options.first_seed
        )
    if options.payloads:
        figures["payloads"] = payloads(options.payloads)
    show(figures, only_json=options.json)


if __name__ == "__main__":
    main()
