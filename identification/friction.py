r"""Joint friction, linear in its coefficients.

.. math:: \tau_f = f_0\,\mathrm{sgn}(v) + f_1 v + f_d |v| + f_2\,\mathrm{sgn}(v)\,v^2
                   + f_s\,\mathrm{sgn}(v)\,e^{-(v/v_s)^2} + f_o

with the joint's speed v. Dry friction does not jump at a reversal: over a displacement of some
1e-4 rad, while teeth and bearings bend, it turns round like a spring (presliding). Dahl (1968)
describes it by a state z in place of sgn(v), which follows the displacement dq alone,

.. math:: z \leftarrow s + (z - s)\,e^{-|dq| / d}, \qquad s = \mathrm{sgn}(dq)

so that the torque stays linear in the coefficients once the distance d is fixed, and friction at
rest is what was left of the motion before it.

The source equation of the paper (after eq. 1: three coefficients per joint) could not be read. The
quadratic third term is what the same authors' later software uses; the cubic one, ``v**3``, is the
other form found in the field, so the term can be chosen or left out.
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
Zone = Literal["exclude", "linear"]

SYMBOLS = ("f0", "f1", "fd", "f2", "fs", "fo")
"""All coefficients that a joint can have, in the order of the parameters."""

OFFSET = "fo"
"""The one coefficient that may be no friction at all, but the zero error of a sensor."""

_THIRD_EXPONENT = {"quadratic": 2, "cubic": 3}
_DRY, _VISCOUS = ("f0", "fs", "fo"), ("f1", "fd")


@dataclass(frozen=True)
class FrictionLaw:
    """Which friction terms a joint has.

    Attributes:
        coulomb: ``f0 sgn(v)``.
        viscous: ``f1 v``.
        third: ``f2 sgn(v) v**2`` ("quadratic"), ``f2 v**3`` ("cubic") or none.
        offset: constant ``fo``, also the zero error of a torque or current measurement.
        standstill: speed [rad/s, m/s] below which a joint counts as standing. Stiction can take
            any value there; see `zone`.
        stribeck: fixed speed v_s [rad/s, m/s] of a term ``fs sgn(v) exp(-(v / v_s)**2)``, by which
            friction is larger at low speed; none without it.
        asymmetric: friction differs by direction. The viscous coefficient is f1 + fd forwards and
            f1 - fd backwards, with a term ``fd |v|``. Coulomb friction is f0 + fo forwards and
            f0 - fo backwards: its asymmetry is the constant column of the offset, which is there
            then too, and the two cannot be told apart.
        presliding: displacement d [rad, m] over which dry friction turns round; zero for a jump.
        zone: what becomes of rows slower than standstill. "exclude": they are not fitted, see
            :meth:`moving`. "linear": they are, with sgn(v) replaced by v / standstill.
    """

    coulomb: bool = True
    viscous: bool = True
    third: ThirdTerm | None = "quadratic"
    offset: bool = False
    standstill: float = 0.01
    stribeck: float | None = None
    asymmetric: bool = False
    zone: Zone = "exclude"
    presliding: float = 0.0

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
        if self.stribeck is not None and not (math.isfinite(self.stribeck) and self.stribeck > 0.0):
            raise ModelError(
                f"friction's Stribeck speed is {self.stribeck!r}; it must be finite and positive"
            )
        if not (math.isfinite(self.presliding) and self.presliding >= 0.0):
            raise ModelError(
                f"friction's presliding displacement is {self.presliding!r}; "
                "it must be a finite number, zero or more"
            )
        if self.zone not in ("exclude", "linear"):
            raise ModelError(f'friction zone = {self.zone!r}: "exclude" or "linear" are known')
        if self.zone == "linear" and self.standstill == 0.0:
            raise ModelError(
                "a linear friction zone needs a standstill speed above zero to be as wide as"
            )

    @property
    def symbols(self) -> tuple[str, ...]:
        """Coefficients, in order: a subset of :data:`SYMBOLS`."""
        present = {
            "f0": self.coulomb,
            "f1": self.viscous,
            "fd": self.asymmetric and self.viscous,
            "f2": self.third is not None,
            "fs": self.stribeck is not None,
            "fo": self.offset or (self.asymmetric and self.coulomb),
        }
        return tuple(symbol for symbol, wanted in present.items() if wanted)

    def names(self, n_joints: int) -> tuple[str, ...]:
        """Return the names if all joints have this law: ``f0_1 .. f0_n, f1_1 .. f1_n, ...``."""
        return tuple(f"{s}_{j}" for s in self.symbols for j in range(1, n_joints + 1))

    def unit(self, symbol: str, *, revolute: bool) -> str:
        """Return the unit of one coefficient of a revolute or a prismatic joint."""
        if symbol in _DRY:
            return "N·m" if revolute else "N"
        if symbol in _VISCOUS:
            return "N·m·s/rad" if revolute else "N·s/m"
        power = "²" if self.third == "quadratic" else "³"
        return f"N·m·s{power}/rad{power}" if revolute else f"N·s{power}/m{power}"

    def sign(self, velocity: Array, out: Array | None = None) -> Array:
        """Return the direction of motion: sgn(v), in a linear zone v / standstill.

        Otherwise it has no dead zone: sgn(0) = 0, everything else is ±1.
        """
        if self.zone == "exclude":
            return np.asarray(np.sign(velocity, out=out))
        scaled = np.divide(velocity, self.standstill, out=out)
        return np.asarray(np.clip(scaled, -1.0, 1.0, out=out))

    def direction(self, time: Array, position: Array, velocity: Array) -> Array:
        """Return the direction of dry friction (m,) along a motion: presliding state, or sign.

        A reversal between two instants divides the step where the velocity, linear between them,
        is zero.

        Args:
            time: of m instants [s].
            position: of the joint or motor [rad, m], in joint units.
            velocity: likewise [rad/s, m/s].
        """
        if self.presliding == 0.0:
            return self.sign(velocity)
        steps, before = np.diff(time), velocity[:-1]
        share = before / np.where(before == velocity[1:], 1.0, before - velocity[1:])
        turning = np.flatnonzero(before * velocity[1:] < 0.0)
        turned = position[turning] + 0.5 * (before * steps * share)[turning]
        path = np.insert(position, turning + 1, turned)
        # What was before the first instant is not known: one step at its speed.
        start = position[0] - velocity[0] * (steps[0] if len(steps) else 0.0)
        state = presliding_state(np.insert(path, 0, start), self.presliding)[1:]
        return np.delete(state, turning + 1 + np.arange(len(turning)))

    def columns(self, velocity: Array, direction: Array, out: Array) -> None:
        """Write one row of `out` (k, ...) per coefficient, for speeds and directions (...)."""
        for row, symbol in enumerate(self.symbols):
            target = out[row]
            if symbol == "f0":
                target[...] = direction
            elif symbol == "f1":
                target[...] = velocity
            elif symbol == "fd":
                np.abs(velocity, out=target)
            elif symbol == "f2":
                np.abs(velocity, out=target)
                if self.third == "cubic":
                    target *= target
                target *= velocity
            elif symbol == "fs":
                assert self.stribeck is not None
                ratio = velocity / self.stribeck
                np.exp(-ratio * ratio, out=target)
                target *= direction
            else:
                target[...] = 1.0

    def moving(self, velocity: Array) -> NDArray[np.bool_]:
        """Return where this law can be fitted: faster than standstill, or in a linear zone."""
        if self.zone == "linear":
            return np.ones(np.shape(velocity), dtype=np.bool_)
        return np.asarray(np.abs(velocity) > self.standstill)


def presliding_state(position: Array, distance: float) -> Array:
    """Return Dahl's state z (m,) of positions (m,), zero at the first of them.

    Within a stretch of one direction it is ``s + (z0 - s) exp(-travel / distance)``.
    """
    steps = np.diff(position, prepend=position[:1])
    travel = np.cumsum(np.abs(steps))
    moved = np.flatnonzero(steps)
    state = np.zeros(len(position))
    if not moved.size:
        return state
    sign = np.sign(steps[moved])
    turns = np.append(0, np.flatnonzero(np.diff(sign)) + 1)
    starts, signs = moved[turns], sign[turns]
    stops = np.append(starts[1:], len(position))
    before, value = travel[starts - 1], 0.0
    for start, stop, s, origin in zip(starts, stops, signs, before, strict=True):
        stretch = s + (value - s) * np.exp((origin - travel[start:stop]) / distance)
        state[start:stop], value = stretch, stretch[-1]
    return state


def law_words(law: FrictionLaw) -> tuple[str, str]:
    """The terms of a law, and what dry friction does at a reversal, in words."""
    terms = {
        "Coulomb": law.coulomb,
        "viscous": law.viscous,
        law.third or "": law.third is not None,
        f"Stribeck ({law.stribeck or 0.0:g} rad/s)": law.stribeck is not None,
        "by direction": law.asymmetric,
        "offset": law.offset,
    }
    listed = ", ".join(word for word, present in terms.items() if present)
    reversal = f"presliding over {law.presliding:g} rad" if law.presliding else "sgn(v)"
    return listed or "no friction", reversal
