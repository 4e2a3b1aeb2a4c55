"""A payload weighed by a campaign: its motion without and with it."""
