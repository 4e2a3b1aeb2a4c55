"""Low-pass of the recorded torque, estimated from the recording.

A low-pass and a delay are one complex weight per frequency. The unfiltered columns of a joint,
[W | torque of known loads | recorded torque], are transformed once and summed to Gram matrices of
narrow bands of frequency; the residual of any filter is then a weighted sum of these (Parseval).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, runs_of
from identification.factor.blocks import EqualRuns, add_grams, equal_runs
from identification.factor.factor import MIN_NOISE
from identification.model.robot import RobotModel
from identification.signals.masks import MAX_END_SECONDS, edge_rows
from identification.signals.noise import noiseless_above
from identification.signals.recording import RIGID_RATE, Recording
from identification.signals.sample_times import MAX_STEP_DEVIATION
from identification.signals.samples import RIGID_BANDWIDTH, Preprocessing, Samples, prepare
from identification.signals.smoothing import (
    FORWARDS,
    WITHOUT_PHASE,
    LowPassShape,
)

Complex = NDArray[np.complex128]

LOWEST_BANDWIDTH: Final = 0.5  # Hz
_MIN_IMPROVEMENT: Final = 0.05  # required relative reduction of the residual, mean over joints
_CANDIDATES_PER_DECADE: Final = 4.0  # candidates per decade of bandwidth, before refinement
_REFINED_CANDIDATES: Final = 5  # candidates between the neighbours of the best
# Spacings about the vertex of a parabola, of the logarithm: for all shapes, then for the best. With
# little noise the minimum is narrower than a parabola.
_VERTEX_SPACINGS: Final = (0.07, 0.02)
# Of the bandwidth, in which a low-pass and its absence differ most.
_BANDWIDTH_OCTAVES: Final = ((1.0, 2.0), (2.0, 4.0))
# share of a low-pass from which on the torque is nearer to it than to none
_MIN_LOW_PASS_SHARE: Final = 0.5
_LOW_PASS_SIGMAS: Final = 2.0  # standard deviations by which the share is larger

# Half a period of the lowest bandwidth: shorter stretches do not show it, and shorter rests between
# stretches stay in, because leaving them out would cost more neighbouring rows.
_MIN_STRETCH_SECONDS: Final = 0.5 / LOWEST_BANDWIDTH  # s
# Share of a stretch over which its weight rises and falls. Window and filter commute up to the
# change of the window during the filter's lag; a window without a level part would be the most
# accurate, but the rows of the middle alone would decide.
_TAPER_SHARE: Final = 0.5
# s of zeros, against the periodicity of the transform
_PADDING_SECONDS: Final = 1.0 / LOWEST_BANDWIDTH
# s; longer segments are transformed in parts, whose tables stay small
_MAX_SEGMENT_SECONDS: Final = 120.0
# signals in addition to the columns: load and torque, and three made of the torque
_EXTRA_SIGNALS: Final = 5

# Gains and phases are constant in a band. A delay of 50 ms turns the phase by 3 mrad in the lowest
# bands and by 0.15 rad at 30 Hz from its centre, where arms have hardly any torque.
_RELATIVE_BAND_WIDTH: Final = 0.03  # width as a share of the frequency
_MIN_BAND_WIDTH: Final = 0.02  # Hz
_RIDGE: Final = 1e-11  # of columns of unit length, as the limit of condition of Gram matrices


def torque_noiseless_above(recording: Recording) -> float | None:
    """Return the frequency [Hz] above which the torque has no noise; None if it has."""
    if recording.torque is None:
        return None
    return noiseless_above(recording.time, recording.torque, recording.segments())


class _Filter(NamedTuple):
    """Low-pass and delay of the torque."""

    delay: float  # [s]
    shape: LowPassShape | None = None
    bandwidth: float = math.inf  # [Hz]


def possible_low_passes(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),  # noqa: B008 - frozen
    undelayed: float | None = None,
) -> tuple[Preprocessing, ...]:
    """Return settings with the best-fitting low-pass of each kind.

    Many controllers log a filtered torque, in which Coulomb friction is a slope instead of a step.
    Causal filters are compared without a delay; a kind whose residuals are not clearly smaller than
    with a delay alone is left out.

    Rows count in stretches of motion of the whole arm of a second or more, whatever rows the
    options leave out: reversals and slow motion of a joint show a filter best, and a filter does
    not end at them.

    Args:
        recording: with torque.
        model: of the arm.
        noise_variance: of the positions (n,), as for :func:`identification.signals.samples.smooth`.
        options: of the preparation.
        undelayed: delay without a low-pass [s]; default: the options'.
    """
    still = options.torque_delay if undelayed is None else undelayed
    mean = recording.averaged(RIGID_RATE)
    if noise_variance is not None:
        noise_variance = noise_variance * mean.n_samples / recording.n_samples
    wide = replace(
        options,
        rigid_bandwidth=RIGID_BANDWIDTH,
        torque_bandwidth=None,
        torque_delay=still,
        smooth_torque=False,
        exclude_rows="rests",
    )
    samples = prepare(mean, model, noise_variance=noise_variance, options=wide)
    # Without the ends, where the smoothed motion is inaccurate.
    spectra = _Spectra.of(model, samples, ~edge_rows(mean, MAX_END_SECONDS), still)
    if not spectra.joints:
        return ()
    delays = tuple(dict.fromkeys((still, options.torque_delay)))
    # A low-pass must be better than a delay alone.
    enough = spectra.misfits([_Filter(delay) for delay in delays]).min()
    enough += math.log(1.0 - _MIN_IMPROVEMENT)
    possible = []
    for kind_delays, shapes in ((delays, WITHOUT_PHASE), ((still,), FORWARDS)):
        kinds = [_Filter(delay, shape) for delay, shape in product(kind_delays, shapes)]
        misfit, best = spectra.best(kinds)
        share, std = spectra.attenuation(best)
        if misfit < enough and share - _LOW_PASS_SIGMAS * std > _MIN_LOW_PASS_SHARE:
            assert best.shape is not None
            possible.append(
                replace(
                    options,
                    torque_delay=best.delay,
                    torque_bandwidth=best.bandwidth,
                    torque_shape=best.shape,
                )
            )
    return tuple(possible)


class _Joint(NamedTuple):
    """Sums over B bands of the windowed spectra of a joint with c columns.

    Products with the torque y are complex, of the conjugate of the first factor.
    """

    columns: NDArray[np.intp]  # parameter indices (c,)
    # Products of [W | known load] (B, (c + 1)²). Their imaginary parts cancel, since a filter has
    # one gain for all of them.
    gram: Array
    # Real and imaginary parts of the products of [W | known load] with the torque, and with the
    # torque in the window's slope, one below the other (4 B, c + 1).
    cross: Array
    powers: Array  # squared torque (B,)
    slope_cross: Complex  # of the torque with itself in the window's slope (B,) [1/s]
    slope_power: Array  # squared torque in the window's slope (B,) [1/s²]
    rows: float  # sum of the squared window

    duration: float  # of these rows [s]

    @property
    def power(self) -> float:
        """Squared torque of all bands."""
        return float(self.powers.sum())

    def modelled(self, values: Array) -> tuple[Array, Complex]:
        """Return power of the torque of parameters (p,) in the bands, and its product with y."""
        own = np.append(values[self.columns], 1.0)
        size = len(own)
        bands = len(self.powers)
        power = np.maximum(self.gram.reshape(bands, size, size) @ own @ own, 0.0)
        return power, self.cross[:bands] @ own + 1j * (self.cross[bands : 2 * bands] @ own)

    def filtered(self, values: Array, gain: Complex) -> _Joint:
        """Return the joint with the torque of parameters (p,) through a gain (B,)."""
        own = np.append(values[self.columns], 1.0)
        bands = len(self.powers)
        products = self.gram.reshape(bands, len(own), len(own)) @ own
        cross = gain[:, None] * products
        return self._replace(
            cross=np.concatenate([cross.real, cross.imag, np.zeros((2 * bands, len(own)))]),
            powers=np.abs(gain) ** 2 * np.maximum(products @ own, 0.0),
            slope_cross=np.zeros_like(self.slope_cross),
            slope_power=np.zeros_like(self.slope_power),
        )

    @classmethod
    def of(cls, columns: NDArray[np.intp], gram: Array, rows: float, step: float) -> _Joint:
        """Take apart the sums (B, c + 5, c + 5) of :meth:`_Segment.add`."""
        regressors = slice(0, -4)
        return cls(
            columns,
            np.ascontiguousarray(gram[:, regressors, regressors]).reshape(len(gram), -1),
            np.concatenate([gram[:, regressors, place] for place in (-4, -3, -2, -1)]),
            gram[:, -4, -4],
            gram[:, -4, -2] + 1j * gram[:, -4, -1],
            gram[:, -2, -2],
            rows,
            rows * step,
        )


@dataclass(frozen=True, eq=False)
class _Spectra:
    """Spectra of the joints with stretches of motion."""

    joints: tuple[_Joint, ...]
    frequency: Array  # of the bands (B,) [Hz]
    delay: float  # of the torque behind the motion, already compensated [s]
    highest: float  # bandwidth [Hz]
    n_parameters: int

    @classmethod
    def of(
        cls, model: RobotModel, samples: Samples, inside: NDArray[np.bool_], delay: float
    ) -> _Spectra:
        """Transform unfiltered samples, prepared with a delay [s], in the rows inside (m,)."""
        time = samples.motion.time
        usable = samples.usable & inside[:, None]
        load = samples.known_torque(model)
        torque = samples.torque + load
        step = float(np.median(np.diff(time)))
        edges = _band_edges(0.5 / step)
        segments = [_Segment.of(time, rows, edges) for rows in _parts(time, samples.segments)]
        count = np.sum([segment.bins for segment in segments], axis=0)
        bands = np.flatnonzero(count)
        total = np.sum([segment.bins * segment.frequency for segment in segments], axis=0)
        columns = model.plan.columns
        sizes = [len(used) + _EXTRA_SIGNALS for used in columns]
        grams = [np.zeros((len(count), size, size)) for size in sizes]
        rows = np.zeros(model.n_joints)
        for segment in segments:
            part = segment.rows
            blocks = model.regressor(samples.motion.rows(part)).blocks
            for joint, (gram, block) in enumerate(zip(grams, blocks, strict=True)):
                table = np.vstack([block.T, load[part, joint], torque[part, joint]])
                rows[joint] += segment.add(gram, table, usable[part, joint])
        joints = [
            _Joint.of(used, gram[bands], weight, step)
            for used, gram, weight in zip(columns, grams, rows.tolist(), strict=True)
            if weight > 0.0
        ]
        frequency = total[bands] / count[bands]
        return cls(tuple(joints), frequency, delay, 0.25 / step, model.n_parameters)

    def response(self, channel: _Filter) -> tuple[Complex, Complex]:
        """Return gain and lag [s] of a filter in the bands (B,)."""
        late = channel.delay - self.delay
        gain = np.exp(-2j * np.pi * self.frequency * late)
        lag = np.full(len(gain), late, dtype=np.complex128)
        if channel.shape is not None:
            other_gain, other_lag = channel.shape.response(self.frequency, channel.bandwidth)
            gain = gain * other_gain
            lag = lag + other_lag
        return gain, lag

    def misfits(self, filters: Sequence[_Filter]) -> Array:
        """Return the mean log standard deviation of the residual of each of k filters (k,).

        Of weighted least squares, as :func:`identification.factor.estimate.estimate`.
        """
        variance, smallest, _ = self._fitted(filters)
        return np.asarray(0.5 * np.log(np.maximum(variance, smallest)).mean(axis=1))

    def _fitted(self, filters: Sequence[_Filter]) -> tuple[Array, Array, Array]:
        """Return residual variances (k, j), the smallest (j,), and parameters (k, p) of filters."""
        responses = [self.response(channel) for channel in filters]
        gain, lag = (np.array(part) for part in zip(*responses, strict=True))
        sums = [_filtered(joint, gain, lag) for joint in self.joints]
        rows = np.array([joint.rows for joint in self.joints])
        power = np.array([joint.power for joint in self.joints])
        variance = np.broadcast_to(power / rows, (len(filters), len(rows)))
        smallest = np.maximum(MIN_NOISE**2 * power / rows, np.finfo(np.float64).tiny)
        for _ in range(2):  # with weights of the torque, then of the residual
            # A torque that is zero throughout was not measured.
            weights = np.where(power > 0.0, 1.0 / np.maximum(variance, smallest), 0.0)
            values = self._solved(sums, weights)
            squares = [
                _squared_error(products, values[:, joint.columns])
                for joint, products in zip(self.joints, sums, strict=True)
            ]
            variance = np.column_stack(squares) / rows
        return variance, smallest, values

    def attenuation(self, channel: _Filter) -> tuple[float, float]:
        """Return how much of a low-pass is in the torque, and the standard deviation of that.

        0: none of it, 1: all of it. In the two octaves above the bandwidth, where the two differ
        most, the gain of the torque over that of a model fitted without the low-pass is compared
        with the gain that the same fit has of the torque that the model with the low-pass predicts:
        parameters that the low-pass changes, such as the inertia, take up a part of its fall.
        Joints and octaves count by how well the torque agrees there with the fit, and the standard
        deviation contains how much their gains contradict each other. Without torque there it is
        infinite.

        A causal low-pass is late as well: of fits without a delay, and with one by its lag, the
        more precise counts.
        """
        assert channel.shape is not None
        delays = [channel.delay]
        if channel.shape.causal:
            delays.append(channel.delay + channel.shape.lag(channel.bandwidth))
        filtered = self._predicted(channel)
        shares = [self._attenuation(filtered, channel, _Filter(delay)) for delay in delays]
        return min(shares, key=lambda pair: pair[1])

    def _predicted(self, channel: _Filter) -> _Spectra:
        """Return spectra whose torque is what a fit with a filter predicts."""
        values = self._fitted([channel])[2][0]
        gain = self.response(channel)[0]
        return replace(self, joints=tuple(joint.filtered(values, gain) for joint in self.joints))

    def _attenuation(
        self, filtered: _Spectra, channel: _Filter, without: _Filter
    ) -> tuple[float, float]:
        gains, information = self._gains(channel, without)
        expected, _ = filtered._gains(channel, without)
        precision = float(np.sum(information * expected**2))
        if not precision > 0.0:
            return 0.0, math.inf
        share = float(np.sum(information * expected * gains)) / precision
        contradiction = float(np.sum(information * (gains - share * expected) ** 2))
        scatter = contradiction / max(1, int(np.count_nonzero(information)) - 1)
        return share, math.sqrt(max(1.0, scatter) / precision)

    def _gains(self, channel: _Filter, without: _Filter) -> tuple[Array, Array]:
        """Return logarithms of the gain of the torque, and the information on them (octaves, j).

        Over the torque of a model that is fitted without the low-pass of a channel.
        """
        values = self._fitted([without])[2][0]
        response = self.response(channel)[0]
        size = np.maximum(np.abs(response), np.finfo(np.float64).tiny)
        # The phase is not judged: that of a delay fitted by mistake would hide the torque.
        phases = (np.ones_like(response), response / size, self.response(without)[0])
        modelled = [joint.modelled(values) for joint in self.joints]
        shape = len(_BANDWIDTH_OCTAVES), len(self.joints)
        gains, information = np.zeros(shape), np.zeros(shape)
        for place, octave in enumerate(_BANDWIDTH_OCTAVES):
            low, high = (factor * channel.bandwidth for factor in octave)
            inside = (self.frequency >= low) & (self.frequency < high)
            for k, (joint, (model, cross)) in enumerate(zip(self.joints, modelled, strict=True)):
                power = float(model[inside].sum())
                torque = float(joint.powers[inside].sum())
                both = cross[inside]
                product = max(float(abs(np.vdot(phase[inside], both))) for phase in phases)
                if not (product > 0.0 and power > 0.0):
                    continue
                # At most one, up to the rounding of sums of squares.
                coherence = min(product**2 / (power * torque), 1.0 - MIN_NOISE)
                count = max(1.0, joint.duration * (high - low))
                information[place, k] = 2.0 * count * coherence / (1.0 - coherence)
                gains[place, k] = math.log(product / power)
        return gains, information

    def _solved(self, sums: Sequence[_Products], weights: Array) -> Array:
        """Return the parameters (k, p) of joint weights (k, j)."""
        count = len(weights)
        size = self.n_parameters
        matrix = np.zeros((count, size * size))
        right = np.zeros((count, size))
        for joint, products, weight in zip(self.joints, sums, weights.T, strict=True):
            places = (joint.columns[:, None] * size + joint.columns).ravel()
            matrix[:, places] += weight[:, None] * products.gram.reshape(count, -1)
            right[:, joint.columns] += weight[:, None] * products.cross
        square = matrix.reshape(count, size, size)
        length = np.sqrt(np.diagonal(square, axis1=1, axis2=2))
        length = np.where(length > 0.0, length, 1.0)
        square /= length[:, :, None] * length[:, None, :]
        square += _RIDGE * np.eye(size)
        return np.asarray(np.linalg.solve(square, (right / length)[..., None])[..., 0] / length)

    def best(self, kinds: Sequence[_Filter]) -> tuple[float, _Filter]:
        """Return the least misfit of shapes and delays over all bandwidths, and its filter."""
        ends = np.log(LOWEST_BANDWIDTH), np.log(max(self.highest, 2.0 * LOWEST_BANDWIDTH))
        count = max(4, round(_CANDIDATES_PER_DECADE * (ends[1] - ends[0]) / np.log(10.0)) + 1)
        grids = np.tile(np.linspace(*ends, count), (len(kinds), 1))
        heights = self._heights(kinds, grids)
        grids = np.array([_around(*pair) for pair in zip(grids, heights, strict=True)])
        heights = self._heights(kinds, grids)
        lowest = np.array([_vertex(*pair) for pair in zip(grids, heights, strict=True)])
        for step in _VERTEX_SPACINGS:
            grids = lowest[:, None] + step * np.array([-1.0, 0.0, 1.0])
            heights = self._heights(kinds, grids)
            least = int(np.argmin(heights.min(axis=1)))
            kinds = kinds[least : least + 1]
            lowest = np.array([_vertex(grids[least], heights[least])])
        width = math.exp(np.clip(lowest[0], *ends))
        best = kinds[0]._replace(bandwidth=width)
        return float(self.misfits([best])[0]), best

    def _heights(self, kinds: Sequence[_Filter], grids: Array) -> Array:
        """Return the misfits of kinds (k,) at log bandwidths (k, w)."""
        filters = [
            kind._replace(bandwidth=width)
            for kind, grid in zip(kinds, np.exp(grids).tolist(), strict=True)
            for width in grid
        ]
        return self.misfits(filters).reshape(grids.shape)


class _Products(NamedTuple):
    """Sums of a joint's filtered columns for k filters, without the known load."""

    gram: Array  # W'W (k, c, c)
    cross: Array  # W'y (k, c)
    power: Array  # y'y (k,)


