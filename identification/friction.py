r"""Joint friction, linear in its coefficients.

.. math:: \tau_f = f_0\,\mathrm{sgn}(\dot q) + f_1 \dot q
                   + f_2\,\mathrm{sgn}(\dot q)\,\dot q^2 + f_o

The source equation of the paper (after eq. 1: three coefficients per joint) could not be read.
The quadratic third term is what the same authors' later software uses; the cubic one, ``qd**3``,
is the other form found in the field, so the term can be chosen or left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from identification.errors import ModelError

Array = NDArray[np.float64]
ThirdTerm = Literal["quadratic", "cubic"]

_THIRD_EXPONENT = {"quadratic": 2, "cubic": 3}
_ROTARY_UNITS = {"f0": "N·m", "f1": "N·m·s/rad", "fo": "N·m"}
_LINEAR_UNITS = {"f0": "N", "f1": "N·s/m", "fo": "N"}


@dataclass(frozen=True)
class FrictionLaw:
    """Which friction terms every joint has.

    Attributes:
        coulomb: ``f0 sgn(qd)``.
        viscous: ``f1 qd``.
        third: ``f2 sgn(qd) qd**2`` ("quadratic"), ``f2 qd**3`` ("cubic") or none.
        offset: constant ``fo``, also the zero error of a torque or current measurement.
        standstill: speed [rad/s, m/s] below which a joint counts as standing. Stiction can take
            any value there, so such rows are left out of a fit (see :meth:`moving`).
    """

    coulomb: bool = True
    viscous: bool = True
    third: ThirdTerm | None = "quadratic"
    offset: bool = False
    standstill: float = 0.01

    def __post_init__(self) -> None:
        if self.third is not None and self.third not in _THIRD_EXPONENT:
            raise ModelError(
                f'friction term third = {self.third!r}: "quadratic", "cubic" or None are known'
            )
        if not (math.isfinite(self.standstill) and self.standstill >= 0.0):
            raise ModelError(
                f"friction standstill speed is {self.standstill!r}; "
                "it must be a finite number, zero or more"
            )

    @property
    def symbols(self) -> tuple[str, ...]:
        """Coefficients per joint, in order: a subset of ``f0, f1, f2, fo``."""
        present = {
            "f0": self.coulomb,
            "f1": self.viscous,
            "f2": self.third is not None,
            "fo": self.offset,
        }
        return tuple(symbol for symbol, wanted in present.items() if wanted)

    def names(self, n_joints: int) -> tuple[str, ...]:
        """Return the parameter names, term by term: ``f0_1 .. f0_n, f1_1 .. f1_n, ...``."""
        return tuple(f"{s}_{j}" for s in self.symbols for j in range(1, n_joints + 1))

    def unit(self, symbol: str, *, revolute: bool) -> str:
        """Return the unit of one coefficient of a revolute or a prismatic joint."""
        if symbol != "f2":
            return (_ROTARY_UNITS if revolute else _LINEAR_UNITS)[symbol]
        power = "²" if self.third == "quadratic" else "³"
        return f"N·m·s{power}/rad{power}" if revolute else f"N·s{power}/m{power}"

    def columns(self, velocity: Array, out: Array) -> None:
        """Write one row of `out` (k, ...) per coefficient for speeds `velocity` (...).

        The sign function has no dead zone: sgn(0) = 0, everything else is ±1.
        """
        row = 0
        if self.coulomb:
            np.sign(velocity, out=out[row])
            row += 1
        if self.viscous:
            out[row] = velocity
            row += 1
        if self.third is not None:
            np.abs(velocity, out=out[row])
            if self.third == "cubic":
                out[row] *= out[row]
            out[row] *= velocity
            row += 1
        if self.offset:
            out[row] = 1.0

    def moving(self, velocity: Array) -> NDArray[np.bool_]:
        """Return where a joint is faster than standstill, same shape as `velocity`."""
        return np.asarray(np.abs(velocity) > self.standstill)
