"""Whether a cycle is fit: stated criteria on measured latencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from scipy.special import gammaincinv

from .latency import RESERVE, Latency

CRITERIA: Final = (
    f"a cycle is fit if no cycle of the measurement was late, with {1e6 * RESERVE:.0f} µs kept for "
    "packet work and wire, and 99.9 % of the latencies used at most half of it"
)
ENOUGH_SECONDS: Final = 60.0
"""s of measurement below which a verdict is provisional."""
_CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Fitness:
    """The verdict on one cycle.

    Attributes:
        cycle_ms: the controller's cycle.
        fit: by `CRITERIA`.
        late: cycles late in the measurement.
        late_per_hour_upper_95: upper bound of the rate with 95 % confidence, one-sided, for late
            cycles that come independently of each other (Poisson). Those of one long stall do not.
        used: largest 99.9 % latency plus reserve, as a share of the cycle.
        reason: in words.
    """

    cycle_ms: int
    fit: bool
    late: int
    late_per_hour_upper_95: float
    used: float
    reason: str


def judge(latencies: Sequence[Latency], cycle_ms: int) -> Fitness:
    """Judge a cycle by the worse of the latencies; without any, it is not fit."""
    if not latencies:
        return Fitness(cycle_ms, False, 0, float("nan"), float("nan"), "nothing was measured")
    period = cycle_ms / 1000
    late, worst = max(((each.late_cycles(period), each) for each in latencies), key=lambda p: p[0])
    slow = max(latencies, key=lambda each: each.percentile(99.9))
    used = (slow.percentile(99.9) + RESERVE) / period
    hours = worst.seconds / 3600.0
    # The mean whose Poisson distribution gives `late` or fewer with 5 % probability only.
    bound = float(gammaincinv(late + 1, _CONFIDENCE)) / hours
    if late:
        longest = 1e3 * float(worst.samples.max())
        reason = (
            f"{late} cycles late in {worst.seconds:.0f} s of {worst.name} "
            f"(some {late / hours:.0f} an hour), the longest {longest:.1f} ms"
        )
    elif used > 0.5:
        reason = f"none late, but {slow.name} uses {100 * used:.0f} % of the cycle at 99.9 %"
    else:
        reason = (
            f"none late in {worst.seconds:.0f} s (fewer than {bound:.0f} an hour, with 95 % "
            f"confidence); {100 * used:.0f} % of the cycle used at 99.9 %"
        )
    return Fitness(cycle_ms, not late and used <= 0.5, late, bound, used, reason)


def in_words(one: Fitness, two: Fitness) -> str:
    """The verdict on both cycles in one sentence."""
    if one.fit and two.fit:
        return "1 ms is fit, and so is 2 ms."
    if two.fit:
        return "2 ms is fit; 1 ms is not."
    if one.fit:
        return "1 ms is fit."
    return "Neither 1 ms nor 2 ms is fit."
