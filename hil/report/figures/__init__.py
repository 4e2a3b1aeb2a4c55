"""Figures of the report as inline SVG that takes its colours from the page's style sheet."""
