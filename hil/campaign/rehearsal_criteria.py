"""What a rehearsal is judged by, each criterion from the twin's archives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.errors import InputError
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import prepare_sources
from hil.identify.sources import gather_sources
from hil.progress import Reporter
from identification.errors import IdentificationError
from identification.quantiles import normal_limit
from identification.recording import RecordingError
from identification.validation import over_all, prediction_error

from .folder import CampaignFolder
from .rehearsal import Criterion
from .rehearsal_twin import Twin

Array = NDArray[np.float64]

MOST_SIGMA: Final = 4.0
"""Standard deviations that an estimate may lie from what was planted."""
MOST_ERROR: Final = 1.2
"""Error on unseen motion, as a multiple of what the planted parameters themselves leave."""
SATURATED: Final = 0.99
"""Share of it from which a motor counts as saturated."""
_NAMED: Final = 3


@dataclass(frozen=True)
class Ran:
    """How the motions went on one twin.

    Attributes:
        name: of the run, in words.
        failures: what went wrong, in sentences.
    """

    name: str
    failures: tuple[str, ...]


def of_motions(ran: Ran) -> Criterion:
    """Every motion was accepted, and none refused, lost or stopped."""
    good = not ran.failures
    return Criterion(
        name=f"motions ({ran.name})",
        value=float(len(ran.failures)),
        bound=0.0,
        passed=good,
        sentence=(
            f"{ran.name}: every motion ran to its end, none was refused by the guard or tripped"
            if good
            else f"{ran.name}: {'; '.join(ran.failures)}"
        ),
    )


def of_currents(twin: Twin, folder: CampaignFolder, name: str, bound: float) -> Criterion:
    """The largest current of any motor, as a share of its limit."""
    worst, motor, where = 0.0, 0, ""
    limit = twin.cell.drive_train.current_limit
    for entry in folder.manifest():
        current = np.abs(open_archive(folder.archives / entry.name).columns["target_current"])
        share = np.nan_to_num(current).max(axis=0, initial=0.0) / limit
        if share.max() > worst:
            worst, motor, where = float(share.max()), int(share.argmax()), entry.name
    return Criterion(
        name=f"current ({name})",
        value=worst,
        bound=bound,
        passed=worst <= bound,
        sentence=f"{name}: the largest current is {worst:.0%} of its limit (motor of "
        f"{twin.cell.joint_names[motor]}, {where}), at most {bound:.0%} is wanted",
    )


def of_estimate(
    twin: Twin, folder: CampaignFolder, reporter: Reporter
) -> tuple[Criterion, Criterion, Criterion]:
    """What identification makes of the archives: determined, found again, predicting."""
    paths = [
        path
        for kind in ("excitation", "validation", "standstill")
        for path in folder.completed(kind)
    ]
    options = FIXED
    try:
        prepared = prepare_sources(gather_sources(paths, options.split), options, reporter)
        estimation = estimate_with(prepared, options, reporter)
    except (InputError, IdentificationError, RecordingError) as error:
        return _unjudged(str(error))
    model, found = twin.cell.model, estimation.result.pooled
    factor = found.interval_factor / normal_limit(0.025)
    ours, theirs = (
        over_all(prediction_error(model, values, prepared.held_out)).rms
        for values in (found.values, twin.truth)
    )
    return (
        _determined(found.undetermined),
        _found_again(found.names, (found.values - twin.truth) / (factor * found.std)),
        _predicting(twin.cell.joint_names, ours / np.maximum(theirs, np.finfo(np.float64).tiny)),
    )


def _unjudged(why: str) -> tuple[Criterion, Criterion, Criterion]:
    def missing(name: str, bound: float) -> Criterion:
        sentence = f"{name}: cannot be told, for nothing can be identified ({why})"
        return Criterion(name=name, value=None, bound=bound, passed=False, sentence=sentence)

    return (
        missing("excitation", 0.0),
        missing("parameters", MOST_SIGMA),
        missing("unseen motion", MOST_ERROR),
    )


def _determined(undetermined: Sequence[str]) -> Criterion:
    count = len(undetermined)
    return Criterion(
        name="excitation",
        value=float(count),
        bound=0.0,
        passed=count == 0,
        sentence=(
            "the excitation determines every parameter"
            if count == 0
            else f"the excitation says nothing about {count} parameters "
            f"({_some(undetermined)}): design a motion that moves every joint"
        ),
    )


def _found_again(names: Sequence[str], apart: Array) -> Criterion:
    """`apart`: of each parameter from what was planted, in standard deviations (p,)."""
    known = np.isfinite(apart)
    if not known.any():
        return _unjudged("no parameter has a standard deviation")[1]
    distance = np.where(known, np.abs(apart), 0.0)
    beyond = [names[i] for i in np.argsort(-distance) if distance[i] > MOST_SIGMA]
    worst = float(distance.max())
    return Criterion(
        name="parameters",
        value=worst,
        bound=MOST_SIGMA,
        passed=not beyond,
        sentence=(
            f"all {int(known.sum())} parameters were found within {worst:.1f} standard deviations "
            f"of what was planted, {MOST_SIGMA:g} are allowed"
            if not beyond
            else f"{len(beyond)} of {int(known.sum())} parameters ({_some(beyond)}) are more than "
            f"{MOST_SIGMA:g} standard deviations, up to {worst:.3g}, from what was planted: the "
            "drive train or the model of the cell file is not that of the arm"
        ),
    )


def _predicting(joints: Sequence[str], ratio: Array) -> Criterion:
    """`ratio`: error on unseen motion over that of the planted parameters (n,)."""
    worst = int(np.nanargmax(ratio)) if np.isfinite(ratio).any() else 0
    value = float(ratio[worst])
    passed = bool(np.isfinite(ratio).all()) and value <= MOST_ERROR
    found = (
        f"on unseen motion the torque error is {value:.2f} times what noise leaves "
        f"({joints[worst]}), at most {MOST_ERROR:g} is wanted"
    )
    remedy = ": the excitation teaches too little; search a better one (`hil design`)"
    return Criterion(
        name="unseen motion",
        value=value if np.isfinite(value) else None,
        bound=MOST_ERROR,
        passed=passed,
        sentence=found if passed else found + remedy,
    )


def _some(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
