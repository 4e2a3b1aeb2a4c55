"""Torque constants from a known load, simulated NS 16: `python -m benchmarks.gains --seeds 200`.

Loads, motions, noise and drifting friction are those of `benchmarks.payload`: one recording without
and one with the known load. Currents are torques of the joints by the planted constants.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.payload import DRIFT, arm_model, load_of, recordings_of, samples_of
from identification.estimators.current_gains import identify_gains
from identification.factor.columns import gain_factor
from identification.model.known_payload import Payload

Array = NDArray[np.float64]

PLANTED: Final = np.array([128.0, 128.0, 80.0, 18.0, 22.0, 14.0])
"""Torque per current on the joint side [N·m/A]."""


@dataclass(frozen=True)
class GainCoverage:
    """How well torque constants are estimated.

    Attributes:
        seeds: number of pairs of recordings.
        determined: share of the constants with a value.
        covered: of these, how often the 95 % interval held the truth.
        covered_by_motor: the same of each motor (6,).
        error: relative error, its root mean square.
        half_width: of each motor, the median of half its interval, relative (6,).
    """

    seeds: int
    determined: float
    covered: float
    covered_by_motor: list[float]
    error: float
    half_width: list[float]


def coverage(
    seeds: range,
    *,
    drift: float = DRIFT,
    duration: float = 16.0,
    other_motions: bool = False,
) -> GainCoverage:
    """Estimate the constants for the load of every seed."""
    model = arm_model()
    errors = []
    halves = []
    for seed in seeds:
        load = load_of(seed)
        xx, xy, xz, yy, yz, zz = load.inertia[np.triu_indices(3)].tolist()
        x, y, z = load.centre.tolist()
        weighed_payload = Payload(load.mass, (x, y, z), (xx, xy, xz, yy, yz, zz))
        recordings = recordings_of(
            seed,
            model.joint_names,
            (None, load),
            drift=drift,
            duration=duration,
            other_motions=other_motions,
        )
        factors = []
        for recording, payload in zip(recordings, (None, weighed_payload), strict=True):
            assert recording.torque is not None
            current = recording.torque / PLANTED
            samples = samples_of(recording, model)
            factors.append(gain_factor(model, samples, current, payload=payload))
        estimate = identify_gains(model, factors)
        errors.append(estimate.values / PLANTED - 1.0)
        halves.append(estimate.interval_factor * estimate.std / PLANTED)
    error = np.array(errors)
    half = np.array(halves)
    known_values = np.isfinite(error)
    inside = np.where(known_values, np.abs(error) <= half, np.nan)
    return GainCoverage(
        seeds=len(seeds),
        determined=float(known_values.mean()),
        covered=float(np.nanmean(inside)),
        covered_by_motor=np.nanmean(inside, axis=0).round(3).tolist(),
        error=float(np.sqrt(np.nanmean(error**2))),
        half_width=np.median(half, axis=0).round(4).tolist(),
    )


def main() -> None:
    """Print coverage and errors."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--drift", type=float, default=DRIFT, help="of friction, relative")
    parser.add_argument("--duration", type=float, default=16.0, help="of a recording, s")
    parser.add_argument("--other-motions", action="store_true", help="loaded by another motion")
    options = parser.parse_args()
    covered = coverage(
        range(options.seeds),
        drift=options.drift,
        duration=options.duration,
        other_motions=options.other_motions,
    )
    show(asdict(covered), only_json=options.json)


if __name__ == "__main__":
    main()
