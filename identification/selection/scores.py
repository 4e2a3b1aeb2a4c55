"""What settings of an identification are worth: their errors in predicted parts, and comparisons.

A candidate replaces the first one only if its error is lower by more than the standard error of the
difference over the segments (one-standard-error rule, Breiman et al. 1984), and by a share.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.consistent import consistent_values
from identification.estimators.prior import (
    USUAL_SPEED,
    BodyPrior,
    body_prior,
    design_effect_of,
    posterior_values,
    torque_scatter,
)
from identification.factor.factor import Factor, total_factor
from identification.model.elements import Element, PositionTorque, TorqueRipple, TorsionSpring
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.selection.folds import FOLDS, Errors, Folds, PredictedRows, mean_error
from identification.selection.settings import Candidate, Choice, Settings, Strength
from identification.signals.samples import Preprocessing, Samples

Rows = NDArray[np.bool_]

TRANSFER_STD: Final = 0.07
"""By how much the gain of an answer on another motion differs from that on parts of this one.

Relative standard deviation, root mean square over eight real arms (60 splits, candidates within
10 % of the chosen one by inner prediction): 8 % for bandwidths (0 to 14 % by arm), 6 % for
presliding displacements (1 to 12 %). Measured once, at ab6d0d94."""

# Improvement required to replace the first, simpler candidate, besides its standard error.
MIN_IMPROVEMENT: Final = 0.01
# Bodies that cannot exist are of no use in a simulator, so they must predict better by more than
# what is worthwhile elsewhere. 3 % in place of 5 % decides eight splits of three of eight real arms
# otherwise, and what is held out is then predicted 5 % better on average (-11 to +1 %).
MIN_IMPOSSIBLE_IMPROVEMENT: Final = 0.03
# An error above the torque itself chooses nothing, nor does one that no sensor resolves.
MEANINGLESS_ERROR: Final = 1.0
_EXACT_ERROR: Final = 1e-5
_SAME_ERROR_TOLERANCE: Final = 1e-4  # relative difference of errors that is none
# Speeds above this share of the largest are predicted from slower ones to try friction terms.
_FAST_SPEED_SHARE: Final = 0.85
# Share of the rows of a joint in motion that are faster than a Stribeck term reaches.
_MIN_FAST_SHARE: Final = 0.1
# Another motion may be faster by this factor, which a friction law has to bear.
_SPEED_FACTOR: Final = 2.0
# Smallest friction within the range of speeds, as a share of Coulomb or static friction.
_MIN_FRICTION_SHARE: Final = 0.5
# Likewise beside a power of the speed that is positive: what scatter may do.
_MIN_CONVEX_FRICTION_SHARE: Final = 0.9
# Share of load that becomes friction in a worm gear; a larger one is another effect.
_MAX_LOAD_FRICTION_SHARE: Final = 0.5
_MIN_SCATTER_SHARE: Final = 0.1  # share of the torque's scatter from which on friction is judged
_SPEED_SAMPLES: Final = 20  # points of that test
_POSTURES: Final = 50  # of a recording in which the inertia of the joints is judged
_FAR_BETTER_ERROR_RATIO: Final = 0.5  # share of an error, of what shows in spite of doubts
# Variance inflation from which on two columns are one (James et al. 2013, section 3.3.3): 5 to 10.
_MAX_VARIANCE_INFLATION: Final = 5.0
# torque of a position over a whole turn, over what the fitted rows show of it
_MAX_UNSEEN_RATIO: Final = 2.0
_TURN_POINTS: Final = 90

Ready = Callable[[RobotModel, Preprocessing], Sequence[Samples]]
"""Prepares the fitted data for a model, averaged to a common rate."""
Columns = tuple[tuple[FrictionLaw, ...], tuple[int, ...], tuple[str, ...], tuple[str, ...]]
"""Friction of a model, periods of its torque ripple per motor turn, joints with a spring, joints
with a torque of their position."""
Known = Mapping[str, tuple[float, float]]
"""Mean and standard deviation of parameters that are known beforehand."""


class SettingDecision(NamedTuple):
    """The settings that were chosen of some candidates."""

    settings: Settings
    choice: Choice


class SettingsTrial:
    """Scores of settings, with cached factors.

    Args:
        model: of the arm.
        ready: prepared recordings.
        stated: settings that are not searched.
        ripples: candidates of torque ripple.
    """

    def __init__(
        self,
        model: RobotModel,
        ready: Ready,
        stated: Known | None = None,
        ripples: Sequence[Sequence[TorqueRipple]] = (),
    ) -> None:
        self.ripples = {ripple[0].orders: ripple for ripple in ripples if ripple}
        self._model = model
        self._models: dict[Columns, RobotModel] = {}
        self._laws: dict[tuple[tuple[str, object], ...], tuple[FrictionLaw, ...]] = {}
        self._ready = ready
        self._known = stated
        self._samples: dict[Preprocessing, list[Samples]] = {}
        self._directed: dict[tuple[Preprocessing, tuple[float, ...]], list[Samples]] = {}
        self._tables: dict[tuple[Columns, Preprocessing], Folds] = {}
        self._priors: dict[tuple[Columns, Preprocessing, bool], BodyPrior] = {}
        self._errors: dict[tuple[Columns, Preprocessing, Strength, str], Errors] = {}
        self._effect = 1.0
        self._weighed: tuple[Columns, Preprocessing] | None = None

    def model(self, settings: Settings) -> RobotModel:
        """Return the model of the arm with the friction and the torque ripple of settings."""
        laws, orders, springs, of_position = key = self._columns(settings)
        if key not in self._models:
            model = self._model.with_friction_laws(laws)
            elements: list[Element] = [*self.ripples.get(orders, ())]
            elements += [TorsionSpring(joint, rest=0.0, identified=True) for joint in springs]
            elements += map(PositionTorque, of_position)
            self._models[key] = model.with_elements(elements)
        return self._models[key]

    def _columns(self, settings: Settings) -> Columns:
        entries = {**settings.friction}
        orders = tuple(entries.pop("ripple", ()))
        springs = tuple(entries.pop("springs", ()))
        of_position = tuple(entries.pop("position_torque", ()))
        key = tuple(entries.items())
        if key not in self._laws:
            self._laws[key] = tuple(law.changed(entries) for law in self._model.friction.laws)
        return self._laws[key], orders, springs, of_position

    def factor_key(self, settings: Settings) -> tuple[Columns, Preprocessing]:
        """Return the key of the settings that change factors."""
        return self._columns(settings), settings.preprocessing

    def key(self, settings: Settings) -> tuple[Columns, Preprocessing, Strength]:
        """Return the key of the settings that change predictions."""
        return *self.factor_key(settings), settings.strength

    def weigh(self, settings: Settings) -> None:
        """Set how many rows count as one by the correlation of the residuals of settings.

        It is the same for all that are compared, so that none wins by a weaker prior.
        """
        key = self.factor_key(settings)
        if key == self._weighed:
            return
        self._weighed = key
        model = self.model(settings)
        total = total_factor(model, self.samples(settings))
        prior = self._prior(settings).gaussian
        self._effect = design_effect_of(total, prior) if total.samples.any() else 1.0
        self._errors.clear()

    def decide(
        self,
        name: str,
        candidates: Sequence[Settings],
        share: float | None = None,
        *,
        by_joint: bool = False,
        joint: str | None = None,
        rows: PredictedRows = "all",
        possible: Callable[[Settings], bool] | None = None,
        certainty: float = 1.0,
        transfer: float = 0.0,
    ) -> SettingDecision:
        """Return the first candidate, or the best one if it is clearly better and possible.

        Args:
            name: of the setting.
            candidates: settings, the default first.
            share: by which the error must fall; by default `MIN_IMPROVEMENT`.
            by_joint: whether the geometric mean over the joints is compared.
            joint: the only joint whose error counts.
            rows: whose error counts.
            possible: whether a candidate may be chosen.
            certainty: standard errors of the difference over the segments by which it must fall.
            transfer: relative standard deviation between motions in addition (`TRANSFER_STD`). With
                it the first candidate wins that is not clearly worse than the best, so the
                candidates are ordered by their distance from the first.
        """
        share = MIN_IMPROVEMENT if share is None else share
        scores = [self.errors(each, rows) for each in candidates]
        if joint is not None:
            index = self._model.joint_names.index(joint)
            segments = [score.segments_of(index) for score in scores]
        else:
            segments = [score.joints if by_joint else score.segments for score in scores]
        means = [mean_error(part) for part in segments]
        chosen = 0
        for k, mean in enumerate(means):
            if not (mean < means[chosen] and mean < MEANINGLESS_ERROR) or means[0] < _EXACT_ERROR:
                continue
            better = clearly_better(segments[k], segments[0], share, certainty, transfer)
            if better and (possible is None or possible(candidates[k])):
                chosen = k
        if transfer and chosen:
            best = segments[chosen]
            for k in range(1, chosen):
                if clearly_better(segments[k], segments[0], share, certainty, transfer) and not (
                    clearly_better(best, segments[k], 0.0, certainty, transfer)
                ):
                    chosen = k
                    break
        self._retain_samples(candidates[chosen])
        return self._decision(name, candidates, means, chosen)

    def odds(self, other: Settings, chosen: Settings, transfer: float) -> float:
        """Return the odds of other settings against chosen ones on another motion, at most one.

        By the likelihood of their difference in the logarithm of the error, whose standard
        deviation is that over the segments and `transfer`.
        """
        theirs, ours = (self.errors(each).segments for each in (other, chosen))
        change, std = _change(theirs, ours, transfer)
        return 1.0 if change <= 0.0 else math.exp(-0.5 * (change / std) ** 2)

    def decide_last(self, name: str, candidates: Sequence[Settings]) -> SettingDecision:
        """Return the last candidate up to which none predicts worse than the first.

        For candidates in the order of what is safer where nothing is predicted, which therefore
        need not be better. None behind one that is worse is tried.
        """
        means = [self.errors(candidates[0]).overall]
        if _EXACT_ERROR <= means[0] < MEANINGLESS_ERROR:
            for each in candidates[1:]:
                means.append(self.errors(each).overall)
                if not means[-1] <= (1.0 + _SAME_ERROR_TOLERANCE) * means[0]:
                    break
        chosen = len(means) - 1
        if not means[chosen] <= (1.0 + _SAME_ERROR_TOLERANCE) * means[0]:
            chosen -= 1
        return self._decision(name, candidates[: len(means)], means, chosen)

    def _decision(
        self, name: str, candidates: Sequence[Settings], means: Sequence[float], chosen: int
    ) -> SettingDecision:
        values = tuple(_candidate(self.model(each), each) for each in candidates)
        return SettingDecision(candidates[chosen], Choice(name, values, tuple(means), chosen))

    def knows_bodies(self, settings: Settings) -> bool:
        """Return whether the description has the masses of this arm."""
        return not self._prior(settings).placeholder

    def has_grouped_rotors(self, settings: Settings) -> bool:
        """Return whether rotors of joints that moved act like the inertia of a link."""
        wide = replace(settings, strength=replace(settings.strength, wide_rotors=True))
        return not np.array_equal(self._prior(settings).std, self._prior(wide).std)

    def fits_impossible(self, settings: Settings, possible: Settings) -> bool:
        """Return whether bodies that cannot exist fit better than possible ones.

        What they fit better is the most that they can predict better.
        """
        limit = (1.0 - MIN_IMPOSSIBLE_IMPROVEMENT) * self.fitted_error(possible)
        return self.fitted_error(settings) < limit

    def stiffness(self, joint: str, settings: Settings) -> float:
        """Return the fitted stiffness of the torsion spring of a joint [N·m/rad]."""
        model = self.model(settings)
        values = self.values(settings)
        springs = [
            placed.part
            for placed in model.elements.identified
            if isinstance(placed.element, TorsionSpring) and placed.element.joint == joint
        ]
        return float(values[model.element_part][springs[0]][0])

    def walk(self, candidates: Sequence[Settings], size: Callable[[Settings], float]) -> list[int]:
        """Return the indices of the first candidate and, to both sides by size, of improvements.

        And of the next ones, which are worse: no candidate beyond is tried.
        """
        order = sorted(range(len(candidates)), key=lambda k: size(candidates[k]))
        start = order.index(0)
        visited = [0]
        for side in (order[:start][::-1], order[start + 1 :]):
            least = self.errors(candidates[0]).overall
            for k in side:
                visited.append(k)
                error = self.errors(candidates[k]).overall
                if not error < least:
                    break
                least = error
        return sorted(visited)

    def best(self, candidates: Sequence[Settings]) -> Settings:
        """Return the candidate with the least error by joint."""
        return min(candidates, key=lambda each: mean_error(self.errors(each).joints))

    def errors(self, settings: Settings, rows: PredictedRows = "all") -> Errors:
        """Return the errors of predicting these rows of each segment from the others."""
        key = *self.key(settings), rows
        if key not in self._errors:
            self._errors[key] = self._predicted(settings, rows)
        return self._errors[key]

    def _predicted(self, settings: Settings, rows: PredictedRows) -> Errors:
        folds = self._folds(settings)
        n = self.model(settings).n_joints
        unknown = Errors(np.full((FOLDS, n), np.inf), np.ones((FOLDS, n)))
        if not folds.separable:
            return unknown
        targets = folds.predicted if rows == "all" else folds.fitted
        if rows == "moving":
            targets = self._folds(settings.preprocessed(exclude_rows="slow")).fitted
        try:
            return folds.errors(self._estimator(settings), targets)
        except (IdentificationError, np.linalg.LinAlgError):
            return unknown

    def _estimator(self, settings: Settings) -> Callable[[Factor], Array]:
        effect = self._effect
        prior = self._prior(settings).with_weight(settings.strength.weight)
        model = self.model(settings)
        _, of_all = posterior_values(self._folds(settings).fitted, prior.gaussian, effect)

        def estimate(factor: Factor) -> Array:
            values, weights = posterior_values(factor, prior.gaussian, effect, of_all)
            if settings.strength.consistent:
                values = consistent_values(model, factor, weights, values, prior, effect)
            return values

        return estimate

    def fitted_error(self, settings: Settings) -> float:
        """Return the error of the fitted rows themselves; infinite if none can be fitted."""
        try:
            values = self.values(settings)
        except (IdentificationError, np.linalg.LinAlgError):
            return math.inf
        return self._folds(settings).fitted.relative_error(values)

    def values(self, settings: Settings) -> Array:
        """Return the parameters (p,) that all fitted rows give."""
        return self._estimator(settings)(self._folds(settings).fitted)

    def left_by_position(self, joint: str, settings: Settings) -> float:
        """Return the error that a torque of a joint's position leaves of its own, as a share.

        In the rows that were fitted, without another fit: which takes little time.
        """
        model = self.model(settings)
        index = model.joint_names.index(joint)
        shape = PositionTorque(joint)
        values = self.values(settings)
        errors, columns = [], []
        for samples in self.samples(settings):
            rows = samples.usable[:, index]
            predicted = samples.predicted_torque(model, values)[rows, index]
            errors.append(samples.torque[rows, index] - predicted)
            columns.append(shape.columns(samples.motion.position[rows, index]))
        error, table = np.concatenate(errors), np.concatenate(columns)
        left = error - table @ np.linalg.lstsq(table, error)[0]
        power = float(error @ error)
        return math.sqrt(float(left @ left) / power) if power > 0.0 else 1.0

    def is_seen_whole(self, joint: str, settings: Settings) -> bool:
        """Return whether the fitted rows show most of the torque of a joint's position.

        Over a whole turn it is then at most twice what varies in these rows (RMS). One that a short
        travel shows may be anything beyond it.
        """
        model = self.model(settings)
        index = model.joint_names.index(joint)
        coefficients = self.values(settings)[model.element_part]
        placed = next(
            each
            for each in model.elements.identified
            if isinstance(each.element, PositionTorque) and each.joint == index
        )
        over_turn, fitted = (
            placed.element.columns(angles) @ coefficients[placed.part]
            for angles in (
                np.linspace(0.0, 2.0 * np.pi, _TURN_POINTS, endpoint=False),
                np.concatenate(
                    [
                        samples.motion.position[samples.usable[:, index], index]
                        for samples in self.samples(settings)
                    ]
                ),
            )
        )
        return bool(over_turn.std() <= _MAX_UNSEEN_RATIO * fitted.std())

    def fast_error(self, settings: Settings) -> float:
        """Return the error of fast motion predicted from slower one; zero if there is none.

        Infinite if slower motion cannot be fitted.
        """
        errors = self.fast_errors(settings)
        torque = errors.torque.sum()
        return math.sqrt(errors.squares.sum() / torque) if torque > 0.0 else 0.0

    def fast_errors(self, settings: Settings) -> Errors:
        """Return the errors of the fast motion of each segment, predicted from all slower one."""
        samples = self.samples(settings)
        model = self.model(settings)
        speeds = [np.abs(each.motion.velocity).max(axis=0) for each in samples]
        folds = Folds.of(model, samples, _FAST_SPEED_SHARE * np.max(speeds, axis=0))
        torque = np.array([table[:, -1, -1] for table in folds.predicted.matrices]).T
        if not folds.fitted.samples.any():
            return Errors(np.zeros_like(torque), np.zeros_like(torque))
        try:
            values = self._estimator(settings)(folds.fitted)
        except (IdentificationError, np.linalg.LinAlgError):
            return Errors(np.full_like(torque, np.inf), torque)
        squares = folds.predicted.squared_errors_by_block(np.tile(values, (FOLDS, 1)))
        return Errors(squares, torque)

    def has_friction(self, settings: Settings) -> bool:
        """Return whether the fitted friction of every joint stays near that at rest at all speeds.

        Up to twice those recorded and at least to a usual one, which another motion may have. Where
        a power of the speed is positive, friction may hardly fall: such a sum with negative viscous
        friction imitates dry friction that falls with speed, and rises without bound beyond it.
        """
        model = self.model(settings)
        values = self.values(settings)
        table = model.friction.table(values[model.friction_part])
        fastest = np.max(
            [np.abs(each.motion.velocity).max(axis=0) for each in self.samples(settings)], axis=0
        )
        fastest = np.maximum(_SPEED_FACTOR * fastest, USUAL_SPEED)
        scatters = torque_scatter(model, self._folds(settings).fitted)
        for law, coefficients, speed, scatter in zip(
            model.friction.laws, table, fastest, scatters, strict=False
        ):
            along = np.linspace(0.0, speed, _SPEED_SAMPLES)
            columns = law.columns(along, np.ones_like(along))
            forces = [
                coefficients[symbol] * column
                for symbol, column in zip(law.symbols, columns, strict=True)
                if symbol != "fo"
            ]
            total = np.sum(forces, axis=0)
            # Stribeck friction at the lowest speed is at most twice that at higher ones.
            dry = max(coefficients.get("f0", 0.0), float(total[0]))
            is_convex = coefficients.get("f2", 0.0) > 0.0
            least = _MIN_CONVEX_FRICTION_SHARE if is_convex else _MIN_FRICTION_SHARE
            # Friction that hardly shows in the torque is not worth a judgement.
            if dry > _MIN_SCATTER_SHARE * scatter and float(total.min()) < least * dry:
                return False
        return True

    def carries_over(self, settings: Settings, possible: Settings) -> bool:
        """Return whether bodies that cannot exist may be trusted in another motion.

        Possible ones do not predict fast motion from slower one better by more than the standard
        error. Their inertia is one, or they predict so much better that they stand for something
        that is there.
        """
        ours, theirs = (self.fast_errors(each).segments for each in (settings, possible))
        if clearly_better(theirs, ours, 0.0, certainty=1.0):
            return False
        limit = _FAR_BETTER_ERROR_RATIO * self.errors(possible).overall
        return self.has_inertia(settings) or self.errors(settings).overall < limit

    def has_inertia(self, settings: Settings) -> bool:
        """Return whether fitted inertias of joints that moved at one frequency are positive.

        Position and acceleration are one column then, and a negative inertia is the torque of a
        position, which is another one in a faster motion. Positive definite where the joints were,
        as bodies that cannot exist may be (Yoshida and Khalil 2000).
        """
        model = self.model(settings)
        values = self.values(settings)
        samples = self.samples(settings)
        moved = [(each.motion.position, each.motion.acceleration) for each in samples]
        alike = np.flatnonzero(_correlation(moved) ** 2 > 1.0 - 1.0 / _MAX_VARIANCE_INFLATION)
        for position, _ in moved:
            some = position[:: max(1, len(position) // _POSTURES)]
            inertia = model.joint_inertia(values, some)[:, alike[:, None], alike]
            if np.linalg.eigvalsh(inertia).min(initial=np.inf) <= 0.0:
                return False
        return True

    def shows_stribeck(self, settings: Settings) -> bool:
        """Return whether all joints that move are faster than their Stribeck term reaches, too.

        A slower one does not tell it from viscous friction, and both would be large and opposite.
        """
        samples = self.samples(settings)
        for joint, law in enumerate(self.model(settings).friction.laws):
            if not law.stribeck:
                continue
            speeds = np.concatenate(
                [np.abs(each.motion.velocity[each.usable[:, joint], joint]) for each in samples]
            )
            moving = speeds[speeds > law.standstill]
            # At twice its speed the term has fallen to 2 %.
            if moving.size and np.mean(moving > 2.0 * law.stribeck) < _MIN_FAST_SHARE:
                return False
        return True

    def has_load_shares(self, settings: Settings) -> bool:
        """Return whether the fitted shares of load that become friction are plausible for gears.

        Weighted by the torque of their joints: that of a joint with hardly any torque is open.
        """
        values = self.values(settings)
        power = self._folds(settings).fitted.gram[:, -1, -1]
        model = self.model(settings)
        shares = [
            (value, power[term.owner])
            for value, term in zip(values[model.friction_part], model.friction.terms, strict=True)
            if term.term.of_load
        ]
        share, weight = np.array(shares).T
        return bool(0.0 < np.average(share, weights=weight) < _MAX_LOAD_FRICTION_SHARE)

    def samples(self, settings: Settings) -> list[Samples]:
        """Return the samples of settings, with direction of friction and transmitted torque.

        The load comes from the estimate without load-dependent friction.
        """
        model = self.model(settings)
        how = settings.preprocessing
        key = how, tuple(law.presliding for law in model.friction.laws)
        if how not in self._samples:
            self._samples[how] = self._directed[key] = [*self._ready(model, how)]
        if key not in self._directed:
            self._directed[key] = [
                each.with_friction_direction(model) for each in self._samples[how]
            ]
        samples = self._directed[key]
        if not model.friction.has_load:
            return samples
        without = settings.with_friction(load=False)
        values = self.values(without)
        return [each.with_load(self.model(without), values) for each in samples]

    def _retain_samples(self, settings: Settings) -> None:
        """Release the samples of all other settings, which are large for a long recording."""
        how = settings.preprocessing
        self._samples = {key: value for key, value in self._samples.items() if key == how}
        self._directed = {key: value for key, value in self._directed.items() if key[0] == how}

    def _folds(self, settings: Settings) -> Folds:
        key = self.factor_key(settings)
        if key not in self._tables:
            self._tables[key] = Folds.of(self.model(settings), self.samples(settings))
        return self._tables[key]

    def _prior(self, settings: Settings) -> BodyPrior:
        wide = settings.strength.wide_rotors
        key = *self.factor_key(settings), wide
        if key not in self._priors:
            self._priors[key] = body_prior(
                self.model(settings),
                self._folds(settings).fitted,
                stated=self._known,
                wide_rotors=wide,
            )
        return self._priors[key]


def _correlation(pairs: Sequence[tuple[Array, Array]]) -> Array:
    """Return the correlation (n,) of two columns (m, n) of recordings, zero of a constant one."""
    first, second = (
        np.concatenate([column - column.mean(axis=0) for column in columns])
        for columns in zip(*pairs, strict=True)
    )
    power = np.sqrt((first**2).sum(axis=0) * (second**2).sum(axis=0))
    return np.asarray((first * second).sum(axis=0) / np.where(power > 0.0, power, 1.0))


def clearly_better(
    errors: Array, first: Array, share: float, certainty: float, transfer: float = 0.0
) -> bool:
    """Return whether errors of segments are clearly lower than others.

    Args:
        errors: of the candidate (k,).
        first: of the default (k,).
        share: by which they must be lower.
        certainty: standard errors of the difference by which they must be lower.
        transfer: relative standard deviation between motions, which adds to the standard error.
    """
    if errors.shape != first.shape or not errors.size:
        return False
    if not np.all(np.isfinite(first)):
        return bool(np.all(np.isfinite(errors)))
    change, std = _change(errors, first, transfer)
    return bool(change < min(math.log(1.0 - share), -certainty * std))


def _change(errors: Array, first: Array, transfer: float) -> tuple[float, float]:
    """Return the mean relative change of errors of segments (k,), and its standard deviation."""
    change = np.log(errors / first)
    scatter = float(change.std(ddof=1) / np.sqrt(len(change))) if len(change) > 1 else np.inf
    return float(change.mean()), math.hypot(scatter, transfer)


def _candidate(model: RobotModel, settings: Settings) -> Candidate:
    """Return what a candidate of a setting may differ in, with its model."""
    how = settings.preprocessing
    law = model.friction.laws[0]
    elements = model.elements.elements
    return Candidate(
        bandwidth=how.rigid_bandwidth,
        velocity=how.velocity,
        friction=tuple(
            (term.label, term.speed if term.speed_symbol else None) for term in law.terms
        ),
        presliding=law.presliding,
        tanh=law.tanh,
        ripple=next((part.orders for part in elements if isinstance(part, TorqueRipple)), ()),
        springs=tuple(part.joint for part in elements if isinstance(part, TorsionSpring)),
        position_torques=tuple(part.joint for part in elements if isinstance(part, PositionTorque)),
        excluded_rows=how.exclude_rows,
        delay=how.torque_delay,
        low_pass=how.torque_bandwidth,
        shape=how.torque_shape,
        strength=settings.strength,
    )
