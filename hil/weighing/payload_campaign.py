"""A payload weighed by a campaign: one motion bare, loaded, loaded, bare, behind all gates.

In this order a steady drift of friction has the same mean in both. Each side is a campaign; that of
the loaded arm has the payload, with assumed figures, as `[robot.payload]` in its cell, so that
checks, rehearsal and dry run include it. Torques are linear in the inertial parameters of a
payload: limits that hold without it and with it hold for every share of it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self

import numpy as np

from hil.base.errors import CampaignFolderError, InputError, OperatorStopError, UnsafeError
from hil.base.files import write_output
from hil.base.progress import Reporter
from hil.base.safe_input import path_exists
from hil.base.terminal_text import plural
from hil.campaign.campaign import Campaign, campaign_of_design
from hil.campaign.campaign_run import RunResult
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.folder import PAYLOAD_RESULT, PAYLOADS, SIDES, CampaignFolder
from hil.campaign.gates import require_rehearsed
from hil.campaign.plan import CampaignPlan
from hil.campaign.precision_record import PrecisionLook, PrecisionRecord, Reached
from hil.campaign.reached_precision import further_repetitions
from hil.campaign.record_messages import precision_line
from hil.cell import Cell
from hil.cell.cell import ASSUMED_PAYLOAD
from hil.cell.schema import CellFile
from hil.control.errors import MotionRefusedError
from hil.control.link import MotionLink
from hil.control.messages import refusal_words
from hil.control.motion_checks import MotionChecks
from hil.control.motion_watch import Stop
from hil.control.simulated_cell import simulated_link
from hil.payload.payload_found import PayloadFound
from hil.payload.payload_run import NoPayloadError, find_payload, flange_of
from hil.precision.requirements import Requirement
from identification import IdentificationError
from identification.estimators.payload_estimate import ball_radius
from identification.model.known_payload import Payload
from identification.model.pseudo_inertia import body

from .messages import weighed_as_json, weighed_lines
from .weighed import Weighed

DEFAULT_CENTRE: Final = (0.0, 0.0, 0.1)
"""Centre of mass of a payload in the frame of the flange [m] where it is not stated."""
MIN_PAIRS: Final = 2  # pairs: bare, loaded, loaded, bare
_NAME: Final = re.compile(r"[A-Za-z0-9][\w.-]{0,63}")

Execute = Callable[[Campaign, Mapping[str, Any]], RunResult]
"""Runs a side with further arguments of `Campaign.run`."""
Links = Callable[[Campaign, int], MotionLink | None]
"""Returns the link of a side in a session of the controller, None for the link of its cell."""


class MountingError(UnsafeError):
    """The payload must be mounted or removed, without an operator to confirm it."""


class PayloadMounting:
    """Whether the payload is mounted, as the operator confirms it.

    Args:
        campaign: the payload campaign.
        reporter: receives what a simulated arm does by itself.
        ask: shows the operator what to do and returns whether it is done; None where he cannot be
            asked.
        mounted: what he has confirmed already.
    """

    def __init__(
        self,
        campaign: PayloadCampaign,
        reporter: Reporter,
        *,
        ask: Callable[[str], bool] | None = None,
        mounted: bool | None = None,
    ) -> None:
        self._name = campaign.name
        self._command = campaign.bare.folder.run_command
        self._virtual = all(
            side.cell.controller.transport == "simulated"
            for side in (campaign.bare, campaign.loaded)
        )
        self._reporter = reporter
        self._ask = ask
        self._mounted = mounted

    def require(self, loaded: bool, option: str = "") -> None:
        """Return when the payload is mounted (`loaded`) or removed.

        `option` of the command continues the run.

        Raises:
            NotRehearsedError: a side has not passed its rehearsal.
            MountingError: it is not confirmed.
            OperatorStopError: the operator stopped instead.
        """
        if self._mounted is loaded:
            return
        demand = f"Remove {self._name}, if it is mounted,"
        if loaded:
            demand = f"Mount {self._name} on the flange"
        if self._virtual:
            self._reporter.say(f"simulated: {self._name} is {'mounted' if loaded else 'removed'}")
        elif self._ask is None:
            command = " ".join((self._command, self._confirmation(loaded), *option.split()))
            raise MountingError(
                f"{demand} and change nothing else; then confirm it with `{command}` (there is no "
                "terminal to ask)."
            )
        elif not self._ask(f"{demand} and change nothing else."):
            raise OperatorStopError(
                f"Stopped before {self._name} was {'mounted' if loaded else 'removed'}; resume "
                f"with `{self._command}`."
            )
        self._mounted = loaded

    def confirmed(self, side: Campaign, loaded: bool) -> Campaign:
        """Return a side whose messages name commands that confirm what `require` required."""
        if self._virtual or self._ask is not None:
            return side
        folder = replace(side.folder, confirmed=self._confirmation(loaded))
        return replace(side, folder=folder)

    @staticmethod
    def _confirmation(loaded: bool) -> str:
        return f"--mounted {'yes' if loaded else 'no'}"


@dataclass(frozen=True, eq=False)
class PayloadCampaign:
    """Two campaigns of one motion in the folder of a payload, without and with it.

    Attributes:
        root: the folder, `payload/NAME` of the campaign with the motion.
        name: of the payload.
        bare, loaded: its sides.
    """

    root: Path
    name: str
    bare: Campaign
    loaded: Campaign

    @classmethod
    def of(cls, campaign: Campaign, name: str, assumed: Payload | None) -> Self:
        """Return the payload campaign of a campaign's motion, begun or to be continued.

        `assumed` is the payload for checks and simulation; None: the payload of the folder.

        Raises:
            InputError: the name is no name of a folder, or nothing was assumed yet.
            MotionRefusedError: the motion breaks a limit with the payload; nothing was created.
            CampaignFolderError: a side has recordings of another cell, motion or payload.
            NotRehearsedError: a file of the campaign was edited.
        """
        campaign.folder.require_unchanged()
        if not _NAME.fullmatch(name):
            problem = f"{name!r} is not a valid name of a payload"
            remedy = "use letters, digits, dots, dashes and underscores"
            raise InputError(None, problem, field="--payload", remedy=remedy)
        root = campaign.folder.root / PAYLOADS / name
        plan = replace(campaign.plan, validation=())
        repetitions = max(MIN_PAIRS, campaign.cell.campaign.repetitions)
        cell = campaign.cell.with_campaign(repetitions=repetitions)
        places = [root / side for side in SIDES]
        if assumed is not None:
            carrying = loaded_cell(cell, name, assumed)
            _require_allowed(carrying, plan, name, assumed)
            return cls(root, name, _side(places[0], cell, plan), _side(places[1], carrying, plan))
        if not CampaignFolder(places[1]).sealed:
            raise InputError(
                root,
                "its motion was not checked with a payload yet",
                field="--payload-mass",
                remedy="state the largest mass that is expected, such as --payload-mass 5 (kg)",
            )
        bare = _side(places[0], cell, plan)
        loaded = Campaign.open(places[1])
        same_motion = loaded.plan.to_text() == bare.plan.to_text()
        if not same_motion or _bare_file(loaded.cell) != _bare_file(cell):
            problem = (
                "was begun with another cell" if same_motion else "was begun with another motion"
            )
            remedy = "state --payload-mass again, or use another name for the payload"
            raise CampaignFolderError(places[1], problem, remedy)
        return cls(root, name, bare, loaded)

    def rehearse(self, reporter: Reporter, stop: Stop) -> None:
        """Rehearse both sides, if they have not passed yet; see `Campaign.rehearse`."""
        for side in (self.bare, self.loaded):
            side.rehearse(reporter=reporter, stop=stop)

    def dry_run(
        self, execute: Execute, mounting: PayloadMounting, choices: Mapping[str, Any]
    ) -> RunResult:
        """Run the dry run of the side whose repetition is the next one that is missing."""
        missing = (
            loaded
            for pair in range(self.limit)
            for loaded in _order(pair)
            if self.side(loaded).folder.complete_archive("excitation", pair) is None
        )
        loaded = next(missing, False)
        mounting.require(loaded, "--dry-run")
        return execute(mounting.confirmed(self.side(loaded), loaded), choices)

    def run(
        self,
        execute: Execute,
        mounting: PayloadMounting,
        reporter: Reporter,
        *,
        requirements: Sequence[Requirement] = (),
        choices: Mapping[str, Any] = MappingProxyType({}),
        links: Links | None = None,
    ) -> Weighed:
        """Run the motions that are missing, and weigh the payload.

        Without a requirement the motion runs bare, loaded, loaded, bare. With one, further pairs
        are run until it is met, or more of them do not help.

        Args:
            execute: runs a side.
            mounting: of the payload; required before the first motion, and where it changes.
            reporter: receives the precision.
            requirements: one, on the mass, or none.
            choices: further arguments of `Campaign.run`, for both sides.
            links: of the sides; by default as in their cells.

        Raises:
            InputError: a requirement is not on the mass, or the recordings show no payload.
            MountingError: there is no confirmation that the payload is mounted or removed.
            OperatorStopError: the operator stopped instead of confirming it.
            HilError: of `Campaign.run`.
        """
        record = self._record(requirements)
        if not choices.get("unrehearsed", False):  # reported before anything is mounted
            for side in (self.bare, self.loaded):
                require_rehearsed(side.folder)
        result = None
        pairs = 0
        runs = count()

        def executed(side: Campaign, more: Mapping[str, Any]) -> RunResult:
            return execute(side, {**more, "say_unchecked": next(runs) == 0})

        while True:
            for loaded in _order(pairs):
                recordings = max(pairs + 1, MIN_PAIRS) if loaded else pairs + 1
                self._record_side(
                    loaded, recordings, executed, mounting, choices, links or _own_link
                )
            pairs += 1
            if record is not None and record.measured < pairs:
                result = self._weighed_so_far(pairs, reporter)
            if record is not None and result is not None and record.measured < pairs:
                record = record.with_look(_look(result, pairs, requirements[0]), self.limit)
                record.save(self._precision)
                reporter.say(precision_line(record))
            if pairs >= MIN_PAIRS and (
                record is None or (record.ended and record.measured == pairs)
            ):
                break
        result = result or self._weighed(pairs, reporter)
        sides = ((self.bare.folder.root,), (self.loaded.folder.root,))
        weighed = Weighed(replace(result, typed=sides), pairs, record)
        text = json.dumps(weighed_as_json(weighed), indent=1, ensure_ascii=False)
        write_output(self.root / PAYLOAD_RESULT, text + "\n")
        write_output(self.root / "payload.txt", "\n".join(weighed_lines(weighed)) + "\n")
        return weighed

    def _record_side(
        self,
        loaded: bool,
        recordings: int,
        execute: Execute,
        mounting: PayloadMounting,
        choices: Mapping[str, Any],
        links: Links,
    ) -> None:
        """Run a side up to a number of repetitions, if some are missing."""
        side = self.side(loaded)
        missing = [
            k for k in range(recordings) if side.folder.complete_archive("excitation", k) is None
        ]
        if not missing:
            return
        # Only a dry run that was seen can be accepted, and each side has its own.
        seen = side.cell.only_simulated or path_exists(side.folder.dry_run)
        mounting.require(loaded, "--accept-dry-run" if seen else "--dry-run")
        with self._rejection_explained(loaded):
            execute(
                mounting.confirmed(side, loaded),
                {
                    **choices,
                    "accept_dry_run": choices.get("accept_dry_run", False) and seen,
                    "repetitions": recordings,
                    "link": links(side, 2 * missing[0] + loaded),
                },
            )

    @contextmanager
    def _rejection_explained(self, loaded: bool) -> Iterator[None]:
        """Say of rejected loaded motions with which payload they were checked."""
        try:
            yield
        except RepetitionsRejectedError as error:
            if not loaded:
                raise
            raise RepetitionsRejectedError(
                error.motion,
                error.reasons,
                f"The motion was checked with {self.name} as --payload-mass and --payload-centre "
                "stated it: if it is heavier or further out, design another motion with them.",
            ) from error

    def side(self, loaded: bool) -> Campaign:
        """Return the campaign of the loaded or the bare arm."""
        return self.loaded if loaded else self.bare

    @property
    def limit(self) -> int:
        """Most pairs of recordings."""
        return self.bare.cell.campaign.repetitions

    @property
    def _precision(self) -> Path:
        return self.root / "precision.json"

    def _record(self, requirements: Sequence[Requirement]) -> PrecisionRecord | None:
        """Return the record of the precision, of an earlier run if it had this requirement."""
        if not requirements:
            return None
        if [requirement.kind for requirement in requirements] != ["mass"]:
            raise InputError(
                None,
                f"{', '.join(map(str, requirements))!r} is not about the payload alone",
                field="--precision",
                remedy='with --payload state "mass of payload 1 %", or run without --payload',
            )
        (requirement,) = requirements
        plan_hash = self.loaded.folder.plan_hash
        new = PrecisionRecord(plan_hash, (str(requirement),), unit="pair")
        record = PrecisionRecord.load(self._precision, plan_hash)
        return new if record is None or record.requirements != new.requirements else record

    def _weighed_so_far(self, pairs: int, reporter: Reporter) -> PayloadFound | None:
        """Weigh the payload as `_found`; None if too few pairs leave it undetermined."""
        try:
            return self._weighed(pairs, reporter)
        except (NoPayloadError, IdentificationError) as error:
            if pairs >= MIN_PAIRS:
                raise
            pair = plural(pairs, "pair")
            reporter.say(f"precision after {pair}: the mass is not determined yet: {error}")
            return None

    def _weighed(self, pairs: int, reporter: Reporter) -> PayloadFound:
        """Weigh the payload by the first pairs of recordings."""
        bare, loaded = (
            [*side.folder.completed("excitation")[:pairs], *side.folder.completed("standstill")]
            for side in (self.bare, self.loaded)
        )
        return find_payload(bare, loaded, reporter)


def assumed_payload(
    cell: Cell, mass: float, centre: tuple[float, float, float] = DEFAULT_CENTRE
) -> Payload:
    """Return a payload on the flange as it is assumed before it is weighed: a ball of water.

    Args:
        cell: of the arm.
        mass: [kg].
        centre: in the frame of the flange [m].

    Raises:
        ModelError: a figure is not finite, or the mass is negative.
    """
    moment = 0.4 * mass * ball_radius(mass) ** 2
    inertia = (moment, 0.0, 0.0, moment, 0.0, moment)
    return Payload(mass, centre, inertia, flange_of(cell.model))


def loaded_cell(cell: Cell, name: str, assumed: Payload) -> Cell:
    """Return the cell of an arm that carries another payload in addition.

    Raises:
        CellError: the cell has a payload on another joint than the last.
    """
    chain = cell.model.chain
    joint, inertial = assumed.carried_by(chain)
    tool = cell.model.payload
    if tool is not None:
        where, tool_body = tool.carried_by(chain)
        if where != joint:
            remedy = "describe it as a part of the URDF"
            raise cell.error(ASSUMED_PAYLOAD, None, "is not on the last joint", remedy)
        inertial = inertial + tool_body
    mass, centre, tensor = body(inertial)
    return cell.with_values(
        {
            f"{ASSUMED_PAYLOAD}.name": name,
            f"{ASSUMED_PAYLOAD}.mass": mass,
            f"{ASSUMED_PAYLOAD}.centre": centre.tolist(),
            f"{ASSUMED_PAYLOAD}.inertia": tensor[np.triu_indices(3)].tolist(),
            f"{ASSUMED_PAYLOAD}.frame": "",
            "cell.assumed": [*cell.file.cell.assumed, ASSUMED_PAYLOAD],
        }
    )


def _require_allowed(cell: Cell, plan: CampaignPlan, name: str, assumed: Payload) -> None:
    """Refuse a motion that breaks a limit with the payload (MotionRefusedError)."""
    checks = MotionChecks.of(cell)
    refusal = checks.refusal(plan.excitation.trajectory)
    if refusal is None:
        return
    centre = ", ".join(f"{part:g}" for part in assumed.centre)
    raise MotionRefusedError(
        f"the motion with {name} (assumed: {assumed.mass:g} kg at {centre} m in {assumed.frame})",
        refusal_words(refusal, checks.frame),
        f"design one with it (hil design --for payload {payload_options(assumed)})",
    )


def payload_options(assumed: Payload) -> str:
    """Return the options of a command that state a payload."""
    options = f"--payload-mass {assumed.mass:g}"
    if assumed.centre == DEFAULT_CENTRE:
        return options
    return f"{options} --payload-centre={','.join(f'{part:g}' for part in assumed.centre)}"


def _side(root: Path, cell: Cell, plan: CampaignPlan) -> Campaign:
    """Return a side, created if it has no recordings yet."""
    try:
        return campaign_of_design(root, cell, plan)
    except CampaignFolderError as error:
        if not CampaignFolder(root).manifest():
            raise
        problem = "has recordings of another motion, cell or assumed payload"
        remedy = "repeat the command that began it, or use another name for the payload"
        raise CampaignFolderError(root, problem, remedy) from error


def _own_link(side: Campaign, session: int) -> MotionLink | None:
    """Return None for the link of the cell; in virtual time each session has noise of its own."""
    if side.cell.controller.transport != "simulated":
        return None
    return simulated_link(side.cell, session=session)


def _order(pair: int) -> tuple[bool, bool]:
    """Return whether the first and second motion of a pair (from 0) are loaded."""
    return (False, True) if pair % 2 == 0 else (True, False)


def _bare_file(cell: Cell) -> CellFile:
    """Return a cell's file without its payload, assumed or stated."""
    robot = cell.file.robot.model_copy(update={"payload": None})
    assumed = [entry for entry in cell.file.cell.assumed if entry != ASSUMED_PAYLOAD]
    described = cell.file.cell.model_copy(update={"assumed": assumed})
    return cell.file.model_copy(update={"robot": robot, "cell": described})


def _look(result: PayloadFound, pairs: int, requirement: Requirement) -> PrecisionLook:
    """Return the precision of the mass after some pairs."""
    low, high = result.estimate.intervals[0].tolist()
    half = (high - low) / 2.0 / (result.body.mass if requirement.relative else 1.0)
    more = further_repetitions(pairs, half / requirement.value, 1.0 - result.estimate.scale_share)
    return PrecisionLook(pairs, (Reached(str(requirement), "mass", half, more),))
