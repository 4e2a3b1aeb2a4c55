"""What the screen of a run looks like: a pure function of what is known and how much room there is.

Eighty columns and twenty-four lines hold everything of a six-joint arm. With less room, bars get
shorter, then go; the last events go before the drift curve, that before the joints.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from rich.text import Text

from hil.campaign.operator import DriftCurve, MotionProgress, OperatorRequest, RunStatus
from hil.terminal_text import printable

from .keys import HELP, SHORT_HELP


def status_line(status: RunStatus, left: str = "") -> str:
    """Where a run stands, in one line; `left` says in words how long a person waits."""
    parts = [f"{status.phase} {status.number} of {status.total}"]
    motion = status.motion
    if motion is not None:
        if motion.motion_time is not None and motion.duration:
            parts.append(f"{motion.motion_time:.1f} of {motion.duration:.1f} s")
        if motion.held:
            parts.append("held")
        if motion.override != 1.0:
            parts.append(f"override {100.0 * motion.override:.0f} %")
        parts += [f"{motion.missed} missed", f"{motion.late} late"]
        if motion.untaken:
            parts.append(f"{motion.untaken} not accepted")
        if motion.latency is not None:
            parts.append(f"latency {duration(motion.latency.p99)} (99 %)")
        for what, share in (
            ("following error", motion.following_share), ("current", motion.current_share)
        ):  # fmt: skip
            if share is not None:
                parts.append(f"{what} {100.0 * share.max():.0f} % of its limit")
    drift = status.drift
    if drift is not None and len(drift.change) > 1:
        parts.append(
            f"friction changed by {100.0 * drift.change[-1]:.1f} % "
            f"(warm below {100.0 * drift.threshold:g} %)"
        )
    parts.append(left or f"{clock(status.time_left)} left")
    return ", ".join(parts)


WIDE: Final = 64
"""Columns from which on there are bars beside the numbers."""
STALE: Final = 1.0
"""s without news after which the screen says so."""
SIMULATED: Final = "SIMULATED"
"""What the first line says where nothing but a simulated arm can move."""
_LEAST_TITLE: Final = 8
"""Columns of the title that stay whatever stands behind it."""
_NUMBERS: Final = 28
"""Columns of a joint's numbers beside its name and bars."""


@dataclass(frozen=True, eq=False)
class Shown:
    """Everything that is shown.

    Attributes:
        title: of the run.
        joint_names: of the n joints.
        status: where the run stands; None before the first.
        request: the person's.
        stopping: whether a stop was asked for.
        age: s since the status came.
        said: lines that the run said, oldest first.
        keys: whether keys are read.
        far_end: what is moved: "SIMULATED", or the controller's address.
        left: time to the end as a person waits for it, in words; that of motion if left out.
    """

    title: str
    joint_names: tuple[str, ...]
    status: RunStatus | None = None
    request: OperatorRequest = field(default_factory=OperatorRequest)
    stopping: bool = False
    age: float = 0.0
    said: tuple[str, ...] = ()
    keys: bool = True
    far_end: str = ""
    left: str = ""


def lines(shown: Shown, width: int, height: int) -> list[Text]:
    """The screen, at most `height` lines of at most `width` columns."""
    status = shown.status
    head = [
        _heading(shown, width),
        _way(status, width),
        _state(shown, width),
        _health(shown, width),
    ]
    tail = [_help(shown, width)]
    joints = [] if status is None else _joints(shown.joint_names, status.motion, width)
    drift = [] if status is None or status.drift is None else _drift(status.drift, width)
    news = [Text(part, style="dim") for line in _news(shown) for part in _wrapped(line, width)]
    room = height - len(head) - len(tail)
    body = _fitting(room, joints, drift, news)
    rows = [*head, *body, *[Text()] * max(0, room - len(body)), *tail][:height]
    for line in rows:
        line.truncate(width, overflow="ellipsis")
    return rows


def _fitting(room: int, joints: list[Text], drift: list[Text], news: list[Text]) -> list[Text]:
    """What fits: the joints first, then the curve, then as many of the newest lines as there is."""
    body = [Text(), *joints] if len(joints) < room else joints[:room]
    if drift and len(body) + len(drift) + 1 <= room:
        body += [Text(), *drift]
    left = room - len(body) - 1
    if left > 0 and news:
        body += [Text(), *news[-left:]]
    return body