def _filtered(joint: _Joint, gain: Complex, lag: Complex) -> _Products:
    """Return the sums of a joint with gains (k, B), and lags [s] for the window.

    With a window v, ``v (h * x) = h * (v x) + v' (t h * x)`` up to v'', and the last term is the
    lag's share of the recorded torque in the window's slope.
    """
    width = joint.cross.shape[1]
    gram = (np.abs(gain) ** 2 @ joint.gram).reshape(-1, width, width)
    late = gain * lag.conj()
    weights = np.concatenate([gain.real, gain.imag, -late.real, -late.imag], axis=1)
    cross = weights @ joint.cross
    power = (
        joint.power - 2.0 * (lag @ joint.slope_cross).real + np.abs(lag) ** 2 @ joint.slope_power
    )
    return _Products(
        gram[:, :-1, :-1],
        cross[:, :-1] - gram[:, :-1, -1],
        power - 2.0 * cross[:, -1] + gram[:, -1, -1],
    )


def _squared_error(products: _Products, values: Array) -> Array:
    """Return the squared residual (k,) of a joint's parameters (k, c)."""
    pull = (products.gram @ values[..., None])[..., 0] - 2.0 * products.cross
    return np.asarray(products.power + (values * pull).sum(axis=1))


@dataclass(frozen=True, eq=False)
class _Segment:
    """A stretch of rows without a gap, and the frequencies of its transform."""

    time: Array  # of the rows (m,) [s]
    rows: slice  # of the recording
    step: float  # [s]
    length: int  # of the transform
    runs: list[EqualRuns]  # real and imaginary parts of the frequencies of each band
    bins: NDArray[np.intp]  # frequencies per band (B,)
    frequency: Array  # their mean (B,) [Hz]

    @classmethod
    def of(cls, time: Array, rows: slice, edges: Array) -> _Segment:
        """Return a segment, for bands with lower edges (B,) [Hz]."""
        time = time[rows]
        step = float(time[-1] - time[0]) / max(len(time) - 1, 1) or 1.0
        length = len(time) + round(_PADDING_SECONDS / step)
        factor = max(1, 2 ** (length.bit_length() - 5))  # of a length that is quick to transform
        length = -(-length // factor) * factor
        frequency = np.fft.rfftfreq(length, step)
        index = np.searchsorted(edges, frequency, side="right") - 1
        bins = np.bincount(index, minlength=len(edges))
        total = np.bincount(index, frequency, minlength=len(edges))
        runs = equal_runs(np.repeat(index, 2))
        return cls(time, rows, step, length, runs, bins, total / np.maximum(bins, 1))

    def add(self, gram: Array, signals: Array, usable: NDArray[np.bool_]) -> float:
        """Add the spectra of a joint's signals to its sums, in place.

        The signals (c + 2, m) have the torque last. The sums (B, c + 5, c + 5) are of them, the
        torque turned by -90 degrees, the torque in the window's slope, and that turned. Returned is
        the sum of the squared window.
        """
        windowed = np.zeros((len(signals) + 1, len(self.time)))
        levels = []
        rows = 0.0
        for start, stop in _stretches(self.time, usable):
            window = _window(stop - start + 2)
            slope = np.gradient(window, self.step)[1:-1]
            window = window[1:-1]
            part = signals[:, start:stop]
            # Low-passes leave a constant as it is: it is no part of the spectrum of the window.
            level = part @ window**2 / (window @ window)
            part = part - level[:, None]
            windowed[:-1, start:stop] = part * window
            windowed[-1, start:stop] = part[-1] * slope
            levels.append(level * np.linalg.norm(window))
            rows += float(window @ window)
        if not levels:
            return 0.0
        spectrum = np.fft.rfft(self._even(windowed), self.length)
        spectrum[:, 1 : (self.length + 1) // 2] *= math.sqrt(2.0)
        spectrum /= math.sqrt(self.length)
        torque, slope = spectrum[-2:]
        spectrum = np.vstack([spectrum[:-1], -1j * torque, slope, -1j * slope])
        # Real and imaginary part of each frequency side by side.
        add_grams(gram, spectrum.view(np.float64), self.runs)
        constant = np.array(levels)
        gram[0, :-3, :-3] += constant.T @ constant
        return rows

    def _even(self, signals: Array) -> Array:
        """Interpolate signals (c, m) at even times."""
        even = np.linspace(self.time[0], self.time[-1], len(self.time))
        step = even[1] - even[0]
        if np.abs(self.time - even).max() <= MAX_STEP_DEVIATION * step:
            return signals
        return np.array([np.interp(even, self.time, signal) for signal in signals])


def _parts(time: Array, segments: Iterable[slice]) -> Iterator[slice]:
    """Yield segments of rows, long ones in parts of equal length."""
    for segment in segments:
        duration = float(time[segment.stop - 1] - time[segment.start])
        count = max(1, math.ceil(duration / _MAX_SEGMENT_SECONDS))
        edges = np.linspace(segment.start, segment.stop, count + 1).round().astype(int).tolist()
        yield from (slice(start, stop) for start, stop in pairwise(edges))


def _window(length: int) -> Array:
    """Return a window (length,) from zero to zero, level but for `_TAPER_SHARE` (Tukey 1967)."""
    phase = np.linspace(0.0, 1.0, length)
    from_end = np.minimum(phase, 1.0 - phase) / (0.5 * _TAPER_SHARE)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.minimum(from_end, 1.0)))


