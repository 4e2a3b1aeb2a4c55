"""A run in plain lines, where there is no terminal."""

from __future__ import annotations

from hil.campaign.operator import RunStatus

from . import marks


def line(status: RunStatus, left: str = "") -> str:
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
            parts.append(f"{motion.untaken} not taken")
        if motion.latency is not None:
            parts.append(f"latency {marks.duration(motion.latency.p99)} (99 %)")
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
    parts.append(left or f"{marks.clock(status.time_left)} left")
    return ", ".join(parts)
