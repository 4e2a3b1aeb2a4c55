"""Errors: `IdentificationError`, and under it `ModelError` and `ShapeError` (`ValueError` too)."""

from __future__ import annotations


class IdentificationError(Exception):
    """Anything the identification package refuses to do."""


class ModelError(IdentificationError, ValueError):
    """A robot description from which no linear dynamic model can be built.

    Attributes:
        joint: name of the joint that is to blame, None when the whole description is.
    """

    def __init__(self, message: str, *, joint: str | None = None) -> None:
        super().__init__(message)
        self.joint = joint


class ShapeError(IdentificationError, ValueError):
    """An array whose shape does not fit the model.

    Attributes:
        name: what the array is.
        shape: the shape it has.
        expected: the shape it should have, in words such as `(m, 6)`.
    """

    def __init__(self, name: str, shape: tuple[int, ...], expected: str) -> None:
        super().__init__(f"{name} has shape {shape}, expected {expected}")
        self.name = name
        self.shape = shape
        self.expected = expected


class WorkspaceError(IdentificationError, ValueError):
    """A box whose corners are not in order."""
