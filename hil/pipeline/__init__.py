"""Identification: archives to samples, estimate, evidence, verdict and results."""
