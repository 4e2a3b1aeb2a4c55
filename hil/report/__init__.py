"""The HTML report of one identification: a single file that opens anywhere, offline.

`write_report` takes what `results.json` holds and the few time series that only figures need.
"""

from __future__ import annotations

from hil.report.page import render_report, write_report
from hil.report.series import ReportSeries, SeriesError

__all__ = ["write_report", "render_report", "ReportSeries", "SeriesError"]
