"""A run: what is still missing of a campaign, in order, behind the gates.

Everything that is sent has been checked before the first motion; each motion is archived, judged
and entered in the manifest before the next one begins, so that a run which is killed at any moment
goes on with the first motion that is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext

from hil.motion_checks import MotionChecks

from .controller_limits import checks_in_force, narrower_currents
from .dry_run import OVERRIDE, DryRunStage
from .gates import require_as_rehearsed, require_gates
from .intervals import Interval, require_joined, require_sound, with_moves
from .live_link import LiveLink
from .run import Run, RunResult
from .runner import Runner, StraightMoves, seen_in_dry_run
from .warmup import WarmUpStage


def execute(run: Run) -> RunResult:
    """See `Campaign.run`; a controller is connected only where something is missing."""
    with run.folder.locked():
        run.folder.require_unchanged()
        run.plan_hash = run.folder.hash_of(run.cell, run.plan)
        dry_run, warm_up = DryRunStage(run), WarmUpStage(run)
        require_gates(run, dry_run)
        adopt(run, dry_run, warm_up)
        slow = dry_run.missing()
        if not slow:
            dry_run.settle()
        full = [] if run.dry_run_only else run.missing()
        cycles = 0
        if slow or full:
            with connected(run, dry_run, warm_up, slow, full) as runner:
                dry_run.run(runner)
                if _moving(full):
                    warm_up.run(runner)
                if full:
                    repetitions(run, runner, warm_up)
                    validation(run, runner, warm_up)
                runner.go_back(OVERRIDE if run.dry_run_only else 1.0)
            cycles = runner.cycles
        return result_of(run, dry_run, warm_up, cycles)


def adopt(run: Run, dry_run: DryRunStage, warm_up: WarmUpStage) -> None:
    """Enter archives that an earlier run completed and was killed before it entered them."""
    next_motion = warm_up.next_motion()
    warming = [] if next_motion is None else [next_motion]
    run.entering.adopt([*run.wanted, *dry_run.intervals, *warming], run.made)


@contextmanager
def connected(
    run: Run,
    dry_run: DryRunStage,
    warm_up: WarmUpStage,
    slow: Sequence[Interval],
    full: Sequence[Interval],
) -> Iterator[Runner]:
    """The controller with its drive on, and all motions checked with its limits.

    Args:
        run: what is run.
        dry_run: says what was needed at low speed, and which ways somebody has watched.
        warm_up: may send the excitation as well.
        slow: motions of the dry run.
        full: motions at full speed.

    Raises:
        MotionRefusedError: a motion, or a way between two, must not be sent; nothing was.
        NotRehearsedError: the controller's figures are not those that were rehearsed.
        ControllerFault: it did not come up, or the connection did not end as it should.
    """
    from hil.cell_link import cell_link  # which opens links of campaigns

    cell, reporter = run.cell, run.reporter
    checks = MotionChecks.of(cell)
    if checks.not_checked is not None:
        reporter.say(checks.not_checked)
    next_motion = warm_up.next_motion() if full else None
    sent = [*slow, *full, *([] if next_motion is None else [next_motion])]
    # What is wrong with a motion itself is reported before anything is connected.
    require_sound(sent, checks)
    own = cell_link(cell, live=run.live) if run.link is None else nullcontext(run.link)
    with own as link:
        link.connection.say = reporter.say
        if isinstance(link, LiveLink):
            for note in link.notes():
                reporter.say(f"note: {note}")
            if link.live is not None:
                reporter.say(link.live.invitation)
        where = link.connect(run.stop)
        require_as_rehearsed(run, link.connection, dry_run.found())
        narrowed = checks_in_force(cell, link.connection, checks)
        if narrowed is not checks:  # the controller's own limits, for the first time known
            checks = narrowed
            require_sound(sent, checks)
        if below := narrower_currents(cell, link.connection):
            run.notes.append(f"the controller's own current limits counted ({'; '.join(below)})")
        # A dry run and a warm-up go the ways of the motions that they are made of.
        joined = with_moves(cell, [*slow, *full], where)
        require_sound([one for one in joined if one.kind == "move"], checks)
        require_joined(joined)
        seen = None if run.unrehearsed else seen_in_dry_run(run.folder)
        moves = StraightMoves(cell, checks, joined, seen)
        times = _times(joined, len(slow), moves, cell.campaign.approach_speed)
        times += warm_up.expected() if _moving(full) else []
        run.watch.time_left, run.watch.motions_left = sum(times), len(times)
        with reporter.task("running the campaign (s of motion)", sum(times)) as task:
            yield Runner(run, link, moves, where, task)
        link.close()


def repetitions(run: Run, runner: Runner, warm_up: WarmUpStage) -> None:
    """The arm at rest, then the excitation again and again while the joints are warm."""
    total = sum(one.kind == "excitation" for one in run.wanted)
    for interval in run.missing("standstill"):
        runner.play_until_good(interval, 1, 1)
    for _ in range(2):  # later repetitions may show that the first one was of no use
        for interval in run.missing("excitation"):
            runner.play_until_good(interval, interval.index + 1, total, warm_up)
            run.watch.note(f"{interval}: good, {run.entering.agreement()}")


def validation(run: Run, runner: Runner, warm_up: WarmUpStage) -> None:
    """The motions that are predicted and never fitted."""
    total = sum(one.kind == "validation" for one in run.wanted)
    for interval in run.missing("validation"):
        runner.play_until_good(interval, interval.index + 1, total)
        warm_up.moved()


def result_of(run: Run, dry_run: DryRunStage, warm_up: WarmUpStage, cycles: int) -> RunResult:
    """What was done, and where the campaign stands."""
    missing = {(one.kind, one.index) for one in run.missing()}

    def whole(kind: str) -> tuple[int, int]:
        total = [one for one in run.wanted if one.kind == kind]
        return sum((one.kind, one.index) not in missing for one in total), len(total)

    found = dry_run.found()
    return RunResult(
        campaign=str(run.folder.root),
        plan_hash=run.plan_hash,
        simulated=run.simulated,
        archives=tuple(run.archives),
        rejected=tuple(run.entering.rejected),
        adopted=tuple(run.entering.adopted),
        dry_run=dry_run.state,
        against_gravity=() if found is None else found.against_gravity,
        warm_up=warm_up.outcome,
        repetitions=whole("excitation"),
        validations=whole("validation"),
        complete=not missing,
        cycles=cycles,
        notes=(
            *run.notes,
            *(f"dry run: {warning}" for warning in (() if found is None else found.warnings)),
            *warm_up.notes,
            *run.entering.notes,
            *run.watch.troubles,
        ),
    )


def _moving(intervals: Sequence[Interval]) -> bool:
    """Whether the arm has to be warm for any of them."""
    return any(one.kind != "standstill" for one in intervals)


def _times(
    joined: Sequence[Interval], slow: int, moves: StraightMoves, approach_speed: float
) -> list[float]:
    """Seconds of each motion and way: slow are the first `slow`, and ways that nobody has seen."""
    times, first = [], slow > 0
    slow_way = min(1.0, OVERRIDE / approach_speed)
    for one in joined:
        share = OVERRIDE if slow else 1.0
        if one.kind == "move":
            unseen = one.from_arm if first else moves.unseen(one)
            share = slow_way if slow or unseen else 1.0
        elif slow:
            slow -= 1
        times.append(one.trajectory.duration / share)
    return times
