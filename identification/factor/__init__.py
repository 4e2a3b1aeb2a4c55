"""Samples reduced to what an estimate needs, and its solution."""
