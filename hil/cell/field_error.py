"""The error of a check of a field, with its remedy."""

from __future__ import annotations


class FieldError(ValueError):
    """A value that a schema does not accept: the `problem`, and the `remedy`."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")
        self.problem = problem
        self.remedy = remedy
