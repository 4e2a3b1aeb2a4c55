"""Identifies an arm from recordings of any kind, in memory, and writes its files."""
