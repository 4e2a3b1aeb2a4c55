"""Stamps of time as dates and times of day, of computers, controllers and spreadsheets."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import numpy as np

_LOCAL: Final = re.compile(r"(\d{1,2})([./-])(\d{1,2})\2(\d{4}|\d{2})(?=\D|$)[\sT,]*(.*)")
_TIME_OF_DAY: Final = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?")
_COMMA: Final = re.compile(r"(:\d{2}),(?=\d)")  # 08:00:01,004
_MILLISECONDS: Final = re.compile(r"(:\d{2}):(\d{3})(?=\D|$)")  # 08:00:01:004
_MONTHS_PER_YEAR: Final = 12


def nanoseconds_of_dates(texts: Sequence[str]) -> list[int | None]:
    """Return stamps [ns], None where a text is none; of days since 1970, or within the day.

    Texts are ISO 8601 with or without zone, or a date in the order of a country (day, month and
    year with points; with slashes the order that gives months for all of them, of two the one with
    fewer days in the log) and a time of day, which may have a decimal comma.
    """
    import pandas as pd  # only a log with dates needs it

    cleaned = [_MILLISECONDS.sub(r"\1.\2", _COMMA.sub(r"\1.", text.strip())) for text in texts]
    filled = [text for text in cleaned if text]
    if filled and all(_TIME_OF_DAY.fullmatch(text) for text in filled[:100]):
        series = pd.to_timedelta(pd.Series(cleaned), errors="coerce")
        return _whole(series.to_numpy("timedelta64[ns]"))
    dates = [_LOCAL.fullmatch(text) for text in cleaned]
    if any(dates):
        cleaned = _in_iso_order(cleaned, dates)
    stamps = pd.to_datetime(pd.Series(cleaned), format="ISO8601", utc=True, errors="coerce")
    if stamps.isna().all():
        stamps = pd.to_datetime(pd.Series(cleaned), format="mixed", utc=True, errors="coerce")
    return _whole(stamps.dt.tz_localize(None).to_numpy("datetime64[ns]"))


def _whole(stamps: np.ndarray) -> list[int | None]:
    numbers = stamps.astype(np.int64).tolist()
    missing = np.isnat(stamps).tolist()
    return [None if no else number for number, no in zip(numbers, missing, strict=True)]


def _in_iso_order(texts: Sequence[str], dates: Sequence[re.Match[str] | None]) -> list[str]:
    """Return dates as year-month-day."""
    matches = [match for match in dates if match]
    firsts = {int(match[1]) for match in matches}
    seconds = {int(match[3]) for match in matches}
    day_first = matches[0][2] != "/" or max(firsts) > _MONTHS_PER_YEAR
    if matches[0][2] == "/" and max(firsts | seconds) <= _MONTHS_PER_YEAR:
        day_first = len(firsts) >= len(seconds)  # the day changes at midnight, the month hardly
    ordered = []
    for text, match in zip(texts, dates, strict=True):
        if match is None:
            ordered.append(text)
            continue
        day, month = (match[1], match[3]) if day_first else (match[3], match[1])
        year = match[4] if len(match[4]) == len("2026") else f"20{match[4]}"
        ordered.append(f"{year}-{int(month):02d}-{int(day):02d}T{match[5] or '00:00'}")
    return ordered
