"""The estimate of a campaign uses its valid archives, and agrees with that without faults.

Parameters are compared by `tests.laws.estimates`. Their degrees of freedom are few, since standard
deviations come from some blocks of residuals. If nothing changed what is measured, the torques that
both models predict for the motion are compared as well. From m samples with white noise of standard
deviation r, the predictions of models with p parameters differ by r sqrt(2 p / m) (rms); correlated
residuals are in both covariances. `ALLOWED` times both together is the limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification import RobotModel, Samples
from tests.faults import DISTURBS_THE_ARM, kind_of
from tests.laws.estimates import alike
from tests.laws.manifests import WANTED, manifest_of, parsed
from tests.simulate.observed import Estimated, Observed

Array = NDArray[np.float64]

ALLOWED: Final = 5.0
"""About 1 is to be expected; the largest of some 200 seeds with a calm arm is 1.9."""


def _changes_records(line: str) -> bool:
    """Return whether a fault may change what is recorded, as a plausible corrupt packet does."""
    kind = kind_of(line)
    return kind in DISTURBS_THE_ARM or (kind == "corrupt" and "to_controller" not in line)


def estimate(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    estimated = observed.found
    twin = observed.twin_found
    if estimated is not None:
        yield from _pooled(observed)
    if estimated is not None and twin is not None:
        disturbed = any(map(_changes_records, observed.struck))
        yield from alike(estimated.result.pooled, twin.result.pooled)
        if not disturbed:
            yield from _predicted_alike(estimated, twin)


def _pooled(observed: Observed) -> Iterator[str]:
    """The estimate uses each completed archive once, and no other."""
    entries = manifest_of(observed.folder)[1]
    good = {e.name for e in entries if e.outcome == "completed" and e.unchanged}
    wanted = {name for name in good if parsed(name)[0] in WANTED}
    pooled = observed.pooled
    for name in pooled:
        if name not in good:
            yield f"{name} was pooled although it is not valid"
    if len({*pooled}) < len(pooled):
        yield "an archive was pooled twice"
    if left_out := wanted - {*pooled}:
        yield f"{', '.join(sorted(left_out))} are valid and were not pooled"


def _predicted_alike(estimated: Estimated, twin: Estimated) -> Iterator[str]:
    ours = estimated.result.pooled
    theirs = twin.result.pooled
    if ours.names != theirs.names:
        return
    determined = ~np.isin(ours.names, [*ours.undetermined, *theirs.undetermined])
    change = np.where(determined, ours.values - theirs.values, 0.0)
    scatter = np.where(np.outer(determined, determined), ours.covariance + theirs.covariance, 0.0)
    variances, directions = np.linalg.eigh(scatter)
    deviations = (directions * np.sqrt(np.maximum(variances, 0.0))).T
    noise = np.minimum(ours.noise_std, theirs.noise_std)
    white = noise * np.sqrt(2.0 * len(change) / np.minimum(ours.samples, theirs.samples))
    for number, samples in enumerate(estimated.fitted):
        apart = _rms(samples, estimated.model, change)
        stated = np.linalg.norm(
            [_rms(samples, estimated.model, deviation) for deviation in deviations], axis=0
        )
        allowed = ALLOWED * np.hypot(white, stated)
        for joint in np.flatnonzero(apart > allowed):
            yield (
                f"joint {joint + 1}, repetition {number}: predicted torques differ from those of "
                f"the undisturbed run by {apart[joint]:.2g} (rms), {allowed[joint]:.2g} are allowed"
            )


def _rms(samples: Samples, model: RobotModel, values: Array) -> Array:
    """Return the rms torque of these parameters (n,) over usable samples."""
    torque = np.where(samples.usable, samples.predicted_torque(model, values), np.nan)
    return np.asarray(np.sqrt(np.nanmean(torque**2, axis=0)))
