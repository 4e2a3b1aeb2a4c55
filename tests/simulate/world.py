"""Simulated cell, disk and operator, over all process lives of one campaign."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import random
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from drivers import State
from drivers.errors import Check
from drivers.events import MotionEnded
from hil.archive import writer
from hil.base.errors import HilError
from hil.base.files import write_atomically
from hil.base.progress import Silent
from hil.campaign import Campaign, VirtualLink
from hil.campaign import folder as campaign_folder
from hil.campaign.campaign_run import RunResult
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.folder import CampaignFolder
from hil.campaign.operator import RunStatus
from hil.control import link, operator_control
from hil.control.errors import MotionFailedError, MotionRefusedError
from hil.control.motion_watch import OperatorRequest, Stop
from hil.control.simulated_cell import simulated_controller
from hil.pipeline.options import FIXED
from hil.pipeline.prepared import prepare_sources
from hil.pipeline.sources import gather_sources
from identification import IdentificationError
from identification.estimators.least_squares import estimate_repetitions
from planner import TrajectoryPlayer
from planner.arrays import Array
from sim_fixtures import ControllerSettings
from sim_fixtures.settings import WHILE_SILENT
from tests.faults import Script, ScriptedEvent, parse_script
from tests.hil.fast_cell import pass_rehearsal
from tests.simulate.draws import Story, draw_script
from tests.simulate.observed import ArmHistory, Digests, Estimated, Life, Observed
from tests.simulate.scenes import NEIGHBOURS, Scene, scene_of
from tests.simulate.watched import (
    Clock,
    SessionLog,
    StampedWatchedTransport,
    WatchedController,
    WatchedTransport,
)


class Killed(BaseException):
    """The process was killed; writes after this are ignored."""


class Disk:
    """Replaces `os` in the archive writer and `write_atomically` of manifests, with disk faults."""

    def __init__(self, script: Script) -> None:
        self._events_at = {
            what: {
                at: event
                for event in script.of(what)
                for at in range(event.at, event.at + event.count)
            }
            for what in ("write", "save", "create")
        }
        self._count = dict.fromkeys(self._events_at, 0)
        self._paths: dict[int, Path] = {}
        self._last: list[Path] = []
        self.struck: list[str] = []
        self.failures: list[str] = []  # kinds since the last `begin`
        self.torn: dict[str, int] = {}  # bytes removed from archives
        self.refused: set[str] = set()  # archives with a failed write
        self.dead = False  # whether the process was killed

    @property
    def most(self) -> int:
        """Number of scripted disk faults."""
        return sum(len(events) for events in self._events_at.values())

    @property
    def done(self) -> dict[str, int]:
        """Number of writes, saves and creates."""
        return {f"{what}s": count for what, count in self._count.items()}

    def begin(self) -> None:
        self.dead = False
        self.failures = []
        self.torn = {}
        self.refused = set()
        self._paths.clear()
        self._last.clear()

    def cut_power(self, keep: float, files: int) -> None:
        """Kill the process and truncate the newest archives."""
        self.dead = True
        for path in self._last[-files:]:
            size = path.stat().st_size
            os.truncate(path, left := round(keep * size))
            self.torn[path.name] = size - left

    def _due(self, what: str) -> ScriptedEvent | None:
        self._count[what] += 1
        event = self._events_at[what].get(self._count[what])
        if event is not None:
            self.struck.append(event.line)
            self.failures.append(event.kind)
        return event

    def open(self, path: Any, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_CREAT and self._due("create") is not None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        descriptor = os.open(path, flags, mode)
        if flags & os.O_CREAT:
            self._paths[descriptor] = Path(path)
            self._last.append(Path(path))
        return descriptor

    def write(self, descriptor: int, data: Any) -> int:
        """Replace `os.write`."""
        if self.dead:
            return len(data)
        event = self._due("write")
        if event is None:
            return os.write(descriptor, data)
        if event.kind == "short-write":
            return os.write(descriptor, data[: max(1, round(event.value * len(data)))])
        part = data[: min(len(data) - 1, round(event.value * len(data)))]
        written = os.write(descriptor, part) if len(part) else 0
        if event.kind == "kill-at-write":
            self.dead = True
            self.torn[self._paths[descriptor].name] = len(data) - written
            raise Killed(event.line)
        self.refused.add(self._paths[descriptor].name)
        number = errno.EIO if event.kind == "disk-error" else errno.ENOSPC
        raise OSError(number, os.strerror(number))

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def save(self, path: Path, content: str | bytes) -> None:
        """Replace `write_atomically`."""
        if self.dead:
            return
        event = self._due("save")
        if event is None:
            write_atomically(path, content)
            return
        if event.kind == "save-full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if event.word == "after":
            write_atomically(path, content)
        elif event.word == "left":
            half = content[: len(content) // 2]
            left = path.with_suffix(path.suffix + ".tmp")
            left.write_bytes(half.encode() if isinstance(half, str) else half)
        self.dead = True
        raise Killed(event.line)


@contextmanager
def installed(disk: Disk) -> Iterator[None]:
    """Write archives and manifests through `disk`."""
    with (
        patch.object(writer, "os", disk),
        patch.object(campaign_folder, "write_atomically", disk.save),
    ):
        yield


class ScriptedOperator:
    """An `Operator` with scripted requests by cycle of the controller."""

    can_answer = True

    def __init__(self, script: Script, cycle: Callable[[], int]) -> None:
        acts = sorted(script.of("cycle"), key=lambda event: event.at)
        self._overrides = [event for event in acts if event.kind == "override"]
        self._holds = [event for event in acts if event.kind == "hold"]
        self._asked = 0
        declines = [event for event in script.of("always") if event.kind == "declines"]
        self._declines = [event.line for event in declines for _ in range(event.count)]
        self._cycle = cycle
        self._speed = 1.0
        self.struck: list[str] = []

    def show(self, status: RunStatus) -> None:
        del status

    def request(self) -> OperatorRequest:
        """See `Operator`; a hold ends after `count` calls."""
        cycle = self._cycle()
        while self._overrides and self._overrides[0].at <= cycle:
            act = self._overrides.pop(0)
            self._speed = min(1.0, act.value / 100.0)
            self.struck.append(act.line)
        held = False
        if self._holds and self._holds[0].at <= cycle:
            if self._asked == 0:
                self.struck.append(self._holds[0].line)
            held = self._asked < self._holds[0].count
            self._asked = self._asked + 1
            if not held:
                self._holds.pop(0)
                self._asked = 0
        return OperatorRequest(self._speed, held)

    def accept_dry_run(self, record: DryRunRecord) -> bool:
        del record
        if self._declines:
            self.struck.append(self._declines.pop())
            return False
        return True


@contextmanager
def lurching(script: Script, cycle: Callable[[], int], struck: list[str]) -> Iterator[None]:
    """Shift set-points as scripted; add the lines that occurred to `struck`."""
    due = [
        event for event in script.of("cycle") if event.kind == "lurch" and event.line not in struck
    ]
    if not due:
        yield
        return
    due.sort(key=lambda event: event.at)
    left = due[0].count
    advance = TrajectoryPlayer.advance

    def advanced(player: TrajectoryPlayer) -> tuple[Array, Array]:
        nonlocal left
        position, velocity = advance(player)
        if not due or cycle() < due[0].at:
            return position, velocity
        if due[0].line not in struck:
            struck.append(due[0].line)
        position = position.copy()
        position[0] += math.nan if due[0].word == "nan" else due[0].value
        left -= 1
        if not left:
            due.pop(0)
            left = due[0].count if due else 0
        return position, velocity

    with patch.object(TrajectoryPlayer, "advance", advanced):
        yield


MOST_LIVES: Final = 32
MOST_CYCLES: Final = 500_000
"""Limit for one life; in 7000 seeds all lives of a campaign together take 66 415 at most."""
_RETRIES: Final = 5
"""Runs that may fail after the last scripted cycle, in addition to the number of disk faults."""
_JUST_BEFORE: Final = 10  # cycles before a refused motion in which the speed is checked
_AFTERWARDS: Final = 400  # cycles of the controller without a PC after a run, at most
_HURRIES: Final = 500
"""Cycles after the last scripted one in which runs are repeated at once."""
_GIVES_UP: Final = 3000  # cycles without an init packet after which the operator ends a run
_LONGEST_WAIT: Final = 100_000  # cycles with the drive off, where the PC's clock was set back
_JOG: Final = "jog the arm"  # remedy in the error of a run without a free path


class EndlessError(Exception):
    """A run does not end in virtual time."""


def standstill_ratio(scene: Scene, history: ArmHistory) -> float:
    """Return the largest speed with closed or opening axes relative to the guard's standstill.

    Above one, whether a motion may start depends on chance.
    """
    still = np.isin(history.phase, ("CLOSED", "OPENING"))
    revolutions = np.abs(scene.cell.drive_train.gear_ratio) * scene.cell.period / (2.0 * np.pi)
    speed = np.abs(history.velocity[still]) * revolutions
    return float(speed.max(initial=0.0) / scene.cell.guard_limits.standstill)


class World:
    """Controller, disk, clock and operator of one campaign, over all its lives."""

    def __init__(
        self,
        scene: Scene,
        settings: ControllerSettings,
        script: Script,
        chance: random.Random,
        folder: Path,
    ) -> None:
        self.folder = folder
        self.settings = settings
        self.script = script
        self._scene = scene
        self._chance = chance
        self._kind = chance.choice((WatchedTransport, StampedWatchedTransport))
        self.controller = WatchedController(
            simulated_controller(scene.cell, settings=settings), script
        )
        self.disk = Disk(script)
        self._clock = Clock(script)
        self._operator = ScriptedOperator(script, lambda: self.controller.cycle)
        self._due = sorted(
            (event for event in script.of("cycle") if event.kind in _BY_CYCLE),
            key=lambda event: event.at,
        )
        self._stop = Stop()
        self._last = _when(script)
        self._struck: list[str] = []
        campaign = Campaign.create(folder, scene.cell, scene.plan)
        self._unrehearsed = not script.has("with-dry-run")
        if not self._unrehearsed:
            pass_rehearsal(campaign.folder)
        self._digests = _digests(folder)

    def all_lives(self) -> list[Life]:
        """Run until the campaign is complete or the number of retries is exhausted."""
        lives: list[Life] = []
        retries = _RETRIES + self.disk.most
        while True:
            lives.append(self.live())
            result = lives[-1].result
            if result is not None and result.complete:
                break
            retries -= self.controller.cycle > self._last and not self._trembled(lives[-1])
            if len(lives) == MOST_LIVES or retries <= 0:
                break
            self._between(jog=_JOG in str(lives[-1].error))
        return lives

    def _trembled(self, life: Life) -> bool:
        """Whether a motion was refused because the arm moved at standstill."""
        if Check.STANDSTILL.quantity not in str(life.error):
            return False
        index = next(k for k, event in reversed(life.events) if isinstance(event, MotionEnded))
        at = life.exchanged[index].cycle
        history = self.controller.history()
        last = slice(at - _JUST_BEFORE, at + 1)
        moved = replace(history, phase=history.phase[last], velocity=history.velocity[last])
        return standstill_ratio(self._scene, moved) > 1.0

    def live(self) -> Life:
        """Run one process, which opens the campaign and runs it."""
        self._stop = Stop()
        self.disk.begin()
        first = self.controller.cycle
        before = self._digests
        names = _names(self.folder)
        transport = self._kind(self.controller, self.script, self._clock, self._on_cycle)
        connection = VirtualLink.over(
            transport, self._scene.cell, finish=self.controller.controller.finish
        )
        log = SessionLog(connection, transport)
        self._begun = first
        self._session = connection.port.session
        result, error = self._run(connection)
        self._digests = after = _digests(self.folder)
        self._struck += transport.struck
        return Life(
            exchanged=log.exchanged,
            records=log.records,
            acts=tuple(log.acts),
            events=tuple(log.events),
            counters=connection.port.session.counters,
            settings=self._scene.cell.session_settings(),
            first_cycle=first,
            last_cycle=self.controller.cycle,
            result=result,
            error=error,
            died=isinstance(error, Killed),
            archives=tuple(sorted(_names(self.folder) - names)),
            torn=dict(self.disk.torn),
            refused=frozenset(self.disk.refused),
            disk=tuple(self.disk.failures),
            before=before,
            after=after,
        )

    def _run(self, connection: VirtualLink) -> tuple[RunResult | None, BaseException | None]:
        lurches = lurching(self.script, lambda: self.controller.cycle, self._struck)
        with installed(self.disk), _no_waiting(), lurches:
            try:
                result = Campaign.open(self.folder).run(
                    connection,
                    self._stop,
                    operator=self._operator,
                    durable=False,
                    unrehearsed=self._unrehearsed,
                )
            except (Exception, Killed, KeyboardInterrupt) as error:
                return None, error
        return result, None

    def _on_cycle(self, cycle: int) -> None:
        """Execute the events of the process that are due in this cycle."""
        if cycle - self._begun > MOST_CYCLES:
            raise EndlessError
        if cycle - self._begun > _GIVES_UP and self._session.state is State.SYNC:
            self._stop.requested = True  # the controller is within a session
        if cycle - self._begun > _LONGEST_WAIT and self._session.state is State.DRIVE_OFF:
            self._stop.requested = True
        while self._due and self._due[0].at <= cycle:
            event = self._due.pop(0)
            self._struck.append(event.line)
            if event.kind == "stop":
                self._stop.requested = True
            elif event.kind == "interrupt":
                raise KeyboardInterrupt
            else:
                if event.kind == "power-cut":
                    self.disk.cut_power(event.value, event.count)
                self.disk.dead = True
                raise Killed(event.line)

    def _between(self, *, jog: bool) -> None:
        """Run the controller without a PC, restart it, and jog the arm home if requested."""
        hurry = self.script.has("hurry") and self.controller.cycle <= self._last + _HURRIES
        hurried = hurry and not jog and not self.controller.ended
        if not hurried:
            self.controller.alone(_AFTERWARDS)
        else:
            self._struck += [
                event.line for event in self.script.of("always") if event.kind == "hurry"
            ]
        if jog:
            home = self._scene.cell.home
            self.controller.controller.plant.set_state(home, np.zeros(len(home)))
        self.controller.press(restart=not hurried, warm=self._chance.random() < 0.5)

    def history(self) -> ArmHistory:
        """Return the history of the controller, some cycles after the last run."""
        if not self.controller.ended:
            self.controller.alone(_AFTERWARDS)
        return self.controller.history()

    def struck(self) -> tuple[str, ...]:
        """Return the lines that occurred; those of the link by their cycles."""
        lines = [*self._struck, *self.controller.struck, *self.disk.struck]
        lines += [*self._clock.struck, *self._operator.struck]
        lines += [event.line for event in self.script.of("always") if event.kind == "with-dry-run"]
        past = [
            line_and_fault
            for line_and_fault in self.script.faults
            if line_and_fault[1].cycle < self.controller.cycle
        ]
        lines += [line for line, fault in past if line not in lines and _of_link(fault)]
        return tuple(dict.fromkeys(lines))


_BY_CYCLE: Final = frozenset({"kill", "interrupt", "power-cut", "stop"})


def _of_link(fault: object) -> bool:
    return type(fault).__module__.startswith("drivers.")


def _when(script: Script) -> int:
    """Return the last cycle in a script."""
    cycles = [fault.cycle + getattr(fault, "count", 1) for _, fault in script.faults]
    cycles += [event.at for event in script.of("cycle")]
    return max(cycles, default=0)


@contextmanager
def _no_waiting() -> Iterator[None]:
    """Do not sleep while the operator holds the arm."""
    fake = SimpleNamespace(sleep=lambda seconds: None, monotonic=time.monotonic)
    with patch.object(link, "time", fake), patch.object(operator_control, "time", fake):
        yield


def _names(folder: Path) -> set[str]:
    return {path.name for path in (folder / "archives").glob("*.mcap")}


def _digests(folder: Path) -> Digests:
    files = [*(folder / "archives").glob("*.mcap"), folder / "manifest.json"]
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.exists()
    }


_MOVING: Final = 0.05  # rad/s
_EMPTY: Final = parse_script(())


@dataclass(frozen=True, eq=False)
class Twin:
    """The run without faults of a group of seeds."""

    scene: Scene
    folder: Path
    found: Estimated
    story: Story
    seen: Observed
    redrawn: int = 0  # rejected scenes before this one


class SceneError(Exception):
    """The random arm or motion of a scene is unusable; another one is drawn."""


class UndisturbedError(Exception):
    """A campaign without faults failed for a reason that is not the scene: a finding."""


def twin_of(group: int, root: Path) -> Twin:
    """Return the campaign without faults of a group, in a folder below `root`.

    Raises:
        UndisturbedError: it failed.
        RuntimeError: no scene of the group is usable.
    """
    why = ""
    for attempt in range(8):
        scene = scene_of(group, attempt)
        folder = root / f"twin_{group}_{attempt}"
        try:
            return replace(_twin(scene, folder), redrawn=attempt)
        except SceneError as error:
            why = str(error)
    raise RuntimeError(f"no scene of group {group} is usable, the last: {why}")


def _check_usable(scene: Scene, life: Life) -> None:
    """Raise SceneError for an unusable arm or motion, UndisturbedError for another failure."""
    error = life.error
    result = life.result
    if isinstance(error, RepetitionsRejectedError):
        raise SceneError(f"{scene.words}: {error}")
    if isinstance(error, MotionFailedError) and Check.STANDSTILL.quantity in error.reason:
        raise SceneError(f"{scene.words}: {error}")
    if isinstance(error, MotionRefusedError) and re.search(
        r"current of motor .* jog the arm", str(error)
    ):
        raise SceneError(f"{scene.words}: {error}")  # where it stands, not by the scene's plan
    if result is None or not result.complete:
        how = f"{type(error).__name__}: {error}" if error is not None else "incomplete"
        raise UndisturbedError(f"{scene.words}: undisturbed, it ended {how}")
    if result.rejected:
        raise SceneError(f"{scene.words}: {result.rejected[0]} was rejected")


def _twin(scene: Scene, folder: Path) -> Twin:
    world = World(scene, scene.controller, _EMPTY, random.Random(0), folder)
    life = world.live()
    _check_usable(scene, life)
    estimate, why = estimated(folder)
    if estimate is None:
        if "record a longer or faster motion" in why:
            raise SceneError(f"{scene.words}: {why}")
        raise UndisturbedError(f"{scene.words}: complete, and not identified: {why}")
    if estimate.result.pooled.undetermined:
        raise SceneError(f"{scene.words}: its motion does not determine all parameters")
    history = world.history()
    if (ratio := standstill_ratio(scene, history)) > 1.0:
        raise SceneError(f"{scene.words}: at rest it moves at {ratio:.2g} times the standstill")
    moving = np.abs(history.velocity).max(axis=1) > _MOVING
    story = Story(
        cycles=world.controller.cycle,
        moving=tuple(np.flatnonzero(moving).tolist()),
        n_joints=history.position.shape[1],
        bytes=12 + 36 * (scene.arm.n_joints + scene.arm.foreign_axes),
        **world.disk.done,
    )
    seen = _observed(scene, world, [life], estimate, why)
    return Twin(scene, folder, estimate, story, replace(seen, seed=scene.group * NEIGHBOURS))


def play(seed: int, twin: Twin, root: Path, script: Script | None = None) -> Observed:
    """Simulate a seed in a folder below `root`, with its own script or another one."""
    chance = random.Random(f"seed {seed}")
    settings = replace(
        twin.scene.controller,
        while_silent=chance.choice(WHILE_SILENT),
        missed_replies=chance.choice((1, 3, 5, 9)),
    )
    drawn_lines = draw_script(chance, twin.story)  # drawn in any case: `chance` is used further
    script = parse_script(drawn_lines) if script is None else script
    world = World(twin.scene, settings, script, chance, root / f"seed_{seed}")
    lives = world.all_lives()
    estimate = None
    why = ""
    if lives[-1].result is not None and lives[-1].result.complete:
        estimate, why = estimated(world.folder)
    seen = _observed(twin.scene, world, lives, estimate, why)
    return replace(seen, seed=seed, twin_found=twin.found)


def _observed(
    scene: Scene, world: World, lives: Sequence[Life], estimate: Estimated | None, why: str
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
        found=estimate,
        twin_found=None,
        unidentified=why,
    )


def estimated(root: Path) -> tuple[Estimated | None, str]:
    """Return the estimate of `hil identify` with fixed settings, or None and the reason."""
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
