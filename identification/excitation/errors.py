"""What the design of an excitation can refuse.

```
IdentificationError
├── CollisionModelError    no collision shapes can be had from a robot description
│   └── MissingMeshError       a mesh that it names is not to be found
├── PostureError           a joint position that is no finite number (also a ValueError)
├── WorkspaceError         obstacles or a margin that mean nothing (also a ValueError)
├── DesignError            a setting outside its range (also a ValueError)
├── NoFeasibleMotionError  every motion tried breaks a constraint
└── JournalError           a file that is not the journal of this search
```
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from identification.errors import IdentificationError

if TYPE_CHECKING:
    from identification.excitation.violation import Violation


class CollisionModelError(IdentificationError):
    """A robot description from which collisions cannot be computed."""


class MissingMeshError(CollisionModelError):
    """A mesh that a robot description names is not to be found.

    Attributes:
        mesh: as the description names it.
    """

    def __init__(self, mesh: str) -> None:
        self.mesh = mesh
        super().__init__(f"the collision mesh {mesh} cannot be found")


class PostureError(IdentificationError, ValueError):
    """A posture with a position that is no finite number."""


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
        rejected: how many break it, by kind of constraint; a motion may count for several.
        nearest: of each kind the violation that came closest to being none.
        closest: all violations of the motion that came closest to being feasible, by their sum.
        tried: how many motions there were.
        unexciting: how many satisfied every constraint, but left a parameter without excitation.
        stopped: whether the search was stopped before its end.
    """

    def __init__(
        self,
        rejected: Mapping[str, int],
        nearest: Mapping[str, Violation],
        *,
        closest: Sequence[Violation] = (),
        tried: int | None = None,
        unexciting: int = 0,
        stopped: bool = False,
    ) -> None:
        self.rejected = dict(rejected)
        self.nearest = dict(nearest)
        self.closest = tuple(closest)
        self.tried = sum(self.rejected.values()) if tried is None else tried
        self.unexciting = unexciting
        self.stopped = stopped
        super().__init__(self.sentence())

    def sentence(self, text_of: Callable[[Violation], str] = str) -> str:
        """In words; `text_of` puts a violation into the words and units of the reader."""
        reasons = [
            f"{kind} forbids {count}, the mildest: {text_of(self.nearest[kind])}"
            for kind, count in sorted(self.rejected.items(), key=lambda item: -item[1])
        ]
        worst: dict[str, Violation] = {}
        for violation in sorted(self.closest, key=lambda violation: -violation.excess):
            worst.setdefault(violation.kind, violation)
        if len(self.closest) > 1:
            breaks = " and ".join(map(text_of, worst.values()))
            reasons.append(f"the motion that comes closest breaks {breaks}")
        if self.unexciting:
            reasons.append(
                f"{self.unexciting} keep every constraint but leave a parameter without excitation"
            )
        if self.stopped:
            reasons.append("the search was stopped before its end")
        which = f"none of {self.tried} motions is feasible" if self.tried else "no motion was tried"
        return f"{which}: {'; '.join(reasons)}"


class JournalError(IdentificationError, ValueError):
    """A file that is not the journal of this search, or that other software wrote."""
