"""What a verdict rests on, as plain numbers: a section of `results.json`.

Per-joint lists follow `Results.joint_names`; null stands for what was not seen or is not known.
"""

from __future__ import annotations

from typing import Literal

from hil.results.frozen import Frozen


class FindingResult(Frozen):
    """One check and its outcome."""

    check: str
    level: Literal["good", "information", "doubtful", "wrong"]
    words: str
    next_step: str
    """What to do about it; empty where nothing needs doing."""


class JointJudgement(Frozen):
    """One joint on unseen motion; on that of the fit where `JudgementResult.in_sample`."""

    joint: str
    unit: Literal["N·m", "N"]
    rms: float
    """Root mean square of the torque error, in `unit`."""
    relative: float | None
    """||e|| / ||tau||."""
    fitted_relative: float | None = None
    """The same on the motion that was fitted."""
    explained: float | None
    """Share of the torque's variance that is explained (R²): zero is no better than a constant."""
    limit: float | None
    """Largest torque of the joint, in `unit`; of the drive, or the URDF's effort limit."""
    share_of_limit: float | None
    """RMS error over `limit`."""
    nominal_relative: float | None
    """||e|| / ||tau|| of the nominal (CAD) model on the same motion."""
    controller_relative: float | None
    """The same of the controller's own dynamic model."""
    nominal_scale: float | None = None
    """Measured torque over what the nominal inertias ask for, friction set aside."""
    controller_inertia: float | None = None
    """The controller's own diagonal inertia (joint side, rotor included) over the identified one:
    median over the recorded postures."""
    controller_inertia_spread: float | None = None
    """Standard deviation of that ratio over the postures."""


class ProfileResult(Frozen):
    """Mean residual of one joint over bins of its speed or position, all recordings."""

    centre: list[float]
    mean: list[float | None]
    std: list[float | None]
    """Standard error that allows for the residual's correlation in time."""


class JudgementResult(Frozen):
    """Every check, the figures per joint, and what the residual follows."""

    in_sample: bool = False
    """Whether nothing was held out: all figures are of the fitted motion then."""
    nominal: str | None = None
    """What `JointJudgement.nominal_relative` is of, in words."""
    findings: list[FindingResult]
    next_steps: list[str]
    joints: list[JointJudgement]
    speed: list[ProfileResult]
    """Over rad/s or m/s."""
    position: list[ProfileResult]
    """Over rad or m."""
    lag: list[float]
    """Of `autocorrelation`, s."""
    autocorrelation: list[list[float | None]]
    """Of each joint's residual."""
    effective_rows: list[float]
    """Independent samples that each joint's rows are worth."""
    friction_over_time: list[list[float | None]] | None
    """Per joint: share by which friction was higher than estimated, in the order of recording."""

    @property
    def worst_first(self) -> list[FindingResult]:
        """Findings with the worst first, otherwise in the order of the checks."""
        levels = ("wrong", "doubtful", "information", "good")
        return sorted(self.findings, key=lambda finding: levels.index(finding.level))

    def any_joint(self, figure: str) -> bool:
        """Whether a figure of :class:`JointJudgement` is known of any joint."""
        return any(getattr(joint, figure) is not None for joint in self.joints)
