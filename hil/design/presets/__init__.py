"""Default settings of each method."""
