"""Recordings as sums, and the estimate of an arm from these with its prior and its intervals."""
