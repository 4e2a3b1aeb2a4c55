"""What the residual follows: speed, position, time."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes

from hil.report import numbers
from hil.report.figures.canvas import footed, headed, plot_panel, ruled
from hil.report.figures.palette import BAND, FIRST, MUTED, SECOND
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.results import JudgementResult, ProfileResult

_HEIGHT = 170.0
# Half a 95 % interval, in standard errors.
_INTERVAL = 1.96


def speed_panels(judgement: JudgementResult) -> list[Panel]:
    """Mean residual of each joint over its own speed."""
    return _profile_panels(judgement, judgement.speed, "s", "speed", "/s")


def position_panels(judgement: JudgementResult) -> list[Panel]:
    """Mean residual of each joint over its own position."""
    return _profile_panels(judgement, judgement.position, "p", "position", "")


def _profile_panels(
    judgement: JudgementResult,
    profiles: Sequence[ProfileResult],
    key: str,
    what: str,
    per: str,
) -> list[Panel]:
    panels = []
    for j, (profile, joint) in enumerate(zip(profiles, judgement.joints, strict=True)):
        known = [
            (at, mean, std)
            for at, mean, std in zip(profile.centre, profile.mean, profile.std, strict=True)
            if mean is not None and std is not None
        ]
        if not known:
            continue
        unit = ("rad" if joint.unit == "N·m" else "m") + per
        at, worst, _ = max(known, key=lambda one: abs(one[1]))
        note = f"RMS error {numbers.significant(joint.rms)} {joint.unit}"
        alt = (
            f"{joint.joint}: mean residual over {what}, at most {numbers.significant(worst)}"
            f" {joint.unit} at {numbers.significant(at)} {unit}; {note}."
        )
        with drawing():
            figure, axes = plot_panel(_HEIGHT)
            _profile(axes, profile, joint.rms)
            headed(axes, f"mean residual [{joint.unit}]")
            footed(axes, f"{what} [{unit}]")
            panels.append(to_panel(figure, key=f"{key}{j}", title=joint.joint, note=note, alt=alt))
    return panels


def _profile(axes: Axes, profile: ProfileResult, rms: float) -> None:
    # The joint's RMS error, so that a pattern is seen beside all that is left over.
    axes.axhspan(-rms, rms, color=BAND, linewidth=0.0)
    axes.axhline(0.0, color=MUTED, linewidth=0.9)
    # No line across a bin that was not seen.
    means = [math.nan if mean is None else mean for mean in profile.mean]
    errors = [math.nan if std is None else _INTERVAL * std for std in profile.std]
    axes.errorbar(
        profile.centre,
        means,
        yerr=errors,
        color=FIRST,
        marker="o",
        markersize=4.5,
        linewidth=1.2,
        elinewidth=1.2,
        capsize=2.5,
    )
    ruled(axes, "both", x_ticks=6)


def autocorrelation_panels(judgement: JudgementResult) -> list[Panel]:
    """Autocorrelation of each joint's residual."""
    panels = []
    milliseconds = [1e3 * lag for lag in judgement.lag]
    rows = zip(
        judgement.autocorrelation,
        judgement.joints,
        judgement.effective_rows,
        strict=True,
    )
    for j, (column, joint, worth) in enumerate(rows):
        if any(value is None for value in column):
            continue
        values = [value for value in column if value is not None]
        note = f"worth {worth:.0f} independent samples"
        with drawing():
            figure, axes = plot_panel(_HEIGHT)
            axes.axhline(0.0, color=MUTED, linewidth=0.9)
            axes.plot(milliseconds, values, color=FIRST, linewidth=1.4)
            axes.set_xlim(0.0, milliseconds[-1])
            axes.set_ylim(min(-0.25, *values), 1.05)
            ruled(axes, "both", x_ticks=6)
            headed(axes, "autocorrelation of the residual")
            footed(axes, "lag [ms]")
            alt = f"{joint.joint}: autocorrelation of the residual up to {milliseconds[-1]:.0f} ms"
            panels.append(
                to_panel(
                    figure,
                    key=f"w{j}",
                    title=joint.joint,
                    note=note,
                    alt=f"{alt}; {note}.",
                )
            )
    return panels


def friction_panels(judgement: JudgementResult) -> list[Panel]:
    """Friction of each joint beside the estimate, recording by recording."""
    panels: list[Panel] = []
    shares = judgement.friction_over_time
    if shares is None:
        return panels
    known = [abs(value) for row in shares for value in row if value is not None]
    # The same scale for all, and never one that makes a change of nothing look like much.
    reach = 100.0 * max(0.02, 1.15 * max(known, default=0.0))
    for j, (row, joint) in enumerate(zip(shares, judgement.joints, strict=True)):
        points = [(k, 100.0 * v) for k, v in enumerate(row, 1) if v is not None]
        if not points:
            continue
        with drawing():
            figure, axes = plot_panel(150.0)
            _friction(axes, points, len(row), reach)
            first, last = points[0][1], points[-1][1]
            alt = f"{joint.joint}: friction, from {first:+.1f} % to {last:+.1f} % of the estimate."
            panels.append(to_panel(figure, key=f"f{j}", title=joint.joint, note="", alt=alt))
    return panels


def _friction(axes: Axes, points: list[tuple[int, float]], count: int, reach: float) -> None:
    axes.axhline(0.0, color=MUTED, linewidth=0.9)
    axes.plot(
        *zip(*points, strict=True),
        color=SECOND,
        marker="s",
        markersize=4.0,
        linewidth=1.2,
    )
    axes.set_xlim(0.5, count + 0.5)
    axes.set_ylim(-reach, reach)
    ruled(axes, "both", x_ticks=min(6, max(2, math.ceil(count))))
    headed(axes, "friction beside the estimate [%]")
    footed(axes, "recording, or equal part of one, in order")
