"""Findings of a verdict: what was checked, what was found, what to do."""
