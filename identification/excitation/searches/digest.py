"""Fingerprints by which two searches are told apart, the same in every process and run."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import numpy as np

from identification.model import RobotModel

# Another release of any of these may draw or compute something else.
_DISTRIBUTIONS: Final = ("hil", "numpy", "scipy", "pymoo", "cma", "ruckig", "pin", "coal")


def digest(value: object) -> str:
    """Return the SHA-256 of what a value is made of: dataclasses, arrays and plain data.

    Other objects take part through their own `__reduce__`.

    Raises:
        TypeError: something in it has no description that is the same in every run.
    """
    summary = hashlib.sha256()
    _feed(summary, value)
    return summary.hexdigest()


def versions() -> dict[str, str]:
    """Return the releases installed of everything that a search's numbers come from."""
    found = {}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _feed(summary: hashlib._Hash, value: object) -> None:
    """Add a value, each part under its kind and size, so that no two values read alike."""
    if isinstance(value, RobotModel):
        # The rest of a model is computed from these, maybe with another last bit elsewhere.
        own = (value.chain, value.gravity, value.rotor_inertia, value.friction, value.payload)
        beside = (value.elements,) if value.elements.elements else ()
        _feed(summary, ("RobotModel", *own, *beside, value.parameter_names))
    elif isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise TypeError("an array of objects has no fingerprint")
        _head(summary, "array", array.dtype.str, *array.shape)
        summary.update(np.ascontiguousarray(array).tobytes())
    elif value is None or isinstance(value, bool | int | float | str | Path):
        text = str(value) if isinstance(value, Path) else repr(value)
        _head(summary, type(value).__name__, len(text.encode()))
        summary.update(text.encode())
    elif isinstance(value, tuple | list):
        _head(summary, "sequence", len(value))
        for item in value:
            _feed(summary, item)
    elif isinstance(value, Mapping):
        _feed(summary, ("mapping", *sorted(value.items())))
    elif is_dataclass(value) and not isinstance(value, type):
        named = [(field.name, getattr(value, field.name)) for field in fields(value) if field.init]
        _feed(summary, (_name(type(value)), *named))
    elif type(value).__reduce__ is not object.__reduce__:
        reduced = value.__reduce__()
        if isinstance(reduced, str):
            raise TypeError(f"{type(value).__qualname__} has no fingerprint")
        _feed(summary, (_name(reduced[0]), reduced[1]))
    else:
        raise TypeError(f"{type(value).__qualname__} has no fingerprint")


def _head(summary: hashlib._Hash, *words: object) -> None:
    summary.update((" ".join(map(str, words)) + "\n").encode())


def _name(thing: object) -> str:
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', '')}"