def _heading(shown: Shown, width: int) -> Text:
    status = shown.status
    where = Text()
    if shown.far_end:
        style = "bold green" if shown.far_end == SIMULATED else "bold yellow"
        where.append("  ").append(shown.far_end, style=style)
    where.append("  beginning" if status is None else "", style="dim")
    left = ""
    if status is not None:
        where.append(f"  {status.phase} {status.number} of {status.total}", style="bold cyan")
        left = shown.left or f"{clock(status.time_left)} left"
    room = max(0, width - len(left) - 2)
    text = Text(
        printable(shown.title), style="bold"
    )  # gives way to where it is and what it is doing
    text.truncate(max(min(_LEAST_TITLE, room), room - where.cell_len), overflow="ellipsis")
    text.append_text(where)
    text.truncate(room, overflow="ellipsis")
    text.append(left.rjust(width - text.cell_len))
    return text


def _way(status: RunStatus | None, width: int) -> Text:
    """How far the motion is."""
    motion = None if status is None else status.motion
    if motion is None:
        return Text("nothing moves", style="dim")
    if motion.motion_time is None or not motion.duration:
        return Text(f"{motion.state.name.lower()}, {motion.cycles} cycles")
    done = min(1.0, motion.motion_time / motion.duration)
    times = f" {motion.motion_time:.1f} of {motion.duration:.1f} s"
    text = Text()
    room = width - len(times)
    if room >= 10:
        filled = round(room * done)
        text.append("━" * filled, style="cyan").append("─" * (room - filled), style="dim")
    return text.append(times.strip() if room < 10 else times)


def _state(shown: Shown, width: int) -> Text:
    """Whether it moves, and how fast."""
    status = shown.status
    motion = None if status is None else status.motion
    text = Text()
    if shown.stopping:
        text.append(" STOPPING ", style="bold red reverse").append("  ")
    elif shown.request.held:
        text.append(" HELD ", style="bold yellow reverse").append("  ")
    if shown.age > STALE and status is not None:
        text.append(f"no news for {shown.age:.0f} s  ", style="bold red")
    override = shown.request.override if motion is None else motion.override
    text.append(f"override {100.0 * override:.0f} %", style=_slower(override))
    if motion is not None and motion.rate is not None:
        text.append(f", now {100.0 * motion.rate:.0f} %", style="dim")
    if motion is not None and width >= WIDE:
        text.append(f"   {motion.state.name.lower().replace('_', ' ')}", style="dim")
    return text


def _health(shown: Shown, width: int) -> Text:
    """Regularity of the cycle."""
    status = shown.status
    motion = None if status is None else status.motion
    text = Text().append("cycles ", style="bold")
    if motion is None:
        return text.append("-", style="dim")
    text.append(f"{motion.cycles}")
    for count, what in (
        (motion.missed, "missed"), (motion.late, "late"), (motion.untaken, "not accepted")
    ):  # fmt: skip
        if count or width >= WIDE:
            text.append(f"  {count} {what}", style="bold yellow" if count else "green")
    latency = motion.latency
    if latency is not None:
        times = [duration(value) for value in (latency.median, latency.p99, latency.worst)]
        if width >= WIDE:
            text.append(f"  {times[0]}, 99 % {times[1]}, worst {times[2]}")
        else:
            text.append(f"  {times[2]}")
    return text


def _slower(override: float) -> str:
    return "" if override >= 1.0 else "bold yellow"


