"""Calls in the child processes of a study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from hil.base.errors import HilError
from hil.base.progress import Reporter
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive

T = TypeVar("T")


class StudyError(HilError):
    """A study was not completed; a restart resumes it."""


def in_children(
    function: Callable[..., T],
    calls: Sequence[tuple[Path, tuple[Any, ...]]],
    title: str,
    reporter: Reporter,
    cluster: Cluster,
) -> list[T]:
    """Call a function in child processes; results in order.

    Args:
        function: that is called.
        calls: place and arguments of each.
        title: of the progress.
        reporter: of it.
        cluster: of workers.

    Raises:
        StudyError: a call failed, crashed or timed out.
    """
    tasks = [ClusterTask(str(place), function, arguments) for place, arguments in calls]
    values: list[T] = []
    with reporter.task(title, len(tasks)) as task:
        results = cluster.results(tasks, task.advance)
    for result in results:
        if isinstance(result, SkippedArchive):
            raise StudyError(f"{result.path}: {result.reason}; start the study again to resume")
        values.append(result)
    return values
