"""Campaigns of one arm compared: did the friction change, on which axis, and what it carries."""

from __future__ import annotations

from .comparison import Comparison, compare_campaigns, gather

__all__ = ["Comparison", "compare_campaigns", "gather"]
