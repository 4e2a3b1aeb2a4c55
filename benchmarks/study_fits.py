"""What `benchmarks.identification_study` does with one recording: fits, whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.study_recordings import Condition, Kept, study_cell, validation_paths
from hil.simulation import planted_values
from identification.estimators.consistent import consistent_estimate
from identification.estimators.instrumental import (
    InstrumentalEstimate,
    estimate_instrumental,
    planned_motion,
)
from identification.estimators.least_squares import estimate_repetitions, fit_least_squares
from identification.estimators.losses import Huber, Tukey
from identification.estimators.robust import robust_estimate
from identification.factor.factor import Estimate, Factor
from identification.factor.phases import instrument_factor
from identification.model.robot import RobotModel
from identification.signals.samples import Preprocessing, Samples, prepare
from identification.validation.endogeneity import EndogeneityTest, endogeneity_test
from planner.arrays import Array

Outliers = Literal["none", "spikes", "bursts"]
BURST: Final = 0.02  # s, about the time a collision takes
GROSS: Final = 30.0  # standard deviations of the torque noise
SHARES: Final = {"none": 0.0, "spikes": 0.01, "bursts": 0.05}
INSTRUMENT_BANDWIDTH: Final = 20.0
"""Hz. A spline that follows the noise becomes so narrow that it takes motion out of the regressor,
which instruments cannot mend; one that does not is what they are for."""
_CLEAN: Final = 1e-20  # rad²: less noise than any bandwidth takes out


class Fit(NamedTuple):
    """One estimate, and how far from the truth it predicts.

    Attributes:
        values: (p,).
        half: half the 95 % interval of each parameter (p,).
        held_out: relative torque error on the validation motions, noise included.
        wrong: the same without their noise: torque of what is wrong with the parameters.
    """

    values: Array
    half: Array
    held_out: float
    wrong: float


class Instrumented(NamedTuple):
    """Least squares and instrumental variables on one recording.

    Attributes:
        usual: least squares on positions smoothed as `hil identify` does it.
        bandwidth: of that, the lowest [Hz].
        least_squares: on positions smoothed to `INSTRUMENT_BANDWIDTH`, whatever their noise.
        instrumental: on the same rows.
        p_value: of the Durbin-Wu-Hausman test, on the same rows.
        weak: parameters whose instruments are weak.
    """

    usual: Fit
    bandwidth: float
    least_squares: Fit
    instrumental: Fit
    p_value: float
    weak: int


class Consistent(NamedTuple):
    """The physically consistent estimate beside the free one.

    Attributes:
        free: weighted least squares.
        consistent: some machine's parameters.
        margin: smallest eigenvalue of any link's pseudo-inertia; positive if possible.
        possible: whether rotor inertias and friction have possible signs as well.
    """

    free: Fit
    consistent: Fit
    margin: float
    possible: bool


@dataclass(frozen=True, eq=False)
class Study:
    """What all fits share.

    Attributes:
        model: of the cell.
        truth: planted parameters (p,).
        preprocessing: as `hil identify` does it.
        validation: factor of the validation motions.
    """

    model: RobotModel
    truth: Array
    preprocessing: Preprocessing
    validation: Factor

    @classmethod
    def of(cls, folder: Path, condition: Condition) -> Study:
        """The study of a folder whose validation motions have been recorded."""
        cell = study_cell()
        delay = cell.controller.current_delay_cycles * cell.period
        empty = cls(
            cell.model,
            planted_values(cell),
            Preprocessing(torque_delay=delay),
            Factor.zero(cell.model),
        )
        total = empty.validation
        for path in validation_paths(folder, cell, condition):
            total = total + Factor.of(cell.model, empty.samples(Kept.load(path)))
        return replace(empty, validation=total)

    def samples(self, kept: Kept) -> Samples:
        """Smoothed and masked."""
        return prepare(
            kept.recording,
            self.model,
            noise_variance=kept.noise_variance,
            options=self.preprocessing,
            origin=kept.origin,
        )

    def fit(self, estimate: Estimate) -> Fit:
        """An estimate, judged."""
        gram = self.validation.gram.sum(axis=0)
        torque = float(gram[-1, -1])
        augmented = np.append(-estimate.values, 1.0)
        apart = estimate.values - self.truth
        return Fit(
            values=estimate.values,
            half=estimate.interval_factor * estimate.std,
            held_out=float(np.sqrt(max(augmented @ gram @ augmented, 0.0) / torque)),
            wrong=float(np.sqrt(max(apart @ gram[:-1, :-1] @ apart, 0.0) / torque)),
        )

    def weighted(self, kept: Kept) -> tuple[Fit, Array]:
        """Weighted least squares, and the classical half intervals (p,) beside the reported."""
        found = estimate_repetitions(self.model, [self.samples(kept)])
        return self.fit(found.pooled), 1.96 * found.classical_std

    def consistent(self, kept: Kept, share: float) -> Consistent:
        """With and without what a machine must obey, from the first share of a recording."""
        stop = round(share * kept.recording.n_samples)
        kept = replace(kept, recording=kept.recording.between(0, stop))
        found = estimate_repetitions(self.model, [self.samples(kept)])
        result = consistent_estimate(self.model, found.factor, found.pooled)
        rotors = [
            value
            for name, value in zip(self.model.standard_names, result.standard, strict=True)
            if name.endswith("m") and name.startswith("I")
        ]
        friction = [
            value
            for name, value in zip(
                self.model.parameter_names[self.model.base.rank :], result.friction, strict=True
            )
            if name.startswith(("f0", "f1"))
        ]
        return Consistent(
            free=self.fit(found.pooled),
            consistent=self.fit(result.estimate),
            margin=float(result.margin.min()),
            possible=min(rotors) >= 0.0 and min(friction) >= 0.0,
        )

    def instrumented(self, kept: Kept, times: float, seed: int) -> Instrumented:
        """Both estimates with `times` the position noise that the encoders have."""
        noisy = noisier(kept, times, seed)
        usual = self.samples(noisy)
        wide = replace(self.preprocessing, rigid_bandwidth=INSTRUMENT_BANDWIDTH)
        clean = replace(noisy, noise_variance=np.full(self.model.n_joints, _CLEAN))
        result, test = self._instrumental(
            replace(self, preprocessing=wide).samples(clean), kept.recording.commanded_position
        )
        return Instrumented(
            usual=self.fit(estimate_repetitions(self.model, [usual]).pooled),
            bandwidth=float(usual.position_bandwidth.min()),
            least_squares=self.fit(result.least_squares),
            instrumental=self.fit(result.estimate),
            p_value=test.p_value,
            weak=len(result.weak),
        )

    def exogenous(self, kept: Kept, seed: int) -> float:
        """Probability that the Durbin-Wu-Hausman test gives where least squares is not biased.

        The torque is what the smoothed motion needs, with noise that has not moved the arm.
        """
        samples = self.samples(kept)
        noise = np.random.default_rng(seed).standard_normal(samples.torque.shape)
        torque = samples.predicted_torque(self.model, self.truth)
        torque += np.sqrt(kept.torque_variance) * noise
        samples = replace(samples, torque=torque)
        return self._instrumental(samples, kept.recording.commanded_position)[1].p_value

    def _instrumental(
        self, samples: Samples, commanded: Array | None
    ) -> tuple[InstrumentalEstimate, EndogeneityTest]:
        assert commanded is not None
        instruments = planned_motion(samples, commanded)
        factor = instrument_factor(self.model, samples, instruments.motion, instruments.usable)
        result = estimate_instrumental(self.model, factor)
        return result, endogeneity_test(self.model, factor, result)

    def with_outliers(self, kept: Kept, kind: Outliers, seed: int) -> dict[str, Fit]:
        """Four estimators on torques with gross errors."""
        samples = self.samples(kept)
        samples = replace(samples, torque=disturbed(samples.torque, kept, kind, seed))
        runs = [samples]
        return {
            "ols": self.fit(fit_least_squares(self.model, runs, "ordinary")),
            "wls": self.fit(fit_least_squares(self.model, runs)),
            "huber": self.fit(robust_estimate(self.model, runs, Huber()).estimate),
            "tukey": self.fit(robust_estimate(self.model, runs, Tukey()).estimate),
        }


def noisier(kept: Kept, times: float, seed: int) -> Kept:
    """The recording with `times` the standard deviation of its position noise, white.

    Noise of what was recorded, not of what the servo has seen: the motion stays what it was.
    """
    if times <= 1.0:
        return kept
    random = np.random.default_rng([seed, round(times)])
    added = np.sqrt((times**2 - 1.0) * kept.noise_variance)
    position = kept.recording.position
    noise = added * random.standard_normal(position.shape)
    return replace(
        kept,
        recording=replace(kept.recording, position=position + noise),
        noise_variance=times**2 * kept.noise_variance,
    )


def disturbed(torque: Array, kept: Kept, kind: Outliers, seed: int) -> Array:
    """Torque (m, n) with a share of its rows off by `GROSS` standard deviations, either way.

    Spikes are single rows of single joints; in a burst all joints are off one way for `BURST`.
    """
    random = np.random.default_rng([seed, len(kind)])
    size = GROSS * np.sqrt(kept.torque_variance)
    hit: NDArray[np.bool_] = random.random(torque.shape) < SHARES[kind]
    if kind == "bursts":
        period = float(np.median(np.diff(kept.recording.time)))
        length = max(1, round(BURST / period))
        hit = np.zeros(torque.shape, dtype=np.bool_)
        sign = np.ones(torque.shape)
        for start in random.integers(0, len(torque), round(SHARES[kind] * len(torque) / length)):
            hit[start : start + length] = True
            sign[start : start + length] = random.choice([-1.0, 1.0], torque.shape[1])
    else:
        sign = random.choice([-1.0, 1.0], torque.shape)
    return torque + np.where(hit, sign * size, 0.0)
