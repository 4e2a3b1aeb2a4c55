"""Page of a fleet: the robots ranked by concern, a sentence and a chart each, then all joints."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Final

import numpy as np

from hil.base.arrays import Array
from hil.base.version import software
from hil.compare.comparison import FALSE_ALARM_RATE, MIN_RELATIVE_CHANGE
from hil.fleet.messages import (
    month,
    name_of,
    name_of_robot,
    notes,
    robot_sentence,
    verdict,
)
from hil.fleet.series import REFERENCE_MONTHS
from hil.fleet.trend import (
    FleetTrend,
    QuantityTrend,
    RobotTrend,
)
from hil.report.chart import Caption, Chart, Legend, Plot
from hil.report.panels import Panel, chart_panel
from hil.report.rendering import environment, page_bytes
from identification.text import percentage

_MONTH_SECONDS: Final = 365.25 / 12.0 * 86400.0  # s
_CHART_HEIGHT: Final = 96.0  # px of a chart
_VALUE: Final = Legend("value", "value without temperature and season", "--wide", 6.0)
_RAW: Final = Legend("raw", "value as estimated", "--muted", 4.0)
_MODEL: Final = Legend("model", "model", "--second", 1.8)


def trend_page(fleet: FleetTrend) -> bytes:
    """Return the trend of a fleet as one HTML file; the same input gives the same bytes."""
    template = environment().get_template("trend.html.j2")
    rules = {
        "alarms": FALSE_ALARM_RATE,
        "least": MIN_RELATIVE_CHANGE,
        "reference": REFERENCE_MONTHS,
    }
    shown = [each for each in fleet.together if each.changed]
    robots = [_robot(number, each, fleet) for number, each in enumerate((*shown, *fleet.robots))]
    text = template.render(
        fleet=fleet,
        verdict=verdict(fleet),
        notes=list(notes(fleet)),
        robots=robots,
        legend=(_VALUE, _RAW, _MODEL),
        rules=rules,
        software=software(),
    )
    return page_bytes(text)


def _robot(number: int, robot: RobotTrend, fleet: FleetTrend) -> dict[str, Any]:
    """Return what the template shows of a robot."""
    main = robot.main
    shown = [each for each in robot.trends if each.changed or each.quantity == "friction"]
    return {
        "key": f"robot-{number}",
        "robot": robot,
        "name": name_of_robot(robot, fleet),
        "sentence": robot_sentence(robot, fleet),
        "panel": None if main is None else _panel(f"main-{number}", main),
        "panels": [_panel(f"r{number}-{k}", each) for k, each in enumerate(shown)],
        "rows": [_row(each) for each in robot.trends],
    }


def _row(trend: QuantityTrend) -> dict[str, Any]:
    speed = "" if trend.speed is None else f" at {trend.speed:.2g}"
    return {
        "trend": trend,
        "name": f"{name_of(trend)}{speed}",
        "since": month(trend.changes[0].begin) if trend.changes else "",
    }


def _panel(key: str, trend: QuantityTrend) -> Panel:
    """Draw the change of a quantity in per cent over the months, with the begins of changes."""
    first = trend.dates[0]
    months = np.array([_months(date, first) for date in trend.dates])
    raw = 100.0 * (trend.values / trend.reference - 1.0)
    traces = [
        _dots(_RAW, raw, months),
        _dots(_VALUE, 100.0 * trend.adjusted, months),
        _MODEL.trace(100.0 * trend.fitted).over(months),
    ]
    shaded = [
        (_months(change.earliest, first), _months(change.latest, first)) for change in trend.changes
    ]
    end = f"{percentage(abs(trend.change))} {'more' if trend.change > 0.0 else 'less'}"
    caption = Caption(
        key, f"{trend.joint}: {name_of(trend)}", end if trend.changed else "", "change over time"
    )
    plot = Plot(_CHART_HEIGHT, "change [%]", traces, shaded=shaded)
    return chart_panel(
        Chart(caption, months, [plot], foot=f"months since {month(first)}", ticks=_ticks(months))
    )


def _dots(legend: Legend, values: Array, months: Array) -> Any:
    trace = legend.trace(values).over(months)
    return type(trace)(
        trace.values, trace.colour, trace.width, name=trace.name, x=trace.x, dots=True
    )


def _months(date: str, first: str) -> float:
    """Return the months from one date to another."""
    return (
        datetime.fromisoformat(date) - datetime.fromisoformat(first)
    ).total_seconds() / _MONTH_SECONDS


def _ticks(months: Array) -> list[float]:
    """Return round numbers of months."""
    span = float(months[-1])
    step = next((step for step in (1, 3, 6, 12) if span <= 6 * step), 24)
    return [float(month) for month in range(0, int(span) + 1, step)]