def _joints(names: Sequence[str], motion: MotionProgress | None, width: int) -> list[Text]:
    """A line of each joint: following error and current, each against its limit."""
    if motion is None or motion.following_error is None or motion.current is None:
        return []
    error_share, current_share = motion.following_share, motion.current_share
    assert error_share is not None
    assert current_share is not None
    name_width = min(max(map(len, [*names, "joint"])), max(5, width // 5))
    hot = None if motion.temperature is None else np.asarray(motion.temperature)
    numbers = _NUMBERS + (6 if hot is not None else 0)
    bars = max(0, (width - name_width - numbers) // 2) if width >= WIDE else 0
    rule = Text("joint".ljust(name_width), style="bold")
    titles = ("following error / threshold", "current / limit")
    for title in titles if bars else ("following", "current"):
        rule.append(f"  {title}".ljust(14 + bars))
    rows = [rule]
    for index, name in enumerate(names):
        line = Text(name[:name_width].ljust(name_width))
        degrees = np.degrees(motion.following_error[index])
        for value, share in (
            (f"{degrees:8.3f}°", float(error_share[index])),
            (f"{motion.current[index]:7.2f} A", float(current_share[index])),
        ):
            line.append(value).append(" ")
            if bars:
                line.append(bar(share, bars - 1)).append(" ")
            line.append(percent(share), style=colour(share))
        if hot is not None:
            line.append(f" {hot[index]:3.0f}°C")
        rows.append(line)
    if hot is not None:
        rule.append(" motor")
    return rows


def _drift(drift: DriftCurve, width: int) -> list[Text]:
    """Friction from motion to motion while the joints warm up."""
    change = [float(value) for value in drift.change]
    known = [value for value in change if np.isfinite(value)]
    text = Text("warm-up: friction changed by ")
    if not known:
        return [text.append("… (one motion so far)")]
    text.append(
        f"{100.0 * known[-1]:.1f} %", style="green" if known[-1] < drift.threshold else "yellow"
    )
    text.append(f", warm below {100.0 * drift.threshold:g} %  ")
    return [text.append(curve(known, max(0, width - text.cell_len)), style="cyan")]


def _news(shown: Shown) -> list[str]:
    status = shown.status
    events = () if status is None or status.motion is None else status.motion.events
    notes = () if status is None else status.notes
    return [*shown.said, *notes, *events]


def _wrapped(line: str, width: int) -> list[str]:
    line = printable(line, keep="")
    return textwrap.wrap(line, max(8, width), subsequent_indent="  ") or [""]


def _help(shown: Shown, width: int) -> Text:
    if not shown.keys:
        return Text("Ctrl-C stops on the path".ljust(width), style="reverse")
    text = next((text for text in (HELP, SHORT_HELP) if len(text) <= width), "h ␣ s + - 1…0")
    return Text(text.ljust(width), style="reverse")


_EIGHTHS: Final = " ▏▎▍▌▋▊▉█"
_HEIGHTS: Final = "▁▂▃▄▅▆▇█"
WARNING: Final = 0.8
"""Share of a limit from which on it is coloured."""


def bar(share: float, width: int) -> Text:
    """A share of a limit; above `WARNING` it is marked by colour, above 1 by the last character."""
    if not math.isfinite(share):
        return Text("?".ljust(width), style="bold red")
    filled = round(8 * width * min(max(share, 0.0), 1.0))
    whole, rest = divmod(filled, 8)
    filled_blocks = "█" * whole + (_EIGHTHS[rest] if rest else "")
    text = Text(filled_blocks, style=colour(share))
    text.append("·" * (width - len(filled_blocks)), style="dim")
    if share > 1.0:
        text = Text("█" * (width - 1) + "▶", style=colour(share))
    return text


def colour(share: float) -> str:
    """Style of a share of a limit; the number beside it says the same without colours."""
    if share > 1.0:
        return "bold red"
    return "yellow" if share > WARNING else "green"


def percent(share: float) -> str:
    """A share in four characters."""
    if not math.isfinite(share):
        return "  ?%"
    value = min(100.0 * share, 999.0)
    return f"{value:3.1f}%" if value < 9.95 else f"{value:3.0f}%"


def curve(values: Sequence[float], width: int) -> str:
    """The last `width` values as a row of blocks, from 0 to the largest of them."""
    shown = [value for value in values if math.isfinite(value)][-width:]
    top = max(shown, default=0.0)
    if top <= 0.0:
        return _HEIGHTS[0] * len(shown)
    return "".join(
        _HEIGHTS[min(len(_HEIGHTS) - 1, int(len(_HEIGHTS) * max(value, 0.0) / top))]
        for value in shown
    )


def clock(seconds: float | None) -> str:
    """A time as h:mm:ss or m:ss."""
    if seconds is None or not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def duration(seconds: float) -> str:
    """A latency."""
    if not math.isfinite(seconds):
        return "> 5 ms"
    return f"{1e3 * seconds:.1f} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.0f} µs"
