"""What `hil reidentify` says when it is done: lines for a person, an object for a program."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

from hil.batch.estimates import relative_error
from hil.batch.types import Arm, BatchResult, Broken, LevelEstimate
from hil.compare.findings import findings, summary
from hil.compare.trend import ArmTrend, Trends
from hil.plural import counted as plural

_LISTED: Final = 20
_WIDTH: Final = 42


def lines(result: BatchResult, found: Trends) -> Iterator[str]:
    """Each arm: its campaigns, what changed, and what to know of the numbers."""
    by_name = {one.name: one for one in found.arms}
    above = _above([one.campaign for one in result.campaigns])
    if above:
        yield f"below {above}"
    for digest, arm in result.arms.items():
        campaigns = [one for one in result.campaigns if one.arm == digest]
        pooled = [one for one in result.pooled if one.arm == digest]
        yield from _arm_lines(arm, campaigns, pooled, by_name.get(arm.name), above)


def alarm_lines(found: Trends) -> Iterator[str]:
    """Only what is to be looked into."""
    for arm in found.arms:
        for finding in findings(arm):
            if finding.level == "alarm":
                yield f"{arm.name}: {finding.words}"


def _arm_lines(
    arm: Arm,
    campaigns: Sequence[LevelEstimate],
    pooled: Sequence[LevelEstimate],
    trend: ArmTrend | None,
    above: str,
) -> Iterator[str]:
    verdict = "no campaign could be estimated" if trend is None else summary(trend)
    yield f"{arm.name}: {verdict}"
    if campaigns:
        yield (
            f"  {'campaign':<{_WIDTH}}{'recorded':<12}{'repetitions':>11}"
            f"{'torque error':>14}{'on unseen motion':>18}"
        )
    shown = campaigns[-_LISTED:]
    if len(campaigns) > len(shown):
        yield f"  … {len(campaigns) - len(shown)} more: see --output and --json"
    several = len({one.setup for one in campaigns}) > 1
    for before, one in zip([None, *shown], shown, strict=False):
        if several and (before is None or before.setup != one.setup):
            yield f"    stated: {one.setup or 'nothing'}"
        yield _campaign_line(one, above)
    for warning in dict.fromkeys(text for one in pooled for text in one.warnings):
        yield f"  note: {warning}"
    if trend is not None:
        for finding in findings(trend):
            if finding.level == "alarm":
                yield f"  ! {finding.words} {finding.next_step}".rstrip()
            elif len(trend.campaigns) > 1:
                earlier = "earlier: " if finding.level == "past" else ""
                yield f"  {earlier}{finding.words}"


def _campaign_line(one: LevelEstimate, above: str) -> str:
    room = _WIDTH - 2
    name = one.campaign.removeprefix(above)
    name = name if len(name) <= room else "…" + name[1 - room :]
    fitted = _share(relative_error(one.noise_std, one.torque_rms, one.samples))
    unseen = _share(relative_error(one.unseen_rms, one.unseen_torque_rms))
    return (
        f"  {name:<{_WIDTH}}{one.when[:10] or 'unknown':<12}{one.repetitions:>11}"
        f"{fitted:>14}{unseen:>18}"
    )


def _above(folders: Sequence[str]) -> str:
    """The folder that all of them are in, with its slash; "" if there is none or only one."""
    if len(set(folders)) < 2:
        return ""
    parts = zip(*(folder.split("/")[:-1] for folder in folders), strict=False)
    shared = [same[0] for same in takewhile(lambda same: len(set(same)) == 1, parts)]
    return "/".join([*shared, ""]) if shared else ""


def _share(error: float) -> str:
    return "-" if math.isnan(error) else f"{error:.1%}"


def written_line(written: Sequence[Path]) -> str:
    """What was written, and where."""
    return f"written to {written[0].parent}: {', '.join(path.name for path in written)}"


def broken_lines(broken: Sequence[Broken]) -> Iterator[str]:
    """What could not be used, one by one."""
    for one in broken[:_LISTED]:
        yield f"{one.path} could not be used: {one.reason}"
    if len(broken) > _LISTED:
        yield f"and {len(broken) - _LISTED} more: see --output and --json"


def skipped_line(skipped: Sequence[Broken]) -> str:
    """How many archives were left alone, by reason; "" for none."""
    if not skipped:
        return ""
    counts = Counter(_kind(one.reason) for one in skipped)
    reasons = "; ".join(_times(reason, count) for reason, count in counts.most_common())
    return f"left alone, as not meant to be fitted: {reasons}"


def _kind(reason: str) -> str:
    """A reason without the archive that it names or the number that it counts."""
    short = re.sub(r"^is an? (?=\w+$)", "", reason)
    short = re.sub(r"\S*(/|\.mcap)\S*", "another", short)
    return re.sub(r"^attempt \d+ ", "a later attempt ", short)


def _times(reason: str, count: int) -> str:
    if " " in reason:
        return f"{count}: {reason}"
    return f"{count} {reason}{'' if count == 1 else 's'}"


def last_line(result: BatchResult) -> str:
    """What was used, and what was not."""
    counts = (
        plural(len(result.repetitions), "repetition"),
        plural(len(result.campaigns), "campaign"),
        plural(len(result.arms), "arm"),
    )
    return (
        f"{counts[0]} in {counts[1]} of {counts[2]}; {plural(result.read, 'archive')} read,"
        f" {result.cached} known, {len(result.skipped)} left alone, {len(result.broken)} broken"
    )


def as_dict(result: BatchResult, found: Trends, written: Sequence[Path]) -> dict[str, Any]:
    """The same for a program."""
    trends = {one.name: _trend(one) for one in found.arms}
    return {
        "estimator": result.estimator,
        "arms": {
            arm.name: {
                "campaigns": _campaigns([one for one in result.campaigns if one.arm == digest]),
                "pooled": next((_level(o) for o in result.pooled if o.arm == digest), None),
                "trend": trends.get(arm.name),
            }
            for digest, arm in result.arms.items()
        },
        "read": result.read,
        "cached": result.cached,
        "broken": [one._asdict() for one in result.broken],
        "skipped": [one._asdict() for one in result.skipped],
        "written": [str(path) for path in written],
    }


def _campaigns(levels: Sequence[LevelEstimate]) -> dict[str, Any]:
    """By folder, and where one folder holds several, by what their cells state as well."""
    folders = Counter(one.campaign for one in levels)
    return {
        one.campaign if folders[one.campaign] == 1 else f"{one.campaign} ({one.setup})": _level(one)
        for one in levels
    }


def _level(one: LevelEstimate) -> dict[str, Any]:
    return {
        "when": one.when or None,
        "setup": one.setup,
        "repetitions": one.repetitions,
        "method": one.method,
        "parameters": {
            name: {"value": float(value), "std": float(std) if math.isfinite(std) else None}
            for name, value, std in zip(one.names, one.values, one.std, strict=True)
        },
        "doubts": list(one.warnings),
    }


def _trend(arm: ArmTrend) -> dict[str, Any]:
    return {
        "summary": summary(arm),
        "dated": arm.dated,
        "undated": list(arm.undated),
        "findings": [
            {"level": one.level, "words": one.words, "next_step": one.next_step}
            for one in findings(arm)
        ],
    }
