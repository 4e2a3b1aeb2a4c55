"""HTML report of one identification: a single file for offline use."""

from __future__ import annotations

from hil.report.page import report_bytes
from hil.report.series import ReportSeries, SeriesError

__all__ = ["report_bytes", "ReportSeries", "SeriesError"]
