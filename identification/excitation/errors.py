"""Errors of the design of excitations."""

from __future__ import annotations

from identification.errors import IdentificationError


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
