"""Motions of an arm in words: slips of its measured positions."""

from __future__ import annotations

import math

from identification.signals.position_steps import PositionJump


def slip_words(jump: PositionJump) -> str:
    """Return what slipped, by how much and when, as a clause."""
    return (
        f"the measured position of {jump.joint} slipped by {math.degrees(abs(jump.size)):.2g}°"
        f" {jump.time:.2f} s after the archive begins, which no motion of the arm explains"
    )
