"""Plays one seed: a campaign in virtual time, with everything that its script says."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import NotAtStandstill
from hil.campaign.errors import MotionFailedError, RepetitionsRejectedError
from hil.campaign.folder import CampaignFolder
from hil.errors import HilError
from hil.identify.options import FIXED
from hil.identify.prepared import prepare_sources
from hil.identify.sources import gather_sources
from hil.progress import Silent
from identification import IdentificationError
from identification.estimators.least_squares import estimate_repetitions
from sim_fixtures.settings import WHILE_SILENT
from tests.simulate.observed import Estimated, Life, Observed
from tests.simulate.scenes import NEIGHBOURS, Scene, scene_of
from tests.simulate.script import Script, Story, draw_script, parse_script
from tests.simulate.world import World, unrest

_MOVING: Final = 0.05  # rad/s
_EMPTY: Final = parse_script(())


@dataclass(frozen=True, eq=False)
class Twin:
    """The run without faults of a group of seeds."""

    scene: Scene  # cell, plan and controller
    folder: Path  # of its campaign
    found: Estimated  # its estimate
    story: Story  # what a script may refer to
    seen: Observed  # all that was seen of it
    redrawn: int = 0  # scenes before this one that were of no use


class SceneError(Exception):
    """A scene of no use, for a reason that scenes may have: another one is drawn."""


class UndisturbedError(Exception):
    """What no scene is a reason for: an undisturbed campaign that fails is a finding."""


def twin_of(group: int, root: Path) -> Twin:
    """The undisturbed campaign of a group, in a folder below `root`.

    Raises:
        UndisturbedError: it ends otherwise than any may.
        RuntimeError: no scene of the group is of use.
    """
    why = ""
    for attempt in range(8):
        scene = scene_of(group, attempt)
        folder = root / f"twin_{group}_{attempt}"
        try:
            return replace(_twin(scene, folder), redrawn=attempt)
        except SceneError as error:
            why = str(error)
    raise RuntimeError(f"no scene of group {group} is of use, the last: {why}")


def _require_use(scene: Scene, life: Life) -> None:
    """What may be wrong with arms and motions that are drawn."""
    error, result = life.error, life.result
    if isinstance(error, RepetitionsRejectedError):
        raise SceneError(f"{scene.words}: {error}")
    if isinstance(error, MotionFailedError) and NotAtStandstill.check in error.reason:
        raise SceneError(f"{scene.words}: {error}")
    if result is None or not result.complete:
        how = f"{type(error).__name__}: {error}" if error is not None else "incomplete"
        raise UndisturbedError(f"{scene.words}: undisturbed, it ended {how}")
    if result.rejected:
        raise SceneError(f"{scene.words}: {result.rejected[0]} was rejected")


def _twin(scene: Scene, folder: Path) -> Twin:
    world = World(scene, scene.controller, _EMPTY, random.Random(0), folder)
    life = world.live()
    _require_use(scene, life)
    found, why = estimated(folder)
    if found is None:
        raise UndisturbedError(f"{scene.words}: complete, and not identified: {why}")
    if found.result.pooled.undetermined:
        raise SceneError(f"{scene.words}: its motion does not determine all parameters")
    history = world.history()
    if (share := unrest(scene, history)) > 1.0:
        raise SceneError(f"{scene.words}: standing, it moves at {share:.2g} of what is at rest")
    moving = np.abs(history.velocity).max(axis=1) > _MOVING
    story = Story(
        cycles=world.controller.cycle,
        moving=tuple(np.flatnonzero(moving).tolist()),
        n_joints=history.position.shape[1],
        bytes=12 + 36 * (scene.arm.n_joints + scene.arm.foreign_axes),
        **world.disk.done,
    )
    seen = _observed(scene, world, [life], found, why)
    return Twin(scene, folder, found, story, replace(seen, seed=scene.group * NEIGHBOURS))


def play(seed: int, twin: Twin, root: Path, script: Script | None = None) -> Observed:
    """Play a seed in a folder below `root`, or another script in the place of the drawn one."""
    chance = random.Random(f"seed {seed}")
    settings = replace(
        twin.scene.controller,
        while_silent=chance.choice(WHILE_SILENT),
        missed_replies=chance.choice((1, 3, 5, 9)),
    )
    drawn = draw_script(chance, twin.story)
    script = parse_script(drawn) if script is None else script
    world = World(twin.scene, settings, script, chance, root / f"seed_{seed}")
    lives = world.all_lives()
    found, why = None, ""
    if lives[-1].result is not None and lives[-1].result.complete:
        found, why = estimated(world.folder)
    seen = _observed(twin.scene, world, lives, found, why)
    return replace(seen, seed=seed, twin_found=twin.found)


def _observed(
    scene: Scene, world: World, lives: Sequence[Life], found: Estimated | None, why: str
) -> Observed:
    return Observed(
        seed=-1,
        cell=scene.cell,
        plan=scene.plan,
        controller=world.settings,
        schedule=world.script.lines,
        struck=world.struck(),
        runs=tuple(lives),
        arm=world.history(),
        folder=world.folder,
        found=found,
        twin_found=None,
        unidentified=why,
    )


def estimated(root: Path) -> tuple[Estimated | None, str]:
    """The estimate from a folder as `hil identify` makes it with fixed settings, or why not."""
    folder = CampaignFolder(root)
    kinds = ("excitation", "validation", "standstill")
    paths = [path for kind in kinds for path in folder.completed(kind)]
    try:
        sources = gather_sources(paths, FIXED.split, ())
        prepared = prepare_sources(sources, FIXED, Silent())
        result = estimate_repetitions(sources.cell.model, prepared.fitted)
    except (HilError, IdentificationError) as error:
        return None, f"{type(error).__name__}: {error}"
    pooled = tuple(path.name for path in paths)
    return Estimated(result, pooled, sources.cell.model, tuple(prepared.fitted)), ""


__all__ = ["NEIGHBOURS", "Twin", "estimated", "play", "twin_of"]
