"""Bundles as they are kept: a summary of each archive, and one sum of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hil.identify.settings import Settings
from planner.plain import DAMAGED, text

from .cache import Entry, Where
from .cache_codec import phase_entry, phase_from, require_one_model, summary_entry, summary_from
from .factors import BUNDLE, reduce_bundle
from .keys import settings_digest, sum_key, summary_key
from .types import ArchiveRef, Broken, Bundle


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
                broken.append(Broken(ref.location, text(found.header["broken"])))
            else:
                summaries.append(summary_from(found, ref))
        phase = phase_from(entry, "")
        require_one_model([one.total for one in summaries] + ([phase] if phase else []))
        return Bundle(refs, tuple(summaries), phase, tuple(broken))

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
