"""What the design of an excitation can refuse."""

from __future__ import annotations

from identification.errors import IdentificationError


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


class JournalError(IdentificationError, ValueError):
    """A file that is not the journal of this search, or that other software wrote."""
