"""Figures of the report as inline SVG that takes its colours from the page's style sheet."""

from __future__ import annotations

from hil.report.figures.boxes import error_boxes
from hil.report.figures.correlation import correlation_matrix
from hil.report.figures.friction import friction_curve_panels
from hil.report.figures.motion import (
    excitation_panels,
    replay_panels,
    split_panels,
    torque_panels,
)
from hil.report.figures.parameters import deviation_panels, uncertainty_panels
from hil.report.figures.spectra import spectrum_panels
from hil.report.figures.svg import Panel

__all__ = [
    "Panel",
    "excitation_panels",
    "torque_panels",
    "split_panels",
    "replay_panels",
    "spectrum_panels",
    "friction_curve_panels",
    "error_boxes",
    "deviation_panels",
    "uncertainty_panels",
    "correlation_matrix",
]
