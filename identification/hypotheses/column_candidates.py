"""Changes that a search by columns tries: of whole recordings, then of parts of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from identification.hypotheses.column_fit import ColumnFit
from identification.hypotheses.column_scores import MIN_BLOCKS, column_score
from identification.hypotheses.joint_changes import Change, Meaning, Part
from identification.model.link_wrenches import MASS_INDEX

JOINT_MEANINGS: Final[tuple[Meaning, ...]] = ("scale", "friction")
"""Changes of a joint that may be of a part."""
_ARM_MEANINGS: Final[tuple[Meaning, ...]] = ("payload", "arm")  # likewise, of the arm


def changes_to_try(fit: ColumnFit) -> Iterator[Change]:
    """Yield the changes to try: throughout, then in parts.

    Of joints that move only: the torque of another does not show its scale.
    """
    of_parts = [Change(meaning) for meaning in _ARM_MEANINGS]
    of_parts += [Change(meaning, (joint,)) for joint in fit.moved for meaning in JOINT_MEANINGS]
    if not fit.seen:
        yield from (Change("delay"), Change("load friction"))
        for joint in fit.moved:
            yield from (Change("delay", (joint,)), Change("scale", (joint,)))
            if fit.model.chain.revolute[joint]:
                yield from (Change("drift", (joint,)), Change("spring", (joint,)))
    for part in _later_parts(fit):
        yield from (change._replace(part=part) for change in of_parts)
    yield from (Change("payload", part=part) for part in _inner_parts(fit))
    if not fit.seen and len(fit.recordings) > 2:
        for change in of_parts:
            yield change._replace(part=_other_recordings(fit, change))


def _later_parts(fit: ColumnFit) -> Iterator[Part]:
    """Yield the blocks from each time on, in recordings in which a change may begin."""
    tables = fit.tables
    blocks = len(tables.recording)
    for first in range(MIN_BLOCKS, blocks - MIN_BLOCKS + 1):
        k = int(tables.recording[first])
        if k < fit.seen:
            continue
        start = tables.start[first]
        name = fit.fitted.name_of(k)
        description = f"{name} from {start:.3g} s on" if start > 0.0 else name
        if k < len(fit.recordings) - 1:
            description += " and what follows it"
        yield Part(description, tuple((np.arange(blocks) >= first).tolist()), start)


def _inner_parts(fit: ColumnFit) -> Iterator[Part]:
    """Yield the blocks from each time to another, within a recording."""
    tables = fit.tables
    blocks = np.arange(len(tables.recording))
    for first in range(MIN_BLOCKS, len(blocks) - 2 * MIN_BLOCKS + 1):
        k = int(tables.recording[first])
        if k < fit.seen or tables.start[first] == 0.0:
            continue
        for end in range(first + MIN_BLOCKS, len(blocks) - MIN_BLOCKS + 1):
            if tables.recording[end] != k or tables.start[end] == 0.0:
                break
            start, stop = tables.start[first], tables.start[end]
            name = f"{fit.fitted.name_of(k)} from {start:.3g} s to {stop:.3g} s"
            inside = (blocks >= first) & (blocks < end)
            yield Part(name, tuple(inside.tolist()), start, stop)


def _other_recordings(fit: ColumnFit, change: Change) -> Part:
    """Return the recordings in which a change is largest, estimated separately in each."""
    tables = fit.tables
    alike = Change("payload") if change.meaning == "arm" else change
    columns = []
    for k in range(1, len(fit.recordings)):
        part = Part(fit.fitted.name_of(k), tuple((tables.recording == k).tolist()))
        columns.append(fit.columns(alike._replace(part=part)))
    score = column_score(tables, np.concatenate(columns, axis=3), tables.torques)
    sizes = score.added.mean(axis=0).reshape(len(columns), -1)
    sizes = np.append(0.0, sizes[:, MASS_INDEX if alike.meaning == "payload" else 0])
    order = np.argsort(sizes)
    cut = int(np.argmax(np.diff(sizes[order]))) + 1
    chosen = sorted(min(order[cut:], order[:cut], key=len).tolist())
    blocks = np.isin(tables.recording, chosen)
    name = ", ".join(fit.fitted.name_of(k) for k in chosen)
    return Part(name, tuple(blocks.tolist()))
