"""What is known beside the fit: jumps of the encoders, nominal inertias, the controller's own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from identification.validation.evidence import Evidence
from identification.validation.findings.finding import Finding
from identification.validation.position_jumps import jump_findings
from identification.validation.thresholds import Thresholds


def jumps(_: Sequence[str], evidence: Evidence, __: Thresholds) -> Iterator[Finding]:
    """Positions that stepped where no arm can follow."""
    for finding in jump_findings(evidence.surroundings.jumps):
        yield replace(finding, role="cause")


def mended(_: Sequence[str], evidence: Evidence, __: Thresholds) -> Iterator[Finding]:
    """What was wrong with the recordings and is made good in what was fitted."""
    yield from evidence.surroundings.mended


def scale(_: Sequence[str], evidence: Evidence, __: Thresholds) -> Iterator[Finding]:
    """Torques that are not as large as the nominal inertias ask for."""
    found, causes = evidence.surroundings.nominal_scale, evidence.causes
    if found is None:
        return
    # Torques in another joint's column, or with the wrong sign, are not of the nominal size.
    explained = {j for one in causes.found for j in one.fault.joints} if causes else set()
    scale = found.scale.copy()
    scale[sorted(explained)] = np.nan
    for finding in replace(found, scale=scale).findings():
        yield replace(finding, role="cause")


def inertia(_: Sequence[str], evidence: Evidence, __: Thresholds) -> Iterator[Finding]:
    """The controller's own diagonal inertia against the model's."""
    found = evidence.surroundings.controller_inertia
    if found is not None:
        yield from found.findings()
