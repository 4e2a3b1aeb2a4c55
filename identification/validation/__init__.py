"""Prediction of unseen motion, checks of the residual, causes and the verdict."""
