"""Evidence and verdict as they go into `results.json`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.results import FindingResult, JointJudgement, JudgementResult, ProfileResult
from identification.errors import IdentificationError
from identification.validation.evidence import Evidence
from identification.validation.residual_profile import Profile
from identification.validation.verdict import Verdict

Array = NDArray[np.float64]

# Points of an autocorrelation that a figure needs.
_LAGS: Final = 150


def judgement_result(
    joint_names: Sequence[str], evidence: Evidence, verdict: Verdict, *, nominal: str | None = None
) -> JudgementResult:
    """What the verdict rests on.

    Args:
        joint_names: (n,).
        evidence: what was found.
        verdict: on it.
        nominal: what the nominal model is, in words.

    Raises:
        IdentificationError: the residuals were not checked.
    """
    checks = evidence.residuals
    if checks is None:
        raise IdentificationError("the evidence holds no checks of the residuals")
    colour, drift = checks.colour, checks.drift
    step = max(1, -(-len(colour.lag) // _LAGS))
    return JudgementResult(
        in_sample=evidence.in_sample,
        nominal=None if evidence.nominal is None else nominal,
        findings=[
            FindingResult(
                check=finding.check,
                level=finding.level,
                words=finding.words,
                next_step=finding.next_step,
            )
            for finding in verdict.findings
        ],
        next_steps=list(verdict.next_steps),
        joints=_joints(joint_names, evidence),
        speed=_profiles(checks.speed),
        position=_profiles(checks.position),
        lag=colour.lag[::step].tolist(),
        autocorrelation=[_each(column) for column in colour.correlation[::step].T],
        effective_rows=np.nan_to_num(colour.effective_rows).tolist(),
        friction_over_time=None if drift is None else [_each(row) for row in drift.share.T],
    )


def _joints(joint_names: Sequence[str], evidence: Evidence) -> list[JointJudgement]:
    error, nominal = evidence.held_out, evidence.nominal
    controller, limit = evidence.surroundings.controller, evidence.surroundings.torque_limit
    explained, relative = error.explained, error.relative
    scale = evidence.surroundings.nominal_scale
    inertia = evidence.surroundings.controller_inertia
    return [
        JointJudgement(
            joint=name,
            unit="N·m" if evidence.revolute(j) else "N",
            rms=float(error.rms[j]),
            relative=_known(relative, j),
            fitted_relative=_known(evidence.training.relative, j),
            explained=_known(explained, j),
            limit=_known(limit, j),
            share_of_limit=_known(evidence.share_of_limit, j),
            nominal_relative=None if nominal is None else _known(nominal.relative, j),
            controller_relative=None if controller is None else _known(controller.relative, j),
            nominal_scale=None if scale is None else _known(scale.scale, j),
            controller_inertia=None if inertia is None else _known(inertia.ratio, j),
            controller_inertia_spread=None if inertia is None else _known(inertia.spread, j),
        )
        for j, name in enumerate(joint_names)
    ]


def _known(values: Array | None, index: int) -> float | None:
    return None if values is None or np.isnan(values[index]) else float(values[index])


def _each(values: Array) -> list[float | None]:
    return [_known(values, index) for index in range(len(values))]


def _profiles(profile: Profile) -> list[ProfileResult]:
    return [
        ProfileResult(centre=centre.tolist(), mean=_each(mean), std=_each(std))
        for centre, mean, std in zip(
            profile.centres, profile.bins.mean, profile.bins.std, strict=True
        )
    ]
