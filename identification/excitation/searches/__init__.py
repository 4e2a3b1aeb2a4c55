"""Searches for the best excitation."""
