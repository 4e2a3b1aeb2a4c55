"""Fleets: many robots, each with many recordings, of archives and logs alike."""
