"""Campaigns to compare, from their archives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hil.batch import run
from hil.batch.factors import cell_in, opened
from hil.batch.types import ArchiveRef, Arm, Broken, LevelEstimate
from hil.batch.workers import Workers
from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import Options
from hil.progress import Reporter

_TWO: Final = "name two campaigns or more of one arm"


@dataclass(frozen=True, eq=False)
class Gathered:
    """Campaigns of one arm.

    Attributes:
        arm: whose they are.
        campaigns: in order of time; in the order given where not all have one.
        repetitions: of each campaign, in order.
        dated: whether the order is that of time.
        broken: what could not be used.
        simulated: whether no robot moved.
    """

    arm: Arm
    campaigns: tuple[LevelEstimate, ...]
    repetitions: tuple[tuple[LevelEstimate, ...], ...]
    dated: bool
    broken: tuple[Broken, ...]
    simulated: bool = False


def gather(
    places: Sequence[str], workers: Workers, reporter: Reporter, plan: run.Plan | None = None
) -> Gathered:
    """Identify the campaigns below some places, and check that they can be compared.

    Args:
        places: campaign folders, or folders with campaigns below; the `results.json` of a campaign
            stands for its folder.
        workers: read the archives.
        reporter: of progress.
        plan: how to identify; by default with least squares, which draw no change towards
            anything.

    Raises:
        InputError: there is one campaign only, or campaigns are of different arms.
    """
    roots = [_folder(place) for place in places]
    refs: list[ArchiveRef] = []

    def check(found: Sequence[ArchiveRef]) -> None:
        _require_campaigns_of_one_arm(found)
        refs.extend(found)

    result = run.reidentify(
        roots,
        plan or run.Plan(Options(estimator="wls")),
        workers,
        reporter,
        check=check,
    )
    campaigns = list(result.campaigns)
    if len(campaigns) < 2:
        why = "".join(f"; {one.path}: {one.reason}" for one in result.broken[:1])
        only = campaigns[0].campaign if campaigns else None
        raise InputError(only, f"is the only campaign that can be estimated{why}", remedy=_TWO)
    dated = all(one.when for one in campaigns)
    campaigns.sort(key=_in_order(roots))
    if dated:
        campaigns.sort(key=lambda one: one.when)
    return Gathered(
        arm=result.arms[campaigns[0].arm],
        campaigns=tuple(campaigns),
        repetitions=tuple(
            tuple(
                rep
                for rep in result.repetitions
                if (rep.campaign, rep.setup) == (one.campaign, one.setup)
            )
            for one in campaigns
        ),
        dated=dated,
        broken=result.broken,
        simulated=refs[0].simulated,  # as all of one arm
    )


def _folder(place: str) -> str:
    if "://" in place or Path(place).name != "results.json":
        return place
    return str(Path(place).parent)


def _in_order(roots: Sequence[str]) -> Callable[[LevelEstimate], tuple[int, str]]:
    """Sorts campaigns as their places were named."""
    absolute = [root if "://" in root else Path(root).resolve().as_posix() for root in roots]

    def key(one: LevelEstimate) -> tuple[int, str]:
        own = one.campaign if "://" in one.campaign else Path(one.campaign).resolve().as_posix()
        found = [k for k, root in enumerate(absolute) if f"{own}/".startswith(f"{root}/")]
        return (found[0] if found else len(absolute), own)

    return key


def _require_campaigns_of_one_arm(found: Sequence[ArchiveRef]) -> None:
    """Friction and mass of another arm are another arm's, and one campaign has nothing beside it.

    Raises:
        InputError: names two campaigns and what their arms differ in, or the only one.
    """
    of = {ref.key: ref for ref in found if ref.use == "excitation"}
    if not of:
        return  # and that is refused
    first = next(iter(of.values()))
    for one in of.values():
        if one.arm != first.arm:
            here, there = (Arm(ref.arm, _cell(ref)) for ref in (one, first))
            raise InputError(
                one.campaign,
                f"is of another arm ({here.name}) than {first.campaign} ({there.name}): "
                f"{apart(here.cell, there.cell)}",
                remedy="compare campaigns of one arm",
            )
    if len(of) < 2:
        raise InputError(first.campaign, "is the only campaign that was named", remedy=_TWO)


def _cell(ref: ArchiveRef) -> Cell:
    with opened(ref) as archive:
        return cell_in(archive)


def apart(one: Cell, other: Cell) -> str:
    """What two arms differ in, in words."""
    here, there = one.file, other.file
    robots = (table.robot.model_dump(exclude={"payload"}) for table in (here, there))
    differ = [
        words
        for words, apart in (
            ("robot.urdf", one.urdf != other.urdf),
            ("[robot]", next(robots) != next(robots)),
            ("[drive_train]", here.drive_train != there.drive_train),
        )
        if apart
    ]
    if not differ:
        return "one of them is a simulation, or their controllers state other drives"
    return f"they differ in {' and '.join(differ)}"
