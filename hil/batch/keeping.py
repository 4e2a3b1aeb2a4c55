"""Bundles and settings as they are kept: triangles of Gram matrices instead of squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from sys import intern
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from identification.estimation import Estimate
from identification.phase_factor import PhaseFactor
from planner.plain import DAMAGED

from .cache import Entry, Where
from .factors import BUNDLE, reduce_bundle
from .keys import settings_digest, sum_key, summary_key
from .types import ArchiveRef, Broken, Bundle, Fit, Settings, Summary

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]

_TEXTS: Final = ("names", "units", "method", "undetermined", "interval_factor", "condition")


class Kept(NamedTuple):
    """A bundle, and how many of its archives had to be read for it."""

    bundle: Bundle
    read: int


def bundles(refs: Sequence[ArchiveRef]) -> list[tuple[ArchiveRef, ...]]:
    """Archives of one campaign in canonical order, in runs that are reduced together."""
    ordered = sorted(refs, key=lambda ref: ref.order)
    return [tuple(ordered[k : k + BUNDLE]) for k in range(0, len(ordered), BUNDLE)]


def is_kept(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> bool:
    """Whether something is kept of all these archives; it may turn out to be damaged."""
    return _Shelf(refs, settings, where).has()


def kept_bundle(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Bundle | None:
    """What is known of all these archives; None unless all of it is."""
    return _Shelf(refs, settings, where).get(len(refs))


def bundle_with_cache(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Kept:
    """Reduce archives, or what is not known of them, and keep what was found."""
    shelf = _Shelf(refs, settings, where)
    for known in range(len(refs), 0, -1):
        begin = shelf.get(known)
        if begin is None:
            continue
        if known == len(refs):
            return Kept(begin, 0)
        bundle = reduce_bundle(refs, settings, begin)
        shelf.put(bundle)
        shelf.forget_sum(known)
        return Kept(bundle, len(refs) - known)
    bundle = reduce_bundle(refs, settings)
    shelf.put(bundle)
    return Kept(bundle, len(refs))


class _Shelf:
    """Where a bundle stands: a summary of each archive, and a sum under the name of all."""

    def __init__(self, refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> None:
        self._refs, self._settings = tuple(refs), settings_digest(settings)
        self._store = where.store(refs[0].location)

    def has(self) -> bool:
        """Whether there are files for all of it."""
        keys = [sum_key(self._refs, self._settings)]
        keys += [summary_key(ref, self._settings) for ref in self._refs]
        return all(self._store.has(key) for key in keys)

    def get(self, count: int) -> Bundle | None:
        """The first `count` archives, if all about them is kept."""
        refs = self._refs[:count]
        if not self._store.has(sum_key(refs, self._settings)):
            return None
        entry = self._store.get(sum_key(refs, self._settings))
        if entry is None:
            return None
        try:
            return self._restored(refs, entry)
        except DAMAGED:  # whole, and still nothing that was put there
            return None

    def _restored(self, refs: tuple[ArchiveRef, ...], entry: Entry) -> Bundle | None:
        summaries, broken = [], []
        for ref in refs:
            found = self._store.get(summary_key(ref, self._settings))
            if found is None:
                return None
            if "broken" in found.header:
                broken.append(Broken(ref.location, found.header["broken"]))
            else:
                summaries.append(summary_from(found, ref))
        return Bundle(refs, tuple(summaries), phase_from(entry, ""), tuple(broken))

    def put(self, bundle: Bundle) -> None:
        """Keep it; nothing of it if it might come out otherwise another time."""
        if not bundle.lasting:
            return
        reasons = dict(bundle.broken)
        summaries = {one.ref: one for one in bundle.summaries}
        for ref in bundle.refs:
            if ref in summaries:
                header, arrays = summary_entry(summaries[ref])
            else:
                header, arrays = {"broken": reasons[ref.location]}, {}
            self._store.put(summary_key(ref, self._settings), header, arrays)
        header, arrays = phase_entry(bundle.phase, "")
        self._store.put(sum_key(bundle.refs, self._settings), header, arrays)

    def forget_sum(self, count: int) -> None:
        """The sum over the first `count` is part of a longer one now."""
        self._store.forget(sum_key(self._refs[:count], self._settings))


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
    """The factor of `phase_entry`."""
    joints = entry.header[f"{prefix}joints"]
    if joints is None:
        return None
    grams, columns = [], []
    for joint in range(joints):
        used = entry.arrays[f"{prefix}columns{joint}"]
        triangle = entry.arrays[f"{prefix}gram{joint}"]
        width = len(used) + 1
        row, column = _triangle(width)
        gram = np.empty((len(triangle), width, width))
        gram[:, row, column] = triangle
        gram[:, column, row] = triangle
        grams.append(gram)
        columns.append(used)
    names = tuple(entry.header[f"{prefix}names"])
    return PhaseFactor(tuple(grams), tuple(columns), entry.arrays[f"{prefix}samples"], names)


def summary_entry(summary: Summary) -> tuple[dict[str, Any], Arrays]:
    """A summary as header and arrays."""
    header, arrays = phase_entry(summary.total, "total.")
    header |= {"duration": summary.duration, "doubts": list(summary.doubts), "fits": {}}
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
    fits = {name: _fit(entry, name, told) for name, told in entry.header["fits"].items()}
    return Summary(
        ref, total, fits, entry.header["duration"], tuple(map(intern, entry.header["doubts"]))
    )


def _fit(entry: Entry, name: str, told: Mapping[str, Any]) -> Fit:
    """Words that most archives share are held once."""
    values = entry.arrays[f"{name}.values"]
    row, column = _triangle(len(values))
    covariance = np.empty((len(values), len(values)))
    covariance[row, column] = covariance[column, row] = entry.arrays[f"{name}.covariance"]
    estimate = Estimate(
        names=tuple(told["names"]),
        units=tuple(told["units"]),
        values=values,
        covariance=covariance,
        noise_std=entry.arrays[f"{name}.noise_std"],
        samples=entry.arrays[f"{name}.samples"],
        method=intern(told["method"]),
        condition=told["condition"],
        undetermined=tuple(map(intern, told["undetermined"])),
        interval_factor=told["interval_factor"],
    )
    return Fit(estimate, told["design_effect"])


def settings_header(settings: Settings) -> dict[str, Any]:
    """Settings as JSON; every figure to the last bit."""
    return asdict(settings)


def settings_from(header: Mapping[str, Any]) -> Settings | None:
    """The settings of `settings_header`; None where they are something else."""
    try:
        return TypeAdapter(Settings).validate_python(dict(header))
    except ValidationError:
        return None


@lru_cache(maxsize=64)
def _triangle(width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the lower triangle of a square."""
    row, column = np.tril_indices(width)
    return row, column
