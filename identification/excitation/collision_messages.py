"""Sentences about pairs of bodies that are not checked for collisions."""

from __future__ import annotations

from identification.excitation.collision import ClosePair, PairExceptions


def unchecked_text(exceptions: PairExceptions) -> str | None:
    """Return which pairs are not checked, or with a smaller margin; None without any."""
    unchecked, reduced = exceptions
    groups = {
        "not checked for collisions, as they are always closer than the margin": unchecked,
        "checked with a smaller margin, as they are rarely further apart": reduced,
    }
    parts = [
        f"{text}: {'; '.join(map(_pair_text, pairs))}" for text, pairs in groups.items() if pairs
    ]
    return "; ".join(parts) or None


def _pair_text(pair: ClosePair) -> str:
    return f"{pair.first} and {pair.second} ({pair.nearest:.3f} to {pair.farthest:.3f} m)"
