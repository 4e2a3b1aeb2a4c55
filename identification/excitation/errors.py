"""Errors of the design of excitations."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from identification.errors import IdentificationError
from identification.excitation.messages import violation_text
from identification.excitation.violation import Violation


class CollisionModelError(IdentificationError):
    """A robot description without usable collision shapes."""


class MissingMeshError(CollisionModelError):
    """A mesh file of a robot description was not found.

    Attributes:
        mesh: file name in the description.
    """

    def __init__(self, mesh: str) -> None:
        self.mesh = mesh
        super().__init__(f"the collision mesh {mesh} cannot be found")


class DesignError(IdentificationError, ValueError):
    """A setting of a design is outside its valid range.

    Attributes:
        name: the setting.
        value: its value.
    """

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name = name
        self.value = value
        super().__init__(f"{name} = {value} is not allowed; valid is {valid}")


class JournalError(IdentificationError, ValueError):
    """A file that is not the journal of this search with these program versions."""


class NoFeasibleMotionError(IdentificationError):
    """None of `tried` motions satisfies all constraints and excites all parameters.

    Args:
        rejected: number of motions, by the kind of constraint that excludes them.
        nearest: smallest violation by kind of constraint.
        tried: number of motions; None if unknown.
        unexciting: motions that satisfy all constraints without exciting all parameters.
        stopped: whether the search was stopped before its end.
    """

    def __init__(
        self,
        rejected: Mapping[str, int],
        nearest: Mapping[str, Violation],
        *,
        tried: int | None = None,
        unexciting: int = 0,
        stopped: bool = False,
    ) -> None:
        self.rejected = dict(rejected)
        self.nearest = dict(nearest)
        self.tried = sum(self.rejected.values()) if tried is None else tried
        self.unexciting = unexciting
        self.stopped = stopped
        super().__init__(self.sentence())

    def sentence(self, text_of: Callable[[Violation], str] = violation_text) -> str:
        """Return a message; `text_of` formats a violation."""
        reasons = [
            f"{kind} excludes {count}, smallest violation: {text_of(self.nearest[kind])}"
            for kind, count in sorted(self.rejected.items(), key=lambda item: -item[1])
        ]
        if self.unexciting:
            reasons.append(
                f"{self.unexciting} satisfy all constraints but leave a parameter without "
                "excitation"
            )
        if self.stopped:
            reasons.append("the search was stopped before its end")
        which = f"none of {self.tried} motions is feasible" if self.tried else "no motion was tried"
        return f"{which}: {'; '.join(reasons)}"
