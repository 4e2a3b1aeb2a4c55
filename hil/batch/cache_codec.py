"""Factors, summaries and settings as they are kept: triangles of Gram matrices, not squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from math import inf
from sys import intern
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from hil.identify.settings import Settings
from identification.factor.factor import Estimate
from identification.factor.phases import PhaseFactor
from planner.plain import number, table, text, texts, whole

from .cache import Entry
from .factors import WEIGHTINGS
from .types import ArchiveRef, Fit, Summary

Arrays = dict[str, NDArray[Any]]

_TEXTS: Final = ("names", "units", "method", "undetermined", "interval_factor", "condition")


def phase_entry(phase: PhaseFactor | None, prefix: str) -> tuple[dict[str, Any], Arrays]:
    """A factor as header and arrays, the names of which begin with the prefix."""
    if phase is None:
        return {f"{prefix}joints": None}, {}
    arrays: Arrays = {f"{prefix}samples": phase.samples}
    for joint, (gram, columns) in enumerate(zip(phase.gram, phase.columns, strict=True)):
        row, column = _triangle(gram.shape[1])
        arrays[f"{prefix}gram{joint}"] = gram[:, row, column]
        arrays[f"{prefix}columns{joint}"] = columns
    header = {f"{prefix}joints": phase.n_joints, f"{prefix}names": list(phase.parameter_names)}
    return header, arrays


def phase_from(entry: Entry, prefix: str) -> PhaseFactor | None:
    """The factor of `phase_entry`.

    Raises:
        errors of `planner.plain.DAMAGED`: the entry holds something else.
    """
    if entry.header[f"{prefix}joints"] is None:
        return None
    joints = whole(entry.header[f"{prefix}joints"])
    if joints < 1:
        raise ValueError("a sum over no joint")
    names = texts(entry.header[f"{prefix}names"])
    samples = _array(entry, f"{prefix}samples", np.intp, (None, joints))
    grams, columns = [], []
    for joint in range(joints):
        used = _array(entry, f"{prefix}columns{joint}", np.intp, (None,))
        if not _are_columns(used.tobytes(), len(names)):
            raise ValueError("columns that are none of the parameters")
        row, column = _triangle(len(used) + 1)
        triangle = _array(entry, f"{prefix}gram{joint}", np.float64, (len(samples), len(row)))
        gram = np.empty((len(triangle), len(used) + 1, len(used) + 1))
        gram[:, row, column] = triangle
        gram[:, column, row] = triangle
        grams.append(gram)
        columns.append(used)
    return PhaseFactor(tuple(grams), tuple(columns), samples, names)


def summary_entry(summary: Summary) -> tuple[dict[str, Any], Arrays]:
    """A summary as header and arrays."""
    header, arrays = phase_entry(summary.total, "total.")
    header |= {"duration": summary.duration, "doubts": list(summary.doubts), "fits": {}}
    if summary.products is not None:
        arrays["products"] = summary.products
    for name, fit in summary.fits.items():
        one = fit.estimate
        row, column = _triangle(len(one.values))
        arrays |= {
            f"{name}.values": one.values,
            f"{name}.covariance": one.covariance[row, column],
            f"{name}.noise_std": one.noise_std,
            f"{name}.samples": one.samples,
        }
        header["fits"][name] = {key: getattr(one, key) for key in _TEXTS} | {
            "design_effect": fit.design_effect
        }
    return header, arrays


def summary_from(entry: Entry, ref: ArchiveRef) -> Summary:
    """The summary of `summary_entry`, of an archive that may lie elsewhere by now.

    Raises:
        errors of `planner.plain.DAMAGED`: the entry holds something else.
    """
    total = phase_from(entry, "total.")
    if total is None:
        raise ValueError("a summary without its sum")
    found = table(entry.header["fits"])
    if set(found) != (set(WEIGHTINGS) if ref.use == "excitation" else set()):
        raise ValueError("other fits than there are")
    fits = {name: _fit(entry, name, table(one), total) for name, one in found.items()}
    duration = number(entry.header["duration"])
    if not 0.0 <= duration < inf:
        raise ValueError("a duration that is none")
    products = None
    if "products" in entry.arrays:
        shape = total.n_joints, total.n_parameters, total.n_parameters + 1
        products = _array(entry, "products", np.float64, shape)
    return Summary(ref, total, fits, duration, _interned(entry.header["doubts"]), products)


def _fit(entry: Entry, name: str, header: Mapping[str, Any], total: PhaseFactor) -> Fit:
    """Words that most archives share are held once."""
    count = total.n_parameters
    row, column = _triangle(count)
    covariance = np.empty((count, count))
    triangle = _array(entry, f"{name}.covariance", np.float64, (len(row),))
    covariance[row, column] = covariance[column, row] = triangle
    estimate = Estimate(
        names=texts(header["names"]),
        units=texts(header["units"]),
        values=_array(entry, f"{name}.values", np.float64, (count,)),
        covariance=covariance,
        noise_std=_array(entry, f"{name}.noise_std", np.float64, (total.n_joints,)),
        samples=_array(entry, f"{name}.samples", np.intp, (total.n_joints,)),
        method=intern(text(header["method"])),
        condition=number(header["condition"]),
        undetermined=_interned(header["undetermined"]),
        interval_factor=number(header["interval_factor"]),
    )
    if estimate.names != total.parameter_names or len(estimate.units) != count:
        raise ValueError("an estimate of another model than its sum")
    return Fit(estimate, number(header["design_effect"]))


def _array(
    entry: Entry, name: str, kind: type[np.generic], shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """An array of an entry that is of this kind and shape; None stands for any length."""
    array = entry.arrays[name]
    fits = array.ndim == len(shape) and all(
        wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype != np.dtype(kind):
        raise ValueError(f"{name} has the shape {array.shape} and the type {array.dtype}")
    return array


def _interned(words: Any) -> tuple[str, ...]:
    return tuple(map(intern, texts(words)))


def require_one_model(factors: Sequence[PhaseFactor]) -> None:
    """Raise ValueError unless factors have the same joints, parameters and columns."""
    for one in factors[1:]:
        same = one.parameter_names == factors[0].parameter_names and one.n_joints == len(
            factors[0].columns
        )
        if not same or not all(map(np.array_equal, one.columns, factors[0].columns)):
            raise ValueError("factors of two models")


def settings_header(settings: Settings) -> dict[str, Any]:
    """Settings as JSON; every figure to the last bit."""
    return asdict(settings)


def settings_from(header: Mapping[str, Any]) -> Settings | None:
    """The settings of `settings_header`; None where they are something else."""
    try:
        return TypeAdapter(Settings).validate_python(dict(header))
    except ValidationError:
        return None


@lru_cache(maxsize=256)
def _are_columns(used: bytes, count: int) -> bool:
    """Whether indices are some of so many parameters, none of them twice."""
    found = np.frombuffer(used, dtype=np.intp).tolist()
    return set(found) <= set(range(count)) and len(set(found)) == len(found)


@lru_cache(maxsize=64)
def _triangle(width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the lower triangle of a square."""
    row, column = np.tril_indices(width)
    return row, column
