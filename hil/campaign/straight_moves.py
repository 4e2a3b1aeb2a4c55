"""Straight ways between the motions of a run, each planned and checked once."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveName, open_archive
from hil.cell import Cell
from hil.errors import ArchiveError
from hil.motion_checks import MotionChecks
from hil.reading import json_of
from identification.excitation.excitation import trajectory_from_dict

from .folder import CampaignFolder
from .intervals import AT_REST_TOLERANCE, Interval, ends, require_sound, way

Array = NDArray[np.float64]
Ends = tuple[Array, Array]


class StraightMoves:
    """Knows the ways that were planned and checked beforehand, and plans others like them.

    Args:
        cell: whose arm goes.
        checks: those of the cell.
        known: intervals with sound ways among them.
        seen: from where to where (n,) [rad] ways led that somebody watched in the dry run; None
            where nobody needs to.
    """

    def __init__(
        self,
        cell: Cell,
        checks: MotionChecks,
        known: Sequence[Interval],
        seen: Sequence[Ends] | None,
    ) -> None:
        self._cell, self._checks = cell, checks
        self._known = [interval for interval in known if interval.kind == "move"]
        self._seen = None if seen is None else [*seen]
        self._given = 0

    def unseen(self, way: Interval) -> bool:
        """Whether nobody has watched this way in the dry run.

        One from or to where the arm happens to stand counts as unseen: whoever jogged it there
        may have done so for a reason.
        """
        if self._seen is None:
            return False
        return way.from_arm or not any(_leads(way, *known) for known in self._seen)

    def saw(self, way: Interval) -> None:
        """A way was gone slowly in the dry run."""
        if self._seen is not None:
            self._seen.append(ends(way))

    def between(self, start: Array, end: Array) -> Interval | None:
        """The next way from `start` to `end` (n,) [rad]; None where they are the same.

        Raises:
            MotionRefusedError: a way that was not known is not free.
        """
        if np.max(np.abs(end - start)) <= AT_REST_TOLERANCE:
            return None
        found = next((one for one in self._known if _leads(one, start, end)), None)
        if found is None:
            found = way(self._cell, start, end)
            require_sound([found], self._checks)
            self._known.append(found)
        self._given += 1
        return replace(found, index=self._given - 1)


def seen_in_dry_run(folder: CampaignFolder) -> list[Ends]:
    """From where to where (n,) [rad] the ways of a dry run led, by its archives.

    Raises:
        CampaignFolderError: the manifest cannot be read.
    """
    found: list[Ends] = []
    entries = [one for one in folder.manifest() if one.outcome == "completed"]
    kinds = [name.kind if (name := ArchiveName.parse(one.name)) else "" for one in entries]
    last = max((k for k, kind in enumerate(kinds) if kind == "dryrun"), default=0)
    for entry, kind in zip(entries[:last], kinds[:last], strict=True):
        if kind != "move":
            continue
        with suppress(ArchiveError, ValueError, KeyError, TypeError):  # not seen, then
            archive = open_archive(folder.archives / entry.name, fields=())
            motion = trajectory_from_dict(json_of(archive.text("plan.json"))["trajectory"])
            start, end = motion.sample(np.array([0.0, motion.duration]))[0]
            found.append((start, end))
    return found


def _leads(interval: Interval, start: Array, end: Array) -> bool:
    first, last = ends(interval)
    apart = max(np.max(np.abs(first - start)), np.max(np.abs(last - end)))
    return bool(apart <= AT_REST_TOLERANCE)
