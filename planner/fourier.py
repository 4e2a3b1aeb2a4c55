r"""Sums of sines, the excitation of the paper's method A (eq. 8), bare or brought to rest.

.. math:: q_j(t) = q_{0,j} + w(t) \sum_{k=1}^{W} a_{jk} \sin(\omega_{jk} t)

The paper has w = 1 throughout, which starts at full speed and cannot be executed. With a ramp, w is
a quintic from 0 to 1 at the beginning and back at the end: the motion starts and ends at rest in
`offset`, is C2, stays within the range of the bare series, and is eq. 8 in between.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import comb, inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arrays import DAMAGED_DATA_ERRORS, Array, numbers, read_only, strict
from planner.errors import InvalidSetting, InvalidTrajectory
from planner.limits import JointLimits
from planner.piecewise_cubic import Extrema

# Resolution of extremes, as a share of their bounds from the amplitudes, and the most samples for
# it; with more, these bounds are the extremes.
_EXTREMA_RESOLUTION = 3e-4
_MAX_SAMPLES = 20_000

# w(u) = 10 u³ - 15 u⁴ + 6 u⁵ and its derivatives in u, highest power first, and the largest
# magnitude of each on [0, 1].
_RAMP_POLYNOMIALS = (
    (6.0, -15.0, 10.0, 0.0, 0.0, 0.0),
    (30.0, -60.0, 30.0, 0.0, 0.0),
    (120.0, -180.0, 60.0, 0.0),
    (360.0, -360.0, 60.0),
)
_RAMP_MAXIMA = (1.0, 15.0 / 8.0, 10.0 / np.sqrt(3.0), 60.0, 360.0, 720.0)


class HarmonicBounds(NamedTuple):
    """The paper's constraints on a series of W harmonics (n,): |a| < amplitude, |w| < frequency.

    The amplitude is the room around the offset divided by W [rad], the frequency the square root of
    acceleration limit over room [rad/s].
    """

    amplitude: Array
    frequency: Array


def harmonic_bounds(limits: JointLimits, offset: ArrayLike, harmonics: int) -> HarmonicBounds:
    """Return the constraints of the paper's appendix for `harmonics` sines about `offset` (n,).

    The paper's q_max, for a range symmetric about the offset, is the room on the narrower side
    here. The bounds imply the limits of position and acceleration of bare series, not those of
    velocity and jerk.

    Raises:
        InvalidSetting: an offset not strictly inside the limits, or no harmonic.
    """
    centre = np.asarray(offset, dtype=np.float64)
    if harmonics < 1:
        raise InvalidSetting("harmonics", harmonics, "1 or more")
    if centre.shape != limits.lower.shape or not np.all(
        (centre > limits.lower) & (centre < limits.upper)
    ):
        raise InvalidSetting("offset", offset, "a position strictly inside the joint limits")
    margin = np.minimum(limits.upper - centre, centre - limits.lower)
    return HarmonicBounds(margin / harmonics, np.sqrt(limits.acceleration / margin))


@dataclass(frozen=True, eq=False)
class FourierSeries:
    """A sum of sines per joint (eq. 8), at rest at both ends if it has a ramp.

    Before time 0 and after `duration` the joints rest at the first and last position. Without a
    ramp the velocity jumps there: such a series can be designed, not executed.

    Attributes:
        offset: Position about which each joint moves, (n,) [rad].
        amplitude: Amplitudes of the sines, (n, W) [rad].
        frequency: Angular frequencies, (n, W) [rad/s].
        length: Duration, ramps included [s].
        ramp: Duration of each of the two ramps [s]; 0 for none.

    Raises:
        InvalidTrajectory: wrong shapes, values that are not finite, ramps longer than the motion.
    """

    offset: Array
    amplitude: Array
    frequency: Array
    length: float
    ramp: float = 0.0

    def __post_init__(self) -> None:
        for name in ("offset", "amplitude", "frequency"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        n = self.offset.size
        if (
            self.offset.ndim != 1
            or n == 0
            or self.amplitude.ndim != 2
            or self.amplitude.shape != self.frequency.shape
            or len(self.amplitude) != n
        ):
            raise InvalidTrajectory(
                f"offset {self.offset.shape}, amplitude {self.amplitude.shape}, frequency "
                f"{self.frequency.shape}; expected (n,), (n, W), (n, W)"
            )
        for field in fields(self):
            if not np.all(np.isfinite(getattr(self, field.name))):
                raise InvalidTrajectory(f"{field.name} of a series of sines must be finite")
        if not (self.length > 0.0 and 0.0 <= 2.0 * self.ramp <= self.length):
            raise InvalidTrajectory(
                f"a series of sines of {self.length} s with two ramps of {self.ramp} s each; "
                "they must fit into it"
            )

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return self.length

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.offset.size)

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at the times `t` (m,), each (m, n)."""
        t = np.asarray(t, dtype=np.float64)
        within = np.clip(t, 0.0, self.length)
        window = self._window(within, 2, self._stage(within))
        sines = self._sines(within, 2)
        q, qd, qdd = (_product(window, sines, order) for order in range(3))
        outside = within != t
        qd[outside] = 0.0
        qdd[outside] = 0.0
        return q + self.offset, qd, qdd

    def sample_one(self, t: float) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at one time `t` [s], each (n,)."""
        q, qd, qdd = self.sample(np.array([t]))
        return q[0], qd[0], qdd[0]

    def extrema(self) -> Extrema:
        """Return rigorous bounds of the extremes over all time, per joint.

        They are the extremes of samples plus M h²/8 (h: sample period, M: largest second
        derivative), tight to 3e-4 of the bounds that follow from the amplitudes. The jump of a bare
        series at its ends is not included.
        """
        low, high = np.full((2, 4, self.n_joints), [[[np.inf]], [[-np.inf]]])
        stages = [(0, self.ramp, self.length - self.ramp)]
        if self.ramp > 0.0:
            stages += [(1, 0.0, self.ramp), (-1, self.length - self.ramp, self.length)]
        for stage, start, stop in stages:
            if stop <= start:
                continue
            bounds = [self._bounds(order, stage != 0) for order in range(6)]
            with np.errstate(all="ignore"):
                curved = np.nan_to_num(np.array(bounds[2:]) / bounds[:4], nan=0.0).max()
                steps = (stop - start) * np.sqrt(curved / (8.0 * _EXTREMA_RESOLUTION))
                steps = int(np.clip(np.ceil(steps), 1, _MAX_SAMPLES))
                t = np.linspace(start, stop, steps + 1)
                window = self._window(t, 3, np.full(t.shape, stage))
                sines = self._sines(t, 3)
                for order in range(4):
                    value = _product(window, sines, order)
                    excess = bounds[order + 2] * (t[1] - t[0]) ** 2 / 8.0
                    # not a number: an overflow
                    most = np.fmin(value.max(axis=0) + excess, bounds[order])
                    least = np.fmax(value.min(axis=0) - excess, -bounds[order])
                    np.maximum(high[order], most, out=high[order])
                    np.minimum(low[order], least, out=low[order])
        rates = np.maximum(high[1:], -low[1:])
        return Extrema(self.offset + low[0], self.offset + high[0], *rates)

    def derivative_bound(self, order: int, *, ramps: bool = True) -> Array:
        """Return a coarse bound of a derivative's magnitude, order 1 to 5, (n,), from amplitudes.

        Without `ramps` it is true only between them, where it may be far lower.
        """
        return self._bounds(order, ramps and self.ramp > 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return lists, from which `from_dict` restores the same bits, also through JSON."""
        return {
            "type": "fourier_series",
            "offset": self.offset.tolist(),
            "amplitude": self.amplitude.tolist(),
            "frequency": self.frequency.tolist(),
            "length": float(self.length),
            "ramp": float(self.ramp),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FourierSeries:
        """Restore a series from `to_dict`.

        Raises:
            InvalidTrajectory: a field is missing or invalid.
        """
        try:
            if (kind := data["type"]) != "fourier_series":
                raise InvalidTrajectory(f"type is {kind!r:.80}; expected 'fourier_series'")
            return cls(
                offset=numbers(data["offset"], 1),
                amplitude=numbers(data["amplitude"], 2),
                frequency=numbers(data["frequency"], 2),
                length=strict(float, data["length"]),
                ramp=strict(float, data["ramp"]),
            )
        except InvalidTrajectory:
            raise
        except DAMAGED_DATA_ERRORS as error:
            raise InvalidTrajectory(f"not a series of sines: {error!r:.200}") from error

    def _bounds(self, order: int, ramped: bool) -> Array:
        """Return a bound of a derivative's magnitude, less offset, from the amplitudes, (n,)."""
        amplitude = np.abs(self.amplitude)
        rate = np.abs(self.frequency)
        with np.errstate(all="ignore"):  # an overflow is inf, which exceeds every limit
            sums = [
                np.sum(np.where(amplitude > 0.0, amplitude * rate**k, 0.0), axis=1)
                for k in range(order + 1)
            ]
            # |sin x| <= |x|
            sums[0] = np.sum(amplitude * np.minimum(rate * self.length, 1.0), axis=1)
            bound = sums[order]
            if ramped:
                ramp = np.float64(self.ramp)
                parts = [
                    comb(order, k) * _RAMP_MAXIMA[k] / ramp**k * sums[order - k]
                    for k in range(order + 1)
                ]
                bound = np.sum(parts, axis=0)
        return np.where(np.isnan(bound), inf, bound)

    def _stage(self, t: Array) -> NDArray[np.int_]:
        """Return the stage at times (m,): 1 in the first ramp, 0 between, -1 in the last ramp."""
        first = t < self.ramp
        last = t > self.length - self.ramp
        return first.astype(np.int_) - (last & ~first).astype(np.int_)

    def _window(self, t: Array, order: int, stage: NDArray[np.int_]) -> list[Array]:
        """Return w and its derivatives up to `order` at times (m,) in stages (m,).

        The third derivative jumps between stages, so at their common time the stage is needed.
        """
        if self.ramp == 0.0:
            return [np.ones_like(t), *(np.zeros_like(t) for _ in range(order))]
        u = np.clip(np.where(stage > 0, t, self.length - t) / self.ramp, 0.0, 1.0)
        pace = stage / self.ramp
        grown = np.where(stage == 0, 1.0, _polynomial(_RAMP_POLYNOMIALS[0], u))
        return [
            grown,
            *(_polynomial(_RAMP_POLYNOMIALS[k], u) * pace**k for k in range(1, order + 1)),
        ]

    def _sines(self, t: Array, order: int) -> list[Array]:
        """Return the sum of sines and its derivatives up to `order`, (m, n) each."""
        phase = t[:, None, None] * self.frequency
        sine = np.sin(phase)
        cosine = np.cos(phase)
        turned = (sine, cosine, -sine, -cosine)
        return [
            np.sum(self.amplitude * self.frequency**k * turned[k % 4], axis=2)
            for k in range(order + 1)
        ]


def _product(window: list[Array], sines: list[Array], order: int) -> Array:
    """Return the derivative `order` of window (m,) x sines (m, n), by Leibniz' rule."""
    total: Array = window[0][:, None] * sines[order]
    for k in range(1, order + 1):
        total = total + comb(order, k) * window[k][:, None] * sines[order - k]
    return total


def _polynomial(coefficients: tuple[float, ...], u: Array) -> Array:
    value = np.full_like(u, coefficients[0])
    for coefficient in coefficients[1:]:
        value *= u
        value += coefficient
    return value
