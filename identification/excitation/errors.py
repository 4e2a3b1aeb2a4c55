"""What the design of an excitation can refuse.

```
IdentificationError
├── CollisionModelError    no collision shapes can be had from a robot description
├── WorkspaceError         obstacles or a margin that mean nothing (also a ValueError)
├── DesignError            a setting outside its range (also a ValueError)
└── NoFeasibleMotionError  every motion tried breaks a constraint
```
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from identification.errors import IdentificationError

if TYPE_CHECKING:
    from identification.excitation.constraints import Violation


class CollisionModelError(IdentificationError):
    """A robot description from which collisions cannot be computed."""


class WorkspaceError(IdentificationError, ValueError):
    """Obstacles or a margin that mean nothing."""


class DesignError(IdentificationError, ValueError):
    """A setting of a design lies outside its range.

    Attributes:
        name: which setting.
        value: what it was.
    """

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name = name
        self.value = value
        super().__init__(f"{name} = {value} is not allowed; valid is {valid}")


class NoFeasibleMotionError(IdentificationError):
    """Every motion that was tried breaks a constraint.

    Attributes:
        rejected: how many were rejected, by kind of constraint.
        nearest: of each kind the violation that came closest to being none.
    """

    def __init__(self, rejected: Mapping[str, int], nearest: Mapping[str, Violation]) -> None:
        self.rejected = dict(rejected)
        self.nearest = dict(nearest)
        total = sum(self.rejected.values())
        reasons = "; ".join(
            f"{kind} forbids {count}, the mildest: {self.nearest[kind]}"
            for kind, count in sorted(self.rejected.items(), key=lambda item: -item[1])
        )
        super().__init__(f"none of {total} motions is feasible: {reasons}")
