"""Changes of friction, payload and inertial parameters between campaigns of one arm."""

from __future__ import annotations

from .comparison import Comparison, compare_campaigns, gather

__all__ = ["Comparison", "compare_campaigns", "gather"]
