"""Estimators, their covariance, and delays."""
