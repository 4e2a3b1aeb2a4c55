"""Where each standard parameter of an arm stands: links, rotors, coupling inertias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.wrench import LINK_SYMBOLS

Array = NDArray[np.float64]
Places = NDArray[np.intp]

_N_LINK = len(LINK_SYMBOLS)
_N_SINGLE_DIGITS = 9


@dataclass(frozen=True)
class StandardLayout:
    """The s standard parameters: joint by joint ten of the link and a rotor, then couplings.

    A coupling inertia ``I45`` is the entry (4, 5) of the rotors' inertia matrix in joint
    coordinates: its column is the acceleration of joint 5 in the row of joint 4, and the other
    way round. Motors that turn with several joints make it.

    Attributes:
        revolute: whether each of the n joints turns.
        rotor_inertia: whether joints have rotor inertias.
        pairs: joints (i, j), i < j from 0, that share a coupling inertia.
    """

    revolute: tuple[bool, ...]
    rotor_inertia: bool
    pairs: tuple[tuple[int, int], ...] = ()

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.revolute)

    @property
    def width(self) -> int:
        """Parameters of one joint: ten, or eleven with a rotor."""
        return _N_LINK + self.rotor_inertia

    @property
    def size(self) -> int:
        """Number s of standard parameters."""
        return self.n_joints * self.width + len(self.pairs)

    @property
    def links(self) -> Places:
        """Places of the ten inertial parameters of each link (n, 10)."""
        return self._joint_blocks[:, :_N_LINK]

    @property
    def rotors(self) -> Places:
        """Places of the rotor inertias (n,), or (0,) without."""
        return self._joint_blocks[:, _N_LINK:].reshape(-1)

    @property
    def couplings(self) -> Places:
        """Places of the coupling inertias (c,), in the order of `pairs`."""
        return np.arange(self.n_joints * self.width, self.size)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (s,), the joint's number where the field writes it: I3xy, mc2y, m4, I5m, I45."""
        symbols = LINK_SYMBOLS + (("Im",) if self.rotor_inertia else ())
        own = [_name(symbol, j) for j in range(1, self.n_joints + 1) for symbol in symbols]
        between = "" if self.n_joints <= _N_SINGLE_DIGITS else "_"
        return (*own, *(f"I{i + 1}{between}{j + 1}" for i, j in self.pairs))

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each (s,)."""
        return tuple(self._unit(standard) for standard in range(self.size))

    def split(self, kept: Sequence[int]) -> tuple[list[list[int]], list[bool], list[int]]:
        """Return what of each joint is among `kept`: link symbols, rotor, and which couplings."""
        links: list[list[int]] = [[] for _ in self.revolute]
        rotors = [False] * self.n_joints
        couplings: list[int] = []
        first = self.n_joints * self.width
        for standard in (int(k) for k in kept):
            joint, symbol = divmod(standard, self.width)
            if standard >= first:
                couplings.append(standard - first)
            elif symbol < _N_LINK:
                links[joint].append(symbol)
            else:
                rotors[joint] = True
        return links, rotors, couplings

    def rotor_matrix(self, standard: Array) -> Array:
        """Return the rotors' inertia matrix in joint coordinates (n, n): positive if possible."""
        values = self.checked(standard)
        matrix = np.zeros((self.n_joints, self.n_joints))
        if self.rotor_inertia:
            np.fill_diagonal(matrix, values[self.rotors])
        for (i, j), value in zip(self.pairs, values[self.couplings], strict=True):
            matrix[i, j] = matrix[j, i] = value
        return matrix

    def checked(self, standard: Array) -> Array:
        """Return standard parameters (s,) as float64.

        Raises:
            ShapeError: they have another shape.
        """
        values = np.asarray(standard, dtype=np.float64)
        if values.shape != (self.size,):
            raise ShapeError("standard", values.shape, f"({self.size},)")
        return values

    @property
    def _joint_blocks(self) -> Places:
        return np.arange(self.n_joints * self.width).reshape(self.n_joints, self.width)

    def _unit(self, standard: int) -> str:
        if standard >= self.n_joints * self.width:
            i, j = self.pairs[standard - self.n_joints * self.width]
            sliding = (not self.revolute[i]) + (not self.revolute[j])
            return ("kg m²", "kg m", "kg")[sliding]
        joint, symbol = divmod(standard, self.width)
        if symbol == _N_LINK:
            return "kg m²" if self.revolute[joint] else "kg"
        return {"I": "kg m²", "mc": "kg m", "m": "kg"}[LINK_SYMBOLS[symbol].rstrip("xyz")]


def _name(symbol: str, joint: int) -> str:
    letters = "mc" if symbol.startswith("mc") else symbol[0]
    return f"{letters}{joint}{symbol[len(letters) :]}"
