"""Benchmarks: `python -m benchmarks.NAME [--json]`; each ends with one line of JSON."""
