"""The HTML report of one identification: a single file that opens anywhere, offline.

`report_bytes` takes what `results.json` holds and the few time series that only figures need.
"""

from __future__ import annotations

from hil.report.page import render_report, report_bytes
from hil.report.series import ReportSeries, SeriesError
from hil.results import csv_tables

__all__ = ["report_bytes", "render_report", "ReportSeries", "SeriesError", "csv_tables"]
