"""What `hil design` says of a motion that was found, and the picture it draws of it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from typing import Any

from hil import lines
from hil.cell import Cell
from hil.design.compare import References
from hil.design.findings import WEAK, margins, weakest
from hil.design.folder import DesignFolder
from hil.design.run import Designed
from hil.errors import InputError
from hil.plots import save
from hil.progress import Reporter


def say(reporter: Reporter, done: Designed) -> None:
    """Say what the criteria are and what stood in the way."""
    excitation, front = done.result.excitation, done.design.front
    broken = ", ".join(f"{kind} {count}" for kind, count in excitation.rejected.items())
    reporter.say(
        f"{excitation.tried} motions tried; broken constraints: {broken or 'none'}; "
        f"{len(front.log10_det)} on the front"
    )
    _say_condition(reporter, done)
    if (origin := done.result.polished_from) is not None:
        reporter.say(
            f"polished from log det {origin.log10_det:.2f}, I_c {origin.coupling_index:.2f}"
        )
    sines = done.result.settings.sines
    if sines is not None and sines.ramp == 0.0:
        reporter.say(
            "this motion begins and ends at full speed: no controller can run it; give it a ramp"
        )


def warn_of_unchecked(done: Designed, cell: Cell) -> None:
    """Say on stderr, however quiet it is to be, what was not looked at."""
    unchecked = done.result.settings.unchecked
    if unchecked:
        lines.say(
            f"warning: not looked at: {', '.join(unchecked)}; {cell.name} may refuse this motion",
            err=True,
        )


def line(done: Designed, folder: DesignFolder) -> str:
    """Return the one line that says how good the motion is."""
    excitation, n = done.result.excitation, done.result.n_parameters
    criteria = excitation.criteria
    return (
        f"log det {criteria.log10_det:.2f}, I_c {criteria.coupling_index:.2f} of "
        f"{n * (n - 1) // 2}, {excitation.trajectory.duration:.2f} s: {folder.result}"
    )


def summary(done: Designed, folder: DesignFolder) -> dict[str, Any]:
    """Return the same as data; what is no finite number is None."""
    excitation = done.result.excitation
    criteria = excitation.criteria
    return {
        "method": excitation.method,
        "seed": excitation.seed,
        "complete": done.design.complete,
        "exhausted": done.design.exhausted,
        "unchecked": list(done.result.settings.unchecked),
        "log10_det": _finite(criteria.log10_det),
        "coupling_index": _finite(criteria.coupling_index),
        "fitness": _finite(criteria.fitness),
        "condition": _finite(criteria.condition),
        "scaled_condition": _finite(criteria.scaled_condition),
        "duration": float(excitation.trajectory.duration),
        "tried": excitation.tried,
        "infeasible": dict(excitation.rejected),
        "front": len(done.design.front.log10_det),
        "file": str(folder.result),
        "picture": str(folder.picture),
    }


def say_campaign(
    reporter: Reporter, folder: DesignFolder, lacking: str | None, files: Sequence[str]
) -> None:
    """Say what comes next, or why the motion became no campaign."""
    if files:
        reporter.say(f"trajectory files in {folder.root}: {', '.join(files)}")
    elif lacking is None:
        root = shlex.quote(str(folder.root))
        reporter.say(f"{folder.root} is a campaign now; next: hil rehearse {root}")
    else:
        reporter.say(f"note: no campaign was made of it: {lacking}")


def campaign_summary(
    folder: DesignFolder, lacking: str | None, files: Sequence[str]
) -> dict[str, Any]:
    """Return the same as data."""
    campaign = str(folder.root) if lacking is None and not files else None
    return {"campaign": campaign, "no_campaign": lacking, "trajectories": [*files]}


def draw(
    folder: DesignFolder, done: Designed, cell: Cell, references: References, *, together: bool
) -> None:
    """Draw the picture; without it the design is as good."""
    from hil.plots.design_picture import draw_design  # loads the arm's shapes

    design, excitation = done.design, done.result.excitation
    front, origin = design.front, design.origin
    knee = None
    if design.chosen is None:
        knee = float(front.log10_det[origin]), float(front.coupling_index[origin])
    figure = draw_design(
        excitation,
        cell,
        front=front,
        chosen=design.chosen,
        knee=knee,
        references=references.measures,
        kinematic=references.kinematic,
        unchecked=done.result.settings.unchecked,
        complete=design.complete,
        together=together,
        margins=margins(cell, done.problem, excitation.trajectory),
        title=cell.name,
    )
    try:
        save(figure, folder.picture)
    except InputError as error:
        lines.say(f"warning: {error}; repeat with --resume to draw it again", err=True)


def _say_condition(reporter: Reporter, done: Designed) -> None:
    excitation = done.result.excitation
    raw, scaled = excitation.criteria.condition, excitation.criteria.scaled_condition
    if raw is None or scaled is None:
        return
    reporter.say(
        f"condition number of the regressor {raw:.0f}, {scaled:.1f} with columns of unit length"
    )
    if scaled > WEAK:
        names = ", ".join(weakest(done.problem.objective, excitation.trajectory))
        more = "via points" if done.result.settings.sines is None else "harmonics"
        reporter.say(
            f"this motion hardly tells apart {names}: take more {more}, allow a longer motion, "
            "search longer, or judge by other parameters ([objective] parameters)"
        )


def _finite(value: float | None) -> float | None:
    """JSON knows no infinity."""
    return value if value is not None and math.isfinite(value) else None
