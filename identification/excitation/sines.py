"""The genome of sums of sines, eq. 8 of the paper's appendix (Calafiore et al., 2001)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.excitation.errors import DesignError
from identification.excitation.genome import between
from planner import (
    FourierSeries,
    InvalidSetting,
    JointLimits,
    PiecewiseCubic,
    PlannerError,
    harmonic_bounds,
)
from planner.arrays import read_only

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SineGenome:
    """Sums of W sines for each joint, with a ramp at both ends or, as in the paper, without.

    Genes are the amplitudes, joint by joint, then the frequencies: 2 n W numbers. Amplitudes
    reach from -q_max / W to q_max / W, so that the sines stay inside the range together; q_max is
    the room about the offset on its narrower side. A negative one turns its sine's phase by 180
    degrees. Velocity and jerk, and with a ramp acceleration too, are not bounded by the genes and
    have to be checked.

    Attributes:
        limits: joint limits.
        length: of the whole motion [s].
        harmonics: W.
        ramp: time over which the sines grow and fade [s]; with 0 the motion starts at full speed,
            and no controller can execute it.
        offset: posture (n,) [rad] about which the joints swing, and where a motion with a ramp
            begins and ends; None: the middle of each range.
        slowest: frequencies that gene 0 means (n,) [rad/s]; None: one period in `length`.
        fastest: frequencies that gene 1 means (n,) [rad/s]; None: the appendix's
            sqrt(qdd_max / q_max), which keeps the acceleration limit where there is no ramp.

    Raises:
        DesignError: an offset outside the limits, or a slowest frequency above the fastest.
    """

    limits: JointLimits
    length: float
    harmonics: int = 3
    ramp: float = 0.0
    offset: Array | None = None
    slowest: Array | None = None
    fastest: Array | None = None

    def __post_init__(self) -> None:
        for name in ("offset", "slowest", "fastest"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, read_only(getattr(self, name)))
        try:
            harmonic_bounds(self.limits, self.centre, self.harmonics)
        except InvalidSetting as error:
            raise DesignError(error.name, error.value, error.valid) from error
        slowest, fastest = self.frequency_range
        if not np.all((slowest > 0.0) & (slowest <= fastest) & (fastest < np.inf)):
            raise DesignError(
                "slowest", slowest.tolist(), f"above 0 and at most fastest = {fastest.tolist()}"
            )

    @property
    def n_genes(self) -> int:
        """Number of amplitudes, n W, and as many frequencies."""
        return 2 * self.limits.n_joints * self.harmonics

    @property
    def centre(self) -> Array:
        """Posture (n,) [rad] about which the joints swing."""
        if self.offset is None:
            return (self.limits.lower + self.limits.upper) / 2.0
        return self.offset

    @property
    def frequency_range(self) -> tuple[Array, Array]:
        """Slowest and fastest frequencies, (n,) each [rad/s]."""
        n = self.limits.n_joints
        slowest, fastest = self.slowest, self.fastest
        if slowest is None:
            slowest = np.full(n, 2.0 * np.pi / self.length)
        if fastest is None:
            fastest = harmonic_bounds(self.limits, self.centre, self.harmonics).frequency
        return slowest, fastest

    def decode(self, genes: ArrayLike) -> tuple[Array, Array]:
        """Return amplitudes [rad] and frequencies [rad/s], (m, n, W) each."""
        rows = np.atleast_2d(genes)
        shares = rows.reshape(len(rows), 2, self.limits.n_joints, self.harmonics)
        (low, high), (slowest, fastest) = self._amplitudes(), self._frequencies()
        return between(low, high, shares[:, 0]), between(slowest, fastest, shares[:, 1])

    def motions(self, genes: Array) -> list[PiecewiseCubic | FourierSeries | PlannerError]:
        """Return the series of each row of genes (m, n_genes)."""
        return [
            FourierSeries(self.centre, amplitude, frequency, self.length, self.ramp)
            for amplitude, frequency in zip(*self.decode(genes), strict=True)
        ]

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a first population (count, n_genes), uniform."""
        return random.random((count, self.n_genes))

    def recorded(
        self,
        genes: Array,  # noqa: ARG002  the series tells them
        trajectory: PiecewiseCubic | FourierSeries,
    ) -> dict[str, Any]:
        """Return the motion of genes (n_genes,), as an argument of an `Excitation`."""
        return {"trajectory": trajectory}

    def _amplitudes(self) -> tuple[Array, Array]:
        """Return the bounds of amplitudes, (n, 1) each [rad]."""
        largest = harmonic_bounds(self.limits, self.centre, self.harmonics).amplitude[:, None]
        return -largest, largest

    def _frequencies(self) -> tuple[Array, Array]:
        """Return the bounds of frequencies, (n, 1) each [rad/s]."""
        slowest, fastest = self.frequency_range
        return slowest[:, None], fastest[:, None]
