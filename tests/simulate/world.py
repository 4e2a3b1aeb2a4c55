"""A simulated cell and the person at it, over all process lives of one campaign."""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Final
from unittest.mock import patch

import numpy as np

from drivers import State
from drivers.errors import NotAtStandstill
from drivers.events import MotionEnded
from hil.campaign import Campaign, Link, link, steering
from hil.campaign.operator import Stop
from hil.campaign.run import RunResult
from hil.simulation import simulated_controller
from sim_fixtures import ControllerSettings
from tests.hil.fast_cell import pass_rehearsal
from tests.simulate.disk import Disk, Killed, planted
from tests.simulate.lurching import lurching
from tests.simulate.observed import ArmHistory, Digests, Life
from tests.simulate.person import Person
from tests.simulate.scenes import Scene
from tests.simulate.script import Script
from tests.simulate.watched import (
    Clock,
    SessionLog,
    StampedWatchedTransport,
    WatchedController,
    WatchedTransport,
)

MOST_LIVES: Final = 32
MOST_CYCLES: Final = 500_000
"""Of one life; all lives together take 66 415 in the longest of some 7000 seeds."""
_SECOND_CHANCES: Final = 5
"""Runs that may still fail once the script speaks of no later cycle, beside the disk's failures."""
_JUST_BEFORE: Final = 10  # Cycles before a motion was refused in which the arm is looked at
_AFTERWARDS: Final = 400  # Cycles that the controller goes on alone after a run, at most
_HURRIES: Final = 500
"""Cycles after the last one of the script in which runs are still begun again at once."""
_GIVES_UP: Final = 3000  # Cycles without an init packet after which the person ends a run
_JOG: Final = "jog the arm"  # What a run says that cannot find a free way from where the arm stands


class EndlessError(Exception):
    """A run goes on and on in virtual time."""


def unrest(scene: Scene, history: ArmHistory) -> float:
    """The largest speed with closed or opening axes, in units of what the guard calls standstill.

    Beyond one it is a matter of chance whether a motion may begin, with faults or without.
    """
    still = np.isin(history.phase, ("CLOSED", "OPENING"))
    revolutions = np.abs(scene.cell.drive_train.gear_ratio) * scene.cell.period / (2.0 * np.pi)
    speed = np.abs(history.velocity[still]) * revolutions
    return float(speed.max(initial=0.0) / scene.cell.guard_limits.standstill)


