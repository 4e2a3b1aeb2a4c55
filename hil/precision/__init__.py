"""Precision that is required of a design, and what it promises."""
