"""From recordings of any kind to an identified arm in memory, and from there to its files."""
