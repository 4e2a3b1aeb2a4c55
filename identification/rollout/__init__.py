"""Measured motions simulated forward by MuJoCo, and the position error over the horizon."""