def _stretches(time: Array, usable: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield start and stop of the stretches of usable rows (m,) that show a low-pass."""
    runs: list[tuple[int, int]] = []
    for start, stop in runs_of(usable):
        if runs and time[start] - time[runs[-1][1] - 1] < _MIN_STRETCH_SECONDS:
            start = runs.pop()[0]
        runs.append((start, stop))
    for start, stop in runs:
        if time[stop - 1] - time[start] >= _MIN_STRETCH_SECONDS:
            yield start, stop


def _band_edges(highest: float) -> Array:
    """Return the lower edges of bands (B,) [Hz] from zero up to a frequency."""
    turn = _MIN_BAND_WIDTH / _RELATIVE_BAND_WIDTH
    if highest <= turn:
        return np.arange(0.0, highest, _MIN_BAND_WIDTH)
    wide = np.arange(math.log(turn), math.log(highest), _RELATIVE_BAND_WIDTH)
    return np.concatenate(
        [np.arange(0.0, turn - 0.5 * _MIN_BAND_WIDTH, _MIN_BAND_WIDTH), np.exp(wide)]
    )


def _around(grid: Array, heights: Array) -> Array:
    """Return `_REFINED_CANDIDATES` points between the neighbours of the lowest of a grid (w,)."""
    best = int(np.argmin(heights))
    return np.linspace(
        grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], _REFINED_CANDIDATES
    )


def _vertex(grid: Array, heights: Array) -> float:
    """Return the minimum of a parabola at the lowest of an even grid (w,), within a step."""
    best = int(np.argmin(heights))
    if best in {0, len(grid) - 1}:
        return float(grid[best])
    before, lowest, after = heights[best - 1 : best + 2]
    curvature = before - 2.0 * lowest + after
    moved = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return float(grid[best] + moved * (grid[1] - grid[0]))
