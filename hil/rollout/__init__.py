"""Held-out motions simulated forward, by torque or on an identified servo."""