class World:
    """Controller, disk, clock and person of one campaign, over all its lives."""

    def __init__(
        self,
        scene: Scene,
        settings: ControllerSettings,
        script: Script,
        chance: random.Random,
        folder: Path,
    ) -> None:
        self.folder = folder
        self.settings, self.script = settings, script
        self._scene, self._chance = scene, chance
        self._kind = chance.choice((WatchedTransport, StampedWatchedTransport))
        self.controller = WatchedController(
            simulated_controller(scene.cell, settings=settings), script
        )
        self.disk = Disk(script)
        self._clock = Clock(script)
        self._person = Person(script, lambda: self.controller.cycle)
        self._due = sorted(
            (one for one in script.of("cycle") if one.kind in _BY_CYCLE), key=lambda one: one.at
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
        """Runs until the campaign is complete, or nothing more is to be hoped for."""
        lives: list[Life] = []
        patience = _SECOND_CHANCES + self.disk.most
        while True:
            lives.append(self.live())
            result = lives[-1].result
            if result is not None and result.complete:
                break
            patience -= self.controller.cycle > self._last and not self._trembled(lives[-1])
            if len(lives) == MOST_LIVES or patience <= 0:
                break
            self._between(jog=_JOG in str(lives[-1].error))
        return lives

    def _trembled(self, life: Life) -> bool:
        """Whether a motion could not begin because the arm did move where it has to stand."""
        if NotAtStandstill.check not in str(life.error):
            return False
        index = next(k for k, event in reversed(life.events) if isinstance(event, MotionEnded))
        at = life.exchanged[index].cycle
        history = self.controller.history()
        last = slice(at - _JUST_BEFORE, at + 1)
        moved = replace(history, phase=history.phase[last], velocity=history.velocity[last])
        return unrest(self._scene, moved) > 1.0

    def live(self) -> Life:
        """One process: opens the campaign and runs it."""
        self._stop = Stop()
        self.disk.begin()
        first, before, names = self.controller.cycle, self._digests, _names(self.folder)
        transport = self._kind(self.controller, self.script, self._clock, self._look)
        connection = Link.over(
            transport, self._scene.cell, finish=self.controller.controller.finish
        )
        log = SessionLog(connection, transport)
        self._begun, self._session = first, connection.session
        result, error = self._run(connection)
        self._digests = after = _digests(self.folder)
        self._struck += transport.struck
        return Life(
            exchanged=log.exchanged,
            records=log.records,
            acts=tuple(log.acts),
            events=tuple(log.events),
            counters=connection.session.counters,
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

    def _run(self, connection: Link) -> tuple[RunResult | None, BaseException | None]:
        lurches = lurching(self.script, lambda: self.controller.cycle, self._struck)
        with planted(self.disk), _no_waiting(), lurches:
            try:
                result = Campaign.open(self.folder).run(
                    connection,
                    self._stop,
                    operator=self._person,
                    durable=False,
                    unrehearsed=self._unrehearsed,
                )
            except (Exception, Killed, KeyboardInterrupt) as error:
                return None, error
        return result, None

    def _look(self, cycle: int) -> None:
        """What is due in this cycle happens to the process."""
        if cycle - self._begun > MOST_CYCLES:
            raise EndlessError
        if cycle - self._begun > _GIVES_UP and self._session.state is State.SYNC:
            self._stop.requested = True  # nobody waits a minute for a controller in mid-session
        while self._due and self._due[0].at <= cycle:
            mishap = self._due.pop(0)
            self._struck.append(mishap.line)
            if mishap.kind == "stop":
                self._stop.requested = True
            elif mishap.kind == "interrupt":
                raise KeyboardInterrupt
            else:
                if mishap.kind == "power-cut":
                    self.disk.cut_power(mishap.value, mishap.count)
                self.disk.dead = True
                raise Killed(mishap.line)

    def _between(self, *, jog: bool) -> None:
        """The controller goes on alone, and somebody sees to it before the next run.

        Args:
            jog: bring the arm home, as was asked for.
        """
        hurry = self.script.has("hurry") and self.controller.cycle <= self._last + _HURRIES
        hurried = hurry and not jog and not self.controller.ended
        if not hurried:
            self.controller.alone(_AFTERWARDS)
        else:
            self._struck += [one.line for one in self.script.of("always") if one.kind == "hurry"]
        if jog:
            home = self._scene.cell.home
            self.controller.controller.plant.set_state(home, np.zeros(len(home)))
        self.controller.press(restart=not hurried, warm=self._chance.random() < 0.5)

    def history(self) -> ArmHistory:
        """The controller's side, when it has ended or gone on for a while."""
        if not self.controller.ended:
            self.controller.alone(_AFTERWARDS)
        return self.controller.history()

    def struck(self) -> tuple[str, ...]:
        """Lines that came to pass, those on the link by the cycles that passed."""
        found = [*self._struck, *self.controller.struck, *self.disk.struck]
        found += [*self._clock.struck, *self._person.struck]
        found += [one.line for one in self.script.of("always") if one.kind == "with-dry-run"]
        on_link = [line for line, fault in self.script.faults if line not in found]
        for line, fault in self.script.faults:
            if line in on_link and fault.cycle < self.controller.cycle and _of_link(fault):
                found.append(line)
        return tuple(dict.fromkeys(found))


_BY_CYCLE: Final = frozenset({"kill", "interrupt", "power-cut", "stop"})


def _of_link(fault: object) -> bool:
    return type(fault).__module__.startswith("drivers.")


def _when(script: Script) -> int:
    """The last cycle that a script speaks of."""
    cycles = [fault.cycle + getattr(fault, "count", 1) for _, fault in script.faults]
    cycles += [one.at for one in script.of("cycle")]
    return max(cycles, default=0)


@contextmanager
def _no_waiting() -> Iterator[None]:
    """A person who holds the arm is asked again at once."""
    fake = SimpleNamespace(sleep=lambda seconds: None, monotonic=time.monotonic)
    with ExitStack() as undo:
        for module in (link, steering):
            undo.enter_context(patch.object(module, "time", fake))
        yield


def _names(folder: Path) -> set[str]:
    return {path.name for path in (folder / "archives").glob("*.mcap")}


def _digests(folder: Path) -> Digests:
    files = [*(folder / "archives").glob("*.mcap"), folder / "manifest.json"]
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.exists()
    }
