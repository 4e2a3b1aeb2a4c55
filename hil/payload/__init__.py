"""A payload weighed by recordings without and with it."""
