"""Trends of a fleet in words: a sentence for each robot."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Final

from hil.base.terminal_text import plural
from hil.batch.messages import batch_lines
from hil.fleet.covariates import is_heat, is_since_start
from hil.fleet.trend import FleetTrend, LimitReached, QuantityTrend, RobotTrend
from identification.text import percentage

_NAMES: Final = {
    "friction": "friction",
    "coulomb": "Coulomb friction",
    "viscous": "viscous friction",
    "gravity load": "gravity load",
    "torque scale": "torque scale",
    "reference error": "torque error of the first months' model",
}


def month(date: str) -> str:
    """Return month and year of a date."""
    return f"{datetime.fromisoformat(date):%B %Y}"


def signed(share: float) -> str:
    """Return a share as a percentage with its sign."""
    return f"{'−' if share < 0.0 else '+'}{percentage(abs(share), 1 if abs(share) < 0.1 else 0)}"


def name_of(trend: QuantityTrend) -> str:
    """Return a quantity in words."""
    return _NAMES[trend.quantity]


def verdict(fleet: FleetTrend) -> str:
    """Return one line about the fleet."""
    robots = plural(len(fleet.robots), "robot")
    if not fleet.changed:
        return f"No significant change in {robots}"
    changed = [name_of_robot(robot, fleet) for robot in fleet.changed]
    own = sum(robot.changed for robot in fleet.robots)
    count = f" ({own} of {robots})" if own else ""
    return f"Changed: {', '.join(changed)}{count}"


def name_of_robot(robot: RobotTrend, fleet: FleetTrend) -> str:
    """Return the name of a robot, or of all of a type together."""
    if robot.robot:
        return robot.robot
    several = len({each.kind for each in fleet.robots}) > 1
    return f"all robots of type {robot.kind[:8]}" if several else "all robots together"


def sentences(fleet: FleetTrend) -> Iterator[str]:
    """Yield a sentence about all robots together, if there is something to say, and about each."""
    for robots in fleet.together:
        if robots.main is not None and (robots.main.changed or robots.main.explained):
            yield robot_sentence(robots, fleet)
    for robot in fleet.robots:
        yield robot_sentence(robot, fleet)


def robot_sentence(robot: RobotTrend, fleet: FleetTrend) -> str:
    """Return the sentence about a robot: what changed, since when, how fast, and why not."""
    trend = robot.main
    name = name_of_robot(robot, fleet)
    if trend is None:
        recordings = plural(len(robot.recordings), "recording")
        return f"{name}: {recordings}, too few to say whether anything changes"
    if trend.changed:
        return f"{name}, {trend_sentence(trend, fleet)}"
    if trend.explained:
        return f"{name}, {trend.joint}: {name_of(trend)} varies; {_explanation(trend)} explains it"
    return f"{name}: no significant change"


def trend_sentence(trend: QuantityTrend, fleet: FleetTrend) -> str:
    """Return joint, quantity and change of a trend that is significant."""
    first = trend.changes[0]
    parts = [f"{trend.joint}: {name_of(trend)} {signed(trend.change)} since {month(first.begin)}"]
    last = trend.changes[-1]
    if trend.rate:
        parts.append(f"{signed(trend.rate)} a month")
    elif last.kind == "step":
        parts.append(f"in one step about {last.begin[:10]}")
    if trend.robot and trend.effects:
        parts.append(f"not explained by {' or '.join(_explaining(trend))}")
    elif fleet.seasonal:
        parts.append("not explained by a season" + (" of all robots" if trend.robot else ""))
    parts += [limit_text(limit) for limit in trend.limits if limit.date is not None]
    return ", ".join(parts)


def limit_text(limit: LimitReached) -> str:
    """Return when a limit is reached."""
    reached = f"{limit.limit.quantity} {signed(limit.limit.share)}"
    assert limit.date is not None
    until = "later" if limit.latest is None else month(limit.latest)
    since = month(limit.date) if limit.earliest is None else month(limit.earliest)
    if since == until:
        return f"reaches {reached} in {since}"
    return f"reaches {reached} in {month(limit.date)} ({since} to {until})"


def _explanation(trend: QuantityTrend) -> str:
    if not trend.robot:
        return "a season"
    season = "a season of all robots"
    names = " and ".join(_explaining(trend))
    return f"{names}, or {season}," if names else season


def _explaining(trend: QuantityTrend) -> list[str]:
    """Return in words what was taken into account for a robot, in addition to a season."""
    words = {
        "temperature" if is_heat(name) else "time since the start" if is_since_start(name) else name
        for name in trend.effects
    }
    return sorted(words)


def notes(fleet: FleetTrend) -> Iterator[str]:
    """Yield what limits the result."""
    if not fleet.covariates:
        yield (
            "no recording has a temperature, so warm-up and season count as day-to-day noise"
            + (", except for changes that all robots share" if fleet.seasonal else "")
        )
    for robot, places in fleet.sources.twice.items():
        yield (
            f"{robot} is recorded in {' and '.join(places)} at the same time; if these are several"
            " robots, name them by several parts of the path: --robot '{robot}/{robot}/...'"
        )
    for name in fleet.unknown:
        yield f"no recording has a column {name!r} of numbers"
    if fleet.sources.dated_by_file:
        recordings = plural(fleet.sources.dated_by_file, "recording")
        yield f"{recordings} dated only by the file's time, which copying changes; see --robot"
    yield from batch_lines(fleet.sources.warnings)
