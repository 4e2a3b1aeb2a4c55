"""HTML report of one identification: a single file for offline use."""
