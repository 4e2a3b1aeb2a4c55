"""Validators of types by pydantic, each built once: it takes a millisecond."""

from __future__ import annotations

from functools import cache
from typing import Any

from pydantic import TypeAdapter


@cache
def adapter_of(kind: Any) -> TypeAdapter[Any]:
    """Return the validator of a dataclass, model or annotation."""
    return TypeAdapter(kind)
