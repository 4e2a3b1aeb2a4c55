"""The dry run as a stage of a run: what of it is missing, and whether it is accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hil.cell import Cell
from hil.errors import OperatorStopError

from .dry_run import OVERRIDE, DryRun, made_by
from .execution_result import DryRunState
from .execution_runner import Runner
from .folder import CampaignFolder
from .gates import not_accepted
from .intervals import Interval
from .operator import Operator
from .quality_entry import Entering
from .stop import Stop


class DryRunStage:
    """Every motion that will be sent at full speed, once and slowly.

    Args:
        folder: of the campaign.
        cell: of the campaign.
        motions: excitations and validation motions; repetitions of one are looked at once.
        operator: may be asked.
        accept: whether the caller accepts without being asked.
        accept_torque: joints that the caller knows to run against the model's gravity.
        simulated: whether nothing but a simulated arm can move.
        plan_hash: of exactly the plan that is run.
        stop: asked for at the question, it is no answer.
    """

    def __init__(
        self,
        folder: CampaignFolder,
        cell: Cell,
        motions: Sequence[Interval],
        operator: Operator,
        *,
        accept: bool,
        accept_torque: Sequence[str],
        simulated: bool,
        plan_hash: str,
        stop: Stop,
    ) -> None:
        self._folder, self._cell, self._operator = folder, cell, operator
        self._accept, self._simulated = accept, simulated
        self._plan_hash, self._stop = plan_hash, stop
        self._motions = [one for one in motions if one.kind == "validation" or one.index == 0]
        # Nobody knows beforehand what will contradict: only what an earlier run saw is accepted.
        self._known = tuple(accept_torque)
        if accept_torque and self.found() is None:
            self._known = ()

    def found(self) -> DryRun | None:
        """The dry run of exactly this plan and kind of arm; None where none counts."""
        return DryRun.that_counts(
            self._folder,
            plan_hash=self._plan_hash,
            motions=len(self._motions),
            simulated=self._simulated,
        )

    @property
    def intervals(self) -> list[Interval]:
        """The motions under the names of their slow runs."""
        return [replace(one, kind="dryrun", index=k) for k, one in enumerate(self._motions)]

    def missing(self) -> list[tuple[Interval, Interval]]:
        """Each motion that was not run slowly yet, and the same as a dry run."""
        both = zip(self._motions, self.intervals, strict=True)
        return [(one, slow) for one, slow in both if self._whole(slow) is None]

    def run(self, runner: Runner, entering: Entering) -> None:
        """Run what is missing, slowly."""
        for _, slow in self.missing():
            name = runner.play(slow, slow.index + 1, len(self._motions), OVERRIDE)
            entering.enter(slow, name)

    def settle(self, *, ask: bool = True) -> DryRunState:
        """Write down what was done, once all of it is, and have it accepted.

        Args:
            ask: whether it must be accepted now.

        Raises:
            DryRunError: it must be and is not.
            OperatorStopError: a stop was asked for instead of an answer.
        """
        found = self.found()
        if found is None:
            names = [name for slow in self.intervals if (name := self._whole(slow)) is not None]
            if len(names) < len(self._motions):
                return "to be accepted"
            found = DryRun.of(
                self._folder,
                self._cell,
                names,
                plan_hash=self._plan_hash,
                simulated=self._simulated,
            )
            found.save(self._folder.dry_run)
        if found.accepted is None:
            summary = found.summary(self._folder.root.resolve().name)
            unknown = [joint for joint in found.against_gravity if joint not in self._known]
            agreed = self._accept and not unknown
            if not agreed and self._operator.can_answer:
                agreed = self._operator.accept_dry_run(summary)
                if not agreed and self._stop.requested:
                    raise OperatorStopError(
                        f"{self._folder.root}: stopped instead of an answer; its slow dry run was "
                        "done, and is not accepted."
                    )
            if not agreed and ask:
                raise not_accepted(self._folder, unknown)
            if not agreed:
                return "to be accepted"
            found.accepted_now().save(self._folder.dry_run)
        return "accepted"

    def _whole(self, slow: Interval) -> str | None:
        """Name of its whole archive, if this kind of arm made it."""
        name = self._folder.whole(slow.kind, slow.index)
        made = name is not None and made_by(self._folder.archives / name, self._simulated)
        return name if made else None
