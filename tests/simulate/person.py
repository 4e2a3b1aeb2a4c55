"""The person before a simulated campaign, who does what the script says."""

from __future__ import annotations

from collections.abc import Callable

from hil.campaign.dry_run import DryRun
from hil.campaign.operator import OperatorRequest, RunStatus
from tests.simulate.script import Script


class Person:
    """An `Operator`.

    Args:
        script: wishes by the controller's cycle.
        cycle: the present one.

    Attributes:
        struck: lines that came to pass.
    """

    can_answer = True

    def __init__(self, script: Script, cycle: Callable[[], int]) -> None:
        acts = sorted(script.of("cycle"), key=lambda one: one.at)
        self._overrides = [one for one in acts if one.kind == "override"]
        self._holds = [one for one in acts if one.kind == "hold"]
        self._asked = 0
        declines = [one for one in script.of("always") if one.kind == "declines"]
        self._declines = [one.line for one in declines for _ in range(one.count)]
        self._cycle = cycle
        self._speed = 1.0
        self.struck: list[str] = []

    def show(self, status: RunStatus) -> None:
        """See `Operator`."""
        del status

    def request(self) -> OperatorRequest:
        """See `Operator`; a hold ends when it was asked after often enough."""
        cycle = self._cycle()
        while self._overrides and self._overrides[0].at <= cycle:
            act = self._overrides.pop(0)
            self._speed = min(1.0, act.value / 100.0)
            self.struck.append(act.line)
        held = False
        if self._holds and self._holds[0].at <= cycle:
            if self._asked == 0:
                self.struck.append(self._holds[0].line)
            held, self._asked = self._asked < self._holds[0].count, self._asked + 1
            if not held:
                self._holds.pop(0)
                self._asked = 0
        return OperatorRequest(self._speed, held)

    def accept_dry_run(self, found: DryRun) -> bool:
        """See `Operator`."""
        del found
        if self._declines:
            self.struck.append(self._declines.pop())
            return False
        return True
